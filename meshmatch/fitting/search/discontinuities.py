"""Discontinuities of a map: points that are neighbours on the shape, but correspond to distant points of the template."""

from __future__ import annotations

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.fitting.search.predictor import weighted_mean
from meshmatch.fitting.solve.system import NodeSystem
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.geometry.triangles import is_discontinuous

Pairs = tuple[Ints, Ints]
"""Indices of neighbouring samples. Normals count, so that touching limbs, which face each other, are not neighbours."""
# Set by hand.
_NEIGHBOURS = 6  # number of neighbours of each sample
_IN_PIECES = 0.5  # if no more than this share of neighbours is on the same connected part, parts are ignored


def neighbours(samples: OrientedPoints, part: Int[Ints, " P"] | None = None) -> Pairs:
    """Pair every sample with the few nearest ones.

    If the connected ``part`` of each sample is given, pairs on different parts are dropped, unless the shape is in pieces.
    """
    count = min(_NEIGHBOURS + 1, len(samples.points))
    index = samples.tree.query(samples.tree.data, count)[1]
    start, end = np.repeat(np.arange(len(index)), index.shape[1] - 1), index[:, 1:].reshape(-1)
    if part is not None and (same := part[start] == part[end]).mean() > _IN_PIECES:
        return start[same], end[same]
    return start, end


def discontinuous_share(
    system: NodeSystem,
    pairs: Pairs,
    local: OrientedPoints,
    vectors: Float[Floats, "K 3"],
    shortened: Float[Floats, " V"] | None = None,
) -> float:
    """Share (0..1) of pairs of samples (core frame) whose template points are far apart on the rest template.

    ``shortened`` is, for each template vertex, the smallest factor by which lines through it are shortened: neighbours on a
    limb with a third of the template's length may be three times as far apart there without a discontinuity.
    """
    surface = system.surface(vectors)
    local = local.facing(surface)
    nearest = surface.tree.query(local.features)[1]
    rest_points = system.verts[nearest]
    start, end = pairs
    length = np.linalg.norm(local.points[start] - local.points[end], axis=1)
    if shortened is not None:
        length = length / np.minimum(shortened[nearest[start]], shortened[nearest[end]])
    apart = is_discontinuous(np.linalg.norm(rest_points[start] - rest_points[end], axis=1), length)
    weights = None if local.weights is None else local.weights[start] * local.weights[end]
    return float(weighted_mean(apart, weights))
