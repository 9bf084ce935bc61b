"""``meshmatch interpolate``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from typer import Argument, Option

import meshmatch
from meshmatch.cli import user_messages
from meshmatch.cli.options import FitOptions, Options, RunOptions, check_outputs, grouped, optional, output_option
from meshmatch.cli.user_messages import Console, Json, print_json
from meshmatch.errors import OptionError
from meshmatch.models.registry import check_model
from meshmatch.outputs import folder_on_success, replace_on_success


@dataclass(frozen=True)
class SequenceOptions(Options):
    """Options of the sequence."""

    frames: int = Option(9, "--frames", "-n", min=2, max=1000, help="Number of shapes.")
    through: list[Path] | None = optional("C", "A shape to pass through between A and B. May be repeated.")
    start: float = Option(0.0, "--from", metavar="T", help="Time of the first shape, from -1; below 0 is before A.")
    stop: float = Option(1.0, "--to", metavar="T", help="Time of the last shape, up to 2; above 1 is beyond B.")
    mesh: Literal["source", "template"] = Option(
        "source", help="Mesh that moves: the mesh of A, with all its detail (source), or the model's template."
    )
    blend: Literal["field", "codes"] = Option(
        "field",
        help="Blend the local rotation and stretch of the surface (field), or the network's latent codes (codes).",
    )
    place: Literal["auto", "files", "source"] = Option(
        "auto",
        help="Position, orientation and size of the shapes. files: changing from those in A's file to those in B's; "
        "source: as in A's file throughout; auto: files, unless the files seem to have different units.",
    )
    resolution: int = Option(
        64,
        min=8,
        max=512,
        help="Grid cells per side when the surfaces of an implicit model are extracted; an even number.",
    )
    format: Literal["ply", "obj", "off", "glb"] = Option("ply", help="Format of the files in a folder.")
    plot: Path | None = optional("FILE", "Plot how well each shape preserves volume and distances: .png, .svg or .pdf.")


@grouped
def interpolate(
    *,
    source: Path = Argument(..., metavar="A", help="The shape at time 0."),
    target: Path = Argument(..., metavar="B", help="The shape at time 1."),
    output: Path = output_option(
        "OUT",
        "A new folder (a name without a suffix) with a file for each shape; a .png of all shapes in a row; or an .html page "
        "with a slider.",
    ),
    sequence: SequenceOptions,
    how: FitOptions,
    run: RunOptions,
) -> None:
    """Blend one shape into another, as a sequence.

    The model's template is fitted to both shapes, the fits are blended, and the mesh of A follows. At time 0 it is A as
    in its file; at time 1 it lies on B. Shapes given with --through are reached at evenly spaced times in between. An
    implicit model blends latent codes instead, and each shape has its own mesh.
    """
    from meshmatch.api import interpolation

    how.check(not_implicit=["through", "mesh", "blend", "place", "plot"])
    suffix = "" if output.is_dir() else output.suffix.lower()
    if suffix not in ("", *_WRITERS):
        hint = "give a name without a suffix for a folder (see --format), or one that ends in .png or .html"
        raise OptionError(f"{output.name}: unsupported format for a sequence: {output.suffix}", hint)
    files = [source, *(sequence.through or []), target]
    check_outputs(files, output, chart=sequence.plot)
    options = interpolation.InterpolationOptions(
        sequence.start, sequence.stop, sequence.mesh, sequence.blend, sequence.place, sequence.resolution
    )
    if how.implicit and suffix in (".html", ".htm"):
        hint = "give a name without a suffix for a folder, or one that ends in .png"
        what = "a page needs shapes that share vertices, and the surfaces of an implicit model do not"
        raise OptionError(f"{output.name}: {what}", hint)
    console = Console(run.quiet)
    # Outputs that cannot be written, an unknown model and broken files are reported before the long computation.
    with (replace_on_success if suffix else folder_on_success)(output) as temporary:
        check_model(how.model)
        shapes = how.load(*files)
        with console.progress() as report:
            result = interpolation.interpolate(
                shapes, sequence.frames, options=options, model=how.model, config=how.configs()[0],
                threads=run.threads, progress=report,
            )  # fmt: skip
        for file, fit in zip(files, result.fits, strict=True):
            user_messages.raise_if_poor(
                run.strict, fit.verdict, (f"{file.name}: {user_messages.join_reasons(fit.reasons)}",)
            )
        # Names of the given shapes by the times at which the sequence passes them.
        key_shapes = dict(zip(result.times, [file.name for file in files], strict=True))
        if sequence.plot is not None:
            _plot(sequence.plot, result, key_shapes)
        if suffix:
            _WRITERS[suffix](temporary, result, key_shapes)
        else:
            moves = not how.implicit and sequence.mesh == "source"
            interpolation.save_folder(temporary, result, sequence.format, source if moves else None)
    _report(console, result, files, sequence.place)
    what = "surfaces" if how.implicit else f"shapes of {result.steps[0].shape.V} vertices"
    console.say(
        f"wrote {output}: {sequence.frames} {what}, from time {sequence.start:g} to {sequence.stop:g} "
        f"({result.seconds:.1f} s)"
    )
    if sequence.plot is not None:
        console.say(f"drew {sequence.plot}: how well each shape preserves volume and distances")
    if run.json:
        chosen = {} if how.implicit else {"mesh": sequence.mesh, "blend": sequence.blend}
        print_json(
            {"output": output, "plot": sequence.plot} | _record(result, files) | chosen | how.record(result.fits[0])
        )


def _draw_strip(path: Path, result: "meshmatch.Interpolation", key_shapes: dict[float, str]) -> None:
    """Draw all shapes in a row, labelled by time, or by the name of the given shape at that time."""
    from meshmatch.render.figures import Panel
    from meshmatch.render.picture import render_shapes

    labels = [key_shapes.get(step.time, f"{step.time:.3g}") for step in result.steps]
    pairs = zip(result.steps, labels, strict=True)
    render_shapes([Panel(step.shape, label=label, rotation=step.rotation) for step, label in pairs], path)


def _write_page(path: Path, result: "meshmatch.Interpolation", key_shapes: dict[float, str]) -> None:
    """Write the page; all shapes are in the frame of the first one, so that motion in the files is visible."""
    from meshmatch.render.viewer.single_pages import write_motion

    shapes = [step.shape for step in result.steps]
    times = [step.time for step in result.steps]
    rotation = result.steps[0].rotation
    assert rotation is not None
    title = " → ".join(key_shapes.values())
    write_motion(path, shapes, times, rotation=rotation, met=key_shapes, title=title)


_WRITERS = {".png": _draw_strip, ".html": _write_page, ".htm": _write_page}


def _plot(path: Path, result: "meshmatch.Interpolation", key_shapes: dict[float, str]) -> None:
    from meshmatch.render.charts import draw_lines

    times = [step.time for step in result.steps]
    deviations = [step.deviation for step in result.steps if step.deviation is not None]
    marks = {time: name for time, name in key_shapes.items() if times[0] <= time <= times[-1]}
    lines = {
        "volume: |det F - det S|": (times, [each.volume for each in deviations]),
        "rigidity: |F'F - S'S|": (times, [each.arap for each in deviations]),
    }
    xlabel = "time (S is the stretch that the shapes themselves have)"
    draw_lines(lines, path, xlabel, "mean deviation over the surface", marks)


def _report(console: Console, result: "meshmatch.Interpolation", files: list[Path], asked: str) -> None:
    console.say(*result.notes)
    for file, fit in zip(files, result.fits, strict=True):
        console.say(f"{file.name}: {user_messages.describe_fit(fit)}")
        user_messages.report_verdict(console, fit.verdict, fit.reasons, f"the fit of {file.name}")
    if asked == "auto" and result.place == "source":
        console.say(f"the files differ much in size: all shapes are in the position and unit of {files[0].name}")
    deviations = [step.deviation for step in result.steps if step.deviation is not None]
    if result.to_target is None or not deviations:
        return
    worst = max(deviations, key=lambda each: each.arap)
    console.say(
        f"at time 1 the mesh is {100 * result.to_target:.2f} % of {files[-1].name}'s size (the root of its area) away "
        f"from it; volume is off by {worst.volume:.3f} and rigidity by {worst.arap:.3f} at most"
    )


def _record(result: "meshmatch.Interpolation", files: list[Path]) -> Json:
    shapes = []
    for file, time, fit in zip(files, result.times, result.fits, strict=True):
        about = user_messages.fit_record(str(file), fit)
        shapes.append(about | {"time": round(time, 9)})
    record: Json = {"shapes": shapes, "place": result.place, "frames": [step.record for step in result.steps]}
    if result.to_target is not None:
        record |= {"vertices": result.steps[0].shape.V, "distance_to_target": round(result.to_target, 6)}
    return record | {"notes": result.notes, "seconds": round(result.seconds, 3)}
