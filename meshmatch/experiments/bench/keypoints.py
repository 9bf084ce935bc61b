"""Errors of maps at semantic keypoints, and of parts that are drawn from them (SHREC'07).

A keypoint of one shape is matched to a place of another; the error is the distance between that place and the true
keypoint over the diagonal of the target's bounding box. A table looks the same from several sides, so its errors are
also counted in the numbering of corners and legs that suits a pair best.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.experiments.bench.category import Maps, Shapes
from meshmatch.shapes.shape import Shape

KEYPOINTS = ".keypoints.npy"
RIGHT = 0.1
"""Share of the target's diagonal within which a keypoint has arrived."""
_TOPS, _FEET = (4, 6, 8, 10), (5, 7, 9, 11)  # keypoints of a table's legs
_SQUARE = [[(first + way * k) % 4 for k in range(4)] for first in range(4) for way in (1, -1)]
_SIDES = (14, 17, 16, 15)  # keypoints in the middle of a table's sides, from the first corner to the second, and on
# All numberings of the corners with the sides between them, and of the legs, tops and feet; the given one first.
_AROUND = [
    [*order, *(_SIDES[min(a, b) if {a, b} != {0, 3} else 3] for a, b in zip(order, order[1:] + order[:1], strict=True))]
    for order in _SQUARE
]
_LEGS = [[ends[k] for ends in (_TOPS, _FEET) for k in order] for order in _SQUARE]


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
    """Errors of maps at the keypoints, the share that arrived, and the overlap (IoU) of parts that maps carry."""
    errors, overlaps = [], []
    parts = {name: keypoint_parts(shape, keypoints[name]) for name, shape in shapes.items()}
    for (source, target), found in maps.items():
        labels = parts[target][found.index]
        overlaps.append(mean_overlap(labels, parts[source], shapes[source].vertex_areas))
        shape, at = shapes[target], keypoints[source]
        off = shape.verts[found.index[at]] - shape.verts[keypoints[target]]
        errors.append(np.linalg.norm(off, axis=1) / shape.diagonal)
    error = np.concatenate(errors)
    arrived = float((error < RIGHT).mean())
    record = {"pairs": len(maps), "mean": float(error.mean()), "median": float(np.median(error))}
    return record | {"arrived": arrived, "iou": float(np.mean(overlaps))}


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
