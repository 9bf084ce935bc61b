"""First-order moving least squares: shape functions and their closed-form gradient.

    u(x)   = sum_i Phi_i(x) u_i
    Phi_i  = p(x)^T M(x)^-1 w_i(x) p(q_i),    p(x) = [1, x, y, z]^T
    M(x)   = sum_i w_i(x) p(q_i) p(q_i)^T

after *Reduced Representation of Deformation Fields for Effective Non-rigid Shape Matching*
(NeurIPS 2022), supplement. The basis is evaluated in coordinates that are centred on x and scaled by the
support radius: the functions are the same (first-order MLS does not depend on the affine frame of its
basis), and the 4 x 4 moment matrices stay well conditioned.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_matrix

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.errors import TemplateError
from meshmatch.fields.shape_functions import ShapeFunctions
from meshmatch.geometry.kernels import KERNELS, MINIMUM_EIGENVALUE, Kernel, support_pairs


def build_field(
    points: Float[Floats, "P 3"], nodes: Float[Floats, "K 3"], radius: float | Float[Floats, " K"], kernel: Kernel
) -> ShapeFunctions:
    """Evaluate the shape functions and their gradient on fixed points.

    Parameters
    ----------
    points, nodes
        In one unit and frame.
    radius
        Support radius of the nodes, same unit.
    kernel
        The model's: vectors learned with one kernel mean something else with another.

    Returns
    -------
    ShapeFunctions
        Sparse; computed in float64.

    Raises
    ------
    TemplateError
        If a point has fewer than four non-coplanar nodes in reach; the message names the points.
    """
    points, nodes = np.asarray(points, np.float64), np.asarray(nodes, np.float64)
    P, K = len(points), len(nodes)
    radii = np.broadcast_to(np.asarray(radius, np.float64), (K,))
    at, of = support_pairs(points, nodes, radii)  # sorted by point
    sums = csr_matrix((np.ones(len(at)), (at, np.arange(len(at)))), (P, len(at)))  # over the nodes of each point
    offset = points[at] - nodes[of]
    weight, slope = KERNELS[kernel](np.linalg.norm(offset, axis=1), radii[of])
    slope_vector = slope[:, None] * offset  # dw/dx

    scale = float(radii.mean())
    basis = np.concatenate([np.ones((len(at), 1)), -offset / scale], 1)  # p(q_i) seen from x
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
    return _assemble(at, of, phi, gradient, (P, K))


def _check_support(moment: Float[Floats, "P 4 4"]) -> None:
    trace = np.maximum(np.trace(moment, axis1=1, axis2=2), 1e-30)
    bad = np.flatnonzero(np.linalg.eigvalsh(moment)[:, 0] / trace < MINIMUM_EIGENVALUE)
    if len(bad):
        some = ", ".join(str(index) for index in bad[:5])
        raise TemplateError(
            f"{len(bad)} points have fewer than four non-coplanar nodes in reach (points {some}"
            + (", ...)" if len(bad) > 5 else ")"),
            "use more nodes or a larger radius",
        )


def _assemble(
    at: Int[Ints, " N"],
    of: Int[Ints, " N"],
    phi: Float[Floats, " N"],
    gradient: Float[Floats, "N 3"],
    size: tuple[int, int],
) -> ShapeFunctions:
    P, K = size
    values = csr_matrix((phi.astype(np.float32), (at, of)), size)
    rows = 3 * at[:, None] + np.arange(3)
    columns = np.broadcast_to(of[:, None], rows.shape)
    slopes = csr_matrix((gradient.astype(np.float32).ravel(), (rows.ravel(), columns.ravel())), (3 * P, K))
    return ShapeFunctions(values, slopes)
