"""Where a map is torn: points that are neighbours on the shape, and belong far apart on the template."""

from __future__ import annotations

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.fitting.search.predictor import weighted_mean
from meshmatch.fitting.solve.system import NodeSystem
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.geometry.triangles import is_discontinuous

Pairs = tuple[Ints, Ints]
"""Numbers of samples that are neighbours, normals included: two touching limbs face each other, and are none."""
# Set by hand.
_NEIGHBOURS = 6  # of a sample
_IN_PIECES = 0.5  # share of neighbours on the same connected part up to which parts say nothing


def neighbours(samples: OrientedPoints, part: Int[Ints, " P"] | None = None) -> Pairs:
    """Every sample with the few that are nearest to it; of a shape whose connected ``part`` is known for each sample, only
    those on the same one, unless the shape is in pieces."""
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
    """Share (0..1) of pairs of samples (core frame) that belong far apart on the resting template.

    ``shortened`` says of each of its vertices to which share of their length lines through it shrink: neighbours on a limb
    that is a third as long as the template's belong three times as far apart without a tear.
    """
    surface = system.surface(vectors)
    local = local.facing(surface)
    foot = surface.tree.query(local.features)[1]
    home = system.verts[foot]
    start, end = pairs
    length = np.linalg.norm(local.points[start] - local.points[end], axis=1)
    if shortened is not None:
        length = length / np.minimum(shortened[foot[start]], shortened[foot[end]])
    apart = is_discontinuous(np.linalg.norm(home[start] - home[end], axis=1), length)
    weights = None if local.weights is None else local.weights[start] * local.weights[end]
    return float(weighted_mean(apart, weights))
