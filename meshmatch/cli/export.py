"""``meshmatch export``."""

from pathlib import Path
from typing import Annotated, Literal

from typer import Argument, Option

import meshmatch
from meshmatch.cli import options
from meshmatch.cli.options import optional, output_option
from meshmatch.cli.user_messages import Console, print_json


def export(
    fits: Annotated[str, Argument(metavar="FITS", help="A folder that `meshmatch fit` made, or its URL.")],
    output: Path = output_option("FOLDER", "A new folder for the meshes or the table."),
    suffix: str = Option(
        "",
        "--format",
        metavar="SUFFIX",
        help="One mesh per shape: .vtp, .vtk, .ply, .obj, .off, .stl or .glb; or one table of all coordinates: .csv with a "
        "row per shape, or .npz with points (S, V, 3). Default: .ply, or .vtp with --original.",
    ),
    place: Literal["files", "template"] = Option(
        "files", help="Coordinates: as in the input files, or all shapes in the orientation of the template, centered."
    ),
    original: bool = Option(
        False,
        "--original",
        help="Write the input shapes instead, as .vtp or .vtk, with data per vertex: signed distance and displacement from "
        "the mean shape, and parts of the template.",
    ),
    values: Path | None = optional(
        "FILE",
        "With --original: also write these numbers, a row per vertex of the template (.npy or .csv), such as groups.csv.",
    ),
    metadata: Path | None = optional(
        "TABLE", "A table with a row per shape, by name, whose columns are added to metadata.csv."
    ),
    smooth: bool = Option(
        False, "--smooth", help="For frames of a sequence: smooth the motion in time, along the surfaces."
    ),
    cycle: bool = Option(
        False, "--cycle", help="As --smooth, for a periodic motion: the first frame follows the last."
    ),
    poor: bool = Option(False, "--poor", help="Also write poor fits."),
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Write the registered meshes of a collection.

    All meshes have the vertices and faces of one template: vertex i is the same point on every shape. Units are those of
    the files. With a table of coordinates, metadata.csv is also written, with a row per shape: its centroid size, whether
    it is a mirror image, and its row of --metadata.
    """  # fmt: skip
    console = Console(quiet)
    with console.progress() as progress:
        done = meshmatch.Collection(fits, progress=progress).export(
            output, suffix=suffix, place=place, poor=poor, original=original, values=values, metadata=metadata,
            smooth=smooth, cycle=cycle,
        )  # fmt: skip
    if done.left_out:
        console.say(f"poor fits are left out: {', '.join(done.left_out)}; --poor writes them too")
    each = "with data per vertex" if original else f"{done.vertices} vertices each"
    console.say(f"wrote {output}: {done.count} shapes, {each}")
    if json:
        print_json({"output": output, "fits": fits, "files": list(done.files), "left_out": list(done.left_out)})
