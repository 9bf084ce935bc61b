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
orientation, are matched by rigid alignment and the nearest vertex. Trained and measured on the same ten. The keypoints
of tables run round the legs one way on some and the other way on others: their truth holds up to a reflection only.
Parts are drawn from keypoints: a vertex belongs to the nearest one. Labels of the target, fetched along the map, are
compared with the source's own: intersection over union (IoU), by area, the mean over parts and pairs.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from meshmatch.config import set_threads
from meshmatch.errors import MeshmatchError, OptionError
from meshmatch.experiments.category import (
    Pair,
    area_under_curve,
    fit_all,
    load_category,
    map_all,
    nearest_all,
    trained,
)
from meshmatch.experiments.report import circumstances, explain, wide_console
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.latent import LatentRefineConfig
from meshmatch.shapes.align import Align
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.shape import Shape
from meshmatch.templates.nodes import NodeConfig

CLASSES = ("table", "plane", "chair")
KEYPOINTS = ".keypoints.npy"
RIGHT = 0.1
"""Share of the target's diagonal within which a keypoint has arrived."""

Turns = Literal["given", "searched"]


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
        "confidence_auc": _rounded(area_under_curve(confidence, right)),
        "confidence_right": _rounded(float(confidence[right].mean()) if right.any() else np.nan),
        "confidence_wrong": _rounded(float(confidence[~right].mean()) if (~right).any() else np.nan),
    }


def keypoint_parts(shape: Shape, keypoints: np.ndarray) -> np.ndarray:
    """(V,) the part of every vertex: the number of its nearest keypoint."""
    return np.asarray(cKDTree(shape.verts[keypoints]).query(shape.verts)[1])


def mean_overlap(found: np.ndarray, truth: np.ndarray, area: np.ndarray) -> float:
    """Intersection over union of labels (V,) with true ones, by the area (V,) of vertices; the mean over true parts."""
    shares = []
    for part in np.unique(truth):
        ours, theirs = found == part, truth == part
        shares.append(area[ours & theirs].sum() / area[ours | theirs].sum())
    return float(np.mean(shares))


def _rounded(value: float) -> float | None:
    return round(value, 4) if np.isfinite(value) else None


def measure(
    name: str,
    data: Path,
    work: Path,
    *,
    turns: Turns,
    minutes: float,
    steps: int,
    threads: int,
    seed: int,
    nodes: int,
    radius: float,
    status: Any,
) -> dict[str, Any]:
    """Train on one class, match all its pairs, and the same by rigid alignment."""

    def tell(what: str) -> None:
        status.update(f"{name}: {what}")

    shapes, keypoints = load_category(data / name, KEYPOINTS)
    how: Align = "rigid"
    if turns == "given":
        shapes, how = stood_alike(shapes, keypoints), "none"
    folder = work / name
    (folder / "shapes").mkdir(parents=True, exist_ok=True)
    for key, shape in shapes.items():
        save_shape(folder / "shapes" / f"{key}.ply", shape)
    results: dict[str, Any] = {
        "rigid alignment, nearest vertex": keypoint_errors(
            shapes, keypoints, nearest_all(shapes, how, "sphere", tell)
        )
    }
    model, went = trained(
        folder / "shapes",
        folder,
        minutes=minutes,
        steps=steps,
        how=how,
        scale="sphere",
        threads=threads,
        seed=seed,
        tell=tell,
        nodes=NodeConfig(strategy="uniform", K=nodes, radius=radius, seed=seed),
    )
    for label, config in (
        ("network alone", FitConfig(seed=seed, refine="none", partial="no")),
        (
            "200 steps on the code",
            FitConfig(seed=seed, refine="latent", latent=LatentRefineConfig(steps=200)),
        ),
        ("nodes refined", FitConfig(seed=seed, partial="no")),
    ):
        fits = fit_all(model, shapes, config, tell)
        maps = map_all(model, shapes, fits, config, tell)
        answers = {pair: (found.index, found.confidence) for pair, found in maps.items()}
        results[label] = keypoint_errors(shapes, keypoints, answers)
        results[label]["verdicts"] = sorted(fit.verdict for fit in fits.values())
    return {"training": went, "results": results}


def run(
    classes: Sequence[str],
    *,
    data: Path,
    turns: Turns,
    minutes: float,
    steps: int,
    threads: int,
    seed: int,
    nodes: int,
    radius: float,
    work: Path,
) -> dict[str, Any]:
    """Measure the classes, print a table and a JSON line; the line's record is returned too."""
    if strangers := [name for name in classes if name not in CLASSES]:
        raise OptionError(f"there is no class '{strangers[0]}'", f"choose from {', '.join(CLASSES)}")
    set_threads(threads)
    console = Console(stderr=True)
    table = Table(title=f"Keypoints, orientation {turns}: error / diagonal, all pairs", title_justify="left")
    for name in (
        "class",
        "method",
        "mean",
        "median",
        f"within {RIGHT:g}",
        "IoU",
        "AUC",
        "sure if right",
        "if wrong",
    ):
        table.add_column(name, justify="left" if name in ("class", "method") else "right")
    records = {}
    for name in classes:
        with console.status(name) as status:
            records[name] = measure(
                name,
                data,
                work,
                turns=turns,
                minutes=minutes,
                steps=steps,
                threads=threads,
                seed=seed,
                nodes=nodes,
                radius=radius,
                status=status,
            )
        for number, (label, each) in enumerate(records[name]["results"].items()):
            told = (each["confidence_auc"], each["confidence_right"], each["confidence_wrong"])
            table.add_row(
                name if number == 0 else "",
                label,
                f"{each['mean']:.3f}",
                f"{each['median']:.3f}",
                f"{100 * each['arrived']:.1f} %",
                f"{each['iou']:.2f}",
                *("-" if value is None else f"{value:.2f}" for value in told),
            )
    wide_console().print(table)
    whole = {
        "benchmark": "segments",
        **circumstances(threads=threads, jobs=1),
        "seed": seed,
        "turns": turns,
        "classes": records,
    }
    print(json.dumps(whole), flush=True)
    return whole


def main(words: Sequence[str] | None = None) -> int:
    """Run the benchmark; 0 when it ran, 1 when the data or the choice stopped it."""
    parser = argparse.ArgumentParser("python -m meshmatch.experiments.segments", description=__doc__)
    parser.add_argument("--classes", default=",".join(CLASSES), help="%(default)s")
    parser.add_argument("--turns", choices=("given", "searched"), default="given")
    parser.add_argument("--data", type=Path, default=Path("../shared/bench"), help="the benchmark's data")
    parser.add_argument("--minutes", type=float, default=10.0, help="of training at most, for each class")
    parser.add_argument("--steps", type=int, default=2000, help="of training")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--nodes", type=int, default=320, help="of the template")
    parser.add_argument("--radius", type=float, default=0.2, help="of a node, units of sqrt(area)")
    parser.add_argument("--work", type=Path, help="keep the prepared folders and the models here")
    options = parser.parse_args(words)
    if options.steps < 1 or options.minutes <= 0 or options.threads < 1 or options.seed < 0:
        parser.error("steps and threads of 1 or more, minutes above 0 and a seed of 0 or more are needed")
    try:
        with tempfile.TemporaryDirectory() as temporary:
            run(
                options.classes.split(","),
                data=options.data,
                turns=options.turns,
                minutes=options.minutes,
                steps=options.steps,
                threads=options.threads,
                seed=options.seed,
                nodes=options.nodes,
                radius=options.radius,
                work=options.work or Path(temporary),
            )
    except MeshmatchError as error:
        explain(error)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
