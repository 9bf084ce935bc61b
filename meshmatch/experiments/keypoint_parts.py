"""Parts of a shape drawn from its keypoints, and what a label transfer makes of them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.experiments.category import Maps, Shapes
from meshmatch.experiments.scores import area_under_curve
from meshmatch.shapes.shape import Shape

_TOPS, _FEET = (4, 6, 8, 10), (5, 7, 9, 11)  # keypoints of a table's legs
_SQUARE = [[(first + way * k) % 4 for k in range(4)] for first in range(4) for way in (1, -1)]
_SIDES = (14, 17, 16, 15)  # keypoints in the middle of a table's sides, from the first corner to the second, and on
# All numberings of the corners with the sides between them, and of the legs, tops and feet; the given one first.
_AROUND = [
    [*order, *(_SIDES[min(a, b) if {a, b} != {0, 3} else 3] for a, b in zip(order, order[1:] + order[:1], strict=True))]
    for order in _SQUARE
]
_LEGS = [[ends[k] for ends in (_TOPS, _FEET) for k in order] for order in _SQUARE]
_BELOW = 0.25  # of the way from the legs' tops to their feet: there legs are apart
_SMALLEST = 20  # vertices of a leg


def keypoint_parts(shape: Shape, keypoints: Int[Ints, " N"]) -> Int[Ints, " V"]:
    """The part of every vertex: the number of its nearest keypoint."""
    return np.asarray(cKDTree(shape.verts[keypoints]).query(shape.verts)[1])


def mean_overlap(found: Int[Ints, " V"], truth: Int[Ints, " V"], area: Float[Floats, " V"]) -> float:
    """Intersection over union of labels with true ones, by the area of vertices; the mean over true parts."""
    shares = []
    for part in np.unique(truth):
        ours, theirs = found == part, truth == part
        shares.append(area[ours & theirs].sum() / area[ours | theirs].sum())
    return float(np.mean(shares))


def category_overlap(found: Int[Ints, " V"], truth: Int[Ints, " V"], parts: int) -> float:
    """Intersection over union of labels with true ones; the mean over all ``parts`` of a category, as ShapeNet's protocol
    counts: a part that is neither true nor found counts 1, one that is found and not true 0."""
    shares = []
    for part in range(parts):
        ours, theirs = found == part, truth == part
        either = (ours | theirs).sum()
        shares.append((ours & theirs).sum() / either if either else 1.0)
    return float(np.mean(shares))


def table_legs(shape: Shape, keypoints: Int[Ints, " N"]) -> Int[Ints, " V"]:
    """Which leg of a table a vertex belongs to, from 0, and -1 elsewhere: pieces of what lies below the top."""
    top, foot = (shape.verts[keypoints[list(rows)]].mean(0) for rows in (_TOPS, _FEET))
    down = foot - top
    low = (shape.verts - top) @ down > _BELOW * down @ down
    faces = shape.faces[low[shape.faces].all(1)]
    ends = faces[:, [0, 1, 2]].reshape(-1), faces[:, [1, 2, 0]].reshape(-1)
    piece = connected_components(coo_matrix((np.ones(len(ends[0])), ends), (shape.V, shape.V)), directed=False)[1]
    sizes = np.bincount(piece[low], minlength=piece.max() + 1)
    number = np.where(sizes > _SMALLEST, np.cumsum(sizes > _SMALLEST) - 1, -1)
    return np.where(low, number[piece], -1)


def leg_confidence(legs: Mapping[str, Int[Ints, " V"]], maps: Maps) -> dict[str, Any]:
    """Mean confidence of a leg where the other table has as many legs and where it has not, and the area under the
    curve that tells these apart (`area_under_curve`); None where there is only one kind."""
    sure, alike = [], []
    for (source, target), found in maps.items():
        for leg in range(legs[source].max() + 1):
            sure.append(float(found.confidence[legs[source] == leg].mean()))
            alike.append(legs[source].max() == legs[target].max())
    values, same = np.array(sure), np.array(alike)
    return {
        "legs_auc": area_under_curve(values, same) if 0 < same.mean() < 1 else None,
        "legs_alike": float(values[same].mean()) if same.any() else None,
        "legs_unlike": float(values[~same].mean()) if (~same).any() else None,
    }


def renumbered_errors(
    shapes: Shapes, keypoints: Mapping[str, Int[Ints, " N"]], maps: Maps, near: float
) -> dict[str, float]:
    """Errors at all keypoints of tables, over the target's diagonal, where corners and sides, and apart from them legs,
    are counted from whichever of the four and in whichever direction suits a pair best; and `leg_errors`."""
    found = []
    for (source, target), each in maps.items():
        shape, truth = shapes[target], shapes[target].verts[keypoints[target]]
        places = shape.verts[each.index[keypoints[source]]]
        rows = [np.linalg.norm(places[[12, 13]] - truth[[12, 13]], axis=1)]
        for numberings in (_AROUND, _LEGS):
            off = [np.linalg.norm(places[numberings[0]] - truth[order], axis=1) for order in numberings]
            rows.append(min(off, key=lambda each: float(each.mean())))
        found.append(np.concatenate(rows) / shape.diagonal)
    error = np.concatenate(found)
    share = {"renumbered_mean": float(error.mean()), "renumbered_arrived": float((error < near).mean())}
    return share | leg_errors(shapes, keypoints, maps, near)


def leg_errors(shapes: Shapes, keypoints: Mapping[str, Int[Ints, " N"]], maps: Maps, near: float) -> dict[str, float]:
    """Errors at the ends of tables' legs, over the target's diagonal, whichever leg is called the first and whichever
    way round they are counted: of the eight numberings of a square the one that suits a pair best. A table looks the
    same in all of them; a leg that lies between two others is wrong in each."""
    found = []
    ends = np.array([_TOPS, _FEET])  # 2 4
    for (source, target), each in maps.items():
        shape = shapes[target]
        places = shape.verts[each.index[keypoints[source][ends]]]
        truth = shape.verts[keypoints[target][ends]]
        off = [np.linalg.norm(places - truth[:, order], axis=-1).reshape(-1) for order in _SQUARE]
        found.append(min(off, key=lambda each: float(each.mean())) / shape.diagonal)
    error = np.concatenate(found)
    return {"legs_mean": float(error.mean()), "legs_arrived": float((error < near).mean())}
