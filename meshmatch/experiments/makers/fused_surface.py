"""Outer surface of a body with self-contact or on a base, as scanners return it: one surface, without gaps narrower than a
voxel.
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

_OFFSET = (3.1e-7, 5.3e-7)  # offset of rays, in voxels, against ambiguous hits of edges
_MARGIN = 4  # empty voxels around a shape
_SMOOTH = 1.2  # standard deviation, in voxels, of the Gaussian that removes the steps of a voxel surface


def fused_surface(shape: Shape, step: float = 0.006) -> Shape:
    """Outer surface of the interior of a watertight mesh, which may intersect itself; ``step`` is the voxel size."""
    low = shape.verts.min(0) - _MARGIN * step
    x, y, z = (int(side) for side in np.ceil(np.ptp(shape.verts, axis=0) / step) + 2 * _MARGIN + 1)
    inside = ndimage.binary_fill_holes(ndimage.binary_closing(occupied(shape, low, (x, y, z), step)))
    parts, count = ndimage.label(inside)
    if count > 1:
        inside = parts == 1 + np.bincount(parts.ravel())[1:].argmax()
    smooth = ndimage.gaussian_filter(inside.astype(np.float32), _SMOOTH)
    verts, faces, _, _ = marching_cubes(smooth, 0.5, spacing=(step,) * 3, allow_degenerate=False)
    return Shape(verts.astype(np.float64) + low, faces[:, ::-1].astype(np.int64), shape.name)


def fused_with_base(shape: Shape, base: Base, rng: np.random.Generator) -> tuple[Shape, Int[Ints, " V"]]:
    """Outer surface of a watertight body (y up) and a base into which its feet extend slightly.

    Also returns the nearest vertex of the body for each vertex, -1 on the base. A scanned floor has only its top, with
    bumps.
    """
    height, low = float(np.ptp(shape.verts[:, 1])), float(shape.verts[:, 1].min())
    feet = shape.verts[shape.verts[:, 1] < low + 0.06 * height]
    top, step = low + rng.uniform(0.005, 0.02) * height, 0.008 * height
    width = rng.uniform(0.8, 1.6, 2) * height
    if base in ("plinth", "plate"):
        width = np.ptp(feet[:, ::2], axis=0) + rng.uniform(0.1, 0.3) * height
    thickness = (rng.uniform(0.2, 0.5) if base == "plinth" else 0.05) * height
    middle = 0.5 * (feet.min(axis=0) + feet.max(axis=0))
    block = trimesh.creation.box((width[0], thickness, width[1])).subdivide_to_size(0.1 * height)
    block_verts = block.vertices + np.array([middle[0], top - 0.5 * thickness, middle[2]])
    combined = Shape(np.concatenate([shape.verts, block_verts]), np.concatenate([shape.faces, block.faces + shape.V]))
    whole = fused_surface(combined, step)
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
    """Whether each point of a grid with origin ``low`` is inside a watertight mesh, by its winding number.

    Winding numbers are counted along a line through every column of the grid: plus one where the line enters through a
    triangle, minus one where it leaves.
    """
    a, b, c = ((shape.verts[shape.faces[:, k]] - low) / step for k in range(3))
    first = np.ceil(np.minimum(np.minimum(a, b), c)[:, :2]).astype(int)
    last = np.floor(np.maximum(np.maximum(a, b), c)[:, :2]).astype(int)
    winding = np.zeros(size, np.int32)
    area = _signed_area(a, b, c)
    for shift in np.ndindex(*(last - first + 1).max(0).clip(0)):
        column = first + shift
        at = np.flatnonzero((column <= last).all(1) & (area != 0))
        column, point = column[at], column[at].astype(np.float64)
        # A small offset, so that a column through an edge or a corner hits exactly one of the triangles there.
        point += _OFFSET
        weights = np.stack(
            [_signed_area(b[at], c[at], point), _signed_area(c[at], a[at], point), _signed_area(a[at], b[at], point)], 1
        )
        weights /= area[at, None]
        inside = (weights >= 0).all(1)
        at, column, weights = at[inside], column[inside], weights[inside]
        height = (weights * np.stack([a[at, 2], b[at, 2], c[at, 2]], 1)).sum(1)
        np.add.at(
            winding, (column[:, 0], column[:, 1], np.ceil(height).astype(int)), -np.sign(area[at]).astype(np.int32)
        )
    return np.asarray(winding.cumsum(2) > 0)


def _signed_area(a: Floats, b: Floats, c: Floats) -> Floats:
    """Twice the signed area of triangles projected along the last axis, positive if counterclockwise."""
    u, v = b[:, :2] - a[:, :2], c[:, :2] - a[:, :2]
    return np.asarray(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])
