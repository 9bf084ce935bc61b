"""The surface around a body that touches itself, as scanners give it: one skin, without gaps narrower than a step."""

from __future__ import annotations

import numpy as np
from scipy import ndimage
from skimage.measure import marching_cubes

from meshmatch.arrays import Bool, Bools, Float, Floats
from meshmatch.shapes.shape import Shape

_BESIDE = (3.1e-7, 5.3e-7)  # steps
_AROUND = 4  # steps of nothing around a shape
_SMOOTH = 1.2  # steps: deviation of the Gaussian that takes the stairs from a surface of voxels


def fused_surface(shape: Shape, step: float = 0.006) -> Shape:
    """The surface around everything inside a watertight mesh, which may run into itself, in voxels of this side."""
    low = shape.verts.min(0) - _AROUND * step
    x, y, z = (int(side) for side in np.ceil(np.ptp(shape.verts, axis=0) / step) + 2 * _AROUND + 1)
    full = ndimage.binary_fill_holes(ndimage.binary_closing(occupied(shape, low, (x, y, z), step)))
    parts, count = ndimage.label(full)
    if count > 1:
        full = parts == 1 + np.bincount(parts.ravel())[1:].argmax()
    smooth = ndimage.gaussian_filter(full.astype(np.float32), _SMOOTH)
    verts, faces, _, _ = marching_cubes(smooth, 0.5, spacing=(step,) * 3, allow_degenerate=False)
    return Shape(verts.astype(np.float64) + low, faces[:, ::-1].astype(np.int64), shape.name)


def occupied(shape: Shape, low: Float[Floats, " 3"], size: tuple[int, int, int], step: float) -> Bool[Bools, "X Y Z"]:
    """Which points of a grid that begins at ``low`` lie inside a watertight mesh: those that it winds around.

    How often it does is counted along a line through every column of the grid: one more where the line comes in through a
    triangle, one less where it goes out.
    """
    a, b, c = ((shape.verts[shape.faces[:, k]] - low) / step for k in range(3))
    first = np.ceil(np.minimum(np.minimum(a, b), c)[:, :2]).astype(int)
    last = np.floor(np.maximum(np.maximum(a, b), c)[:, :2]).astype(int)
    turns = np.zeros(size, np.int32)
    area = _turn(a, b, c)
    for shift in np.ndindex(*(last - first + 1).max(0).clip(0)):
        column = first + shift
        at = np.flatnonzero((column <= last).all(1) & (area != 0))
        column, point = column[at], column[at].astype(np.float64)
        # A column that meets an edge or a corner belongs to one triangle at it: as if it ran a hair beside.
        point += _BESIDE
        weights = np.stack([_turn(b[at], c[at], point), _turn(c[at], a[at], point), _turn(a[at], b[at], point)], 1)
        weights /= area[at, None]
        inside = (weights >= 0).all(1)
        at, column, weights = at[inside], column[inside], weights[inside]
        height = (weights * np.stack([a[at, 2], b[at, 2], c[at, 2]], 1)).sum(1)
        np.add.at(turns, (column[:, 0], column[:, 1], np.ceil(height).astype(int)), -np.sign(area[at]).astype(np.int32))
    return np.asarray(turns.cumsum(2) > 0)


def _turn(a: Floats, b: Floats, c: Floats) -> Floats:
    """Twice the area of triangles seen along the last axis, positive if they turn left."""
    one, two = b[:, :2] - a[:, :2], c[:, :2] - a[:, :2]
    return np.asarray(one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0])
