"""Visibility from outside: removes hidden faces of shapes made of intersecting or layered parts.

Characters are often built of closed parts that intersect, or stand under armor and clothes. Hidden faces make the shape
seem larger, and attract the template inwards.
"""

from __future__ import annotations

import numpy as np

from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints
from meshmatch.derived import derived
from meshmatch.geometry.trees import cKDTree
from meshmatch.shapes.sampling import Samples, sample_surface
from meshmatch.shapes.shape import Shape

# Set by hand; lengths in units of sqrt(area).
_SAMPLES = 40_000
_N_VIEWS = 48
_CELL_SIZE = 0.012  # cell size of depth maps; a cell holds several samples, so that surfaces behind do not show through
_DEPTH_TOLERANCE = 0.012  # depth behind the nearest sample of a cell from which on samples are hidden
_MIN_FACING = 0.25  # minimum cosine between a normal and the direction to the viewer
# heights above a sample at which to search for another part, and the search radius
_LAYER_HEIGHTS, _LAYER_RADIUS = (0.008, 0.016), 0.007
_MIN_VIEWS = 2  # minimum number of views that show a visible sample
_MIN_CONSISTENCY = 0.05  # minimum consistency of a part's normals to know which side is out, see `_outward`
_MAX_EXTENT = 4.0  # maximum extent (a body with spread arms has 1.4); depth maps of more would need much memory
_MIN_OTHER_SHARE = 0.05  # minimum share of the area outside the largest part for anything to be hidden
_MIN_HIDDEN_SHARE = 0.1  # minimum share of the area that must be hidden to be removed
_MIN_VISIBLE_SHARE = 0.2  # minimum share of the area that must be visible


@derived
def remove_hidden_faces(shape: Shape) -> Shape:
    """Remove the faces that are invisible from outside from a mesh of several connected parts.

    All vertices are kept. Other shapes are returned unchanged, and so is a shape of which little or nearly everything
    is hidden, as of foliage; one so large that depth maps would show too little; and one whose weights vary, because
    vertices of weight 0 must not hide others.
    """
    if shape.is_cloud or (shape.weights is not None and np.ptp(shape.weights[shape.faces]) > 0):
        return shape
    part = shape.face_parts
    area = np.bincount(part, shape.face_areas)
    unit = float(np.sqrt(area.sum()))
    if (
        not unit > 0
        or area.max() > (1 - _MIN_OTHER_SHARE) * unit**2
        or np.ptp(shape.verts[shape.faces.ravel()], 0).max() > _MAX_EXTENT * unit
    ):
        return shape
    samples = sample_surface(shape, _SAMPLES, np.random.default_rng(0))
    visible = _find_visible(samples, part[samples.face], unit)
    if not _MIN_VISIBLE_SHARE < visible.mean() < 1 - _MIN_HIDDEN_SHARE:
        return shape
    n_samples, n_visible = (np.bincount(samples.face[rows], minlength=shape.F) for rows in (slice(None), visible))
    is_visible = 2 * n_visible >= n_samples
    unsampled = np.flatnonzero(n_samples == 0)  # small faces: like the nearest samples
    is_visible[unsampled] = visible[cKDTree(samples.points).query(shape.verts[shape.faces[unsampled]].mean(1))[1]]
    return Shape(shape.verts, shape.faces[is_visible], shape.name, weights=shape.weights)


def _find_visible(samples: Samples, part: Int[Ints, " P"], unit: float) -> Bool[Bools, " P"]:
    """Whether each sample is visible in some views from outside."""
    points = (samples.points - samples.points.mean(0)) / unit
    side = _outward(points, samples.normals, part)[part]
    n_views = np.zeros(len(points), np.int64)
    for toward, across, up in _views():
        cell = np.floor(points @ np.stack([across, up], 1) / _CELL_SIZE).astype(np.int64)
        cell -= cell.min(0)
        key, depth = cell[:, 0] * (cell[:, 1].max() + 1) + cell[:, 1], points @ toward
        nearest = np.full(key.max() + 1, -np.inf)
        np.maximum.at(nearest, key, depth)
        facing = (samples.normals @ toward) * np.where(side == 0, 1, side)
        facing = np.where(side == 0, np.abs(facing), facing)
        n_views += (facing > _MIN_FACING) & (depth > nearest[key] - _DEPTH_TOLERANCE)
    covered_on_side = [_covered(points, sign * samples.normals, part) for sign in (1.0, -1.0)]
    covered = np.where(
        side > 0, covered_on_side[0], np.where(side < 0, covered_on_side[1], covered_on_side[0] & covered_on_side[1])
    )
    return np.asarray((n_views >= _MIN_VIEWS) & ~covered)


def _covered(points: Float[Floats, "P 3"], out: Float[Floats, "P 3"], part: Int[Ints, " P"]) -> Bool[Bools, " P"]:
    """Whether another part lies close above each sample: depth maps do not separate thin layers."""
    tree, covered = cKDTree(points), np.zeros(len(points), bool)
    for gap in _LAYER_HEIGHTS:
        distance, nearest = tree.query(points + gap * out, distance_upper_bound=_LAYER_RADIUS)
        near = np.isfinite(distance)
        covered[near] |= part[nearest[near]] != part[near]
    return covered


def _outward(points: Float[Floats, "P 3"], normals: Float[Floats, "P 3"], part: Int[Ints, " P"]) -> Float[Floats, " N"]:
    """For each part: 1 if its normals point out, -1 if they point in, 0 if unknown."""
    count = np.maximum(np.bincount(part), 1)
    middle = np.stack([np.bincount(part, points[:, k]) for k in range(3)], 1) / count[:, None]
    radial = points - middle[part]
    out = np.bincount(part, (radial * normals).sum(1)) / np.maximum(
        np.bincount(part, np.linalg.norm(radial, axis=1)), 1e-12
    )
    return np.where(np.abs(out) < _MIN_CONSISTENCY, 0.0, np.sign(out))


def _views() -> Float[Floats, "N 3 3"]:
    """Evenly distributed view directions (a Fibonacci spiral), each with its horizontal and vertical image axes."""
    height = 1 - 2 * (np.arange(_N_VIEWS) + 0.5) / _N_VIEWS
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(_N_VIEWS)
    radius = np.sqrt(1 - height**2)
    toward = np.stack([radius * np.cos(angle), height, radius * np.sin(angle)], 1)
    across = np.stack([-np.sin(angle), np.zeros(_N_VIEWS), np.cos(angle)], 1)
    return np.stack([toward, across, np.cross(toward, across)], 1)
