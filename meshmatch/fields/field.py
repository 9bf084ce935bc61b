"""What every representation of a deformation does on fixed points, in torch: for training, and for searches by gradient.

A decoder answers a code with *rows* (R, 3). For the linear representations (moving least squares, radial basis
functions) these are the vectors of the nodes; for the pointwise one (`fields.pointwise`) they are the code itself. Who
moves points needs to know neither: a field says where its points go and what the deformation gradient is there.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from meshmatch.arrays import Float
from meshmatch.fields.pointwise import PointwiseField
from meshmatch.fields.shape_functions import ShapeFunctions


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
        return columns.transpose(-1, -2) + torch.eye(3, dtype=kind, device=rows.device)

    def for_training(self, strained: int | None = None) -> Field:
        """The same arranged for large batches; the gradient on the first ``strained`` points alone."""
        # Dense, for a large batch is one product: a sparse one would be slower.
        rows = None if strained is None else 3 * strained
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

    def to(self, *args, **kwargs) -> Field:
        return Field(self.phi.to(*args, **kwargs), self.gradient.to(*args, **kwargs))

    def _apply(self, matrix: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
        return apply_shape_functions(matrix, rows)


# A representation on P fixed points; both answer the same questions, and take rows (B, R, 3).
PointField = Field | PointwiseField


@dataclass(frozen=True, eq=False)
class _DescentField(Field):
    """A sparse field that keeps its transposes: torch would sort new ones for each gradient. One answer at a time."""

    phi_transpose: torch.Tensor
    gradient_transpose: torch.Tensor

    def _apply(self, matrix: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
        transpose = self.phi_transpose if matrix is self.phi else self.gradient_transpose
        return _Product.apply(rows[0], matrix, transpose)[None]


class _Product(torch.autograd.Function):
    """A sparse matrix times a dense one, whose gradient uses a kept transpose."""

    @staticmethod
    def forward(ctx, dense, matrix, transpose):
        ctx.transpose = transpose
        return matrix @ dense

    @staticmethod
    def backward(ctx, gradient):
        return ctx.transpose @ gradient, None, None


def apply_shape_functions(
    matrix: Float[torch.Tensor, "R K"], vectors: Float[torch.Tensor, "B K 3"]
) -> Float[torch.Tensor, "B R 3"]:
    """One matrix, sparse or dense, on a batch of node vectors.

    As a single product: a batched one with three columns is twenty times slower on a CPU.
    """
    B, K, _ = vectors.shape
    flat = vectors.transpose(0, 1).reshape(K, B * 3)
    return (matrix @ flat).unflatten(1, (B, 3)).transpose(0, 1)


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


def determinant(F: Float[torch.Tensor, "*B 3 3"]) -> Float[torch.Tensor, "*B"]:
    """Determinant written out: several times faster than a batched LU."""
    a, b, c = F[..., 0], F[..., 1], F[..., 2]
    return (torch.linalg.cross(a, b) * c).sum(-1)


def volume_energy(F: Float[torch.Tensor, "*B 3 3"]) -> Float[torch.Tensor, "*B"]:
    """(det F - 1)^2 of every point: volume preservation (the NeurIPS 2022 paper, section 4)."""
    return (determinant(F) - 1).square()


def arap_energy(F: Float[torch.Tensor, "*B 3 3"]) -> Float[torch.Tensor, "*B"]:
    """|F^T F - I| (Frobenius) of every point: as rigid as possible (ibidem)."""
    # Six dot products of columns: a batched 3 x 3 matmul is several times slower on a CPU.
    a, b, c = F[..., 0], F[..., 1], F[..., 2]
    diagonal = ((a * a).sum(-1) - 1).square() + ((b * b).sum(-1) - 1).square() + ((c * c).sum(-1) - 1).square()
    mixed = (a * b).sum(-1).square() + (a * c).sum(-1).square() + (b * c).sum(-1).square()
    return (diagonal + 2 * mixed + 1e-12).sqrt()
