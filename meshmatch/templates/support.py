"""Which nodes reach which points, and whether that is enough for moving least squares."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.geometry.kernels import KERNELS, Kernel

# Smallest accepted eigenvalue of the scaled moment matrix, relative to its trace. Set by hand, as is the margin below.
MINIMUM_EIGENVALUE = 1e-6


def support_pairs(
    points: Float[Floats, "P 3"], nodes: Float[Floats, "K 3"], radii: Float[Floats, " K"]
) -> tuple[Int[Ints, " N"], Int[Ints, " N"]]:
    """Pairs (point, node) with |x - q| <= r, sorted by point then node."""
    tree = cKDTree(points)
    reach = tree.query_ball_point(nodes, radii)
    column = np.repeat(np.arange(len(nodes)), [len(hits) for hits in reach])
    row = np.concatenate([np.asarray(hits, np.int64) for hits in reach]) if len(column) else column
    order = np.lexsort((column, row))
    return row[order].astype(np.int64), column[order].astype(np.int64)


def poorly_supported(
    points: Float[Floats, "P 3"],
    nodes: Float[Floats, "K 3"],
    radius: float | Float[Floats, " K"],
    kernel: Kernel = "smooth",
) -> Int[Ints, " N"]:
    """Indices of the points without four non-coplanar nodes in reach (with a safety margin)."""
    radii = np.broadcast_to(np.asarray(radius, np.float64), (len(nodes),))
    row, column = support_pairs(points, nodes, radii)
    offset = points[row] - nodes[column]
    weight = KERNELS[kernel](np.linalg.norm(offset, axis=1), radii[column])[0]
    basis = np.concatenate([np.ones((len(row), 1)), -offset / radii.mean()], 1)
    moment = np.zeros((len(points), 4, 4))
    np.add.at(moment, row, weight[:, None, None] * basis[:, :, None] * basis[:, None, :])
    trace = np.trace(moment, axis1=1, axis2=2)
    smallest = np.linalg.eigvalsh(moment)[:, 0] / np.maximum(trace, 1e-30)
    return np.flatnonzero(smallest < 30 * MINIMUM_EIGENVALUE)
