"""``meshmatch match`` and ``meshmatch register``: two shapes, or one, and the template of a model."""

from pathlib import Path

from typer import Argument, Option

import meshmatch
from meshmatch.cli import options, words
from meshmatch.cli.options import FitOptions, PairOptions, RunOptions, check_outputs, grouped, output_option
from meshmatch.cli.words import Console, print_json
from meshmatch.models.registry import locate_model
from meshmatch.outputs import replace_on_success


@grouped
def match(
    *,
    source: options.Source,
    target: options.Target,
    output: Path = output_option("MAP", "The map; its suffix chooses the format: .npy .npz .csv .txt .mat .json."),
    how: PairOptions,
    run: RunOptions,
    picture: Path | None = options.optional("PNG", "Draw both shapes, corresponding points in one colour."),
) -> None:
    """Match every vertex of one shape to another.

    The two files may differ in vertex count, unit, up axis and orientation. In the map, index[i] is the vertex of the
    target matched to vertex i of the source; vertices are counted from 0, in the order of the files.
    """
    from meshmatch.maps.files import check_suffix

    how.check()
    check_suffix(output)
    check_outputs([source, target, how.known_pairs], output, picture=picture)
    console, names = Console(run.quiet), words.names_of([source, target])
    # What cannot be written, a mistyped model and broken files are told before the long work.
    with replace_on_success(output) as temporary:
        locate_model(how.model)
        shapes = meshmatch.load_shape(source), meshmatch.load_shape(target)
        result = how.match(*shapes, run, console)
        found = result.map
        words.refuse_poor(run.strict, found.verdict, found.reasons)
        meshmatch.save_map(temporary, found)
    if picture is not None:
        from meshmatch.render.compose import compose_match

        compose_match(*shapes, found, result.rotations).named(names).render(picture)
    words.tell_match(console, result, names)
    words.tell_verdict(console, found.verdict, found.reasons)
    console.say(
        f"wrote {output}: for each of the {found.source_vertices} vertices of {names[0]} "
        f"its vertex of {names[1]} ({result.seconds:.1f} s)"
    )
    if picture is not None:
        console.say(f"drew {picture}: corresponding points in one colour")
    if run.json:
        print_json({"output": output, "picture": picture} | words.match_record(result, names) | how.record)


@grouped
def register(
    *,
    shape: Path = Argument(..., metavar="SHAPE", help="The shape to fit the template to."),
    output: Path = output_option(
        "MESH", "The fitted template, in the frame and unit of SHAPE: .ply .obj .off .stl .glb."
    ),
    how: FitOptions,
    run: RunOptions,
    dense: bool = Option(False, "--dense", help="Write the template in its full resolution."),
    picture: Path | None = options.optional("PNG", "Draw the template over the shape, coloured by distance."),
) -> None:
    """Fit the model's template to one shape.

    Results for all shapes have the same vertices and triangles in the same order. More than one of --threads may change
    the last bits.
    """
    from meshmatch.shapes.files import check_suffix

    how.check()
    check_suffix(output)
    check_outputs([shape], output, picture=picture)
    console = Console(run.quiet)
    with replace_on_success(output) as temporary:
        locate_model(how.model)
        loaded = meshmatch.load_shape(shape)
        matcher = meshmatch.Matcher(how.model, how.configs()[0], run.threads)
        with console.progress() as matcher.progress:
            fit = matcher.fit(loaded)
        words.refuse_poor(run.strict, fit.verdict, fit.reasons)
        fitted = matcher.dense(fit) if dense else meshmatch.Shape(fit.points_in_file, fit.faces, output.stem)
        meshmatch.save_shape(temporary, fitted)
    if picture is not None:
        from meshmatch.render.compose import compose_fit

        compose_fit(loaded, fitted, fit.frame.rotation).render(picture)
    console.say(*fit.notes)
    console.say(f"fitted the template of {how.model} to {loaded.name}: {words.fit_words(fit)}")
    words.tell_verdict(console, fit.verdict, fit.reasons)
    console.say(f"wrote {output}: {fitted.V} vertices, {fitted.F} faces ({fit.seconds:.1f} s)")
    if picture is not None:
        console.say(f"drew {picture}: the template over the shape, and their distance")
    if run.json:
        record = {"output": output, "picture": picture, "vertices": fitted.V, "faces": fitted.F, "dense": dense}
        print_json(record | how.record | words.fit_record(loaded.name, fit) | {"notes": list(fit.notes)})
