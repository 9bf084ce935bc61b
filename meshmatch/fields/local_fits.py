"""Moving least squares (see `shape_functions`), for NumPy arrays and torch tensors.

With tensors, results are differentiable with respect to points, nodes and radii.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.sparse import csr_array, csr_matrix

from meshmatch.arrays import Float, Floats, Int, Ints, as_numbers, is_tensor
from meshmatch.errors import TemplateError
from meshmatch.geometry.kernels import CURVATURES, KERNELS, MINIMUM_EIGENVALUE, Kernel, support_pairs, support_scale

Pairs = tuple[Int[Ints, " N"], Int[Ints, " N"]]
_AXIS_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


@dataclass(frozen=True, eq=False)
class LocalFits:
    """Local least squares fits at P points, as N pairs of a point and a node that reaches it, sorted by point."""

    at: Any  # (N,) index of the point
    of_node: Any  # (N,) index of the node
    offset: Any  # (N, 3) from the node to the point
    radius: Any  # (N,) of the node
    kernel: Kernel
    weight: Any  # (N,) w(d)
    slope: Any  # (N,) (dw/dd) / d
    scale: Any  # (N,) unit of length of the basis at the point
    basis: Any  # (N, 4) p(q_i), centred on x
    inverse: Any  # (P, 4, 4) inverse moment matrices

    @classmethod
    def of(
        cls, points: Any, nodes: Any, radii: Any, kernel: Kernel, pairs: Pairs | None = None, flat: float = 0.0
    ) -> LocalFits:
        """Fit at points (P, 3) with nodes (K, 3) and radii (K,), all arrays or all tensors, in float64 or float32.

        ``pairs`` are indices of points and of nodes that move them, by default those in reach. ``flat`` regularises moment
        matrices by this share of their weight; without it `TemplateError` names points that lack nodes.
        """
        xp = namespace(points)
        at, of_node = support_pairs(plain(points), plain(nodes), plain(radii)) if pairs is None else pairs
        rows, columns = at, of_node
        at, of_node = alike(at, points), alike(of_node, points)
        offset = points[at] - nodes[of_node]
        distance = length(offset)
        scale = alike(support_scale(rows, columns, plain(radii), len(points), plain(distance))[rows], points)
        weight, slope = KERNELS[kernel](distance, radii[of_node])
        basis = xp.concatenate([xp.ones_like(offset[:, :1]), -offset / scale[:, None]], 1)
        moment = sums(weight[:, None] * outer(basis), at, len(points)).reshape(-1, 4, 4)
        if flat:
            moment += flat * moment[:, :1, :1] * alike(np.diag([0.0, 1.0, 1.0, 1.0]), moment)
        else:
            check_support(plain(moment))
        inverse = xp.linalg.inv(moment)
        return cls(at, of_node, offset, radii[of_node], kernel, weight, slope, scale, basis, inverse)

    @cached_property
    def along(self) -> Any:
        """(N,) p(x)^T M^-1 p(q_i) with p(x) = [1, 0, 0, 0]."""
        return (self.inverse[:, 0][self.at] * self.basis).sum(1)

    @property
    def values(self) -> Any:
        """(N,) Phi_i at the points."""
        return self.weight * self.along

    @property
    def gradient(self) -> Any:
        """(N, 3) dPhi_i / dx_k at the points."""
        at, weight, inverse, P = self.at, self.weight, self.inverse, len(self.inverse)
        xp, full, along, constant = namespace(weight), outer(self.basis), self.along, inverse[:, 0]
        slope_vector = self.slope[:, None] * self.offset  # dw/dx
        solved = (inverse[at] @ self.basis[..., None])[..., 0]  # M^-1 p(q_i)
        columns = []
        for k in range(3):
            moment_slope = sums(slope_vector[:, k, None] * full, at, P).reshape(P, 4, 4)
            left = (constant[:, None] @ moment_slope)[:, 0]  # p^T M^-1 dM
            columns.append(
                weight * solved[:, k + 1] / self.scale
                - weight * (left[at] * solved).sum(1)
                + slope_vector[:, k] * along
            )
        return xp.stack(columns, 1)

    @property
    def second_derivative(self) -> Any:
        """(N, 3, 3) d2Phi_i / dx_k dx_l at the points.

        With M a = p(x) and Phi_i = w_i p(q_i)^T a, in a basis that is centred on the point and fixed.
        """
        at, basis, inverse, P = self.at, self.basis, self.inverse, len(self.inverse)
        xp, full, a = namespace(basis), outer(basis), inverse[:, :, 0]
        curvature = CURVATURES[self.kernel](length(self.offset), self.radius)
        first = [self.slope * self.offset[:, k] for k in range(3)]  # dw/dx_k
        moment = [sums(each[:, None] * full, at, P).reshape(P, 4, 4) for each in first]
        scale = self.scale.new_zeros(P) if xp is not np else np.zeros(P)
        scale[at] = self.scale
        change = []  # da/dx_k
        for k in range(3):
            right = -(moment[k] @ a[..., None])[..., 0]
            right[:, k + 1] += 1 / scale
            change.append((inverse @ right[..., None])[..., 0])
        rows: dict[tuple[int, int], Any] = {}
        for k, m in _AXIS_PAIRS:
            weight = curvature * self.offset[:, k] * self.offset[:, m] + (self.slope if k == m else 0.0)
            both = sums(weight[:, None] * full, at, P).reshape(P, 4, 4)
            right = moment[k] @ change[m][..., None] + moment[m] @ change[k][..., None] + both @ a[..., None]
            turn = -(inverse @ right)[..., 0]
            factors = ((weight, a), (first[k], change[m]), (first[m], change[k]), (self.weight, turn))
            rows[k, m] = rows[m, k] = sum(w * (basis * each[at]).sum(1) for w, each in factors)
        return xp.stack([xp.stack([rows[k, m] for m in range(3)], 1) for k in range(3)], 1)


def namespace(array: Any) -> Any:
    """The module with the functions for an array: `numpy` or `torch`."""
    if isinstance(array, np.ndarray):
        return np
    import torch

    return torch


def plain(array: Any) -> Any:
    """Convert to a NumPy array, without gradients."""
    return array if isinstance(array, np.ndarray) else array.numpy(force=True)


def alike(array: Any, like: Any) -> Any:
    """Convert a NumPy array to the type and device of ``like``, floating-point numbers to its precision."""
    if isinstance(like, np.ndarray):
        return array
    import torch

    tensor = torch.from_numpy(np.ascontiguousarray(array))
    return tensor.to(like.device, like.dtype if tensor.is_floating_point() else tensor.dtype)


def length(offset: Any) -> Any:
    """(N,) lengths of vectors; differentiable at 0."""
    if isinstance(offset, np.ndarray):
        return np.linalg.norm(offset, axis=1)
    return offset.square().sum(1).clip(min=1e-36).sqrt()


def outer(basis: Any) -> Any:
    """(N, 16) flattened outer products of vectors (N, 4) with themselves."""
    return (basis[:, :, None] * basis[:, None, :]).reshape(-1, 16)


def sums(values: Any, at: Any, P: int) -> Any:
    """(P, C) sums of values (N, C) by point."""
    if isinstance(values, np.ndarray):
        return csr_matrix((np.ones(len(at)), (at, np.arange(len(at)))), (P, len(at))) @ values
    return values.new_zeros(P, values.shape[1]).index_add(0, at, values)


def product(matrix: csr_array, values: Any) -> Any:
    """Multiply a SciPy sparse matrix by values (K,) or (K, C); a tensor keeps its precision and gradients."""
    if not is_tensor(values):
        return np.asarray(matrix @ as_numbers(values, "values"))
    values = values if values.is_floating_point() else values.double()
    row = np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr))
    row, column, weight = (alike(each, values) for each in (row, matrix.indices.astype(np.int64), matrix.data))
    found = sums(weight[:, None] * values.reshape(len(values), -1)[column], row, matrix.shape[0])
    return found.reshape(-1, *values.shape[1:])


def unsupported(moment: Float[Floats, "P 4 4"]) -> Int[Ints, " N"]:
    """Indices of points without four non-coplanar nodes in reach, according to their moment matrices."""
    trace = np.maximum(np.trace(moment, axis1=1, axis2=2), 1e-30)
    return np.flatnonzero(np.linalg.eigvalsh(moment)[:, 0] / trace < MINIMUM_EIGENVALUE)


def check_support(moment: Float[Floats, "P 4 4"]) -> None:
    """Raise `TemplateError` if there are points without enough nodes."""
    bad = unsupported(moment)
    if len(bad):
        some = ", ".join([*map(str, bad[:5]), *(["..."] if len(bad) > 5 else [])])
        problem = f"{len(bad)} points have fewer than four non-coplanar nodes in reach (points {some})"
        raise TemplateError(problem, "use more nodes or another radius, in the unit of the points")
