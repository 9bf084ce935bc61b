"""Fields that are linear in the vectors of their nodes: shape functions on fixed points, as NumPy and SciPy hold them.

First-order moving least squares, after *Reduced Representation of Deformation Fields for Effective Non-rigid Shape
Matching* (NeurIPS 2022), supplement:

    u(x)   = sum_i Phi_i(x) u_i
    Phi_i  = p(x)^T M(x)^-1 w_i(x) p(q_i),    p(x) = [1, x, y, z]^T
    M(x)   = sum_i w_i(x) p(q_i) p(q_i)^T

The basis is evaluated in coordinates that are centred on x and scaled by the support radius (the largest there, where
nodes have radii of their own): the functions are the same (they do not depend on the affine frame of the basis), and the
4 x 4 moment matrices stay well conditioned.

Radial basis functions, the multiquadric that the paper compares with:

    u(x)      = sum_i (A^-1 U)_i phi(x, q_i),    A_ij = phi(q_i, q_j)
    phi(a, b) = sqrt(C + eps |a - b|^2),         C = 1, eps = 50

Shape functions are Phi(x) = A^-1 phi(x, .): the field passes through its node vectors. They have no compact support, so
that their matrices are dense; a rigid motion of the nodes is rigid nearly, not exactly.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from scipy.sparse import csr_matrix

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.errors import TemplateError
from meshmatch.geometry.kernels import KERNELS, MINIMUM_EIGENVALUE, Kernel, support_pairs, support_scale

FieldName = Literal["mls", "rbf", "pointwise"]
FIELDS: tuple[FieldName, ...] = get_args(FieldName)
CONSTANT, STEEPNESS = 1.0, 50.0  # of the multiquadric
_MAX_CONDITION = 1e13
_BLOCK = 4096


def has_nodes(name: FieldName) -> bool:
    """Whether a deformation is given by node vectors, in which it is linear."""
    return name != "pointwise"


@dataclass(frozen=True, eq=False)
class ShapeFunctions:
    """Shape functions of K nodes on P fixed points.

    ``phi`` (P, K) and ``gradient`` (3 P, K) are float32, sparse (CSR) or dense. With moving least squares each row of
    ``phi`` sums to one. Row 3 p + k of ``gradient`` is the derivative at point p along axis k (1 / length).
    """

    phi: Any
    gradient: Any

    @property
    def K(self) -> int:
        return int(self.phi.shape[1])

    def displaced(self, rows: Float[Floats, "K 3"]) -> Float[Floats, "P 3"]:
        """Displacement of the points by node vectors, in float64."""
        return np.asarray(self.phi.astype(np.float64) @ rows)

    def strain(self, rows: Float[Floats, "K 3"], at: Int[Ints, " N"] | slice = slice(None)) -> Float[Floats, "N 3 3"]:
        """F = I + sum_i u_i (grad Phi_i)^T at some of the points, F[..., a, k] = dx'_a / dx_k, in float64."""
        slopes = np.asarray(self.gradient.astype(np.float64) @ rows).reshape(-1, 3, 3)
        return slopes.transpose(0, 2, 1)[at] + np.eye(3)


def shape_functions(
    name: FieldName,
    points: Float[Floats, "P 3"],
    nodes: Float[Floats, "K 3"],
    radius: float | Float[Floats, " K"],
    kernel: Kernel,
) -> ShapeFunctions:
    """A representation that has nodes, on fixed points of the template's frame; radial basis functions take all nodes.

    `TemplateError` where the nodes do not carry the points: too few in reach (mls), two in one place (rbf).
    """
    assert has_nodes(name)
    return build_rbf(points, nodes) if name == "rbf" else build_field(points, nodes, radius, kernel)


