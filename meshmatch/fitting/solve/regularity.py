"""Regularity of a deformation, and removal of its folds.

A deformation preserves orientation where the determinant of its gradient F is positive. Where it is zero or negative, the
template is crushed flat or turned inside out, for example where a nose or a finger slides into the surface next to it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from meshmatch.arrays import Float, Floats
from meshmatch.fitting.solve.priors import signed_svd

_MIN_STRETCH = 0.1  # smallest stretch that folded gradients get
_NEARLY_FOLDED = 0.3  # gradients with a smaller determinant are opened too
_LENGTH = 0.03  # units of sqrt(area): moving a vertex this far costs as much as a change of F by one. Set by hand.
_DAMPING = 1e-3  # weight of the current node vectors, relative to the mean diagonal of the other terms
_MAX_ROUNDS, _OVERRELAXATION = 20, 4.0  # each round goes this many times its step, which opens folds in fewer rounds


@dataclass(frozen=True)
class Regularity:
    """How regular a deformation is over the template's vertices; F is the deformation gradient.

    Attributes
    ----------
    inverted : share (0..1) of the vertices where det F <= 0: there the template is folded, or turned inside out
    volume : mean of \\|det F - 1\\|, the change of volume; proportions unlike the template's contribute to it
    """

    inverted: float = 0.0
    volume: float = 0.0

    @classmethod
    def of(cls, gradients: Float[Floats, "V 3 3"]) -> Regularity:
        """Regularity for given deformation gradients."""
        found = np.linalg.det(gradients)
        return cls(float((found <= 0).mean()), float(np.abs(found - 1).mean()))


class Unfolding:
    """Removes the folds of a field that is linear in its K node vectors, and moves the rest as little as possible.

    The deformation gradient of every vertex that is folded, or nearly so, is replaced by the nearest one with positive
    stretches. The node vectors follow by least squares that hold all vertices, and all other gradients, in place. This is
    repeated until nothing is folded. These are the alternating steps for maps of bounded distortion (Aigerman and Lipman,
    *Injective and bounded distortion mappings in 3D*, SIGGRAPH 2013); their matrix is constant and is factored once.
    """

    def __init__(self, phi: Any, gradient: Any) -> None:
        """Factor the matrix, given shape functions (V, K) at the template's vertices and their gradient (3 V, K)."""
        self._gradient = gradient.astype(np.float64)
        moved, squared_gradient = (each.T @ each for each in (phi.astype(np.float64), self._gradient))
        normal = moved + _LENGTH**2 * squared_gradient
        normal = normal if isinstance(normal, np.ndarray) else normal.toarray()
        normal[np.diag_indices_from(normal)] += _DAMPING * np.trace(normal) / len(normal)
        self._factor = cho_factor(normal, overwrite_a=True)

    def __call__(self, vectors: Float[Floats, "K 3"]) -> Float[Floats, "K 3"]:
        """Node vectors near the given ones with no folds, or fewer; the same vectors if nothing is folded."""
        best, fewest = vectors, np.inf
        for _ in range(_MAX_ROUNDS):
            F = self._deformation_gradient(vectors)
            determinants = np.linalg.det(F)
            folds = int((determinants <= 0).sum())
            if folds < fewest:
                best, fewest = vectors, folds
            if folds == 0:
                break
            change = np.zeros_like(F)
            near = np.flatnonzero(determinants < _NEARLY_FOLDED)
            change[near] = unfolded_gradients(F[near]) - F[near]
            pull = self._gradient.T @ change.transpose(0, 2, 1).reshape(-1, 3)
            vectors = vectors + _OVERRELAXATION * _LENGTH**2 * cho_solve(self._factor, pull)
        return best

    def _deformation_gradient(self, vectors: Float[Floats, "K 3"]) -> Float[Floats, "V 3 3"]:
        return np.asarray((self._gradient @ vectors).reshape(-1, 3, 3).transpose(0, 2, 1) + np.eye(3))


def unfolded_gradients(F: Float[Floats, "N 3 3"]) -> Float[Floats, "N 3 3"]:
    """The nearest matrices whose stretches are at least `_MIN_STRETCH`; their determinants are positive."""
    U, stretches, Vh = signed_svd(F)
    return (U * np.maximum(stretches, _MIN_STRETCH)[:, None, :]) @ Vh
