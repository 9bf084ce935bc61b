"""``meshmatch match``, ``register`` and ``evaluate``."""

from math import isinf
from pathlib import Path
from typing import TYPE_CHECKING

from typer import Argument, Option

import meshmatch
from meshmatch.cli import options, user_messages
from meshmatch.cli.options import FitOptions, PairOptions, RunOptions, check_outputs, grouped, optional, output_option
from meshmatch.cli.user_messages import Console, Json, print_json, print_rows
from meshmatch.errors import OptionError
from meshmatch.models.registry import check_model
from meshmatch.outputs import replace_on_success

if TYPE_CHECKING:
    from meshmatch.api.kinds import UnitName
    from meshmatch.maps.evaluate import Evaluation


@grouped
def match(
    *,
    source: options.Source,
    target: options.Target,
    output: Path = output_option(
        "MAP", "The map; its suffix chooses the format: .npy, .npz, .csv, .txt, .mat or .json."
    ),
    how: PairOptions,
    run: RunOptions,
    picture: Path | None = optional("PNG", "Draw both shapes, corresponding points in the same color."),
) -> None:
    """Match every vertex of one shape to another.

    The two files may differ in vertex count, unit, up axis and orientation. In the map, index[i] is the vertex of the
    target matched to vertex i of the source; vertices are counted from 0, in the order of the files.
    """
    from meshmatch.maps.files import check_suffix
    from meshmatch.maps.vertex_map import DIRECTION

    how.check()
    check_suffix(output)
    check_outputs([source, target, how.known_pairs], output, picture=picture)
    console, names = Console(run.quiet), user_messages.names_of([source, target])
    # Outputs that cannot be written, an unknown model and broken files are reported before the long computation.
    with replace_on_success(output) as temporary:
        check_model(how.model)
        a, b = how.load(source, target)
        result = how.match(a, b, run, console)
        found = result.map
        user_messages.raise_if_poor(run.strict, found.verdict, found.reasons, "the map")
        meshmatch.save_map(temporary, found)
    if picture is not None:
        from meshmatch.render.compose import compose_match

        shown = compose_match(*(result.shapes or (a, b)), found, result.rotations).named(names)
        shown.render(picture)
    user_messages.report_match(console, result, names)
    user_messages.report_verdict(console, found.verdict, found.reasons, "the map")
    console.say(
        f"wrote {output}: for each of the {found.source_vertices} vertices of {names[0]} "
        f"its vertex of {names[1]} ({result.seconds:.1f} s)"
    )
    if picture is not None:
        console.say(f"drew {picture}: {shown.caption}")
    if run.json:
        fits = [
            user_messages.fit_record(*each) for each in zip(names, (result.source_fit, result.target_fit), strict=True)
        ]
        about = {"direction": DIRECTION, "confidence_mean": float(found.confidence.mean()), "notes": result.notes}
        about |= {"fits": fits, "seconds": round(result.seconds, 3)}
        print_json(
            {"output": output, "picture": picture}
            | user_messages.map_record(found, names)
            | about
            | how.record(result.source_fit)
        )


