"""Tables, planes and chairs without correspondence: ``python -m meshmatch.experiments.segments``.

For each class a model is trained on its ten shapes without correspondence, every shape is fitted with 200 steps on
the code (the paper's test-time weights), and all ordered pairs are matched. What is asked is what a label transfer
needs: where a keypoint of one shape lies on another. The error is the distance between the matched and the true
keypoint over the diagonal of the target's bounding box; a label arrives where that is below a tenth. Structure
differs within a class (four legs, one leg, none), so no map can be right everywhere: whether the confidence knows is
the area under its ROC curve, and its mean where the keypoint is right and where it is wrong.

Files are turned every way. `--turns given` (the default) brings each shape to the axes of the first one with the turn
of a cube that suits its keypoints best, so upright and facing the same way, as the benchmark's protocol gives it;
`--turns searched` lets `meshmatch prepare --align rigid` find the orientation. The same shapes, in the same
orientation, are matched by rigid alignment and the nearest vertex. Trained and measured on the same ten. A table looks
the same from several sides, and keypoints begin at any leg and run round either way: so the ends of legs are measured
once more, for every method, in the numbering that suits a pair best.
Parts are drawn from keypoints: a vertex belongs to the nearest one. Labels of the target, fetched along the map, are
compared with the source's own: intersection over union (IoU), by area, the mean over parts and pairs. Of tables the
legs are counted (three, four or eight): a leg can have no counterpart where the other table has another number of
them, and the confidence of legs is compared between such pairs and the others.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rich.console import Console
from rich.status import Status
from scipy.spatial.transform import Rotation

from meshmatch.errors import OptionError
from meshmatch.experiments.category import (
    Pair,
    Training,
    area_under_curve,
    fit_all,
    load_category,
    map_all,
    nearest_all,
    options_of_training,
    trained,
    training_of,
)
from meshmatch.experiments.keypoint_parts import (
    carried_picture,
    keypoint_parts,
    leg_confidence,
    leg_errors,
    mean_overlap,
    rounded,
    table_legs,
)
from meshmatch.experiments.report import columns, publish, status_of
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.latent import LatentRefineConfig
from meshmatch.outputs import make_folder
from meshmatch.render.picture import Look
from meshmatch.shapes.align import Align
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.shape import Shape
from meshmatch.threads import set_threads

CLASSES = ("table", "plane", "chair")
KEYPOINTS = ".keypoints.npy"
RIGHT = 0.1
"""Share of the target's diagonal within which a keypoint has arrived."""

Turns = Literal["given", "searched"]

_LOOKS = {
    "table": Look(up="-z", front="-y", turn=25, tilt=-20),
    "plane": Look(up="z", front="-x", turn=-40, tilt=40),
    "chair": Look(up="y", front="-x", turn=35, tilt=15),
}


def stood_alike(shapes: Mapping[str, Shape], keypoints: Mapping[str, np.ndarray]) -> dict[str, Shape]:
    """Every shape by the turn of a cube that brings its keypoints nearest to those of the first shape."""
    turns = Rotation.create_group("O").as_matrix()
    first, like = next(iter(shapes)), _unit(next(iter(shapes.values())), next(iter(keypoints.values())))
    stood = {first: shapes[first]}
    for name, shape in shapes.items():
        if name == first:
            continue
        own = _unit(shape, keypoints[name])
        best = min(turns, key=lambda turn: float(np.square(own @ turn.T - like).sum()))
        stood[name] = Shape(shape.verts @ best.T, shape.faces, shape.name)
    return stood


def _unit(shape: Shape, keypoints: np.ndarray) -> np.ndarray:
    return (shape.verts[keypoints] - shape.bounds.mean(axis=0)) / shape.diagonal


def keypoint_errors(
    shapes: Mapping[str, Shape],
    keypoints: Mapping[str, np.ndarray],
    maps: Mapping[Pair, tuple[np.ndarray, np.ndarray]],
) -> dict[str, Any]:
    """Errors of (index, confidence) maps at the keypoints, and what their confidence tells."""
    errors, sure, means, overlaps = [], [], {}, []
    parts = {name: keypoint_parts(shape, keypoints[name]) for name, shape in shapes.items()}
    for (source, target), (index, confidence) in maps.items():
        overlaps.append(mean_overlap(parts[target][index], parts[source], shapes[source].vertex_areas))
        shape, at = shapes[target], keypoints[source]
        apart = shape.verts[index[at]] - shape.verts[keypoints[target]]
        found = np.linalg.norm(apart, axis=1) / shape.diagonal
        errors.append(found)
        sure.append(confidence[at])
        means[source, target] = float(found.mean())
    error, confidence = np.concatenate(errors), np.concatenate(sure).astype(float)
    right = error < RIGHT
    worst = max(means, key=lambda pair: means[pair])
    return {
        "pairs": len(maps),
        "mean": round(float(error.mean()), 4),
        "median": round(float(np.median(error)), 4),
        "arrived": round(float(right.mean()), 4),
        "iou": round(float(np.mean(overlaps)), 4),
        "worst_pair": [*worst, round(means[worst], 4)],
        "confidence_auc": rounded(area_under_curve(confidence, right)),
        "confidence_right": rounded(float(confidence[right].mean()) if right.any() else np.nan),
        "confidence_wrong": rounded(float(confidence[~right].mean()) if (~right).any() else np.nan),
    }


