"""``meshmatch wrap``."""

from pathlib import Path
from typing import TYPE_CHECKING

from typer import Argument

import meshmatch
from meshmatch.cli import user_messages
from meshmatch.cli.match import surfaces_apart
from meshmatch.cli.options import PairOptions, RunOptions, check_outputs, grouped, optional, output_option
from meshmatch.cli.transfer_options import Picture
from meshmatch.cli.user_messages import Console, print_json
from meshmatch.models.registry import check_model

if TYPE_CHECKING:
    from meshmatch.arrays import Ints


@grouped
def wrap(
    *,
    base: Path = Argument(..., metavar="BASE", help="Your mesh."),
    scan: Path = Argument(..., metavar="SCAN", help="The shape onto whose surface it is deformed."),
    output: Path = output_option(
        "FILE",
        "BASE on SCAN. An .obj written from an .obj, or a .glb from a .glb, keeps everything but the positions; materials "
        "and images of an .obj are copied next to it. Other formats keep less; a warning lists what is lost.",
    ),
    how: PairOptions,
    run: RunOptions,
    free: Path | None = optional(
        "FILE",
        "Vertices of BASE that keep their local shape and follow those around them, such as eyes and the inside of the "
        'mouth: a number per line, counted from 0 (.txt, .csv or .npy), or lists by part, {"eyes": [17, 18]} (.json). '
        "Meshes that --only and --without leave out do so too.",
    ),
    picture: Picture = None,
) -> None:
    """Deform your own mesh onto the surface of a scan.

    BASE is matched to SCAN, deformed along the match, and projected onto the surface, smoothly at first and then in finer
    steps. Its vertex order, polygons, texture coordinates and groups are kept. Prints, in the unit of SCAN, the distance
    of its vertices from the surface, and the distance between the two surfaces.
    """
    import numpy as np

    from meshmatch.api.skeletons import move_skeleton
    from meshmatch.outputs import replace_all_on_success
    from meshmatch.shapes.deformed_files import MovedFile
    from meshmatch.shapes.files import check_mesh_suffix

    how.check()
    check_mesh_suffix(output)
    how.refuse(["model"] if how.implicit else [], "wrap", "choose another model, or none")
    console, names = Console(run.quiet), user_messages.names_of([base, scan])
    check_outputs([base, scan, how.known_pairs, free], output, picture=picture)
    plan = MovedFile.planned(output, base)
    check_outputs([base, scan, how.known_pairs, free], *plan.files, picture=picture)
    plan.make_folders()
    with replace_all_on_success(plan.files) as temporary:
        check_model(how.model)
        a, b = how.load(base, scan)
        rows = _read_vertices(free, a)
        pairs = how.pairs()
        with console.progress() as report:
            result = meshmatch.wrap(
                a, b, free=rows, model=how.model, config=how.configs(), landmarks=pairs, threads=run.threads,
                progress=report,
            )  # fmt: skip
        found = result.match.map
        user_messages.raise_if_poor(run.strict, found.verdict, found.reasons, "the map")
        binding = move_skeleton(base, result.shape, b.upright)
        plan.write(temporary, result.shape, result.turns, binding, result.turn)
    user_messages.report_match(console, result.match, names)
    user_messages.report_verdict(console, found.verdict, found.reasons, "the map")
    apart = result.distance[~result.free & a.valid]
    numbers = {"mean": apart.mean(), "95 %": np.quantile(apart, 0.95), "worst": apart.max()} if len(apart) else {}
    distances = ", ".join(f"{what} {value:.4g}" for what, value in numbers.items())
    kept = f"; {result.free.sum()} vertices kept their shape" if result.free.any() else ""
    console.say(f"vertices to {names[1]} (whose sqrt(area) is {np.sqrt(b.area):.4g}): {distances}{kept}")
    # Free parts, such as eyes, are not meant to lie on the scan.
    surfaces = surfaces_apart(result.match, result.shape, b, "file", one_way=bool(result.free.any()))
    console.say(str(surfaces))
    if binding is not None and output.suffix.lower() == ".glb":
        console.say(f"the {len(binding.rig.joints)} joints of {names[0]} were moved with it")
    if plan.is_turned(binding, result.turn):
        console.say(f"note: a node turns {names[0]} upright, along y")
    written = ", ".join(map(str, plan.files))
    console.say(f"wrote {written}: {names[0]} on {names[1]} ({result.match.seconds + result.seconds:.1f} s)")
    if picture is not None:
        from meshmatch.render.compose import compose_fit

        compose_fit(b, result.shape, result.match.rotations[1], what=f"the mesh of {names[0]}").render(picture)
        console.say(f"drew {picture}: the mesh over {names[1]}, and their distance")
    if run.json:
        record = {"output": output, "files": [str(file) for file in plan.files], "picture": picture, "vertices": a.V}
        record |= {"free": int(result.free.sum()), "distance": surfaces.as_dict()}
        record["vertices_to_surface"] = {key: float(each) for key, each in numbers.items()}
        record |= user_messages.map_record(found, names) | how.record(result.match.source_fit)
        print_json(
            record | {"notes": list(result.match.notes), "seconds": round(result.match.seconds + result.seconds, 3)}
        )


def _read_vertices(file: Path | None, base: "meshmatch.Shape") -> "Ints":
    """Read vertices from a file, as one list or by part; empty without a file."""
    import numpy as np

    from meshmatch.shapes.vertex_lists import load_points
    from meshmatch.transfer.label_files import load_labels

    if file is None:
        return np.empty(0, np.int64)
    if file.suffix.lower() == ".json":
        return np.flatnonzero(load_labels(file, base, "vertices").codes >= 0)
    return load_points(file)
