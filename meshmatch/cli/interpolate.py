"""``meshmatch interpolate``."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from meshmatch.cli import words
from meshmatch.cli.console import Console, Json, print_json
from meshmatch.cli.options import FitOptions, RunOptions, grouped
from meshmatch.cli.output_paths import check_chart, check_distinct, claimed
from meshmatch.errors import OptionError

if TYPE_CHECKING:
    from meshmatch.api.interpolation import Interpolation, InterpolationOptions


@dataclass(frozen=True)
class SequenceOptions:
    """What the shapes between two shapes are."""

    frames: Annotated[int, typer.Option("--frames", "-n", min=2, max=1000, help="Number of shapes.")] = 9
    through: Annotated[
        list[Path] | None, typer.Option(metavar="C", help="A shape to pass on the way; may be repeated.")
    ] = None
    start: Annotated[
        float, typer.Option("--from", metavar="T", help="Time of the first shape; below 0 is before A.")
    ] = 0.0
    stop: Annotated[float, typer.Option("--to", metavar="T", help="Time of the last shape; above 1 is beyond B.")] = 1.0
    mesh: Annotated[
        Literal["source", "template"],
        typer.Option(help="Mesh that moves: that of A, with all its detail, or the model's template."),
    ] = "source"
    blend: Annotated[
        Literal["field", "codes"],
        typer.Option(help="Blend the local rotation and stretch of the surface (field), or the network's codes."),
    ] = "field"
    place: Annotated[
        Literal["auto", "files", "source"],
        typer.Option(
            help="Position, orientation and size of the shapes. files: from those of A's file to those of B's; "
            "source: all as A; auto: files, unless the files seem to have different units."
        ),
    ] = "auto"
    format: Annotated[Literal["ply", "obj", "off", "glb"], typer.Option(help="Format of the files in a folder.")] = (
        "ply"
    )
    plot: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Plot how well each shape keeps volume and distances: .png, .svg or .pdf."),
    ] = None

    def options(self) -> "InterpolationOptions":
        """The same for the library."""
        from meshmatch.api.interpolation import InterpolationOptions

        return InterpolationOptions(self.start, self.stop, self.mesh, self.blend, self.place)


@grouped
def interpolate(
    source: Annotated[Path, typer.Argument(metavar="A", help="The shape at time 0.")],
    target: Annotated[Path, typer.Argument(metavar="B", help="The shape at time 1.")],
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="OUT",
            help="No suffix: a new folder with a file for each shape. .png: all shapes in a row. .html: a page with a "
            "slider.",
        ),
    ],
    sequence: SequenceOptions,
    how: FitOptions,
    run: RunOptions,
) -> None:
    """Make the shapes between two shapes.

    The model's template is fitted to each, and its poses are blended; A's own mesh moves along. Time 0 is A as it is in
    its file, and at time 1 A's mesh lies on B. Shapes given with --through are passed at even times in between.
    """
    from meshmatch.api import interpolation
    from meshmatch.models.registry import locate_model
    from meshmatch.outputs import folder_on_success, replace_on_success
    from meshmatch.shapes.files import load_shape

    how.check()
    kind = _kind(output)
    plot = sequence.plot
    check_chart(plot)
    files = [source, *(sequence.through or []), target]
    check_distinct([output, plot], files)
    options = sequence.options()
    console = Console(run.quiet)
    # What cannot be written, a mistyped model and broken files are told before the long work.
    claim = folder_on_success if kind == "folder" else replace_on_success
    with claimed(plot) as plotted, claim(output) as temporary:
        locate_model(how.model)
        shapes = [load_shape(file) for file in files]
        with console.progress() as report:
            result = interpolation.interpolate(
                shapes, sequence.frames, options=options, model=how.model, config=how.config(), threads=run.threads,
                progress=report,
            )  # fmt: skip
        for file, fit in zip(files, result.fits, strict=True):
            words.refuse_poor(run.strict, fit.verdict, (f"{file.name}: {words.why(fit.reasons)}",))
        met = dict(zip(result.times, [file.name for file in files], strict=True))
        if plotted is not None:
            _plot(plotted, result, met)
        if kind == "folder":
            interpolation.save_folder(temporary, result, sequence.format)
        else:
            (_draw_strip if kind == "strip" else _write_page)(temporary, result, met)
    _tell(console, result, files, sequence.place)
    console.say(
        f"wrote {output}: {sequence.frames} shapes of {result.steps[0].shape.V} vertices, from time "
        f"{sequence.start:g} to {sequence.stop:g} ({result.seconds:.1f} s)"
    )
    if plot is not None:
        console.say(f"drew {plot}: how well each shape keeps volume and distances")
    if run.json:
        print_json(
            {"output": output, "plot": plot}
            | _record(result, files)
            | {"mesh": sequence.mesh, "blend": sequence.blend}
            | how.record
        )


def _kind(output: Path) -> Literal["folder", "strip", "page"]:
    if output.suffix == "" or output.is_dir():
        return "folder"
    if output.suffix.lower() == ".png":
        return "strip"
    if output.suffix.lower() in (".html", ".htm"):
        return "page"
    raise OptionError(
        f"{output.name}: unsupported format for a sequence: {output.suffix}",
        "give a name without a suffix for a folder (see --format), or one that ends in .png or .html",
    )


def _draw_strip(path: Path, result: "Interpolation", met: dict[float, str]) -> None:
    """All shapes in a row, each with its time, or the name of the shape that is passed then."""
    from meshmatch.render.figures import Panel
    from meshmatch.render.picture import render_shapes

    panels = [
        Panel(step.shape, label=met.get(step.time, f"{step.time:.3g}"), rotation=step.rotation) for step in result.steps
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
    from meshmatch.render.charts import draw_lines

    times = [step.time for step in result.steps]
    marks = {time: name for time, name in met.items() if times[0] <= time <= times[-1]}
    lines = {
        "volume: |det F - det S|": (times, [step.deviation.volume for step in result.steps]),
        "rigidity: |F'F - S'S|": (times, [step.deviation.arap for step in result.steps]),
    }
    xlabel = "time (S is the stretch that the shapes themselves have)"
    draw_lines(lines, path, xlabel, "mean deviation over the surface", marks)


def _tell(console: Console, result: "Interpolation", files: list[Path], asked: str) -> None:
    for note in result.notes:
        console.say(note)
    for file, fit in zip(files, result.fits, strict=True):
        console.say(f"{file.name}: {words.fit_words(fit)}")
        words.tell_verdict(console, fit.verdict, fit.reasons, f"the fit of {file.name}")
    if asked == "auto" and result.place == "source":
        console.say(f"the files differ much in size: all shapes are in the place and unit of {files[0].name}")
    worst = max(result.steps, key=lambda step: step.deviation.arap)
    console.say(
        f"at time 1 the mesh is {100 * result.to_target:.2f} % of {files[-1].name}'s size (the root of its area) away "
        f"from it; volume is off by {worst.deviation.volume:.3f} and rigidity by {worst.deviation.arap:.3f} at most"
    )


def _record(result: "Interpolation", files: list[Path]) -> Json:
    return {
        "shapes": [
            {
                "shape": str(file),
                "time": round(moment, 9),
                "verdict": fit.verdict,
                "reasons": list(fit.reasons),
                "up": fit.up,
                "front": fit.front,
            }
            for file, moment, fit in zip(files, result.times, result.fits, strict=True)
        ],
        "place": result.place,
        "vertices": result.steps[0].shape.V,
        "frames": [step.record for step in result.steps],
        "distance_to_target": round(result.to_target, 6),
        "notes": list(result.notes),
        "seconds": round(result.seconds, 3),
    }
