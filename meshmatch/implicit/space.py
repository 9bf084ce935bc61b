"""Moving least squares at arbitrary points of the cube, with nodes near surfaces and on the cube.

Points are not known in advance, so shape functions are evaluated on demand, for all pairs of a point and a node. Neither
the functions nor their gradients are formed explicitly: they are applied to vectors as products of two matrices (weights
of the nodes, and their slopes) with a few columns. Nodes on the cube have large radii, so that every point has enough
nodes.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
import torch
from torch.nn.functional import pad

from meshmatch.arrays import Float, Floats
from meshmatch.geometry.kernels import KERNELS, Kernel

CUBE_RADIUS = 1.6
"""Support radius of the nodes on the cube: with three nodes inside each edge, every point of the cube has enough nodes."""


def cube_nodes(per_edge: int = 3) -> Float[Floats, "K 3"]:
    """The vertices of the cube from -1 to 1, and ``per_edge`` evenly spaced nodes inside each of its edges."""
    ticks = np.linspace(-1, 1, per_edge + 2)
    lattice = np.array(list(product(ticks, repeat=3)))
    return np.asarray(lattice[(np.abs(lattice) == 1).sum(1) >= 2])


@dataclass(frozen=True, eq=False)
class SpaceField:
    """Shape functions of K nodes at P points of each of B shapes: those of `fields.shape_functions.build_field`.

    With p(q) = [1, q], M(x) = sum_i w_i p_i p_i^T and a = M^-1 p(x), a function is w_i a . p_i.
    """

    points: Float[torch.Tensor, "B P 3"]
    nodes: Float[torch.Tensor, "K 3"]
    weight: Float[torch.Tensor, "B P K"]
    slope: Float[torch.Tensor, "B P K"]  # dw/dx = slope (x - q)
    along: Float[torch.Tensor, "B P 4"]  # a
    change: Float[torch.Tensor, "B P 3 4"] | None  # da/dx_k; None if evaluated without gradient

    @classmethod
    def at(
        cls,
        points: Float[torch.Tensor, "B P 3"],
        nodes: Float[torch.Tensor, "K 3"],
        radii: Float[torch.Tensor, " K"],
        kernel: Kernel,
        gradient: bool = True,
    ) -> SpaceField:
        """Evaluate at points, each of which must have four non-coplanar nodes in reach."""
        x, q, r = points.flatten(0, 1), nodes.to(points), radii.to(points)
        square = torch.addmm(x.square().sum(1, keepdim=True) + q.square().sum(1), x, q.T, alpha=-2)
        weight, slope = KERNELS[kernel](square.clamp_min(0).sqrt(), r)
        one = pad(q, (1, 0), value=1.0)  # p
        two = _outer(one, one)
        moment = (weight @ two).unflatten(1, (4, 4))
        inverse = torch.linalg.inv(moment.double()).to(points)  # ill-conditioned for float32
        along = _times(inverse, pad(x, (1, 0), value=1.0))
        change = None
        if gradient:  # dM/dx_k = x_k S_0 - S_k, with S_j = sum_i slope_i p_j p p^T
            tilted = _times((slope @ _outer(one, two)).unflatten(1, (4, 4, 4)), along[:, None])
            change = inverse[:, 1:] - (x[:, :, None] * tilted[:, :1] - tilted[:, 1:]) @ inverse
        B = len(points)
        split: Any = [None if each is None else each.unflatten(0, (B, -1)) for each in (weight, slope, along, change)]
        return cls(points, q, *split)

    def displacement(self, vectors: Float[torch.Tensor, "B K 3"]) -> Float[torch.Tensor, "B P 3"]:
        """sum_i phi_i v_i at every point."""
        return _rows(self.along, self._weighted_moments(vectors))

    def jacobian(self, vectors: Float[torch.Tensor, "B K 3"]) -> Float[torch.Tensor, "B P 3 3"]:
        """du_a / dx_k of the displacement u."""
        assert self.change is not None
        one = pad(self.nodes, (1, 0), value=1.0)
        slopes = self.slope @ _outer(_outer(one, one).expand(len(vectors), -1, -1), vectors)
        slopes = _rows(self.along[..., None, :], slopes.unflatten(2, (4, 4, 3)))  # sum_i slope_i [1, q_i] a . p_i v_i
        columns = (
            self.change @ self._weighted_moments(vectors)
            + self.points[..., None] * slopes[..., :1, :]
            - slopes[..., 1:, :]
        )
        return columns.transpose(-1, -2)

    def _weighted_moments(self, vectors: torch.Tensor) -> Float[torch.Tensor, "B P 4 3"]:
        """sum_i w_i p_i v_i^T."""
        one = pad(self.nodes, (1, 0), value=1.0).expand(len(vectors), -1, -1)
        result: torch.Tensor = (self.weight @ _outer(one, vectors)).unflatten(2, (4, 3))
        return result


def _outer(a: Float[torch.Tensor, "*K M"], b: Float[torch.Tensor, "*K N"]) -> Float[torch.Tensor, "*K MN"]:
    return (a[..., :, None] * b[..., None, :]).flatten(-2)


def _times(matrix: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
    return (matrix @ vector[..., None])[..., 0]


def _rows(vector: torch.Tensor, matrix: torch.Tensor) -> torch.Tensor:
    return (vector[..., None, :] @ matrix)[..., 0, :]
