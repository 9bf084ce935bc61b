"""``meshmatch register``."""

from pathlib import Path
from typing import Annotated

import typer

from meshmatch.cli import words
from meshmatch.cli.console import Console, print_json
from meshmatch.cli.options import FitOptions, RunOptions, grouped
from meshmatch.cli.output_paths import check_distinct, check_png, claimed


@grouped
def register(
    shape: Annotated[Path, typer.Argument(metavar="SHAPE", help="The shape to fit the template to.")],
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="MESH",
            help="The fitted template, in the frame and unit of SHAPE: .ply .obj .off .stl .glb.",
        ),
    ],
    how: FitOptions,
    run: RunOptions,
    dense: Annotated[bool, typer.Option("--dense", help="Write the template in its full resolution.")] = False,
    picture: Annotated[
        Path | None, typer.Option(metavar="PNG", help="Draw the template over the shape, coloured by distance.")
    ] = None,
) -> None:
    """Fit the model's template to one shape.

    Results for all shapes have the same vertices and triangles in the same order. More than one of --threads may change
    the last bits.
    """
    from meshmatch.models.registry import locate_model
    from meshmatch.outputs import replace_on_success
    from meshmatch.shapes.files import check_suffix, load_shape, save_shape
    from meshmatch.shapes.shape import Shape

    how.check()
    check_suffix(output)
    check_png(picture)
    check_distinct([output, picture], [shape])
    console = Console(run.quiet)
    with claimed(picture) as drawing:
        with replace_on_success(output) as temporary:
            locate_model(how.model)
            loaded = load_shape(shape)
            from meshmatch.api import matching

            matcher = matching.Matcher(how.model, how.config(), run.threads)
            with console.progress() as report:
                matcher.progress = report
                fit = matcher.fit(loaded)
            words.refuse_poor(run.strict, fit.verdict, fit.reasons)
            fitted = matcher.dense(fit) if dense else Shape(fit.points_in_file, fit.faces, output.stem)
            save_shape(temporary, fitted)
        if drawing is not None:
            from meshmatch.render.compose import compose_fit

            compose_fit(loaded, fitted, fit.frame.rotation).render(drawing)
    for note in fit.notes:
        console.say(note)
    console.say(f"fitted the template of {how.model} to {loaded.name}: {words.fit_words(fit)}")
    words.tell_verdict(console, fit.verdict, fit.reasons)
    console.say(f"wrote {output}: {fitted.V} vertices, {fitted.F} faces ({fit.seconds:.1f} s)")
    if picture is not None:
        console.say(f"drew {picture}: the template over the shape, and their distance")
    if run.json:
        record = {"output": output, "picture": picture, "vertices": fitted.V, "faces": fitted.F, "dense": dense}
        print_json(record | how.record | words.fit_record(loaded.name, fit) | {"notes": list(fit.notes)})
