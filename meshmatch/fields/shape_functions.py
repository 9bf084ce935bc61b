"""Shape functions of fields that are linear in the vectors of their nodes, on fixed points, in NumPy and SciPy.

First-order moving least squares, after *Reduced Representation of Deformation Fields for Effective Non-rigid Shape
Matching* (NeurIPS 2022), supplement:

    u(x)   = sum_i Phi_i(x) u_i
    Phi_i  = p(x)^T M(x)^-1 w_i(x) p(q_i),    p(x) = [1, x, y, z]^T
    M(x)   = sum_i w_i(x) p(q_i) p(q_i)^T

The basis is evaluated in coordinates centred on x and scaled by the support radius (the largest one there, if nodes have
different radii). The functions do not depend on the affine frame of the basis, and the 4 x 4 moment matrices are well
conditioned in this one.

Radial basis functions, with the multiquadric that the paper compares to:

    u(x)      = sum_i (A^-1 U)_i phi(x, q_i),    A_ij = phi(q_i, q_j)
    phi(a, b) = sqrt(C + eps |a - b|^2),         C = 1, eps = 50

Shape functions are Phi(x) = A^-1 phi(x, .): the field interpolates its node vectors. They have no compact support, so
their matrices are dense; a rigid motion of the nodes is reproduced only approximately.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import csr_matrix

from meshmatch.arrays import Float, Floats, Int, Ints, ShortRepr, as_numbers
from meshmatch.errors import InputError, OptionError, TemplateError, warn
from meshmatch.fields.local_fits import LocalFits
from meshmatch.geometry.kernels import KERNELS, Kernel
from meshmatch.shapes.shape import LARGEST

FieldName = Literal["mls", "rbf", "pointwise"]
FIELDS: tuple[FieldName, ...] = get_args(FieldName)
CONSTANT, STEEPNESS = 1.0, 50.0  # of the multiquadric
MAX_AMPLIFICATION = 50.0
"""Sum of the absolute shape functions at a point above which there is a warning that nodes are placed badly. For the models
that ship it is at most 22; above 1 / sqrt(`MINIMUM_EIGENVALUE`), 1,000, nodes are refused anyway."""
_MAX_CONDITION = 1e13
_BLOCK = 4096
_REGULARIZATION = 1e-3  # regularisation of moment matrices, relative to their weight


def has_nodes(name: FieldName) -> bool:
    """Whether deformations of this field are linear in node vectors."""
    return name != "pointwise"


@dataclass(frozen=True, eq=False, repr=False)
class ShapeFunctions(ShortRepr):
    """Shape functions of K nodes on P fixed points.

    ``phi`` (P, K) and ``gradient`` (3 P, K), which is computed on first use, are float32, sparse (CSR) or dense. With
    moving least squares each row of ``phi`` sums to one. Row 3 p + k of ``gradient`` is the derivative at point p along
    axis k (1 / length).
    """

    phi: Any
    gradient_rows: Any = field(repr=False)  # the gradient, or a function from indices of points to its rows

    @cached_property
    def gradient(self) -> Any:
        return self.gradient_rows(np.arange(self.phi.shape[0])) if callable(self.gradient_rows) else self.gradient_rows

    def gradient_at(self, at: Int[Ints, " N"]) -> Any:
        """The rows (3 N, K) of ``gradient`` at some of the points; with moving least squares no others are computed."""
        if callable(self.gradient_rows):
            return self.gradient_rows(at)
        return self.gradient_rows[(3 * at[:, None] + np.arange(3)).reshape(-1)]

    @property
    def K(self) -> int:
        return int(self.phi.shape[1])

    def displaced(self, rows: Float[Floats, "K 3"]) -> Float[Floats, "P 3"]:
        """Displacement of the points by node vectors, in float64."""
        return np.asarray(self.phi.astype(np.float64) @ rows)

    def deformation_gradient_at(
        self, rows: Float[Floats, "K 3"], at: Int[Ints, " N"] | slice = slice(None)
    ) -> Float[Floats, "N 3 3"]:
        """F = I + sum_i u_i (grad Phi_i)^T at some of the points, F[..., a, k] = dx'_a / dx_k, in float64."""
        rates = np.asarray(self.gradient.astype(np.float64) @ rows).reshape(-1, 3, 3)
        return rates.transpose(0, 2, 1)[at] + np.eye(3)