@grouped
def register(
    *,
    shape: Path = Argument(..., metavar="SHAPE", help="The shape to fit the template to."),
    output: Path = output_option(
        "MESH",
        "The deformed mesh, in the frame and unit of the shape that it was fitted to: .ply, .obj, .off, .stl, .glb, .vtp "
        "or .vtk.",
    ),
    how: FitOptions,
    run: RunOptions,
    onto: Path | None = optional(
        "TARGET", "Deform the mesh of SHAPE onto this shape, instead of the template onto SHAPE."
    ),
    template: Path | None = optional(
        "MESH", "Deform this mesh onto SHAPE, instead of the model's template; same as `register MESH --onto SHAPE`."
    ),
    dense: bool = Option(False, "--dense", help="Write the template at its full resolution."),
    picture: Path | None = optional("PNG", "Draw the deformed mesh over the shape, colored by distance."),
) -> None:
    """Fit a template or another mesh to a shape.

    This is a non-rigid registration: the model's template is deformed, and SHAPE is not moved. Results for all shapes have
    the same vertices and triangles in the same order. With --onto, the mesh of SHAPE is deformed onto TARGET; an .obj
    written from an .obj, or a .glb from a .glb, keeps everything but the positions. `wrap` does the same and also projects
    the mesh onto the surface. With more than one thread, results may differ in the last bits.
    """
    from meshmatch.api.matching import matcher_for
    from meshmatch.api.upright import upright_rotation_of_fit
    from meshmatch.shapes.files import check_mesh_suffix, save_upright

    how.check(not_implicit=["dense", "onto", "template"])
    check_mesh_suffix(output)
    check_outputs([shape, onto, template], output, picture=picture)
    console = Console(run.quiet)
    if template is not None:
        how.refuse(["dense", "onto"], "--template")
        return _register_onto(template, shape, output, picture, how, run, console)
    if onto is not None:
        how.refuse(["dense"], "--onto")
        return _register_onto(shape, onto, output, picture, how, run, console)
    with replace_on_success(output) as temporary:
        check_model(how.model)
        (loaded,) = how.load(shape)
        matcher = matcher_for(how.model, how.configs()[0], run.threads)
        with console.progress() as matcher.progress:
            fit = matcher.fit(loaded)
        user_messages.raise_if_poor(run.strict, fit.verdict, fit.reasons)
        plain = meshmatch.Shape(fit.points_in_file, fit.faces, output.stem)
        fitted = matcher.dense(fit) if dense else plain  # type: ignore[arg-type]
        turned = save_upright(temporary, fitted, None if loaded.upright else upright_rotation_of_fit(fit))
    if picture is not None:
        from meshmatch.render.compose import compose_fit

        compose_fit(loaded, fitted, None if how.implicit else fit.frame.turn).render(picture)
    console.say(*fit.notes)
    console.say(f"fitted the template of {fit.model} to {loaded.name}: {user_messages.describe_fit(fit)}")
    apart: Json = {}
    if isinstance(fit, meshmatch.Fit):
        read = fit.repaired.shape if fit.repaired else loaded  # without parts that were left out
        distance = meshmatch.measure_distance(read, fitted, one_way=fit.partial)
        apart["distance"] = distance.as_dict()
        console.say(str(distance))
    user_messages.report_verdict(console, fit.verdict, fit.reasons)
    if turned:
        console.say("note: a node turns the template upright, along y")
    console.say(f"wrote {output}: {fitted.V} vertices, {fitted.F} faces ({fit.seconds:.1f} s)")
    if picture is not None:
        console.say(f"drew {picture}: the template over the shape, and their distance")
    if run.json:
        record = {"output": output, "picture": picture, "vertices": fitted.V, "faces": fitted.F, "dense": dense}
        record |= apart | how.record(fit)
        print_json(record | user_messages.fit_record(loaded.name, fit) | {"notes": list(fit.notes)})


def surfaces_apart(
    result: "meshmatch.MatchResult",
    moved: "meshmatch.Shape",
    onto: "meshmatch.Shape",
    unit: "UnitName" = "auto",
    one_way: bool = False,
) -> "meshmatch.SurfaceDistance":
    """Measure the distance between a mesh and the shape it was fitted to; one way, from the part, if one is partial."""
    parts = [isinstance(fit, meshmatch.Fit) and fit.partial for fit in (result.source_fit, result.target_fit)]
    begins = (moved, onto) if parts[0] and not onto.is_cloud else (onto, moved)
    return meshmatch.measure_distance(*begins, one_way=one_way or any(parts), unit=unit)