def measure(
    name: str, data: Path, training: Training, turns: Turns, pictures: Path | None, status: Status
) -> dict[str, Any]:
    """Train on one class, match all its pairs, and the same by rigid alignment; draw labels as they are carried."""

    def tell(what: str) -> None:
        status.update(f"{name}: {what}")

    shapes, keypoints = load_category(data / name, KEYPOINTS)
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
    answers = nearest_all(shapes, how, "sphere", tell)
    rigid = keypoint_errors(shapes, keypoints, answers)
    if legs:
        rigid |= leg_errors(shapes, keypoints, answers, RIGHT)
    results: dict[str, Any] = {"rigid alignment, nearest vertex": rigid}
    model, went = trained(folder, training, how=how, scale="sphere", tell=tell)
    for label, config in (
        ("network alone", FitConfig(seed=training.seed, refine="none", partial="no")),
        (
            "200 steps on the code",
            FitConfig(seed=training.seed, refine="latent", latent=LatentRefineConfig(steps=200)),
        ),
        ("nodes refined", FitConfig(seed=training.seed, partial="no")),
    ):
        fits = fit_all(model, shapes, config, tell)
        maps = map_all(model, shapes, fits, config, tell)
        answers = {pair: (found.index, found.confidence) for pair, found in maps.items()}
        results[label] = keypoint_errors(shapes, keypoints, answers)
        results[label]["verdicts"] = sorted(fit.verdict for fit in fits.values())
        if legs:
            results[label] |= leg_confidence(legs, answers) | leg_errors(shapes, keypoints, answers, RIGHT)
    if pictures is not None:
        first = Path(went["template"]).stem
        parts = keypoint_parts(shapes[first], keypoints[first])
        carried_picture(shapes, parts, answers, first, pictures / f"segments-{name}.png", _LOOKS[name])
    return {"training": went, "results": results}


def run(
    classes: Sequence[str], training: Training, *, data: Path, turns: Turns, pictures: Path | None
) -> dict[str, Any]:
    """Measure the classes, print a table and a JSON line; the line's record is returned too."""
    if strangers := [name for name in classes if name not in CLASSES]:
        raise OptionError(f"there is no class '{strangers[0]}'", f"choose from {', '.join(CLASSES)}")
    set_threads(training.threads)
    if pictures is not None:
        make_folder(pictures)
    numbers = ["mean", "median", f"within {RIGHT:g}", "IoU", "AUC", "sure if right", "if wrong"]
    told = [*numbers, "legs", f"within {RIGHT:g}", "AUC of legs", "sure if as many", "if not"]
    title = f"Keypoints, orientation {turns}: error / diagonal, all pairs"
    table = columns(title, ["class", "method"], told if "table" in classes else numbers)
    records = {}
    for name in classes:
        with Console(stderr=True).status(name) as status:
            records[name] = measure(name, data, training.inside(name), turns, pictures, status)
        for number, (label, each) in enumerate(records[name]["results"].items()):
            sure = [each[f"confidence_{key}"] for key in ("auc", "right", "wrong")]
            if "table" in classes:
                sure += [each.get("legs_mean"), each.get("legs_arrived")]
                sure += [each.get(f"legs_{key}") for key in ("auc", "alike", "unlike")]
            table.add_row(
                name if number == 0 else "",
                label,
                f"{each['mean']:.3f}",
                f"{each['median']:.3f}",
                f"{100 * each['arrived']:.1f} %",
                f"{each['iou']:.2f}",
                *("-" if value is None else f"{value:.2f}" for value in sure),
            )
    record = {"seed": training.seed, "turns": turns, "classes": records}
    return publish("segments", table, record, threads=training.threads)


def main(words: Sequence[str] | None = None) -> int:
    """Run the benchmark; 0 when it ran, 1 when the data or the choice stopped it."""
    parser = options_of_training("segments", __doc__, minutes=10, steps=2000, nodes=320, radius=0.2)
    parser.add_argument("--classes", default=",".join(CLASSES), help="%(default)s")
    parser.add_argument("--turns", choices=("given", "searched"), default="given")
    parser.add_argument("--pictures", type=Path, metavar="FOLDER", help="draw labels as they are carried")
    options = parser.parse_args(words)
    with training_of(parser, options) as training:
        return status_of(
            lambda: run(
                options.classes.split(","),
                training,
                data=options.data,
                turns=options.turns,
                pictures=options.pictures,
            )
        )


if __name__ == "__main__":
    sys.exit(main())
