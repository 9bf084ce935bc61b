"""``meshmatch interpolate``."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from meshmatch.cli import options
from meshmatch.cli.console import Console, print_json
from meshmatch.cli.output_paths import check_apart, check_chart, claimed

if TYPE_CHECKING:
    from meshmatch.api.interpolation import Interpolation

_HINT = "is it the model's category? try --up and --front, or leave out --strict to look at it"


def interpolate(
    source: Annotated[Path, typer.Argument(metavar="A", help="The shape at time 0.")],
    target: Annotated[Path, typer.Argument(metavar="B", help="The shape at time 1.")],
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="OUT",
            help="A name without a suffix: a new folder with a file for each shape. A .png: all in a row. An .html: "
            "a page with a slider.",
        ),
    ],
    frames: Annotated[int, typer.Option("--frames", "-n", min=2, max=1000, help="How many shapes.")] = 9,
    through: Annotated[
        list[Path] | None,
        typer.Option(metavar="C", help="A shape to pass through on the way; may be given several times."),
    ] = None,
    start: Annotated[
        float, typer.Option("--from", metavar="T", help="Time of the first shape; below 0 is before A.")
    ] = 0.0,
    stop: Annotated[
        float, typer.Option("--to", metavar="T", help="Time of the last shape; above 1 is beyond B.")
    ] = 1.0,
    mesh: Annotated[
        Literal["source", "template"],
        typer.Option(help="What moves: the mesh of A, with all its detail, or the model's template."),
    ] = "source",
    blend: Annotated[
        Literal["field", "codes"],
        typer.Option(
            help="What is blended: how the surface turns and stretches everywhere, or the network's codes."
        ),
    ] = "field",
    place: Annotated[
        Literal["auto", "files", "source"],
        typer.Option(
            help="Where the shapes lie: from A's place, turn and size in its file to B's, or all in A's; auto is "
            "A's if the files seem to have different units."
        ),
    ] = "auto",
    format: Annotated[
        Literal["ply", "obj", "off", "glb"], typer.Option(help="Of the files in a folder.")
    ] = "ply",
    plot: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Plot how far each shape is from keeping volume and distances: .png, .svg or .pdf.",
        ),
    ] = None,
    model: options.Model = "human",
    refine: options.RefineOption = "nodes",
    up: options.Up = None,
    front: options.Front = None,
    partial: options.PartialFlag = None,
    seed: options.Seed = 0,
    strict: options.Strict = False,
    json: options.Json = False,
    threads: options.Threads = 2,
    quiet: options.Quiet = False,
) -> None:
    """Make the shapes between two shapes.

    The model's template is laid on each, and its poses are blended; A's own mesh goes along. Time 0 is A as its
    file has it, and at time 1 A's mesh lies on B. Shapes given with --through are met at even times in between.
    """
    from meshmatch.threads import set_threads

    set_threads(1)
    from meshmatch.errors import PoorFit
    from meshmatch.models.registry import locate_model
    from meshmatch.outputs import folder_on_success, replace_on_success
    from meshmatch.shapes.files import load_shape

    way = [] if through is None else through
    options.check_axes(up, front)
    kind = _kind(output)
    check_chart(plot)
    files = [source, *way, target]
    check_apart([output, plot], files)
    voice = Console(quiet)
    # Outputs that cannot be written, a mistyped model and broken files are told before the long work.
    claim = folder_on_success if kind == "folder" else replace_on_success
    with claimed(plot) as plotted, claim(output) as temporary:
        locate_model(model)
        from meshmatch.api import interpolation
        from meshmatch.fitting.fit_config import FitConfig

        choices_of_sequence = interpolation.InterpolationOptions(start, stop, mesh, blend, place)
        config = FitConfig(
            refine=refine, seed=seed, up=up, front=front, partial=options.partial_choice(partial)
        )
        shapes = [load_shape(file) for file in files]
        with voice.progress() as report:
            result = interpolation.interpolate(
                shapes,
                frames,
                options=choices_of_sequence,
                model=model,
                config=config,
                threads=threads,
                progress=report,
            )
        poor = [file.name for file, fit in zip(files, result.fits, strict=True) if fit.verdict == "poor"]
        if strict and poor:
            raise PoorFit(f"poor fit of {', '.join(poor)}, nothing was written", _HINT)
        met = dict(zip(result.times, [file.name for file in files], strict=True))
        if plotted is not None:
            _plot(plotted, result, met)
        if kind == "folder":
            interpolation.save_folder(temporary, result, format)
        elif kind == "strip":
            _draw_strip(temporary, result, met)
        else:
            _write_page(temporary, result, met)
    _tell(voice, result, files, place)
    voice.say(
        f"wrote {output}: {frames} shapes of {result.steps[0].shape.V} vertices, from time {start:g} to {stop:g} "
        f"({result.seconds:.1f} s)"
    )
    if plot is not None:
        voice.say(f"drew {plot}: how far each shape is from keeping volume and distances")
    if json:
        choices = {"mesh": mesh, "blend": blend, "model": model, "refine": refine, "seed": seed}
        print_json(_record(output, plot, result, files) | choices)


def _kind(output: Path) -> Literal["folder", "strip", "page"]:
    from meshmatch.errors import OptionError

    if output.suffix == "" or output.is_dir():
        return "folder"
    if output.suffix.lower() == ".png":
        return "strip"
    if output.suffix.lower() in (".html", ".htm"):
        return "page"
    raise OptionError(
        f"{output.name}: a sequence is not written as {output.suffix}",
        "a name without a suffix for a folder (see --format), or one that ends in .png or .html",
    )


def _draw_strip(path: Path, result: "Interpolation", met: dict[float, str]) -> None:
    """All shapes in a row, each with its time, or the name of the shape that is met then."""
    from meshmatch.render.figures import Panel
    from meshmatch.render.picture import render_shapes

    panels = [
        Panel(step.shape, label=met.get(step.time, f"{step.time:.3g}"), rotation=step.rotation)
        for step in result.steps
    ]
    render_shapes(panels, path)


def _write_page(path: Path, result: "Interpolation", met: dict[float, str]) -> None:
    """In one frame, that of the first shape: what moves in the files moves on the page."""
    from meshmatch.render.viewer.motion import write_motion

    shapes = [step.shape for step in result.steps]
    times = [step.time for step in result.steps]
    title = " → ".join(met.values())
    write_motion(path, shapes, times, rotation=result.steps[0].rotation, met=met, title=title)


def _plot(path: Path, result: "Interpolation", met: dict[float, str]) -> None:
    from meshmatch.render.charts import Chart, Line, draw_lines

    times = [step.time for step in result.steps]
    marks = {time: name for time, name in met.items() if times[0] <= time <= times[-1]}
    lines = {
        "volume: |det F - det S|": Line(times, [step.deviation.volume for step in result.steps]),
        "rigidity: |F'F - S'S|": Line(times, [step.deviation.arap for step in result.steps]),
    }
    xlabel = "time (S is the stretch that the shapes themselves have)"
    draw_lines([Chart(xlabel, lines, marks=marks)], path, "mean deviation over the surface")


def _tell(voice: Console, result: "Interpolation", files: list[Path], asked: str) -> None:
    for note in result.notes:
        voice.say(note)
    for file, fit in zip(files, result.fits, strict=True):
        voice.say(f"{file.name}: {fit.verdict} fit, up {fit.up}, front {fit.front}")
        why = "; ".join(fit.reasons) or "no reason was given"
        if fit.verdict == "poor":
            voice.warn(f"the fit of {file.name} is poor: {why}")
        elif fit.verdict != "good":
            voice.say(f"note: {why}")
    if asked == "auto" and result.place == "source":
        voice.say(f"the files differ much in size: all shapes are in the place and unit of {files[0].name}")
    worst = max(result.steps, key=lambda step: step.deviation.arap)
    voice.say(
        f"at time 1 the mesh is {100 * result.to_target:.2f} % of {files[-1].name}'s size (the root of its area) away "
        f"from it; volume is off by {worst.deviation.volume:.3f} and rigidity by {worst.deviation.arap:.3f} at most"
    )


def _record(output: Path, plot: Path | None, result: "Interpolation", files: list[Path]) -> dict[str, Any]:
    shapes = [
        {
            "shape": str(file),
            "time": round(moment, 9),
            "verdict": fit.verdict,
            "reasons": list(fit.reasons),
            "up": fit.up,
            "front": fit.front,
        }
        for file, moment, fit in zip(files, result.times, result.fits, strict=True)
    ]
    return {
        "output": str(output),
        "plot": None if plot is None else str(plot),
        "shapes": shapes,
        "place": result.place,
        "vertices": result.steps[0].shape.V,
        "frames": [step.record for step in result.steps],
        "distance_to_target": round(result.to_target, 6),
        "notes": list(result.notes),
        "seconds": round(result.seconds, 3),
    }