def build_field(
    points: Float[Floats, "P 3"], nodes: Float[Floats, "K 3"], radius: float | Float[Floats, " K"], kernel: Kernel
) -> ShapeFunctions:
    """Evaluate moving least squares and their gradient on fixed points: sparse, computed in float64.

    Points, nodes and the nodes' support radius (of all, or of each) are in one unit and frame. The kernel is the model's:
    vectors learned with one mean something else with another. `TemplateError` names the points that have fewer than four
    non-coplanar nodes in reach.
    """
    points, nodes = np.asarray(points, np.float64), np.asarray(nodes, np.float64)
    P, K = len(points), len(nodes)
    radii = np.broadcast_to(np.asarray(radius, np.float64), (K,))
    at, of = support_pairs(points, nodes, radii)  # sorted by point
    sums = csr_matrix((np.ones(len(at)), (at, np.arange(len(at)))), (P, len(at)))  # over the nodes of each point
    offset = points[at] - nodes[of]
    weight, slope = KERNELS[kernel](np.linalg.norm(offset, axis=1), radii[of])
    slope_vector = slope[:, None] * offset  # dw/dx

    scale = support_scale(at, of, radii, P)[at]
    basis = np.concatenate([np.ones((len(at), 1)), -offset / scale[:, None]], 1)  # p(q_i) seen from x
    outer = (basis[:, :, None] * basis[:, None, :]).reshape(-1, 16)
    moment = (sums @ (weight[:, None] * outer)).reshape(P, 4, 4)
    _check_support(moment)
    inverse = np.linalg.inv(moment)
    constant = inverse[:, 0]  # p(x)^T M^-1 with p(x) = [1, 0, 0, 0]
    along = (constant[at] * basis).sum(1)
    phi = weight * along
    solved = (inverse[at] @ basis[..., None])[..., 0]  # M^-1 p(q_i)
    gradient = np.empty((len(at), 3))
    for k in range(3):
        moment_slope = (sums @ (slope_vector[:, k, None] * outer)).reshape(P, 4, 4)
        left = (constant[:, None] @ moment_slope)[:, 0]  # p^T M^-1 dM
        gradient[:, k] = (
            weight * solved[:, k + 1] / scale - weight * (left[at] * solved).sum(1) + slope_vector[:, k] * along
        )
    values = csr_matrix((phi.astype(np.float32), (at, of)), (P, K))
    rows = 3 * at[:, None] + np.arange(3)
    columns = np.broadcast_to(of[:, None], rows.shape)
    slopes = csr_matrix((gradient.astype(np.float32).ravel(), (rows.ravel(), columns.ravel())), (3 * P, K))
    return ShapeFunctions(values, slopes)


def _check_support(moment: Float[Floats, "P 4 4"]) -> None:
    trace = np.maximum(np.trace(moment, axis1=1, axis2=2), 1e-30)
    bad = np.flatnonzero(np.linalg.eigvalsh(moment)[:, 0] / trace < MINIMUM_EIGENVALUE)
    if len(bad):
        some = ", ".join([*map(str, bad[:5]), *(["..."] if len(bad) > 5 else [])])
        problem = f"{len(bad)} points have fewer than four non-coplanar nodes in reach (points {some})"
        raise TemplateError(problem, "use more nodes or a larger radius")


def build_rbf(points: Float[Floats, "P 3"], nodes: Float[Floats, "K 3"]) -> ShapeFunctions:
    """Evaluate radial basis functions and their gradient on fixed points: dense, computed in float64.

    Points and nodes are in one unit and frame. The paper's numbers are for shapes in the unit sphere, so lengths are
    measured in the largest distance of a node from the middle of all: the functions do not depend on the unit.
    `TemplateError` if two nodes are (nearly) in one place.
    """
    points, nodes = np.asarray(points, np.float64), np.asarray(nodes, np.float64)
    unit = float(np.linalg.norm(nodes - nodes.mean(0), axis=1).max())
    q = nodes / unit
    among = multiquadric(q[:, None] - q)
    if not np.linalg.cond(among) < _MAX_CONDITION:
        hint = "use fewer nodes, or another field than rbf"
        raise TemplateError("nodes lie too close together to interpolate between them", hint)
    inverse = np.linalg.inv(among)
    phi = np.empty((len(points), len(q)), np.float32)
    gradient = np.empty((len(points), 3, len(q)), np.float32)
    for start in range(0, len(points), _BLOCK):
        here = slice(start, start + _BLOCK)
        offset = points[here, None] / unit - q  # P K 3
        value = multiquadric(offset)
        phi[here] = value @ inverse
        for k in range(3):
            gradient[here, k] = (STEEPNESS * offset[..., k] / value) @ inverse / unit
    return ShapeFunctions(phi, gradient.reshape(3 * len(points), len(q)))


def multiquadric(offset: Float[Floats, "*N 3"]) -> Float[Floats, "*N"]:
    """phi of offsets, in units of the nodes' radius."""
    return np.sqrt(CONSTANT + STEEPNESS * np.square(offset).sum(-1))
