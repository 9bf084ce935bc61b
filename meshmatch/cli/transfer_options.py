"""What the verbs share that take something from one shape to another: the map, the picture, the words."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from meshmatch.cli import words
from meshmatch.cli.console import Console, Json
from meshmatch.cli.options import PAIRS_HELP, PairOptions, RunOptions
from meshmatch.cli.output_paths import check_distinct, check_png, check_writable
from meshmatch.errors import OptionError

if TYPE_CHECKING:
    from meshmatch.api.results import MapPair, MatchResult
    from meshmatch.render.compose import Composition
    from meshmatch.shapes.shape import Shape
    from meshmatch.transfer.low_confidence import LowConfidence

Source = Annotated[Path, typer.Argument(metavar="SRC", help="Shape to transfer from.")]
Target = Annotated[Path, typer.Argument(metavar="TGT", help="Shape to transfer to.")]
Picture = Annotated[Path | None, typer.Option(metavar="PNG", help="Draw both shapes with what was transferred.")]


@dataclass(frozen=True)
class MapOptions(PairOptions):
    """A map from a file, or how the shapes are matched."""

    map: Annotated[
        Path | None,
        typer.Option(
            "--map", metavar="MAP", help="Map from SRC to TGT that `meshmatch match` wrote. Default: match them."
        ),
    ] = None


@dataclass(frozen=True)
class MapOptionsWithPairs(MapOptions):
    """The same for a verb whose --landmarks are what it transfers."""

    known_pairs: Annotated[Path | None, typer.Option("--pairs", metavar="FILE", help=PAIRS_HELP)] = None


@dataclass(frozen=True)
class ViewMapOptions(MapOptions):
    """The same for the viewer, where the axes also say how a shape stands."""

    @property
    def given(self) -> list[str]:
        return [name for name in super().given if name not in ("--up", "--front")]


@dataclass(frozen=True)
class Transfer:
    """One transfer between two files: calling it with the loaded shapes finds the maps and says so."""

    source: Path
    target: Path
    options: MapOptions
    run: RunOptions
    console: Console

    @property
    def names(self) -> list[str]:
        """Names to show."""
        return words.names_of([self.source, self.target])

    @contextmanager
    def outputs(
        self, outputs: Sequence[Path], inputs: Sequence[Path | None], picture: Path | None = None
    ) -> Iterator[list[Path]]:
        """Temporary paths that become the outputs when all went well; what cannot be written is told before the work."""
        from meshmatch.models.registry import locate_model
        from meshmatch.outputs import replace_on_success

        self.options.check()
        if self.options.map is not None and self.options.given:
            raise OptionError(
                f"{self.options.given[0]} is for matching, and --map gives the match", "leave one of them out"
            )
        check_distinct([*outputs, picture], [self.source, self.target, self.options.map, *inputs])
        check_png(picture)
        check_writable(picture)
        with ExitStack() as claims:  # the first is renamed last: it names the others
            temporary = [claims.enter_context(replace_on_success(output)) for output in outputs]
            if self.options.map is None:
                locate_model(self.options.model)  # a mistyped name is told before the long work
            yield temporary

    def __call__(self, source: Shape, target: Shape) -> MapPair:
        """The maps, from the file or by matching; judged if --strict was given."""
        from meshmatch.api.maps import find_maps

        maps = find_maps(source, target, self.options.map or self._match)
        found = maps.forward
        words.refuse_poor(self.run.strict, found.verdict, found.reasons)
        a, b = self.names
        if maps.match is None:
            self.console.say(f"used the map {self.options.map} from {a} to {b}")
        else:
            words.tell_match(self.console, maps.match, (a, b))
            self.console.say(f"matched {a} to {b} ({maps.match.seconds:.1f} s)")
        words.tell_verdict(self.console, found.verdict, found.reasons)
        return maps

    def _match(self, source: Shape, target: Shape) -> MatchResult:
        from meshmatch.api.matching import match

        with self.console.progress() as report:
            return match(
                source,
                target,
                model=self.options.model,
                config=self.options.configs(),
                landmarks=self.options.pairs(),
                threads=self.run.threads,
                progress=report,
            )

    def draw(self, picture: Path | None, maps: MapPair, shown: Composition) -> None:
        """Draw what was transferred, on both shapes, if a picture was asked for."""
        from meshmatch.outputs import replace_on_success
        from meshmatch.render.facing import same_side

        if picture is None:
            return
        turns = same_side(maps.source, maps.target, maps.forward, maps.rotations)
        with replace_on_success(picture) as temporary:
            shown.rotated(turns).named(self.names).render(temporary)
        self.console.say(f"drew {picture}: both shapes with what was transferred")

    def record(self, maps: MapPair, confidence: float) -> Json:
        """What --json says of the map."""
        record = words.map_record(maps.forward, self.names) | {
            "map": None if self.options.map is None else str(self.options.map),
            "confidence_mean": confidence,
        }
        if maps.match is not None:
            seconds = round(maps.match.seconds, 3)
            record |= self.options.record | {"notes": list(maps.match.notes), "seconds": seconds}
        return record


def tell_low(console: Console, low: LowConfidence, minimum: float, what: str = "vertices") -> None:
    """How many values are not trusted, and what became of them."""
    if not low.low:
        return
    parts = [
        (low.filled, "filled in from their neighbours"),
        (low.blank, "left blank"),
        (low.low - low.filled - low.blank, "kept as they are"),
    ]
    became = ", ".join(f"{count} {done}" for count, done in parts if count > 0)
    console.say(
        f"{100.0 * low.low / low.total:.1f} % of the {what} ({low.low} of {low.total}) have no value to take, or "
        f"less confidence than {minimum:g}: {became}"
    )


def low_record(low: LowConfidence, minimum: float) -> Json:
    """The same for --json."""
    return {
        "min_confidence": minimum,
        "low_confidence": low.low,
        "low_confidence_share": low.low / low.total,
        "blank": low.blank,
        "filled": low.filled,
    }
