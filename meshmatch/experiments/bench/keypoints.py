"""Errors of maps at semantic keypoints, and of parts that are drawn from them (SHREC'07).

A keypoint of one shape is matched to a place of another; the error is the distance between that place and the true
keypoint over the diagonal of the target's bounding box.
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
