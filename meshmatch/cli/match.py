"""``meshmatch match`` and ``meshmatch register``."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from meshmatch.cli import options
from meshmatch.cli.console import Console, print_json
from meshmatch.cli.output_paths import check_apart, check_png, claimed

if TYPE_CHECKING:
    from meshmatch.fitting.fit import Fit
    from meshmatch.pipeline import MatchResult


def match(
    source: options.Source,
    target: options.Target,
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="MAP",
            help="Where the map goes; the suffix chooses the format: .npy .npz .csv .txt .mat .json.",
        ),
    ],
    model: options.Model = "human",
    refine: options.RefineOption = "nodes",
    up: options.Up = None,
    front: options.Front = None,
    partial: options.PartialFlag = None,
    landmarks: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Known pairs to honour: a source vertex and a target vertex a line, counted from 0.",
        ),
    ] = None,
    picture: Annotated[
        Path | None,
        typer.Option(metavar="PNG", help="Draw both shapes, matched places in one colour."),
    ] = None,
    seed: options.Seed = 0,
    strict: options.Strict = False,
    json: options.Json = False,
    threads: options.Threads = 2,
    quiet: options.Quiet = False,
) -> None:
    """Match every vertex of one shape to another.

    The two files may differ in vertex count, unit, up axis and facing. In the map, index[i] is the vertex of
    the target matched to vertex i of the source; vertices are counted from 0, in the order of the files.
    """
    from meshmatch.threads import set_threads

    set_threads(1)  # before NumPy reads it: the two fits run side by side, one thread each
    from meshmatch.errors import PoorFit
    from meshmatch.maps.files import check_suffix, save_map
    from meshmatch.maps.pairs import load_pairs
    from meshmatch.models.registry import locate_model
    from meshmatch.outputs import replace_on_success
    from meshmatch.shapes.files import load_shape

    options.check_axes(up, front)
    check_suffix(output)
    check_png(picture)
    check_apart([output, picture], [source, target, landmarks])
    voice = Console(quiet)
    names = _apart(source, target)
    # Outputs that cannot be written, a mistyped model and broken files are told before the long work.
    with claimed(picture) as drawing:
        with replace_on_success(output) as temporary:
            locate_model(model)
            shapes = load_shape(source), load_shape(target)
            pairs = None if landmarks is None else load_pairs(landmarks)
            from meshmatch import pipeline

            with voice.progress() as report:
                result = pipeline.match(
                    *shapes,
                    model=model,
                    refine=refine,
                    seed=seed,
                    up=up,
                    front=front,
                    partial=options.partial_choice(partial),
                    landmarks=pairs,
                    workers=threads,
                    progress=report,
                )
            found = result.map
            if strict and found.verdict == "poor":
                raise PoorFit(f"poor fit, nothing was written: {_why(found.reasons)}", _HINT)
            save_map(temporary, found)
        if drawing is not None:
            from meshmatch.render.compose import compose_match

            rotations = result.source_fit.frame.rotation, result.target_fit.frame.rotation
            compose_match(*shapes, found, rotations).named(names).render(drawing)
    _tell_match(voice, result, names, output)
    if picture is not None:
        voice.say(f"drew {picture}: matched places have one colour")
    if json:
        choices = {"model": model, "refine": refine, "seed": seed}
        files = {"output": str(output), "picture": None if picture is None else str(picture)}
        print_json(files | _match_record(result, names) | choices)


def register(
    shape: Annotated[Path, typer.Argument(metavar="SHAPE", help="The shape on which the template is laid.")],
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="MESH",
            help="Where the fitted template goes, in the frame and unit of SHAPE: .ply .obj .off .stl .glb.",
        ),
    ],
    model: options.Model = "human",
    refine: options.RefineOption = "nodes",
    up: options.Up = None,
    front: options.Front = None,
    partial: options.PartialFlag = None,
    dense: Annotated[
        bool, typer.Option("--dense", help="Write the template in its full resolution.")
    ] = False,
    picture: Annotated[
        Path | None,
        typer.Option(metavar="PNG", help="Draw the template over the shape, the distance as heat."),
    ] = None,
    seed: options.Seed = 0,
    strict: options.Strict = False,
    json: options.Json = False,
    threads: Annotated[
        int, typer.Option(min=1, help="How many threads to use; more than 1 may change the last bits.")
    ] = 1,
    quiet: options.Quiet = False,
) -> None:
    """Lay the model's template on one shape.

    Whatever shape it was laid on, the result has the same vertices and triangles in the same order.
    """
    from meshmatch.threads import set_threads

    set_threads(threads)
    import numpy as np

    from meshmatch.errors import PoorFit
    from meshmatch.models.registry import locate_model
    from meshmatch.outputs import replace_on_success
    from meshmatch.shapes.files import load_shape, save_shape
    from meshmatch.shapes.shape import Shape

    options.check_axes(up, front)
    check_png(picture)
    check_apart([output, picture], [shape])
    voice = Console(quiet)
    with claimed(picture) as drawing:
        with replace_on_success(output) as temporary:
            speck = Shape(np.eye(3), np.array([[0, 1, 2]]))
            save_shape(temporary, speck)  # a suffix that cannot be is told now
            locate_model(model)
            loaded = load_shape(shape)
            from meshmatch import pipeline

            with voice.progress() as report:
                fit = pipeline.register(
                    loaded,
                    model=model,
                    refine=refine,
                    seed=seed,
                    up=up,
                    front=front,
                    partial=options.partial_choice(partial),
                    progress=report,
                )
            if strict and fit.verdict == "poor":
                raise PoorFit(f"poor fit, nothing was written: {_why(fit.reasons)}", _HINT)
            fitted = Shape(fit.points_in_file, fit.faces, output.stem)
            if dense:
                from meshmatch.fitting.dense import dense_shape

                fitted = dense_shape(pipeline.read_model(model), fit)
            save_shape(temporary, fitted)
        if drawing is not None:
            from meshmatch.render.compose import compose_fit

            compose_fit(loaded, fitted, fit.frame.rotation).render(drawing)
    notes = [f"{loaded.name}: {note}" for note in pipeline.usable(loaded).notes]
    notes += pipeline.refine_notes(pipeline.read_model(model), refine)
    for note in notes:
        voice.say(note)
    voice.say(f"laid the template of {model} on {loaded.name}: {_fit_words(fit)}")
    _warn(voice, fit.verdict, fit.reasons)
    voice.say(f"wrote {output}: {fitted.V} vertices, {fitted.F} faces ({fit.seconds:.1f} s)")
    if picture is not None:
        voice.say(f"drew {picture}: the template over the shape, and how far apart they are")
    if json:
        files = {"output": str(output), "picture": None if picture is None else str(picture)}
        size = {"vertices": fitted.V, "faces": fitted.F}
        choices = {"model": model, "refine": refine, "dense": dense}
        print_json(files | size | choices | _fit_record(loaded.name, fit) | {"notes": notes})


_HINT = "is it the model's category? try --up and --front, --landmarks, or leave out --strict to look at it"


def _apart(source: Path, target: Path) -> tuple[str, str]:
    """Names to show: those of the files, with their folders where they are the same."""
    return (source.name, target.name) if source.name != target.name else (str(source), str(target))


def _tell_match(voice: Console, result: "MatchResult", names: tuple[str, str], output: Path) -> None:
    found = result.map
    for note in result.notes:
        voice.say(note)
    for name, fit in zip(names, (result.source_fit, result.target_fit), strict=True):
        voice.say(f"{name}: {_fit_words(fit)}")
    _warn(voice, found.verdict, found.reasons)
    voice.say(
        f"wrote {output}: for each of the {found.source_vertices} vertices of {names[0]} "
        f"its vertex of {names[1]} ({result.seconds:.1f} s)"
    )


def _warn(voice: Console, verdict: str, reasons: tuple[str, ...]) -> None:
    if verdict == "poor":
        voice.warn(f"the fit is poor: {_why(reasons)}")
    elif verdict != "good":
        for reason in reasons:
            voice.say(f"note: {reason}")


def _why(reasons: tuple[str, ...]) -> str:
    return "; ".join(reasons) or "no reason was given"


def _fit_words(fit: "Fit") -> str:
    return f"{fit.verdict} fit, up {fit.up}, front {fit.front}"


def _fit_record(name: str, fit: "Fit") -> dict[str, Any]:
    return {
        "shape": name,
        "verdict": fit.verdict,
        "reasons": list(fit.reasons),
        "residual": float(fit.residual),
        "up": fit.up,
        "front": fit.front,
        "seconds": round(fit.seconds, 3),
        "seed": fit.seed,
    }


def _match_record(result: "MatchResult", names: tuple[str, str]) -> dict[str, Any]:
    from meshmatch.maps.vertex_map import DIRECTION

    found = result.map
    return {
        "source": names[0],
        "target": names[1],
        "direction": DIRECTION,
        "source_vertices": found.source_vertices,
        "target_vertices": found.target_vertices,
        "verdict": found.verdict,
        "reasons": list(found.reasons),
        "confidence_mean": float(found.confidence.mean()),
        "notes": list(result.notes),
        "fits": [
            _fit_record(name, fit)
            for name, fit in zip(names, (result.source_fit, result.target_fit), strict=True)
        ],
        "seconds": round(result.seconds, 3),
    }
