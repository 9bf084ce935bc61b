"""``meshmatch export``."""

from pathlib import Path
from typing import Annotated, Literal

from typer import Argument, Option

import meshmatch
from meshmatch.cli import options
from meshmatch.cli.options import optional, output_option
from meshmatch.cli.words import Console, print_json


def export(
    fits: Annotated[str, Argument(metavar="FITS", help="A folder that `meshmatch fit` made, or its URL.")],
    output: Path = output_option("FOLDER", "A new folder for the meshes or the table."),
    suffix: str = Option(
        "",
        "--format",
        metavar="SUFFIX",
        help="A mesh of each shape: .vtp, .vtk, .ply, .obj, .off, .stl or .glb; or one table of all coordinates: .csv, a "
        "row for each shape, or .npz with points (S, V, 3). Default: .ply, or .vtp with --original.",
    ),
    place: Literal["files", "template"] = Option(
        "files",
        help="Coordinates: as the input files have them, or all turned as the template stands, about its center.",
    ),
    original: bool = Option(
        False,
        "--original",
        help="Write the shapes themselves, as .vtp or .vtk, with what is known of their vertices: signed distance and "
        "displacement from the mean shape, and parts of the template.",
    ),
    values: Path | None = optional(
        "FILE",
        "With --original: also these numbers, a row per vertex of the template (.npy or .csv), such as groups.csv.",
    ),
    metadata: Path | None = optional(
        "TABLE", "What is known of each shape: a row each, with its name; metadata.csv then has it, too."
    ),
    smooth: bool = Option(
        False, "--smooth", help="The shapes of a folder are frames: smooth their motion in time, along their surfaces."
    ),
    cycle: bool = Option(
        False, "--cycle", help="The same of a periodic motion: the last frame is followed by the first."
    ),
    poor: bool = Option(False, "--poor", help="Write poor fits too."),
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Write the registered meshes of a collection.

    All have the vertices and faces of one template: vertex i is the same point on every shape. Units are those of the
    files. Beside a table of coordinates, metadata.csv has a row for each shape: its centroid size, whether it is a
    mirror image, and the row of TABLE.
    """  # fmt: skip
    console = Console(quiet)
    with console.progress() as progress:
        done = meshmatch.Collection(fits, progress=progress).export(
            output, suffix=suffix, place=place, poor=poor, original=original, values=values, metadata=metadata,
            smooth=smooth, cycle=cycle,
        )  # fmt: skip
    if done.left_out:
        console.say(f"poor fits are left out: {', '.join(done.left_out)}; --poor writes them too")
    each = "with what is known of their vertices" if original else f"{done.vertices} vertices each"
    console.say(f"wrote {output}: {done.count} shapes, {each}")
    if json:
        print_json({"output": output, "fits": fits, "files": list(done.files), "left_out": list(done.left_out)})
