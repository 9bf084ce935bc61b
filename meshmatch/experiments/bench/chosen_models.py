"""Of what kind `--model auto` takes every shape of the benchmark, and things that are of none.

Bodies, animals, hands and heads have a model ("spot" is the textured cow, of stylised proportions); hearts, furniture and
plain solids have none and must be refused. Hands and heads are generated (meshmatch/experiments/makers/cut_scans.py),
and so are characters (character_designs.py), but for the evaluation data's two, and the chairs, tables and planes of
"furniture". Clouds with noise, and sparse ones with outliers, are bodies too; where a cloud cannot be told alone it
takes the kind of the shape that it is matched with ("unsure" here), which is all that can be said of "clouds" of
hearts, chairs, tables and planes, every other one with a tenth of strays.
*Reading* is the mean distance of the shape and a model's unrefined template (units of sqrt(area)).
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import trimesh
from typer import Option

from meshmatch.api.inputs import validated
from meshmatch.api.kinds import category_residuals, classify_shapes, installed_models
from meshmatch.errors import InputError
from meshmatch.experiments import runner
from meshmatch.experiments.bench.characters import characters_of
from meshmatch.experiments.bench.sets import CLOUD_SET, SET_NAMES, load_clouds, load_set
from meshmatch.experiments.makers.character_designs import Designer
from meshmatch.experiments.makers.cut_scans import make_scans
from meshmatch.experiments.makers.furniture import KINDS, furniture
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.judge.category import KNOWN
from meshmatch.shapes.files import as_shape
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape
from meshmatch.templates.template import read_template
from meshmatch.threads import thread_limit

FOLDERS = {"faust_scans": "human", "animal": "quadruped", "heart": "", "chair": "", "table": "", "plane": ""}
"""Folders of meshes, and their kind; empty: none."""
MADE = ("hand", "head")
CHARACTERS = ("stylised", "robots", "soldiers", "rogues")
SETS = (*SET_NAMES, CLOUD_SET, "outliers", *FOLDERS, "spot", "clouds", *MADE, *CHARACTERS, "solids", "furniture")
_SCANS, _CAST, _PIECES = 20, 12, 20
_POINTS, _STRAYS = (4000, 1000), (0, 100)  # of one cloud and the next
COLUMNS = {
    **{
        "set": "set",
        "shapes": "shapes:d",
        "of kind": "kind",
        "right": "right:d",
        "unsure": "unsure:d",
        "wrong": "wrong:d",
    },
    **{"own reading, at most": "own:.4f", "others', at least": "others:.4f"},
}


def shapes_of(name: str, data: Path) -> Iterator[Shape]:
    """The shapes of a set as a method gets them."""
    if name in (*SET_NAMES, CLOUD_SET):
        bench = load_set(name, data)
        yield from (bench.seen(shape) for shape in bench.shapes)
    elif name == "outliers":
        yield from load_clouds(data).values()
    elif name == "spot":
        yield as_shape(data / "textured" / "spot_triangulated.obj")
    elif name == "clouds":
        none = [each for folder, kind in FOLDERS.items() if not kind for each in shapes_of(folder, data)]
        yield from (as_cloud(each, number) for number, each in enumerate(none))
    elif name in MADE:
        yield from (scan.shape for scan in make_scans(name, _SCANS))
    elif name in CHARACTERS:
        designer = Designer.unseen(read_template("human-T"))
        yield from (each.shape for each in characters_of(name, _CAST, designer, data))
    elif name == "furniture":
        yield from (furniture(kind, 0, number).mesh() for kind in KINDS for number in range(_PIECES))
    elif name == "solids":
        solids = {
            "box": trimesh.creation.box().subdivide().subdivide().subdivide(),
            "ball": trimesh.creation.icosphere(4),
            "ring": trimesh.creation.torus(1.0, 0.3),
            "rod": trimesh.creation.cylinder(0.2, 2.0).subdivide().subdivide(),
            "capsule": trimesh.creation.capsule(2.0, 0.3),
        }
        yield from (Shape(solid.vertices, solid.faces, word) for word, solid in solids.items())
    else:
        yield from (as_shape(file) for file in sorted((data / name).glob("*.ply")))


def as_cloud(shape: Shape, number: int) -> Shape:
    """Points of a shape's surface, and strays in its box."""
    rng = np.random.default_rng(number)
    points = sample_surface(shape, _POINTS[number % 2], rng).points
    low, high = points.min(0), points.max(0)
    points = np.concatenate([points, rng.uniform(low, high, (_STRAYS[number % 2], 3))])
    return Shape(points, np.empty((0, 3), np.int64), f"cloud of {shape.name}")


def row_of(name: str, shapes: list[Shape]) -> dict[str, Any]:
    """How many of a set's shapes are taken for what they are; the highest reading of their kind, the lowest of others."""
    nothing = name in ("clouds", "solids", "furniture")
    made = name if name in MADE else "" if nothing else "quadruped" if name == "spot" else "human"
    wanted = FOLDERS.get(name, made)
    models, config = installed_models(), [FitConfig()]
    right, unsure, wrong, own, others = 0, 0, list[str](), 0.0, np.inf
    for shape in runner.track(shapes, name):
        clean = [validated(shape).shape]
        with thread_limit(1):
            readings = category_residuals(models, clean, config, sure=0.0)  # all are asked
        for model, reading in zip(models, readings[:, 0], strict=True):
            if model.card.category == wanted:
                own = max(own, float(reading))
            else:
                others = min(others, float(reading))
        try:
            kind = classify_shapes(models, readings, clean, config)[0].kind
        except InputError:
            kind = ""
        right += kind == wanted
        unsure += kind is None
        if kind not in (wanted, None):
            wrong.append(f"{shape.name}: {kind or 'none'}")
    record = {"set": name, "kind": wanted or "none", "shapes": len(shapes), "right": right, "unsure": unsure}
    return record | {"wrong": len(wrong), "own": own or None, "others": others, "which": wrong}


@runner.command
def main(
    data: runner.Data = runner.DATA,
    sets: Annotated[str, Option(help=f"of {', '.join(SETS)}")] = ",".join(SETS),
    limit_shapes: Annotated[int | None, Option(min=1, help="of each set, evenly spread")] = None,
) -> runner.Report:
    rows = [
        row_of(name, runner.spread(list(shapes_of(name, data)), limit_shapes))
        for name in runner.names_of(sets, SETS, "set")
    ]
    notes = [f"wrong: {word}" for row in rows for word in row["which"]]
    record = {"known": KNOWN, "models": [model.card.name for model in installed_models()], "rows": rows}
    return runner.Report(record, [runner.table("The kind of every shape", rows, COLUMNS)], notes)
