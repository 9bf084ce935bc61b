"""What every representation of a deformation does on fixed points, in torch: for training, and for searches by gradient.

A decoder answers a code with *rows* (R, 3). For the linear representations (moving least squares, radial basis
functions) these are the vectors of the nodes; for the pointwise one they are the code itself. Who
moves points needs to know neither: a field says where its points go and what the deformation gradient is there.

The pointwise representation is a network that says for each point and code where the point goes. There are no node
vectors. The rows that stand for a deformation are the code, three numbers a row, and last three rows T of a turn that
comes after the network:

    x' = y + T^T y,   y = x + u(x, code)

T is 0 for what a decoder answers; it is there so that a deformation read in a turned frame can be turned back. The
deformation gradient comes from automatic differentiation.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from meshmatch.arrays import Brief, Float, Floats, Int, Ints, as_numbers, is_tensor
from meshmatch.errors import InputError
from meshmatch.fields.local_fits import namespace
from meshmatch.fields.shape_functions import ShapeFunctions

# (points (B, P, 3), code (B, D)) -> displacements (B, P, 3); what happens to a point depends on no other point.
Motion = Callable[[Float[torch.Tensor, "B P 3"], Float[torch.Tensor, "B D"]], Float[torch.Tensor, "B P 3"]]
TURN_ROWS = 3
# So many codes at a time: what a network makes of more points does not stay in the processor's cache.
CODES = 8


@dataclass(frozen=True, eq=False)
class Field:
    """`ShapeFunctions` of K nodes on P fixed points as tensors, sparse (CSR) or dense."""

    phi: Float[torch.Tensor, "P K"]
    gradient: Float[torch.Tensor, "P3 K"]

    @classmethod
    def of(cls, functions: ShapeFunctions) -> Field:
        """The same shape functions as tensors."""
        return cls(_tensor(functions.phi), _tensor(functions.gradient))

    @property
    def K(self) -> int:
        return int(self.phi.shape[1])

    def displacement(self, rows: Float[torch.Tensor, "B K 3"]) -> Float[torch.Tensor, "B P 3"]:
        """Where the points go, relative to where they are."""
        return self._apply(self.phi, rows)

    def deformation_gradient(self, rows: Float[torch.Tensor, "B K 3"]) -> Float[torch.Tensor, "B P 3 3"]:
        """F = I + sum_i u_i (grad Phi_i)^T, F[..., a, k] = dx'_a / dx_k: on all points, except after `for_training`."""
        columns = self._apply(self.gradient, rows).unflatten(1, (-1, 3))  # B P k a
        # At least float32: in bfloat16 the small difference from the identity would be lost.
        kind = torch.promote_types(rows.dtype, torch.float32)
        result: torch.Tensor = columns.transpose(-1, -2) + torch.eye(3, dtype=kind, device=rows.device)
        return result

    def for_training(self, gradients: int | None = None) -> Field:
        """The same arranged for large batches; the gradient at the first ``gradients`` points alone."""
        # Dense, for a large batch is one product: a sparse one would be slower.
        rows = None if gradients is None else 3 * gradients
        return Field(self.phi.to_dense(), self.gradient.to_dense()[:rows])

    def for_descent(self) -> Field:
        """The same arranged for many steps with gradients of a single answer."""
        if self.phi.layout == torch.strided:
            return self
        transposes = (self.phi.t().to_sparse_csr(), self.gradient.t().to_sparse_csr())
        return _DescentField(self.phi, self.gradient, *transposes)

    def part(self, start: int, stop: int) -> Field:
        """The same on the points from ``start`` to ``stop``; after `for_training`."""
        return Field(self.phi[start:stop], self.gradient[3 * start : 3 * stop])

    def to(self, device: str | torch.device) -> Field:
        return Field(self.phi.to(device), self.gradient.to(device))

    def _apply(self, matrix: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
        return apply_shape_functions(matrix, rows)


@dataclass(frozen=True, eq=False)
class _DescentField(Field):
    """A sparse field that keeps its transposes: torch would sort new ones for each gradient. One answer at a time."""

    phi_transpose: torch.Tensor
    gradient_transpose: torch.Tensor

    def _apply(self, matrix: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
        transpose = self.phi_transpose if matrix is self.phi else self.gradient_transpose
        result: torch.Tensor = _Product.apply(rows[0], matrix, transpose)[None]  # type: ignore[no-untyped-call]
        return result


class _Product(torch.autograd.Function):
    """A sparse matrix times a dense one, whose gradient uses a kept transpose."""

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
    """One matrix, sparse or dense, on a batch of node vectors.

    As a single product: a batched one with three columns is twenty times slower on a CPU.
    """
    B, K, _ = vectors.shape
    flat = vectors.transpose(0, 1).reshape(K, B * 3)
    result: torch.Tensor = (matrix @ flat).unflatten(1, (B, 3)).transpose(0, 1)
    return result


def _tensor(matrix: Any) -> torch.Tensor:
    """A float32 tensor, sparse CSR or dense as the matrix is."""
    if isinstance(matrix, np.ndarray):
        return torch.from_numpy(matrix)
    start, column = (torch.from_numpy(part.astype(np.int64)) for part in (matrix.indptr, matrix.indices))
    values = torch.from_numpy(matrix.data)
    with warnings.catch_warnings():
        # Torch announces its CSR layout as beta at the first use: nothing a user could act on.
        warnings.filterwarnings("ignore", message="Sparse CSR tensor support is in beta")
        return torch.sparse_csr_tensor(start, column, values, matrix.shape, check_invariants=True)


def volume_energy(F: Any) -> Any:
    """How far a deformation is from keeping volumes, at each point: (det F - 1)^2.

    Parameters
    ----------
    F
        (..., 3, 3) deformation gradients, an array or a tensor.

    Returns
    -------
    (...)
        As F is; a tensor keeps its gradient.

    Raises
    ------
    InputError
        F are not 3 x 3 numbers.
    """
    a, b, c = _columns(F)
    # written out: several times faster than a batched LU
    return ((namespace(a).linalg.cross(a, b) * c).sum(-1) - 1) ** 2


def arap_energy(F: Any) -> Any:
    """How far a deformation is from a rigid one, at each point: the Frobenius norm of F^T F - I.

    Parameters
    ----------
    F
        (..., 3, 3) deformation gradients, an array or a tensor.

    Returns
    -------
    (...)
        As F is; a tensor keeps its gradient.

    Raises
    ------
    InputError
        F are not 3 x 3 numbers.
    """
    # Six dot products of columns: a batched 3 x 3 matmul is several times slower on a CPU.
    a, b, c = _columns(F)
    diagonal = ((a * a).sum(-1) - 1) ** 2 + ((b * b).sum(-1) - 1) ** 2 + ((c * c).sum(-1) - 1) ** 2
    mixed = (a * b).sum(-1) ** 2 + (a * c).sum(-1) ** 2 + (b * c).sum(-1) ** 2
    return namespace(a).sqrt(diagonal + 2 * mixed + 1e-12)


def _columns(F: Any) -> tuple[Any, Any, Any]:
    """The columns of matrices (..., 3, 3); `InputError` for anything else."""
    given: Any = F
    if not (is_tensor(F) or (isinstance(F, np.ndarray) and F.dtype.kind == "f")):
        given = as_numbers(F, "deformation gradients")
    if tuple(given.shape[-2:]) != (3, 3):
        raise InputError(f"deformation gradients must be (..., 3, 3), not {tuple(given.shape)}")
    return given[..., 0], given[..., 1], given[..., 2]


def code_rows(D: int) -> int:
    """How many rows of three numbers hold a code of D."""
    return -(-D // 3)


def pack(code: Float[torch.Tensor, "B D"]) -> Float[torch.Tensor, "B R 3"]:
    """Rows of codes, without a turn."""
    D = code.shape[1]
    fill = 3 * (code_rows(D) + TURN_ROWS) - D
    result: torch.Tensor = torch.nn.functional.pad(code, (0, fill)).unflatten(1, (-1, 3))
    return result


def unpack(
    rows: Float[torch.Tensor, "B R 3"], D: int
) -> tuple[Float[torch.Tensor, "B D"], Float[torch.Tensor, "B 3 3"]]:
    """Codes and turns T of rows."""
    return rows[:, :-TURN_ROWS].flatten(1)[:, :D], rows[:, -TURN_ROWS:]


def turned_rows(rows: Float[Floats, "R 3"], turn: Float[Floats, "3 3"]) -> Float[Floats, "R 3"]:
    """Rows of the deformation whose moved points are those of ``rows`` times ``turn`` (points are rows)."""
    turned = rows.copy()
    turned[-TURN_ROWS:] = (np.eye(3) + rows[-TURN_ROWS:]) @ turn - np.eye(3)
    return turned


@dataclass(frozen=True, eq=False, repr=False)
class PointwiseField(Brief):
    """A network's motion on fixed points, with gradients at ``gradient_points``; codes have D numbers."""

    points: Float[torch.Tensor, "P 3"]
    gradient_points: Float[torch.Tensor, "G 3"]
    motion: Motion
    D: int

    def displacement(self, rows: Float[torch.Tensor, "B R 3"]) -> Float[torch.Tensor, "B P 3"]:
        code, turn = unpack(rows, self.D)
        u = torch.cat([self.motion(self.points.expand(len(part), -1, -1), part) for part in code.split(CODES)])
        return u + (self.points + u) @ turn

    def deformation_gradient(self, rows: Float[torch.Tensor, "B R 3"]) -> Float[torch.Tensor, "B G 3 3"]:
        code, turn = unpack(rows, self.D)
        at = self.gradient_points
        parts = (value_and_jacobian(self.motion, at.expand(len(part), -1, -1), part)[1] for part in code.split(CODES))
        F = torch.cat(list(parts))
        F = F + torch.eye(3, dtype=F.dtype, device=F.device)
        return F + turn.transpose(1, 2)[:, None] @ F

    def displaced(self, rows: Float[Floats, "R 3"]) -> Float[Floats, "P 3"]:
        with torch.no_grad():
            return self.displacement(torch.from_numpy(np.array(rows)).float()[None])[0].double().numpy()

    def deformation_gradient_at(
        self, rows: Float[Floats, "R 3"], at: Int[Ints, " N"] | slice = slice(None)
    ) -> Float[Floats, "N 3 3"]:
        """F of one answer at some of the points, in float64."""
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
        """Where the points are; the network is moved by whoever owns it."""
        points, gradient_points = (each.to(device) for each in (self.points, self.gradient_points))
        return PointwiseField(points, gradient_points, self.motion, self.D)


def value_and_jacobian(
    motion: Motion, points: Float[torch.Tensor, "B P 3"], code: Float[torch.Tensor, "B D"]
) -> tuple[Float[torch.Tensor, "B P O"], Float[torch.Tensor, "B P O 3"]]:
    """What a network answers at points (of a motion u), and du_a / dx_k; differentiable where gradients are.

    Points do not act on one another, so the gradient of a sum over points holds each point's own. Backwards through the
    network once for each output: forward mode costs the same here and more memory for its tangents.
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


# A representation on P fixed points; both answer the same questions, and take rows (B, R, 3).
PointField = Field | PointwiseField
