"""What of a shape can be seen from outside: characters are often built of closed parts that run into each other, or stand
under armour and clothes.

What is hidden belongs to nothing, yet it is surface: it makes the shape seem larger, and draws the template inside.
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
_VIEWS = 48
_CELL = 0.012  # of a view's depths: holds several samples, so that what lies behind does not shine through
_BEHIND = 0.012  # what lies further behind the nearest of its cell is hidden there
_FACING = 0.25  # cosine of a normal towards the viewer
_GAPS, _REACH = (0.008, 0.016), 0.007  # how far above a sample another part is looked for, and how near to there
_OFTEN = 2  # views in which a sample must be seen
_SIDED = 0.05  # of a part whose normals tell inside from outside, see `_outward`
_WIDE = 4.0  # a body with its arms spread is 1.4 wide; depths of more would take memory
_APART = 0.05  # share of the area outside the largest part from which on something may be hidden
_HIDDEN = 0.1  # share of the area that must be hidden to be left out
_SHOWN = 0.2  # share of the area that must be seen


@derived
def without_hidden(shape: Shape) -> Shape:
    """A mesh of several connected parts without the faces that no view from outside shows; any other shape as it is.

    All vertices stay. A shape stays as it is if little of it is hidden, or nearly all, as of foliage; if it reaches so far
    that views show too little; or if it is not trusted alike everywhere, for what is not must hide nothing.
    """
    if shape.is_cloud or (shape.weights is not None and np.ptp(shape.weights[shape.faces]) > 0):
        return shape
    part = shape.face_parts
    area = np.bincount(part, shape.face_areas)
    unit = float(np.sqrt(area.sum()))
    if (
        not unit > 0
        or area.max() > (1 - _APART) * unit**2
        or np.ptp(shape.verts[shape.faces.ravel()], 0).max() > _WIDE * unit
    ):
        return shape
    samples = sample_surface(shape, _SAMPLES, np.random.default_rng(0))
    seen = _seen(samples, part[samples.face], unit)
    if not _SHOWN < seen.mean() < 1 - _HIDDEN:
        return shape
    drawn, shown = (np.bincount(samples.face[rows], minlength=shape.F) for rows in (slice(None), seen))
    kept = 2 * shown >= drawn
    bare = np.flatnonzero(drawn == 0)  # small faces: as the samples near them
    kept[bare] = seen[cKDTree(samples.points).query(shape.verts[shape.faces[bare]].mean(1))[1]]
    return Shape(shape.verts, shape.faces[kept], shape.name, weights=shape.weights)


def _seen(samples: Samples, part: Int[Ints, " P"], unit: float) -> Bool[Bools, " P"]:
    """Whether some views from outside show each sample of parts."""
    points = (samples.points - samples.points.mean(0)) / unit
    side = _outward(points, samples.normals, part)[part]
    times = np.zeros(len(points), np.int64)
    for toward, across, up in _views():
        at = np.floor(points @ np.stack([across, up], 1) / _CELL).astype(np.int64)
        at -= at.min(0)
        key, depth = at[:, 0] * (at[:, 1].max() + 1) + at[:, 1], points @ toward
        nearest = np.full(key.max() + 1, -np.inf)
        np.maximum.at(nearest, key, depth)
        facing = (samples.normals @ toward) * np.where(side == 0, 1, side)
        facing = np.where(side == 0, np.abs(facing), facing)
        times += (facing > _FACING) & (depth > nearest[key] - _BEHIND)
    over = [_covered(points, sign * samples.normals, part) for sign in (1.0, -1.0)]
    covered = np.where(side > 0, over[0], np.where(side < 0, over[1], over[0] & over[1]))
    return np.asarray((times >= _OFTEN) & ~covered)


def _covered(points: Float[Floats, "P 3"], out: Float[Floats, "P 3"], part: Int[Ints, " P"]) -> Bool[Bools, " P"]:
    """Whether another part lies close above each sample: views do not tell layers apart."""
    tree, covered = cKDTree(points), np.zeros(len(points), bool)
    for gap in _GAPS:
        distance, nearest = tree.query(points + gap * out, distance_upper_bound=_REACH)
        near = np.isfinite(distance)
        covered[near] |= part[nearest[near]] != part[near]
    return covered


def _outward(points: Float[Floats, "P 3"], normals: Float[Floats, "P 3"], part: Int[Ints, " P"]) -> Float[Floats, " N"]:
    """Of each part: 1 if its normals point out, -1 if they point in, 0 if that cannot be told."""
    count = np.maximum(np.bincount(part), 1)
    middle = np.stack([np.bincount(part, points[:, k]) for k in range(3)], 1) / count[:, None]
    arm = points - middle[part]
    out = np.bincount(part, (arm * normals).sum(1)) / np.maximum(np.bincount(part, np.linalg.norm(arm, axis=1)), 1e-12)
    return np.where(np.abs(out) < _SIDED, 0.0, np.sign(out))


def _views() -> Float[Floats, "N 3 3"]:
    """Directions evenly around (a Fibonacci spiral): towards the viewer, across and up."""
    height = 1 - 2 * (np.arange(_VIEWS) + 0.5) / _VIEWS
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(_VIEWS)
    radius = np.sqrt(1 - height**2)
    toward = np.stack([radius * np.cos(angle), height, radius * np.sin(angle)], 1)
    across = np.stack([-np.sin(angle), np.zeros(_VIEWS), np.cos(angle)], 1)
    return np.stack([toward, across, np.cross(toward, across)], 1)