def shape_functions(
    name: FieldName,
    points: Float[Floats, "P 3"],
    nodes: Float[Floats, "K 3"],
    radius: float | Float[Floats, " K"],
    kernel: Kernel,
) -> ShapeFunctions:
    """Evaluate the shape functions of a field that has nodes; ``radius`` and ``kernel`` are for moving least squares.

    `TemplateError` if points have too few nodes in reach (mls), or two nodes coincide (rbf).
    """
    assert has_nodes(name)
    return build_rbf(points, nodes) if name == "rbf" else build_field(points, nodes, radius, kernel)


def build_field(points: ArrayLike, nodes: ArrayLike, radius: ArrayLike, kernel: Kernel) -> ShapeFunctions:
    """Evaluate moving least squares and their gradient on fixed points: sparse, computed in float64.

    Points (P, 3), nodes (K, 3) and the nodes' support radius (one, or (K,) one for each) are in one unit and frame. Vectors
    are only valid with the kernel with which they were learned.

    `TemplateError` names the points that have fewer than four non-coplanar nodes in reach; `MeshmatchWarning` if the
    absolute shape functions at a point sum to more than `MAX_AMPLIFICATION`. `InputError` for positions or radii that are
    not finite numbers of these shapes, `OptionError` for an unknown kernel.
    """
    check_kernel(kernel)
    points, nodes = checked_positions(points, "points"), checked_positions(nodes, "nodes")
    radii = checked_radii(radius, len(nodes))
    fit = LocalFits.of(points, nodes, radii, kernel)
    phi = fit.values.astype(np.float32)
    warn_amplification(np.bincount(fit.at, np.abs(phi), len(points)).astype(np.float64))
    values = csr_matrix((phi, (fit.at, fit.of_node)), (len(points), len(nodes)))
    return ShapeFunctions(values, lambda some: _gradient(points[some], nodes, radii, kernel))


def check_kernel(kernel: Kernel) -> None:
    """Raise `OptionError` if the kernel is unknown."""
    if kernel not in tuple(KERNELS):  # a tuple, because invalid values may not be hashable
        raise OptionError(f"invalid kernel {kernel!r}", f"choose one of {', '.join(KERNELS)}")


def checked_radii(radius: ArrayLike, K: int) -> Float[Floats, " K"]:
    """Return the radius of each of K nodes; `InputError` if one is invalid."""
    radii = as_numbers(radius, "the radius", finite=True)
    if radii.shape not in ((), (K,)) or not (radii > 0).all():
        what = f"the radius must be positive, one number or one for each of {K} nodes"
        raise InputError(f"{what}, not {radii if radii.ndim == 0 else radii.shape}", "in the unit of the nodes")
    if not radii.max() < LARGEST:
        raise InputError("the radius is too large", "measure it in another unit")
    if not radii.min() > 1 / LARGEST:
        raise InputError("the radius is too small", "measure it in another unit")
    return np.broadcast_to(radii, (K,))


def build_surface_field(
    points: Float[Floats, "P 3"],
    nodes: Float[Floats, "K 3"],
    radii: Float[Floats, " K"],
    pairs: tuple[Int[Ints, " N"], Int[Ints, " N"]],
) -> ShapeFunctions:
    """Evaluate moving least squares in which a node moves only some of the points within its radius: those of ``pairs``.

    Pairs are indices of points and nodes, sorted by point, at least one for each point. Thus the two sides of a thin
    sheet, or two limbs that touch, can have separate nodes. The nodes of a point may lie in a plane: moment matrices are
    regularised, so that the field is nearly constant across the plane. Rows of ``phi`` sum to nearly one.
    """
    fit = LocalFits.of(points, nodes, radii, "smooth", pairs, _REGULARIZATION)
    values = csr_matrix((fit.values, (fit.at, fit.of_node)), (len(points), len(nodes)))
    return ShapeFunctions(values, _gradient_matrix(fit, len(points), len(nodes)))