def _register_onto(
    shape: Path, onto: Path, output: Path, picture: Path | None, how: FitOptions, run: RunOptions, console: Console
) -> None:
    """Deform the mesh of one shape onto another."""
    import numpy as np

    from meshmatch.api.matching import match as match_shapes
    from meshmatch.api.skeletons import move_skeleton
    from meshmatch.api.upright import turn_of_moved
    from meshmatch.geometry.triangles import rotations_between
    from meshmatch.outputs import replace_all_on_success
    from meshmatch.shapes.blend_shapes import shape_normals
    from meshmatch.shapes.deformed_files import MovedFile

    names = user_messages.names_of([shape, onto])
    plan = MovedFile.planned(output, shape)
    check_outputs([shape, onto], *plan.files, picture=picture)
    plan.make_folders()
    with replace_all_on_success(plan.files) as temporary:
        check_model(how.model)
        a, b = how.load(shape, onto)
        if a.is_cloud:
            raise OptionError(f"{names[0]} has no faces, and only a mesh can be deformed", "exchange the shapes")
        with console.progress() as report:
            result = match_shapes(
                a, b, model=how.model, config=how.configs()[0], threads=run.threads, progress=report
            )  # fmt: skip
        found = result.map
        user_messages.raise_if_poor(run.strict, found.verdict, found.reasons, "the registration")
        moved = result.deformed_source()
        turn = turn_of_moved(a, moved.verts, b, result.target_fit)
        before, after = shape_normals(a, (moved.verts - a.verts)[None].astype(np.float32))
        binding = move_skeleton(shape, moved, b.upright)
        plan.write(temporary, moved, rotations_between(before, after), binding, turn)
    if picture is not None:
        from meshmatch.render.compose import compose_fit

        compose_fit(b, moved, result.rotations[1], what=f"the mesh of {names[0]}").render(picture)
    user_messages.report_match(console, result, names)
    apart = surfaces_apart(result, moved, b)
    console.say(str(apart))
    user_messages.report_verdict(console, found.verdict, found.reasons, "the registration")
    if plan.is_turned(binding, turn):
        console.say(f"note: a node turns {names[0]} upright, along y")
    where = ", ".join(map(str, plan.files))
    console.say(f"wrote {where}: the mesh of {names[0]} on {names[1]}, {moved.V} vertices ({result.seconds:.1f} s)")
    if picture is not None:
        console.say(f"drew {picture}: the mesh over {names[1]}, and their distance")
    if run.json:
        fits = [
            user_messages.fit_record(*each) for each in zip(names, (result.source_fit, result.target_fit), strict=True)
        ]
        record: Json = {"output": output, "picture": picture, "onto": onto, "vertices": moved.V, "faces": moved.F}
        record |= {"distance": apart.as_dict(), "verdict": found.verdict, "reasons": found.reasons}
        record |= {"fits": fits, "notes": result.notes}
        print_json(record | how.record(result.source_fit) | {"seconds": round(result.seconds, 3)})


