"""Kernels of moving least squares, and which points have enough nodes in reach.

A kernel is a node's weight by distance, up to its support radius. To add one, add its name to `Kernel` and its
functions to `KERNELS` and `CURVATURES`. The functions take NumPy arrays and torch tensors alike.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.geometry.trees import cKDTree

Kernel = Literal["cubic", "smooth"]
# Smallest accepted eigenvalue of the scaled moment matrix, relative to its trace. This and the next constant are set by
# hand.
MINIMUM_EIGENVALUE = 1e-6
_MAX_SCALE_RATIO = 10.0  # of the support radius to the farthest node, see `support_scale`


def _cubic(distance: Any, radius: Any) -> tuple[Any, Any]:
    """(1 - d/r)^3, the kernel of the NeurIPS 2022 paper; its gradient at the node is set to 0 by symmetry."""
    inside = (1 - distance / radius).clip(min=0)
    slope = -3 * inside**2 / (radius * distance.clip(min=1e-30))
    return inside**3, slope * (distance > 0)


def _smooth(distance: Any, radius: Any) -> tuple[Any, Any]:
    """(1 - d^2/r^2)^3, which is C1 at the node."""
    inside = (1 - (distance / radius) ** 2).clip(min=0)
    return inside**3, -6 * inside**2 / radius**2


# (distance, radius) -> weight w(d) and its slope (dw/dd) / d
KERNELS: dict[Kernel, Callable[[Any, Any], tuple[Any, Any]]] = {"cubic": _cubic, "smooth": _smooth}


def _cubic_curvature(distance: Any, radius: Any) -> Any:
    inside = (1 - distance / radius).clip(min=0)
    d = distance.clip(min=1e-12 * radius)
    return (6 * inside / (radius * d) + 3 * inside**2 / d**2) / (radius * d) * (distance > 1e-12 * radius)


def _smooth_curvature(distance: Any, radius: Any) -> Any:
    return 24 * (1 - (distance / radius) ** 2).clip(min=0) / radius**4


# (distance, radius) -> (ds/dd) / d of the slope s above. That of the cubic kernel has no limit at the node and is set
# to 0.
CURVATURES: dict[Kernel, Callable[[Any, Any], Any]] = {"cubic": _cubic_curvature, "smooth": _smooth_curvature}


def support_pairs(
    points: Float[Floats, "P 3"], nodes: Float[Floats, "K 3"], radii: Float[Floats, " K"]
) -> tuple[Int[Ints, " N"], Int[Ints, " N"]]:
    """Pairs (point, node) with |x - q| <= r, sorted by point then node."""
    reach = cKDTree(points).query_ball_point(nodes, radii)
    column = np.repeat(np.arange(len(nodes)), [len(hits) for hits in reach])
    row = np.concatenate([np.asarray(hits, np.int64) for hits in reach]) if len(column) else column
    order = np.lexsort((column, row))
    return row[order].astype(np.int64), column[order].astype(np.int64)


def support_scale(
    row: Int[Ints, " N"], column: Int[Ints, " N"], radii: Float[Floats, " K"], P: int, distance: Float[Floats, " N"]
) -> Float[Floats, " P"]:
    """Length (P,) by which the offsets from each point are divided in moment matrices.

    It is the largest radius of a node that reaches the point, so that matrices are equally well conditioned for wide
    and narrow supports. If that is `_MAX_SCALE_RATIO` times the largest ``distance`` of any node from its point, it is
    that distance: wider supports do not make nodes more coplanar.
    """
    if radii.min() == radii.max():
        scale = np.full(P, radii.mean())
    else:
        scale = np.zeros(P)
        np.maximum.at(scale, row, radii[column])
        scale = np.where(scale > 0, scale, radii.mean())
    farthest = distance.max(initial=0.0)
    return np.where((scale > _MAX_SCALE_RATIO * farthest) & (farthest > 0), farthest, scale)


def poorly_supported(
    points: Float[Floats, "P 3"],
    nodes: Float[Floats, "K 3"],
    radius: float | Float[Floats, " K"],
    kernel: Kernel = "smooth",
    margin: float = 30.0,
) -> Int[Ints, " N"]:
    """Indices of the points without four clearly non-coplanar nodes in reach.

    A node set is accepted if its smallest eigenvalue is at least ``margin`` times `MINIMUM_EIGENVALUE`.
    """
    radii = np.broadcast_to(np.asarray(radius, np.float64), (len(nodes),))
    row, column = support_pairs(points, nodes, radii)
    offset = points[row] - nodes[column]
    distance = np.linalg.norm(offset, axis=1)
    weight = KERNELS[kernel](distance, radii[column])[0]
    scale = support_scale(row, column, radii, len(points), distance)
    basis = np.concatenate([np.ones((len(row), 1)), -offset / scale[row, None]], 1)
    moment = np.zeros((len(points), 4, 4))
    np.add.at(moment, row, weight[:, None, None] * basis[:, :, None] * basis[:, None, :])
    trace = np.trace(moment, axis1=1, axis2=2)
    smallest = np.linalg.eigvalsh(moment)[:, 0] / np.maximum(trace, 1e-30)
    return np.flatnonzero(smallest < margin * MINIMUM_EIGENVALUE)
