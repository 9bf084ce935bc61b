"""A folder of generated four-legged animals (meshmatch/generators/quadrupeds.py): registered watertight meshes, seeded.

FOLDER receives one mesh for each animal, all with the same vertices and triangles, and first, as `0-rest.ply`, one at
rest, symmetric, which faces +z and stands along y: `meshmatch prepare FOLDER` makes it the template. The meshes are under
the licence of the dog of dm_control, Apache-2.0.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from meshmatch.experiments import runner
from meshmatch.generators.quadruped_rig import load_rig
from meshmatch.generators.quadrupeds import make_animal, resting_animal
from meshmatch.outputs import make_folder
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.shape import Shape

REST = "0-rest"  # comes first


@runner.command
def main(
    folder: Annotated[Path, Argument(help="receives the meshes")],
    count: Annotated[int, Option(min=1, help="of animals")] = 2000,
    assets: Annotated[Path | None, Option(help="folder dog_v2 of dm_control; default: of the installed one")] = None,
    seed: runner.Seed = 0,
) -> runner.Report:
    rig = load_rig(assets)
    make_folder(folder)
    save_shape(folder / f"{REST}.ply", Shape(resting_animal(rig), rig.faces, REST))
    for number in runner.track(range(count), "making animals"):
        name = f"animal-{number:05d}"
        save_shape(folder / f"{name}.ply", Shape(make_animal(rig, seed, number), rig.faces, name))
    facts = {"animals": count, "vertices": len(rig.verts), "triangles": len(rig.faces)}
    return runner.Report(facts, notes=[f"wrote {count} animals and {REST}.ply to {folder}"])


if __name__ == "__main__":
    sys.exit(main())