def evaluate(
    *,
    map_file: Path = Argument(..., metavar="MAP", help="A map that `meshmatch match` wrote, or a folder of fits."),
    source: Path = Argument(..., metavar="SOURCE", help="The shape that it maps from."),
    target: Path = Argument(..., metavar="TARGET", help="The shape that it maps to."),
    truth: options.Truth = None,
    points: options.Points = None,
    backward: Path | None = optional("MAP", "The map from TARGET to SOURCE, to measure bijectivity."),
    threshold: float | None = Option(
        None,
        min=0.0,
        metavar="LENGTH",
        help="Report the share of errors above this, in --unit; by default 15 cm, or 10 % of the square root of the area "
        "(needs ground truth).",
    ),
    curve: Path | None = optional("FILE", "Plot the cumulative error curve: .png, .svg or .pdf (needs ground truth)."),
    picture: Path | None = optional("PNG", "Draw both shapes, errors as a color map (needs ground truth)."),
    unit: options.ErrorUnit = "auto",
    seed: options.Seed = 0,
    json: options.Json = False,
) -> None:
    """Measure how good a map is.

    Reports coverage and, for meshes, distortion, Dirichlet energy and folds. With --truth or --points, also reports
    geodesic errors on TARGET, in percent of the square root of its area and in the unit of its file; for a person in
    centimetres, with TARGET scaled to 1.9 square metres of skin. With --backward, also reports bijectivity: the mean
    distance between a vertex and where both maps together take it.
    """
    has_truth = options.check_truth(truth, points)
    if threshold is not None and isinf(threshold):
        raise OptionError("--threshold must be a length, not inf", "leave it out for the default")
    for what, given in (("curve", curve), ("picture", picture), ("threshold", threshold)):
        if given is not None and not has_truth:
            raise OptionError(f"a {what} of errors needs ground truth", "give it with --truth or --points")
    check_outputs([map_file, source, target, truth, backward, *(points or ())], chart=curve, picture=picture)
    shapes = meshmatch.load_shape(source), meshmatch.load_shape(target)
    back = None if backward is None else meshmatch.load_map(backward, *shapes[::-1])
    if map_file.is_dir():
        if backward is not None:
            raise OptionError(
                "--backward does not go with a folder of fits", "leave it out: the fits also give the map back"
            )
        both = meshmatch.Collection(map_file).maps_between(*shapes)
        found, back = both.forward, both.backward
    else:
        found = meshmatch.load_map(map_file, *shapes)
    known = options.load_truth(truth, points, shapes, (source, target))
    console = Console()
    with console.progress() as report:
        result = meshmatch.evaluate(found, *shapes, known, backward=back, unit=unit, seed=seed, progress=report)
    if known is not None and result.errors is not None:
        if curve is not None:
            from meshmatch.render.charts import draw_curves

            limit = 20.0 if result.unit.name == "cm" else 2.5 * result.unit.lost
            draw_curves({found.source or source.stem: result.errors}, curve, limit, unit=result.unit)
        if picture is not None:
            from meshmatch.render.compose import compose_errors

            compose_errors(*shapes, found, known, result.errors, result.unit).render(picture)
    console.say(*(f"note: {reason}" for reason in found.reasons))
    if json:
        print_json(dict(result.as_dict(threshold)))
    else:
        print_rows(_rows(result, threshold))


def _rows(result: "Evaluation", threshold: float | None) -> list[tuple[str, str, str]]:
    rows, unit = [], result.unit
    if (errors := result.errors) is not None:
        digits, limit = ".2f" if unit.name == "cm" else ".3g", unit.lost if threshold is None else threshold
        also = "" if unit.name == "x100" else "{:.2f} x 0.01 sqrt(area)"
        rows = [
            (f"{name} error", f"{unit.factor * value:{digits}} {unit.symbol}", also.format(100 * value))
            for name, value in {"mean": errors.mean, "median": errors.median}.items()
        ]
        limits = f"over {limit:{'.3g' if threshold is None else '.9g'}} {unit.symbol}"
        rows += [
            ("large errors", f"{100 * result.share_over(threshold):.2f} %", limits),
            ("points", f"{errors.values.size}", f"geodesic: {result.geodesic}"),
        ]
    rows += [
        ("coverage", f"{100 * result.coverage.vertices:.1f} %", "of the target's vertices"),
        ("", f"{100 * result.coverage.area:.1f} %", "of the target's area"),
    ]
    if result.distortion is not None:
        rows.append(("distortion", f"{result.distortion:.4f}", "sqrt(area), between random pairs of points"))
    if result.dirichlet is not None:
        rows.append(("dirichlet", f"{result.dirichlet:.3f}", "energy; 1 for an isometry"))
    if result.bijectivity is not None:
        rows.append(("bijectivity", f"{result.bijectivity:.4f}", "sqrt(area), from a vertex to its image by both maps"))
    if (folds := result.folds) is not None:
        rows += [
            ("flipped", f"{100 * folds.flipped:.2f} %", "of the source's area is turned over"),
            ("crushed", f"{100 * folds.crushed:.2f} %", "is mapped to less than a quarter of its area"),
            ("stretch", f"{folds.stretch:.2f}", "median factor by which the surface is stretched or shrunk"),
        ]
    return rows
