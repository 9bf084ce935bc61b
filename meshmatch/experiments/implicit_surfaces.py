"""Surfaces between two shapes of an implicit model, in the frames of their files, and a map from one to the other.

A and B are names of shapes that MODEL (a folder of `experiments.implicit_training`) learned from. --map writes the map
from the vertices of A's surface to those of B's, or of the files given with --source and --target.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import numpy as np
from typer import Argument, Option

from meshmatch.experiments import runner
from meshmatch.experiments.implicit_model import load_implicit
from meshmatch.maps.files import save_map
from meshmatch.outputs import folder_on_success
from meshmatch.shapes.files import save_shape


@runner.command
def main(
    model: Annotated[Path, Argument(help="folder of the model")],
    a: Annotated[str, Argument(help="name of the first shape")],
    b: Annotated[str, Argument(help="name of the last shape")],
    output: Annotated[Path, Option("-o", "--output", help="folder of the surfaces")],
    frames: Annotated[int, Option("-n", "--frames", min=2)] = 9,
    resolution: Annotated[int, Option(help="cells along each side of the cube, an even number")] = 64,
    path: Annotated[Path | None, Option("--map", help="file of the map")] = None,
    source: Annotated[Path | None, Option(help="A's own file")] = None,
    target: Annotated[Path | None, Option(help="B's own file")] = None,
    threads: runner.Threads = 1,
) -> runner.Report:
    loaded = load_implicit(model)
    with folder_on_success(output) as folder:
        for number, time in enumerate(np.linspace(0, 1, frames).tolist()):
            save_shape(folder / f"frame-{number:03d}.ply", loaded.surface(a, b, time, resolution))
        if path is not None:
            save_map(path, loaded.match(a, b, source, target))
    return runner.Report({"output": output, "frames": frames, "map": path})


if __name__ == "__main__":
    sys.exit(main())
