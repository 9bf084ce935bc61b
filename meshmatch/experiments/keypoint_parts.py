"""Parts of a shape drawn from its keypoints, and what a label transfer makes of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from meshmatch.experiments.category import Pair, area_under_curve
from meshmatch.render.picture import Look, Panel, render_shapes
from meshmatch.render.scales import label_colors
from meshmatch.shapes.shape import Shape

_TOPS, _FEET = (4, 6, 8, 10), (5, 7, 9, 11)  # keypoints of a table's legs
_SQUARE = [[(first + way * k) % 4 for k in range(4)] for first in range(4) for way in (1, -1)]
_BELOW = 0.25  # of the way from the legs' tops to their feet: there legs are apart
_SMALLEST = 20  # vertices of a leg


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


def table_legs(shape: Shape, keypoints: np.ndarray) -> np.ndarray:
    """(V,) which leg of a table a vertex belongs to, from 0, and -1 elsewhere: pieces of what lies below the top."""
    top, foot = (shape.verts[keypoints[list(rows)]].mean(0) for rows in (_TOPS, _FEET))
    down = foot - top
    low = (shape.verts - top) @ down > _BELOW * down @ down
    faces = shape.faces[low[shape.faces].all(1)]
    ends = faces[:, [0, 1, 2]].reshape(-1), faces[:, [1, 2, 0]].reshape(-1)
    piece = connected_components(
        coo_matrix((np.ones(len(ends[0])), ends), (shape.V, shape.V)), directed=False
    )[1]
    sizes = np.bincount(piece[low], minlength=piece.max() + 1)
    number = np.where(sizes > _SMALLEST, np.cumsum(sizes > _SMALLEST) - 1, -1)
    return np.where(low, number[piece], -1)


def leg_confidence(
    legs: Mapping[str, np.ndarray], maps: Mapping[Pair, tuple[np.ndarray, np.ndarray]]
) -> dict[str, Any]:
    """Mean confidence of a leg where the other table has as many legs and where it has not, and the area under the
    curve that tells these apart (`area_under_curve`)."""
    sure, alike = [], []
    for (source, target), (_, confidence) in maps.items():
        for leg in range(legs[source].max() + 1):
            sure.append(float(confidence[legs[source] == leg].mean()))
            alike.append(legs[source].max() == legs[target].max())
    values, same = np.array(sure), np.array(alike)
    return {
        "legs_auc": rounded(area_under_curve(values, same)),
        "legs_alike": rounded(float(values[same].mean()) if same.any() else np.nan),
        "legs_unlike": rounded(float(values[~same].mean()) if (~same).any() else np.nan),
    }


def leg_errors(
    shapes: Mapping[str, Shape],
    keypoints: Mapping[str, np.ndarray],
    maps: Mapping[Pair, tuple[np.ndarray, np.ndarray]],
    near: float,
) -> dict[str, Any]:
    """Errors at the ends of tables' legs, over the target's diagonal, whichever leg is called the first and whichever
    way round they are counted: of the eight numberings of a square the one that suits a pair best. A table looks the
    same in all of them; a leg that is torn between two others is wrong in each."""
    found = []
    for (source, target), (index, _) in maps.items():
        shape = shapes[target]
        ends = np.array([_TOPS, _FEET])  # 2 4
        places = shape.verts[index[keypoints[source][ends]]]
        truth = shape.verts[keypoints[target][ends]]
        apart = [
            np.linalg.norm(places - truth[:, order], axis=-1).reshape(-1) / shape.diagonal
            for order in _SQUARE
        ]
        found.append(min(apart, key=lambda each: float(each.mean())))
    error = np.concatenate(found)
    return {"legs_mean": rounded(float(error.mean())), "legs_arrived": rounded(float((error < near).mean()))}


def rounded(value: float) -> float | None:
    """Four digits; nothing for what is not finite, which JSON cannot say."""
    return round(value, 4) if np.isfinite(value) else None


def carried_picture(
    shapes: Mapping[str, Shape],
    labels: np.ndarray,
    maps: Mapping[Pair, tuple[np.ndarray, np.ndarray]],
    first: str,
    path: Path,
    look: Look,
    others: int = 5,
) -> None:
    """One shape's labels (V,) in colours, and the same on others as the maps carry them, grey where not sure."""
    colors = label_colors(np.arange(int(labels.max()) + 1))
    panels = [Panel(shapes[first], colors[labels], label=f"{first}: labelled")]
    for name in _spread([name for name in shapes if name != first], others):
        index, confidence = maps[name, first]
        share = np.clip(confidence, 0, 1)[:, None]
        panels.append(
            Panel(shapes[name], share * colors[labels[index]] + (1 - share) * 0.85, label=f"on {name}")
        )
    render_shapes(panels, path, look)


def _spread(names: Sequence[str], count: int) -> list[str]:
    return [names[k] for k in np.unique(np.linspace(0, len(names) - 1, min(count, len(names))).astype(int))]
