"""Fields that are linear in the vectors of their nodes: shape functions on fixed points, as NumPy and SciPy hold them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints


@dataclass(frozen=True, eq=False)
class ShapeFunctions:
    """Shape functions of K nodes on P fixed points.

    Attributes
    ----------
    phi : (P, K) float32, sparse (CSR) or dense
        With moving least squares each row sums to one.
    gradient : (3 P, K) float32, likewise
        Row 3 p + k holds the derivative of the shape functions at point p along axis k (1 / length).
    """

    phi: Any
    gradient: Any
    linear = True

    @property
    def P(self) -> int:
        return int(self.phi.shape[0])

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
