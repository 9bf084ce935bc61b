"""Moving least squares wherever a point may lie: nodes near a surface, and others around the whole cube.

Where the points are not known beforehand, shape functions are computed when asked, for all pairs of a point and a node:
matrix products alone, as quick as a small network. Nodes on the cube reach far, so that every point has enough of them.
"""

from __future__ import annotations

from itertools import product

import numpy as np
import torch

from meshmatch.arrays import Float, Floats
from meshmatch.fields.field import Field
from meshmatch.geometry.kernels import KERNELS, Kernel

CUBE_RADIUS = 1.6
"""Support of the nodes on a cube of half side 1: with three inside each edge, every point of the cube has enough."""


def cube_nodes(per_edge: int = 3) -> Float[Floats, "K 3"]:
    """The vertices of the cube from -1 to 1, and so many evenly spread nodes inside each of its edges."""
    ticks = np.linspace(-1, 1, per_edge + 2)
    lattice = np.array(list(product(ticks, repeat=3)))
    return lattice[(np.abs(lattice) == 1).sum(1) >= 2]


def field_at(
    points: Float[torch.Tensor, "P 3"],
    nodes: Float[torch.Tensor, "K 3"],
    radii: Float[torch.Tensor, " K"],
    kernel: Kernel,
    gradient: bool = True,
) -> Field:
    """`build_field` on the fly, in torch: the same functions, dense; without a ``gradient`` that has no rows.

    Each node has its radius of support. Every point must have four non-coplanar nodes in reach.
    """
    x, q, r = points, nodes.to(points), radii.to(points)
    square = x.square().sum(1, keepdim=True) + q.square().sum(1) - 2 * (x @ q.T)  # P K
    weight, slope = KERNELS[kernel](square.clamp_min(0).sqrt(), r)
    basis = torch.nn.functional.pad(q, (1, 0), value=1.0)  # K 4: p(q) = [1, q]
    outer = (basis[:, :, None] * basis[:, None]).flatten(1)  # K 16
    moment = (weight @ outer).unflatten(1, (4, 4))
    inverse = torch.linalg.inv(moment.double()).to(points)  # its condition takes half the digits
    along = (inverse @ torch.nn.functional.pad(x, (1, 0), value=1.0)[..., None])[..., 0]  # M^-1 p(x), P 4
    value = along @ basis.T
    at_point = (slope @ outer).unflatten(1, (4, 4))
    columns = []
    for k in range(3 if gradient else 0):  # dw/dx = slope (x - q)
        moment_slope = x[:, k, None, None] * at_point - (slope @ (q[:, k, None] * outer)).unflatten(1, (4, 4))
        change = inverse[:, :, k + 1] - (inverse @ (moment_slope @ along[..., None]))[..., 0]  # d(M^-1 p) / dx_k
        columns.append(weight * (change @ basis.T) + slope * (x[:, k, None] - q[:, k]) * value)
    phi = weight * value
    return Field(phi, torch.stack(columns, 1).flatten(0, 1) if gradient else phi[:0])
