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

import warnings

import numpy as np
import torch

from meshmatch.arrays import Float, Floats
from meshmatch.errors import TemplateError
from meshmatch.fields.field import Field
from meshmatch.geometry.kernels import KERNELS, Kernel
from meshmatch.templates.support import MINIMUM_EIGENVALUE, support_pairs


def build_field(
    points: Float[Floats, "P 3"],
    nodes: Float[Floats, "K 3"],
    radius: float | Float[Floats, " K"],
    kernel: Kernel,
) -> Field:
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
    Field
        float32 tensors; computed in float64.

    Raises
    ------
    TemplateError
        If a point has fewer than four non-coplanar nodes in reach; the message names the points.
    """
    points, nodes = np.asarray(points, np.float64), np.asarray(nodes, np.float64)
    P, K = len(points), len(nodes)
    radii = np.broadcast_to(np.asarray(radius, np.float64), (K,))
    row, column = support_pairs(points, nodes, radii)
    x, q, r = (torch.from_numpy(np.array(a)) for a in (points, nodes, radii))
    at, of = torch.from_numpy(row), torch.from_numpy(column)
    offset = x[at] - q[of]
    weight, slope = KERNELS[kernel](offset.norm(dim=1), r[of])
    slope_vector = slope[:, None] * offset  # dw/dx

    scale = float(r.mean())
    basis = torch.cat([torch.ones(len(at), 1, dtype=x.dtype), -offset / scale], 1)  # p(q_i) seen from x
    outer = basis[:, :, None] * basis[:, None, :]
    moment = torch.zeros(P, 4, 4, dtype=x.dtype).index_add_(0, at, weight[:, None, None] * outer)
    _check_support(moment)
    inverse = torch.linalg.inv(moment)
    constant = inverse[:, 0]  # p(x)^T M^-1 with p(x) = [1, 0, 0, 0]
    along = (constant[at] * basis).sum(1)
    phi = weight * along
    solved = (inverse[at] @ basis[..., None])[..., 0]  # M^-1 p(q_i)
    gradient = torch.empty(len(at), 3, dtype=x.dtype)
    for k in range(3):
        moment_slope = torch.zeros(P, 4, 4, dtype=x.dtype).index_add_(
            0, at, slope_vector[:, k, None, None] * outer
        )
        left = (constant[:, None] @ moment_slope)[:, 0]  # p^T M^-1 dM
        gradient[:, k] = (
            weight * solved[:, k + 1] / scale
            - weight * (left[at] * solved).sum(1)
            + slope_vector[:, k] * along
        )
    return _assemble(at, of, phi, gradient, P, K)


def _relative_eigenvalue(moment: torch.Tensor) -> torch.Tensor:
    trace = moment.diagonal(dim1=1, dim2=2).sum(1)
    return torch.linalg.eigvalsh(moment)[:, 0] / trace.clamp_min(1e-30)


def _check_support(moment: torch.Tensor) -> None:
    bad = torch.nonzero(_relative_eigenvalue(moment) < MINIMUM_EIGENVALUE).flatten()
    if len(bad):
        some = ", ".join(str(int(index)) for index in bad[:5])
        raise TemplateError(
            f"{len(bad)} points have fewer than four non-coplanar nodes in reach (points {some}"
            + (", ...)" if len(bad) > 5 else ")"),
            "use more nodes or a larger radius",
        )


def _assemble(at, of, phi, gradient, P, K) -> Field:
    counts = torch.bincount(at, minlength=P)
    start = torch.cat([torch.zeros(1, dtype=torch.int64), counts.cumsum(0)])
    values = _csr(start, of, phi, (P, K))
    rows = (3 * at[:, None] + torch.arange(3)).T.flatten()
    order = torch.argsort(rows, stable=True)
    start3 = torch.cat([torch.zeros(1, dtype=torch.int64), counts.repeat_interleave(3).cumsum(0)])
    slopes = _csr(start3, of.repeat(3)[order], gradient.T.flatten()[order], (3 * P, K))
    return Field(values, slopes)


def _csr(
    start: torch.Tensor, column: torch.Tensor, values: torch.Tensor, size: tuple[int, int]
) -> torch.Tensor:
    with warnings.catch_warnings():
        # Torch announces its CSR layout as beta at the first use: nothing a user could act on.
        warnings.filterwarnings("ignore", message="Sparse CSR tensor support is in beta")
        return torch.sparse_csr_tensor(start, column, values.float(), size, check_invariants=True)
