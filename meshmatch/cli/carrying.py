"""What all the verbs share that carry something from one shape to another: arguments, the map, the words."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from meshmatch.cli import options
from meshmatch.cli.console import Console

if TYPE_CHECKING:
    from meshmatch.maps.vertex_map import VertexMap
    from meshmatch.pipeline import MatchResult
    from meshmatch.render.compose import Composition
    from meshmatch.shapes.shape import Shape
    from meshmatch.transfer.low_confidence import LowConfidence

Source = Annotated[Path, typer.Argument(metavar="SRC", help="The shape that has it.")]
Target = Annotated[Path, typer.Argument(metavar="TGT", help="The shape that gets it.")]
MapOption = Annotated[
    Path | None,
    typer.Option(
        "--map",
        metavar="MAP",
        help="A map from SRC to TGT that `meshmatch match SRC TGT` wrote. Without it the two are matched.",
    ),
]
Fill = Annotated[
    bool, typer.Option("--fill", help="Fill in from the neighbours where the confidence is too low.")
]
Blank = Annotated[
    str | None,
    typer.Option(metavar="VALUE", help="What to write where the confidence is too low. Kept if not given."),
]
Least = Annotated[
    float,
    typer.Option("--min-confidence", min=0.0, max=1.0, help="The confidence below which it is too low."),
]
Picture = Annotated[
    Path | None,
    typer.Option(metavar="PNG", help="Draw what was carried, on SRC and on TGT."),
]
LEAST = 0.3


@dataclass(frozen=True)
class Request:
    """The words of the user that say how two shapes are matched."""

    source: Path
    target: Path
    map: Path | None
    model: str
    refine: options.Refine
    seed: int
    up: options.Axis | None
    front: options.Axis | None
    strict: bool
    threads: int

    @property
    def names(self) -> tuple[str, str]:
        """Names to show: those of the files, with their folders where they are the same."""
        a, b = self.source, self.target
        return (a.name, b.name) if a.name != b.name else (str(a), str(b))


@dataclass(frozen=True)
class Maps:
    """The two maps between SRC and TGT, and the match that they come from if it was none from a file."""

    back: "VertexMap"
    forward: "VertexMap"
    match: "MatchResult | None" = None


def check_request(request: Request, fill: bool = False, blank: str | None = None) -> None:
    """Refuse what does not go together (`OptionError`)."""
    from meshmatch.errors import OptionError

    options.check_axes(request.up, request.front)
    if fill and blank is not None:
        raise OptionError("--fill and --blank contradict each other", "choose one of them")
    if request.map is not None:
        for name in ("up", "front"):
            if getattr(request, name) is not None:
                raise OptionError(
                    f"--{name} is for matching, and --map says the match", "leave one of them out"
                )


@contextmanager
def output_file(request: Request, output: Path, inputs: list[Path | None]) -> Iterator[Path]:
    """A temporary path for the output, which replaces it when all went well; no input is ever replaced."""
    from meshmatch.cli.output_paths import check_apart
    from meshmatch.models.registry import locate_model
    from meshmatch.outputs import replace_on_success

    check_apart([output], [request.source, request.target, request.map, *inputs])
    with replace_on_success(output) as temporary:
        if request.map is None:
            locate_model(request.model)  # a mistyped name is told before the long work
        yield temporary


def check_picture(request: Request, picture: Path | None, others: list[Path | None]) -> None:
    """Refuse a picture that is not a PNG, cannot be written, or would replace a file of this command: before the work."""
    from meshmatch.cli.output_paths import check_apart, check_png, check_writable

    check_apart([picture], [request.source, request.target, request.map, *others])
    check_png(picture)
    check_writable(picture)


def draw(
    request: Request,
    voice: Console,
    picture: Path | None,
    shapes: "tuple[Shape, Shape]",
    maps: Maps,
    shown: "Composition",
) -> None:
    """Draw what was carried along `maps` between the two shapes."""
    from meshmatch.outputs import replace_on_success
    from meshmatch.render.facing import same_side

    if picture is None:
        return
    found = maps.match
    turns = (
        (None, None) if found is None else (found.source_fit.frame.rotation, found.target_fit.frame.rotation)
    )
    with replace_on_success(picture) as temporary:
        shown.rotated(same_side(*shapes, maps.forward, turns)).named(request.names).render(temporary)
    voice.say(f"drew {picture}: what was carried, on both shapes")


def find_maps(request: Request, voice: Console, source: "Shape", target: "Shape") -> Maps:
    """The maps both ways, from the file or by matching; what was found is said, and judged if ``strict``."""
    from meshmatch.errors import PoorFit

    result = _from_file(request, source, target) or _by_matching(request, voice, source, target)
    found = result.forward
    why = "; ".join(found.reasons) or "no reason was given"
    if request.strict and found.verdict == "poor":
        hint = "is it the model's category? try --up and --front, or leave out --strict to look at it"
        raise PoorFit(f"poor fit, nothing was written: {why}", hint)
    _tell(request, voice, result)
    if found.verdict == "poor":
        voice.warn(f"the fit is poor: {why}")
    elif found.verdict != "good":
        for reason in found.reasons:
            voice.say(f"note: {reason}")
    return result


def _from_file(request: Request, source: "Shape", target: "Shape") -> Maps | None:
    """Without the pipeline, which takes seconds to load."""
    if request.map is None:
        return None
    from meshmatch.maps.files import load_map
    from meshmatch.transfer.inverse_map import invert_map

    forward = load_map(request.map, source, target)
    return Maps(invert_map(forward, source, target, request.threads), forward)


def _by_matching(request: Request, voice: Console, source: "Shape", target: "Shape") -> Maps:
    from meshmatch import pipeline

    with voice.progress() as report:
        result = pipeline.carry(
            source,
            target,
            model=request.model,
            refine=request.refine,
            seed=request.seed,
            up=request.up,
            front=request.front,
            workers=request.threads,
            progress=report,
        )
    return Maps(result.back, result.forward, result.match)


def _tell(request: Request, voice: Console, result: Maps) -> None:
    a, b = request.names
    if result.match is None:
        voice.say(f"used the map {request.map} from {a} to {b}")
        return
    for note in result.match.notes:
        voice.say(note)
    for name, fit in zip((a, b), (result.match.source_fit, result.match.target_fit), strict=True):
        voice.say(f"{name}: {fit.verdict} fit, up {fit.up}, front {fit.front}")
    voice.say(f"matched {a} to {b} ({result.match.seconds:.1f} s)")


def map_record(request: Request, result: Maps, used: "VertexMap") -> dict[str, Any]:
    """What --json says of the map; `used` is the one along which things were carried."""
    a, b = request.names
    record: dict[str, Any] = {
        "source": a,
        "target": b,
        "source_vertices": result.forward.source_vertices,
        "target_vertices": result.forward.target_vertices,
        "map": None if request.map is None else str(request.map),
        "verdict": result.forward.verdict,
        "reasons": list(result.forward.reasons),
        "confidence_mean": float(used.confidence.mean()),
    }
    if result.match is not None:
        choices = {"model": request.model, "refine": request.refine, "seed": request.seed}
        record |= choices | {"notes": list(result.match.notes), "seconds": round(result.match.seconds, 3)}
    return record


def tell_doubt(voice: Console, doubt: "LowConfidence", least: float, what: str = "vertices") -> None:
    """How much was in doubt, and what became of it, in words."""
    if not doubt.low:
        return
    share = 100.0 * doubt.low / doubt.total
    parts = [
        (doubt.filled, "filled in from their neighbours"),
        (doubt.blank, "left blank"),
        (doubt.low - doubt.filled - doubt.blank, "kept as they came"),
    ]
    became = ", ".join(f"{count} {words}" for count, words in parts if count > 0)
    voice.say(
        f"{share:.1f} % of the {what} ({doubt.low} of {doubt.total}) have nothing to take over, or less "
        f"confidence than {least:g}: {became}"
    )


def doubt_record(doubt: "LowConfidence", least: float) -> dict[str, Any]:
    """The same for --json."""
    return {
        "min_confidence": least,
        "low_confidence": doubt.low,
        "low_confidence_share": doubt.low / doubt.total,
        "blank": doubt.blank,
        "filled": doubt.filled,
    }
