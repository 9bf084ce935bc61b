"""``meshmatch symmetry``."""

from pathlib import Path

from typer import Argument, Option

import meshmatch
from meshmatch.cli import options, user_messages
from meshmatch.cli.options import check_outputs, optional, output_option
from meshmatch.cli.user_messages import Console, print_json

_NAMES = ("asymmetry", "displacement_x", "displacement_y", "displacement_z")


def symmetry(
    *,
    shape: Path = Argument(..., metavar="SHAPE", help="A mesh that is nearly symmetric, such as a head."),
    output: Path = output_option(
        "MAP", "The map from SHAPE to itself; its suffix chooses the format: .npy, .npz, .csv, .txt, .mat or .json."
    ),
    values: Path | None = optional(
        "FILE",
        "The asymmetry of each vertex along its normal, positive if it lies farther out than its counterpart, and its "
        "displacement from the mirror image of that: .vtp or .vtk for ParaView and 3D Slicer, .ply, .csv or .npy.",
    ),
    strict: bool = Option(False, "--strict", help="Write nothing and exit with status 1 if the map is poor."),
    threads: options.Threads = 2,
    seed: options.Seed = 0,
    quiet: options.Quiet = False,
    json: options.Json = False,
) -> None:
    """Find the mirror counterpart of each vertex of a shape.

    The shape is matched to its own mirror image: index[i] of the map is the vertex on the other side that corresponds to
    vertex i. Prints the plane of symmetry and the asymmetry, in the unit of the file. For the asymmetry of a collection,
    see `meshmatch atlas --symmetry`.
    """
    import numpy as np

    from meshmatch.maps.files import check_suffix
    from meshmatch.outputs import replace_all_on_success
    from meshmatch.transfer.value_files import Values, check_values_suffix, save_values

    check_suffix(output)
    if values is not None:
        check_values_suffix(values)
    check_outputs([shape], output, values)
    console, name = Console(quiet), shape.name
    with replace_all_on_success([output, *([] if values is None else [values])]) as temporary:
        loaded = meshmatch.load_shape(shape)
        config = meshmatch.FitConfig(seed=seed)
        with console.progress() as report:
            found = meshmatch.find_symmetry(loaded, config=config, threads=threads, progress=report)
        user_messages.raise_if_poor(strict, found.map.verdict, found.map.reasons, "the map")
        meshmatch.save_map(temporary[0], found.map)
        if values is not None:
            numbers = np.column_stack([found.along_normal, found.displacement])
            save_values(temporary[1], Values(numbers, _NAMES), loaded)
    console.say(*(f"{name}: {note}" for note in found.notes))
    apart = np.abs(found.along_normal[np.isfinite(found.along_normal)])
    normal = " ".join(f"{each:.4g}" for each in found.normal)
    console.say(f"plane of symmetry: x . ({normal}) = {found.offset:.4g}")
    console.say(f"asymmetry along the normal: mean {apart.mean():.4g}, 95 % {np.quantile(apart, 0.95):.4g}")
    user_messages.report_verdict(console, found.map.verdict, found.map.reasons, "the map")
    console.say(f"wrote {output}: mirror counterparts of the {loaded.V} vertices of {name} ({found.seconds:.1f} s)")
    if values is not None:
        console.say(f"wrote {values}: its asymmetry")
    if json:
        record = {"output": output, "values": values, "normal": found.normal.tolist(), "offset": found.offset}
        record |= {"asymmetry": {"mean": float(apart.mean()), "95 %": float(np.quantile(apart, 0.95))}}
        record |= user_messages.map_record(found.map, [name, name])
        print_json(record | {"notes": list(found.notes), "seconds": round(found.seconds, 3)})
