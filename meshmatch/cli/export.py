"""``meshmatch export``."""

from pathlib import Path
from typing import Annotated, Literal

from typer import Argument, Option

import meshmatch
from meshmatch.cli import options
from meshmatch.cli.options import output_option
from meshmatch.cli.words import Console, print_json


def export(
    fits: Annotated[str, Argument(metavar="FITS", help="A folder that `meshmatch fit` made, or its URL.")],
    output: Path = output_option("FOLDER", "A new folder for the meshes or the table."),
    suffix: str = Option(
        ".ply",
        "--format",
        metavar="SUFFIX",
        help="A mesh of each shape: .vtp, .vtk, .ply, .obj, .off, .stl or .glb; or one table of all coordinates: .csv, a "
        "row for each shape, or .npz with points (S, V, 3).",
    ),
    place: Literal["files", "template"] = Option(
        "files",
        help="Coordinates: as the input files have them, or all turned as the template stands, about its center.",
    ),
    poor: bool = Option(False, "--poor", help="Write poor fits too."),
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Write the registered meshes of a collection: all have the vertices and faces of one template.

    Vertex i is the same point on every shape. Units are those of the files.
    """  # fmt: skip
    console = Console(quiet)
    with console.progress() as progress:
        done = meshmatch.Collection(fits, progress=progress).export(output, suffix=suffix, place=place, poor=poor)
    if done.left_out:
        console.say(f"poor fits are left out: {', '.join(done.left_out)}; --poor writes them too")
    console.say(f"wrote {output}: {done.count} shapes, {done.vertices} vertices each")
    if json:
        print_json({"output": output, "fits": fits, "files": list(done.files), "left_out": list(done.left_out)})
