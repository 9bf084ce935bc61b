"""Tables, planes and chairs without correspondence.

For each class a model is trained on its ten shapes without correspondence, every shape is fitted with 200 steps on the
code (the paper's test-time weights), and all ordered pairs are matched. What is asked is what a label transfer needs:
where a keypoint of one shape lies on another. The error is the distance between the matched and the true keypoint over
the diagonal of the target's bounding box; a label arrives where that is below a tenth. Structure differs within a class
(four legs, one leg, none), so no map can be right everywhere: whether the confidence knows is the area under its ROC
curve, and its mean where the keypoint is right and where it is wrong.

Files are turned every way. --turns given (the default) brings each shape to the axes of the first one with the turn of a
cube that suits its keypoints best, so upright and facing the same way, as the benchmark's protocol gives it; --turns
searched lets `meshmatch prepare --align rigid` find the orientation. The same shapes, in the same orientation, are
matched by rigid alignment and the nearest vertex. Trained and measured on the same ten. A table looks the same from
several sides, and keypoints begin at any leg and run round either way: so the ends of legs are measured once more, for
every method, in the numbering that suits a pair best.

Parts are drawn from keypoints: a vertex belongs to the nearest one. Labels of the target, fetched along the map, are
compared with the source's own: intersection over union (IoU), by area, the mean over parts and pairs. Of tables the legs
are counted (three, four or eight): a leg can have no counterpart where the other table has another number of them, and
the confidence of legs is compared between such pairs and the others.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from scipy.spatial.transform import Rotation
from typer import Option

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.experiments import category, runner
from meshmatch.experiments.category import Maps, Shapes
from meshmatch.experiments.keypoint_parts import keypoint_parts, leg_confidence, leg_errors, mean_overlap, table_legs
from meshmatch.experiments.scores import area_under_curve
from meshmatch.experiments.sets import load_folder
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.latent import LatentRefineConfig
from meshmatch.outputs import make_folder
from meshmatch.render.picture import Look
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.normalise import Align
from meshmatch.shapes.shape import Shape
from meshmatch.templates.make import NodeConfig

KEYPOINTS = ".keypoints.npy"
RIGHT = 0.1
"""Share of the target's diagonal within which a keypoint has arrived."""
CLASSES = {
    "table": Look(up="-z", front="-y", turn=25, tilt=-20),
    "plane": Look(up="z", front="-x", turn=-40, tilt=40),
    "chair": Look(up="y", front="-x", turn=35, tilt=15),
}
COLUMNS = {
    **{"class": "class", "method": "method", "mean": "mean:.3f", "median": "median:.3f"},
    **{f"within {RIGHT:g}": "arrived:.1%", "IoU": "iou:.2f", "AUC": "confidence_auc:.2f"},
    **{"sure if right": "confidence_right:.2f", "if wrong": "confidence_wrong:.2f"},
}
LEGS = {
    **{"legs": "legs_mean:.3f", "legs arrived": "legs_arrived:.0%", "AUC of legs": "legs_auc:.2f"},
    **{"sure if as many": "legs_alike:.2f", "if not": "legs_unlike:.2f"},
}


def stood_alike(shapes: Shapes, keypoints: Mapping[str, Int[Ints, " N"]]) -> dict[str, Shape]:
    """Every shape by the turn of a cube that brings its keypoints nearest to those of the first shape."""
    turns = Rotation.create_group("O").as_matrix()
    first = next(iter(shapes))
    like = _unit(shapes[first], keypoints[first])
    stood = {first: shapes[first]}
    for name, shape in list(shapes.items())[1:]:
        own = _unit(shape, keypoints[name])
        best = min(turns, key=lambda turn: float(np.square(own @ turn.T - like).sum()))
        stood[name] = Shape(shape.verts @ best.T, shape.faces, shape.name)
    return stood


def _unit(shape: Shape, keypoints: Int[Ints, " N"]) -> Float[Floats, "N 3"]:
    return (shape.verts[keypoints] - shape.bounds.mean(axis=0)) / shape.diagonal


