"""``meshmatch match`` and ``meshmatch register``."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from meshmatch.cli import options
from meshmatch.cli.voice import Voice, print_json

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
    landmarks: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Known pairs to honour: a source vertex and a target vertex a line, counted from 0.",
        ),
    ] = None,
    polish: Annotated[
        options.Polish,
        typer.Option(help="Polish the map along both surfaces: where it helps, always, never."),
    ] = "auto",
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
    from meshmatch.config import set_threads

    set_threads(1)  # before NumPy reads it: the two fits run side by side, one thread each
    from meshmatch.errors import PoorFit
    from meshmatch.maps.files import check_suffix, save_map
    from meshmatch.maps.pairs import load_pairs
    from meshmatch.outputs import replace_on_success

    check_suffix(output)
    voice = Voice(quiet)
    with replace_on_success(output) as temporary:  # a folder that cannot be written is told at once
        pairs = None if landmarks is None else load_pairs(landmarks)
        from meshmatch import pipeline

        with voice.progress() as report:
            result = pipeline.match(
                source,
                target,
                model=model,
                refine=refine,
                polish=polish,
                seed=seed,
                up=up,
                front=front,
                landmarks=pairs,
                workers=threads,
                progress=report,
            )
        found = result.map
        if strict and found.verdict == "poor":
            raise PoorFit(f"poor fit, nothing was written: {_why(found.reasons)}", _HINT)
        save_map(temporary, found)
    _tell_match(voice, result, output)
    if json:
        choices = {"model": model, "refine": refine, "polish": polish, "seed": seed}
        print_json(_match_record(result, output) | choices)


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
    seed: options.Seed = 0,
    strict: options.Strict = False,
    json: options.Json = False,
    threads: options.Threads = 2,
    quiet: options.Quiet = False,
) -> None:
    """Lay the model's template on one shape.

    Whatever shape it was laid on, the result has the same vertices and triangles in the same order.
    """
    from meshmatch.config import set_threads

    set_threads(threads)
    import numpy as np

    from meshmatch.errors import PoorFit
    from meshmatch.outputs import replace_on_success
    from meshmatch.shapes.files import load_shape, save_shape
    from meshmatch.shapes.shape import Shape

    voice = Voice(quiet)
    with replace_on_success(output) as temporary:
        save_shape(temporary, Shape(np.eye(3), np.array([[0, 1, 2]])))  # a suffix that cannot be is told now
        loaded = load_shape(shape)
        from meshmatch import pipeline

        with voice.progress() as report:
            fit = pipeline.register(
                loaded, model=model, refine=refine, seed=seed, up=up, front=front, progress=report
            )
        if strict and fit.verdict == "poor":
            raise PoorFit(f"poor fit, nothing was written: {_why(fit.reasons)}", _HINT)
        save_shape(temporary, Shape(fit.points_in_file, fit.faces, output.stem))
    voice.say(f"laid the template of {model} on {loaded.name}: {_fit_words(fit)}")
    _warn(voice, fit.verdict, fit.reasons)
    voice.say(f"wrote {output} ({fit.seconds:.1f} s)")
    if json:
        print_json({"output": str(output), "model": model, "refine": refine} | _fit_record(loaded.name, fit))


_HINT = "is it the model's category? try --up and --front, --landmarks, or leave out --strict to look at it"


def _tell_match(voice: Voice, result: "MatchResult", output: Path) -> None:
    found = result.map
    for note in result.notes:
        voice.say(note)
    for name, fit in ((found.source, result.source_fit), (found.target, result.target_fit)):
        voice.say(f"{name}: {_fit_words(fit)}")
    _warn(voice, found.verdict, found.reasons)
    voice.say(
        f"wrote {output}: for each of the {found.source_vertices} vertices of {found.source} "
        f"its vertex of {found.target} ({result.seconds:.1f} s)"
    )


def _warn(voice: Voice, verdict: str, reasons: tuple[str, ...]) -> None:
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


def _match_record(result: "MatchResult", output: Path) -> dict[str, Any]:
    found = result.map
    return {
        "output": str(output),
        "source": found.source,
        "target": found.target,
        "source_vertices": found.source_vertices,
        "target_vertices": found.target_vertices,
        "verdict": found.verdict,
        "reasons": list(found.reasons),
        "confidence_mean": float(found.confidence.mean()),
        "notes": list(result.notes),
        "fits": [
            _fit_record(found.source, result.source_fit),
            _fit_record(found.target, result.target_fit),
        ],
        "seconds": round(result.seconds, 3),
    }
