"""The surface around a body that touches itself, or stands in a base, as scanners give it: one skin, without gaps narrower
than a step.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
import trimesh
from scipy import ndimage
from skimage.measure import marching_cubes

from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints
from meshmatch.geometry.trees import cKDTree
from meshmatch.shapes.shape import Shape

Base = Literal["plinth", "plate", "floor", "scanned floor"]

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


def fused_with_base(shape: Shape, base: Base, rng: np.random.Generator) -> tuple[Shape, Int[Ints, " V"]]:
    """The surface around a watertight body, y up, and a base in which its feet stand a little; and of each vertex the
    nearest one of the body, -1 on the base. Of a scanned floor there is the top alone, with bumps.
    """
    height, low = float(np.ptp(shape.verts[:, 1])), float(shape.verts[:, 1].min())
    feet = shape.verts[shape.verts[:, 1] < low + 0.06 * height]
    top, step = low + rng.uniform(0.005, 0.02) * height, 0.008 * height
    wide = rng.uniform(0.8, 1.6, 2) * height
    if base in ("plinth", "plate"):
        wide = np.ptp(feet[:, ::2], axis=0) + rng.uniform(0.1, 0.3) * height
    thick = (rng.uniform(0.2, 0.5) if base == "plinth" else 0.05) * height
    middle = 0.5 * (feet.min(axis=0) + feet.max(axis=0))
    block = trimesh.creation.box((wide[0], thick, wide[1])).subdivide_to_size(0.1 * height)
    at = block.vertices + np.array([middle[0], top - 0.5 * thick, middle[2]])
    both = Shape(np.concatenate([shape.verts, at]), np.concatenate([shape.faces, block.faces + shape.V]))
    whole = fused_surface(both, step)
    distance, nearest = cKDTree(shape.verts).query(whole.verts)
    nearest = np.where((distance < 2 * step) & (whole.verts[:, 1] > top + 1.5 * step), nearest, -1)
    if base != "scanned floor":
        return whole, nearest
    waves, phase = 3 / height * rng.standard_normal((6, 2)), rng.uniform(0, 2 * np.pi, 6)
    bumps = 0.0015 * np.sin(whole.verts[:, ::2] @ waves.T + phase).sum(axis=1) + 0.001 * rng.standard_normal(whole.V)
    verts = whole.verts.copy()
    verts[:, 1] += height * bumps * np.clip((top - verts[:, 1]) / (3 * step) + 1, 0, 1)
    faces = whole.faces[whole.verts[whole.faces, 1].mean(axis=1) > top - 0.6 * step]
    used, corners = np.unique(faces, return_inverse=True)
    return Shape(verts[used], corners.reshape(-1, 3)), nearest[used]


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