def keypoint_errors(shapes: Shapes, keypoints: Mapping[str, Int[Ints, " N"]], maps: Maps) -> dict[str, Any]:
    """Errors of maps at the keypoints, and what their confidence tells (None where there is nothing to tell apart)."""
    errors, sure, means, overlaps = [], [], {}, []
    parts = {name: keypoint_parts(shape, keypoints[name]) for name, shape in shapes.items()}
    for (source, target), found in maps.items():
        labels = parts[target][found.index]
        overlaps.append(mean_overlap(labels, parts[source], shapes[source].vertex_areas))
        shape, at = shapes[target], keypoints[source]
        off = shape.verts[found.index[at]] - shape.verts[keypoints[target]]
        errors.append(np.linalg.norm(off, axis=1) / shape.diagonal)
        sure.append(found.confidence[at])
        means[source, target] = float(errors[-1].mean())
    error, confidence = np.concatenate(errors), np.concatenate(sure).astype(float)
    right = error < RIGHT
    worst = max(means, key=lambda pair: means[pair])
    return {
        **{"pairs": len(maps), "mean": float(error.mean()), "median": float(np.median(error))},
        **{"arrived": float(right.mean()), "iou": float(np.mean(overlaps))},
        "worst_pair": [*worst, means[worst]],
        "confidence_auc": area_under_curve(confidence, right) if 0 < right.mean() < 1 else None,
        "confidence_right": float(confidence[right].mean()) if right.any() else None,
        "confidence_wrong": float(confidence[~right].mean()) if (~right).any() else None,
    }


def measure(
    name: str, data: Path, training: category.Training, turns: str, pictures: Path | None
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Train on one class, match all its pairs, and the same by rigid alignment; draw labels as they are carried."""
    shapes, keypoints = load_folder(data / name, KEYPOINTS)
    how: Align = "rigid"
    if turns == "given":
        shapes, how = stood_alike(shapes, keypoints), "none"
    folder = training.work / "shapes"
    make_folder(folder)
    for key, shape in shapes.items():
        save_shape(folder / f"{key}.ply", shape)
    legs = {}
    if name == "table":
        legs = {key: table_legs(shape, keypoints[key]) for key, shape in shapes.items()}

    def errors(maps: Maps) -> dict[str, Any]:
        found = keypoint_errors(shapes, keypoints, maps)
        return found | (leg_errors(shapes, keypoints, maps, RIGHT) if legs else {})

    def with_confidence(maps: Maps) -> dict[str, Any]:
        return errors(maps) | (leg_confidence(legs, maps) if legs else {})

    pairs = category.ordered_pairs(shapes)
    rows = [{"method": category.RIGID, **errors(category.nearest_maps(shapes, how, "sphere", pairs))}]
    config = NodeConfig("uniform", training.nodes, training.radius, 0.03, seed=training.seed)
    model, went = category.trained(folder, training, config, how=how, scale="sphere")
    latent = LatentRefineConfig(steps=200)
    network, nodes = category.network_and_nodes(training.seed).items()
    code = ("200 steps on the code", FitConfig(seed=training.seed, refine="latent", latent=latent))
    found, maps = category.compared(model, shapes, dict([network, code, nodes]), pairs, with_confidence)
    if pictures is not None:
        first = Path(went["template"]).stem
        others = [key for key in shapes if key != first]
        picked = np.unique(np.linspace(0, len(others) - 1, min(5, len(others))).astype(int))
        onto = {others[k]: maps[others[k], first] for k in picked}
        parts = keypoint_parts(shapes[first], keypoints[first])
        category.carried_picture(pictures / f"segments-{name}.png", CLASSES[name], shapes, parts, onto, first)
    return went, [{"class": name, **row} for row in rows + found]


@runner.command
def main(
    data: runner.Data = runner.DATA,
    classes: Annotated[str, Option(help=f"of {', '.join(CLASSES)}")] = ",".join(CLASSES),
    turns: Annotated[Literal["given", "searched"], Option(help="how shapes are turned")] = "given",
    pictures: Annotated[Path | None, Option(help="draw labels as they are carried into this folder")] = None,
    minutes: category.Minutes = 10,
    steps: category.Steps = 2000,
    nodes: category.Nodes = 320,
    radius: category.Radius = 0.2,
    work: category.Work = None,
    threads: runner.Threads = 2,
    seed: runner.Seed = 0,
) -> runner.Report:
    names = runner.names_of(classes, CLASSES, "class")
    if pictures is not None:
        make_folder(pictures)
    went, rows = {}, []
    how = {"minutes": minutes, "steps": steps, "threads": threads, "seed": seed}
    with category.training_in(work, nodes=nodes, radius=radius, **how) as training:
        for name in names:
            runner.tell(name)
            went[name], found = measure(name, data, training.inside(name), turns, pictures)
            rows += found
    columns = COLUMNS | (LEGS if "table" in names else {})
    title = f"Keypoints, orientation {turns}: error / diagonal, all pairs"
    return runner.Report({"training": went, "rows": rows}, [runner.table(title, rows, columns)])


if __name__ == "__main__":
    sys.exit(main())