def checked_positions(values: ArrayLike, what: str) -> Float[Floats, "N 3"]:
    """Return a copy of positions; `InputError` if they are not finite numbers in three columns."""
    found = as_numbers(values, what, finite=True)
    if found.ndim != 2 or found.shape[1] != 3 or not len(found):
        raise InputError(f"{what} must be an array of (N, 3), not {found.shape}", "one position in each row")
    return np.array(found)


def _gradient(
    points: Float[Floats, "P 3"], nodes: Float[Floats, "K 3"], radii: Float[Floats, " K"], kernel: Kernel
) -> Any:
    """The gradient of moving least squares (3 P, K)."""
    return _gradient_matrix(LocalFits.of(points, nodes, radii, kernel), len(points), len(nodes))


def _gradient_matrix(fit: LocalFits, P: int, K: int) -> Any:
    rows = 3 * fit.at[:, None] + np.arange(3)
    columns = np.broadcast_to(fit.of_node[:, None], rows.shape)
    return csr_matrix((fit.gradient.astype(np.float32).ravel(), (rows.ravel(), columns.ravel())), (3 * P, K))


def warn_amplification(total: Float[Floats, " P"]) -> None:
    """Warn if a point is extrapolated from its nodes, according to the sums of its absolute shape functions.

    Errors of the nodes' vectors can grow by this factor; its maximum is the Lebesgue constant.
    """
    worst = int(total.argmax())
    if total[worst] > MAX_AMPLIFICATION:
        what = f"point {worst} may move by {total[worst]:,.0f} times as much as the nodes around it"
        warn(f"{what}, which lie nearly in a plane or on one side: use more nodes or a larger radius")


def build_rbf(points: ArrayLike, nodes: ArrayLike) -> ShapeFunctions:
    """Evaluate radial basis functions and their gradient on fixed points: dense, computed in float64.

    Points (P, 3) and nodes (K, 3) are in one unit and frame. The paper's constants are for shapes in the unit sphere, so
    lengths are divided by the largest distance of a node from the mean of all; the functions do not depend on the unit.
    `TemplateError` if two nodes (nearly) coincide; `InputError` as `build_field`.
    """
    points, nodes = checked_positions(points, "points"), checked_positions(nodes, "nodes")
    unit = float(np.linalg.norm(nodes - nodes.mean(0), axis=1).max())
    q = nodes / unit
    matrix = multiquadric(q[:, None] - q)
    if not np.linalg.cond(matrix) < _MAX_CONDITION:
        hint = "use fewer nodes, or another field than rbf"
        raise TemplateError("nodes lie too close together to interpolate between them", hint)
    inverse = np.linalg.inv(matrix)
    phi = np.empty((len(points), len(q)), np.float32)
    gradient = np.empty((len(points), 3, len(q)), np.float32)
    for start in range(0, len(points), _BLOCK):
        chunk = slice(start, start + _BLOCK)
        offset = points[chunk, None] / unit - q  # P K 3
        value = multiquadric(offset)
        phi[chunk] = value @ inverse
        for k in range(3):
            gradient[chunk, k] = (STEEPNESS * offset[..., k] / value) @ inverse / unit
    return ShapeFunctions(phi, gradient.reshape(3 * len(points), len(q)))


def multiquadric(offset: Float[Floats, "*N 3"]) -> Float[Floats, "*N"]:
    """Multiquadric of offsets, in units of the largest distance of a node from the mean of all."""
    return np.asarray(np.sqrt(CONSTANT + STEEPNESS * np.square(offset).sum(-1)))
