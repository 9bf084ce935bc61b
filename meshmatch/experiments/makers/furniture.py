"""Generated chairs, tables and planes whose parts are known: watertight meshes with a label for every vertex.

Every shape is drawn at random, a function of the kind, the seed and its number alone. Chairs have a seat, a back, legs and
sometimes arms; tables a top, legs and sometimes shelves; planes a fuselage, wings (with what hangs on them) and a tail.
y is up and z to the front (a plane's nose); chairs and tables are in metres, a plane is about 1 long.

NAME.ply is the mesh; NAME.labels.npy the part of every vertex, an index of the names in parts.json. In Python,
`furniture` gives the solids themselves: their mesh, samples with normals and parts, and signed distances anywhere.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import numpy as np
from typer import Argument, Option

from meshmatch.errors import OptionError
from meshmatch.experiments import runner
from meshmatch.experiments.makers.furniture_designs import chair, table
from meshmatch.experiments.makers.furniture_pieces import Draw, Parts
from meshmatch.experiments.makers.furniture_planes import aeroplane
from meshmatch.experiments.makers.furniture_solids import Assembly
from meshmatch.outputs import make_folder, replace_on_success
from meshmatch.shapes.files import save_shape

KINDS = {
    "chair": ("seat", "back", "legs", "arms"),
    "table": ("top", "legs", "shelves"),
    "plane": ("fuselage", "wings", "tail"),
}


def furniture(kind: str, seed: int, number: int) -> Assembly:
    """One of the shapes of a kind, always the same for a seed and a number. `OptionError` for an unknown kind."""
    if kind not in KINDS:
        raise OptionError(f"unknown kind {kind!r}", f"choose from {', '.join(KINDS)}")
    draw = Draw(np.random.default_rng([seed, number, sorted(KINDS).index(kind)]))
    make: Callable[[Draw], tuple[Parts, float]] = {"chair": chair, "table": table, "plane": aeroplane}[kind]
    solids, fillet = make(draw)
    return Assembly(kind, KINDS[kind], tuple(solids), fillet)


Kind = Annotated[str, Option(help=f"of {', '.join(KINDS)}")]


@runner.command
def main(
    folder: Annotated[Path, Argument(help="where the shapes are written")],
    kind: Kind = "chair",
    count: Annotated[int, Option(min=1)] = 500,
    first: Annotated[int, Option(min=0, help="number of the first one")] = 0,
    resolution: Annotated[int, Option(min=16, help="voxels along the longest side")] = 96,
    seed: runner.Seed = 0,
) -> runner.Report:
    make_folder(folder)
    vertices = 0
    for number in runner.track(range(first, first + count), kind):
        made = furniture(kind, seed, number)
        shape = made.mesh(resolution)
        name = f"{kind}{number:04d}"
        save_shape(folder / f"{name}.ply", shape)
        with replace_on_success(folder / f"{name}.labels.npy") as temporary:
            np.save(temporary, made.parts_at(shape.verts))
        vertices += shape.V
    with replace_on_success(folder / "parts.json") as temporary:
        Path(temporary).write_text(json.dumps(KINDS[kind]) + "\n", encoding="utf-8")
    note = f"{count} meshes of {vertices // count:,} vertices on average in {folder}"
    return runner.Report({"count": count, "vertices": vertices, "parts": KINDS[kind]}, notes=[note])


if __name__ == "__main__":
    sys.exit(main())
