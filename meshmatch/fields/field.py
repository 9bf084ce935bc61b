"""Deformation fields on fixed points in torch, with a common interface: for training and for gradient descent.

A decoder maps a code to *rows* (R, 3), which parameterize a deformation. For the linear representations (moving least
squares, radial basis functions) rows are the vectors of the nodes; for the pointwise one they contain the code. Callers need
not know which: a field computes the displacements of its points and the deformation gradients there from rows.

The pointwise representation is a network that displaces each point, given a code; there are no node vectors. Its rows are
the code, three numbers per row, followed by three rows T of a linear map that is applied after the network:

    x' = y + T^T y,   y = x + u(x, code)

Decoders return T = 0; T expresses a rotation of the result, so that a deformation found in a rotated frame can be converted
back. Deformation gradients are computed by automatic differentiation.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from meshmatch.arrays import Float, Floats, Int, Ints, ShortRepr, as_numbers, is_tensor
from meshmatch.errors import InputError
from meshmatch.fields.local_fits import namespace
from meshmatch.fields.shape_functions import ShapeFunctions

# (points (B, P, 3), code (B, D)) -> displacements (B, P, 3); the displacement of a point does not depend on other points.
Motion = Callable[[Float[torch.Tensor, "B P 3"], Float[torch.Tensor, "B D"]], Float[torch.Tensor, "B P 3"]]
TURN_ROWS = 3
# Codes per batch: with more, the network's activations do not stay in the processor's cache.
CODE_BATCH = 8


@dataclass(frozen=True, eq=False)
class Field:
    """`ShapeFunctions` of K nodes on P fixed points, as tensors, sparse (CSR) or dense."""

    phi: Float[torch.Tensor, "P K"]
    gradient: Float[torch.Tensor, "P3 K"]

    @classmethod
    def of(cls, functions: ShapeFunctions) -> Field:
        """Convert shape functions to tensors."""
        return cls(_tensor(functions.phi), _tensor(functions.gradient))

    @property
    def K(self) -> int:
        return int(self.phi.shape[1])

    def displacement(self, rows: Float[torch.Tensor, "B K 3"]) -> Float[torch.Tensor, "B P 3"]:
        """Displacements of the points."""
        return self._apply(self.phi, rows)

    def deformation_gradient(self, rows: Float[torch.Tensor, "B K 3"]) -> Float[torch.Tensor, "B P 3 3"]:
        """F = I + sum_i u_i (grad Phi_i)^T, F[..., a, k] = dx'_a / dx_k; at all points, unless limited by `for_training`."""
        columns = self._apply(self.gradient, rows).unflatten(1, (-1, 3))  # B P k a
        # At least float32: in bfloat16 the small difference from the identity would be lost.
        kind = torch.promote_types(rows.dtype, torch.float32)
        result: torch.Tensor = columns.transpose(-1, -2) + torch.eye(3, dtype=kind, device=rows.device)
        return result

    def for_training(self, gradients: int | None = None) -> Field:
        """Convert to dense matrices for large batches; gradients are kept at the first ``gradients`` points only."""
        # A large batch is one product, which would be slower with sparse matrices.
        rows = None if gradients is None else 3 * gradients
        return Field(self.phi.to_dense(), self.gradient.to_dense()[:rows])

    def for_descent(self) -> Field:
        """Precompute transposes for many gradient steps on a single deformation (B = 1)."""
        if self.phi.layout == torch.strided:
            return self
        transposes = (self.phi.t().to_sparse_csr(), self.gradient.t().to_sparse_csr())
        return _DescentField(self.phi, self.gradient, *transposes)

    def part(self, start: int, stop: int) -> Field:
        """The field on the points from ``start`` to ``stop``; call `for_training` before."""
        return Field(self.phi[start:stop], self.gradient[3 * start : 3 * stop])

    def to(self, device: str | torch.device) -> Field:
        return Field(self.phi.to(device), self.gradient.to(device))

    def _apply(self, matrix: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
        return apply_shape_functions(matrix, rows)


@dataclass(frozen=True, eq=False)
class _DescentField(Field):
    """A sparse field for a single deformation that stores transposes, which torch would compute for each gradient."""

    phi_transpose: torch.Tensor
    gradient_transpose: torch.Tensor

    def _apply(self, matrix: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
        transpose = self.phi_transpose if matrix is self.phi else self.gradient_transpose
        result: torch.Tensor = _Product.apply(rows[0], matrix, transpose)[None]  # type: ignore[no-untyped-call]
        return result


class _Product(torch.autograd.Function):
    """Sparse-dense matrix product whose backward pass uses a stored transpose."""

    @staticmethod
    def forward(ctx: Any, dense: torch.Tensor, matrix: torch.Tensor, transpose: torch.Tensor) -> torch.Tensor:
        ctx.transpose = transpose
        return matrix @ dense

    @staticmethod
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor, None, None]:
        return ctx.transpose @ gradient, None, None


def apply_shape_functions(
    matrix: Float[torch.Tensor, "R K"], vectors: Float[torch.Tensor, "B K 3"]
) -> Float[torch.Tensor, "B R 3"]:
    """Multiply one matrix, sparse or dense, by a batch of node vectors.

    Done as a single product: a batched one with three columns is twenty times slower on a CPU.
    """
    B, K, _ = vectors.shape
    flat = vectors.transpose(0, 1).reshape(K, B * 3)
    result: torch.Tensor = (matrix @ flat).unflatten(1, (B, 3)).transpose(0, 1)
    return result


def _tensor(matrix: Any) -> torch.Tensor:
    """Convert to a float32 tensor, sparse CSR or dense like the matrix."""
    if isinstance(matrix, np.ndarray):
        return torch.from_numpy(matrix)
    start, column = (torch.from_numpy(part.astype(np.int64)) for part in (matrix.indptr, matrix.indices))
    values = torch.from_numpy(matrix.data)
    with warnings.catch_warnings():
        # At first use torch warns that its CSR layout is in beta, which is of no use to users.
        warnings.filterwarnings("ignore", message="Sparse CSR tensor support is in beta")
        return torch.sparse_csr_tensor(start, column, values, matrix.shape, check_invariants=True)


def volume_energy(F: Any) -> Any:
    """Deviation from volume preservation at each point: (det F - 1)^2.

    Parameters
    ----------
    F
        (..., 3, 3) deformation gradients, an array or a tensor.

    Returns
    -------
    (...)
        An array or a tensor like F; a tensor keeps its gradient.

    Raises
    ------
    InputError
        F are not 3 x 3 matrices of numbers.
    """
    a, b, c = _columns(F)
    # triple product: several times faster than a batched LU
    return _in_precision_of(F, ((namespace(a).linalg.cross(a, b) * c).sum(-1) - 1) ** 2)


def arap_energy(F: Any) -> Any:
    """Deviation from rigidity at each point: the Frobenius norm of F^T F - I.

    Parameters
    ----------
    F
        (..., 3, 3) deformation gradients, an array or a tensor.

    Returns
    -------
    (...)
        An array or a tensor like F; a tensor keeps its gradient.

    Raises
    ------
    InputError
        F are not 3 x 3 matrices of numbers.
    """
    # Six dot products of columns: a batched 3 x 3 matmul is several times slower on a CPU.
    a, b, c = _columns(F)
    diagonal = ((a * a).sum(-1) - 1) ** 2 + ((b * b).sum(-1) - 1) ** 2 + ((c * c).sum(-1) - 1) ** 2
    mixed = (a * b).sum(-1) ** 2 + (a * c).sum(-1) ** 2 + (b * c).sum(-1) ** 2
    return _in_precision_of(F, namespace(a).sqrt(diagonal + 2 * mixed + 1e-12))


def _columns(F: Any) -> tuple[Any, Any, Any]:
    """The columns of matrices (..., 3, 3), of half precision in single precision; `InputError` for anything else.

    In half precision fourth powers overflow soon, and the square root would have no gradient at a rotation.
    """
    given: Any = F
    if not (is_tensor(F) or (isinstance(F, np.ndarray) and F.dtype.kind == "f")):
        given = as_numbers(F, "deformation gradients")
    if tuple(given.shape[-2:]) != (3, 3):
        raise InputError(f"deformation gradients must be (..., 3, 3), not {tuple(given.shape)}")
    if _is_half(given):
        given = given.astype(np.float32) if isinstance(given, np.ndarray) else given.float()
    return given[..., 0], given[..., 1], given[..., 2]


def _in_precision_of(F: Any, energy: Any) -> Any:
    """Round an energy to half precision if F has it."""
    if not _is_half(F):
        return energy
    if is_tensor(F):
        return energy.half()
    with np.errstate(over="ignore"):
        return energy.astype(np.float16)


def _is_half(array: Any) -> bool:
    return getattr(array, "dtype", None) in (np.float16, torch.float16)


def code_rows(D: int) -> int:
    """Number of rows of three numbers that a code of length D takes."""
    return -(-D // 3)


def pack(code: Float[torch.Tensor, "B D"]) -> Float[torch.Tensor, "B R 3"]:
    """Pack codes into rows, with T = 0."""
    D = code.shape[1]
    fill = 3 * (code_rows(D) + TURN_ROWS) - D
    result: torch.Tensor = torch.nn.functional.pad(code, (0, fill)).unflatten(1, (-1, 3))
    return result


def unpack(
    rows: Float[torch.Tensor, "B R 3"], D: int
) -> tuple[Float[torch.Tensor, "B D"], Float[torch.Tensor, "B 3 3"]]:
    """Split rows into codes and T."""
    return rows[:, :-TURN_ROWS].flatten(1)[:, :D], rows[:, -TURN_ROWS:]


def rotated_rows(rows: Float[Floats, "R 3"], turn: Float[Floats, "3 3"]) -> Float[Floats, "R 3"]:
    """Rows of the deformation followed by a rotation: its moved points (row vectors) are those of ``rows`` @ turn."""
    turned = rows.copy()
    turned[-TURN_ROWS:] = (np.eye(3) + rows[-TURN_ROWS:]) @ turn - np.eye(3)
    return turned


@dataclass(frozen=True, eq=False, repr=False)
class PointwiseField(ShortRepr):
    """A network's motion on fixed points, with deformation gradients at ``gradient_points``; codes have length D."""

    points: Float[torch.Tensor, "P 3"]
    gradient_points: Float[torch.Tensor, "G 3"]
    motion: Motion
    D: int

    def displacement(self, rows: Float[torch.Tensor, "B R 3"]) -> Float[torch.Tensor, "B P 3"]:
        code, turn = unpack(rows, self.D)
        u = torch.cat([self.motion(self.points.expand(len(part), -1, -1), part) for part in code.split(CODE_BATCH)])
        return u + (self.points + u) @ turn

    def deformation_gradient(self, rows: Float[torch.Tensor, "B R 3"]) -> Float[torch.Tensor, "B G 3 3"]:
        code, turn = unpack(rows, self.D)
        at = self.gradient_points
        parts = (
            value_and_jacobian(self.motion, at.expand(len(part), -1, -1), part)[1] for part in code.split(CODE_BATCH)
        )
        F = torch.cat(list(parts))
        F = F + torch.eye(3, dtype=F.dtype, device=F.device)
        return F + turn.transpose(1, 2)[:, None] @ F

    def displaced(self, rows: Float[Floats, "R 3"]) -> Float[Floats, "P 3"]:
        with torch.no_grad():
            return self.displacement(torch.from_numpy(np.array(rows)).float()[None])[0].double().numpy()

    def deformation_gradient_at(
        self, rows: Float[Floats, "R 3"], at: Int[Ints, " N"] | slice = slice(None)
    ) -> Float[Floats, "N 3 3"]:
        """F of one deformation at some of the points, in float64."""
        index = at if isinstance(at, slice) else torch.from_numpy(at)
        part = PointwiseField(self.points, self.points[index], self.motion, self.D)
        with torch.no_grad():
            given = torch.from_numpy(np.array(rows)).float()[None]
            return part.deformation_gradient(given)[0].double().numpy()

    def for_training(self, gradients: int | None = None) -> PointwiseField:
        return PointwiseField(self.points, self.points[:gradients], self.motion, self.D)

    def for_descent(self) -> PointwiseField:
        return self

    def part(self, start: int, stop: int) -> PointwiseField:
        points = self.points[start:stop]
        return PointwiseField(points, points, self.motion, self.D)

    def to(self, device: str | torch.device) -> PointwiseField:
        """Move the points to a device; the caller moves the network."""
        points, gradient_points = (each.to(device) for each in (self.points, self.gradient_points))
        return PointwiseField(points, gradient_points, self.motion, self.D)


def value_and_jacobian(
    motion: Motion, points: Float[torch.Tensor, "B P 3"], code: Float[torch.Tensor, "B D"]
) -> tuple[Float[torch.Tensor, "B P O"], Float[torch.Tensor, "B P O 3"]]:
    """Outputs u_a of a network at points, and du_a / dx_k; differentiable if gradients are enabled.

    Points are independent, so the gradient of a sum over points consists of the gradients at each point. One backward pass
    for each output; forward mode takes the same time and more memory.
    """
    wanted = torch.is_grad_enabled() and not torch.is_inference_mode_enabled()
    with torch.inference_mode(False), torch.enable_grad():
        at = points.clone().requires_grad_(True)
        moved = motion(at, code.clone())
        last = moved.shape[-1] - 1
        rows = [
            torch.autograd.grad(moved[..., a].sum(), at, create_graph=wanted, retain_graph=wanted or a < last)[0]
            for a in range(last + 1)
        ]
    return moved if wanted else moved.detach(), torch.stack(rows, -2)


# A representation on P fixed points; both have the same interface, with rows (B, R, 3).
PointField = Field | PointwiseField
