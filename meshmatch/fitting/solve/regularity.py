"""How regular a deformation is, and how it is made regular where it folds.

A deformation keeps the order of space where the determinant of its gradient F is positive. Where that is zero or less the
template is crushed flat or turned inside out, as happens where a nose or a finger slides into the surface beside it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from meshmatch.arrays import Float, Floats
from meshmatch.fitting.solve.priors import signed_svd

_THICK = 0.1  # what is folded is opened until its smallest stretch is so much, or until nothing is folded
_NEARLY = 0.3  # a determinant from which on no vertex is near to folding
_LENGTH = 0.03  # units of sqrt(area): moving a vertex so far costs as much as a change of F by one. Set by hand.
_DAMPING = 1e-3  # weight of the node vectors as they are, against the mean of the other two
_ROUNDS, _AHEAD = 20, 4.0  # each round goes so many times as far as its equations say: folds open in fewer rounds


@dataclass(frozen=True)
class Regularity:
    """How regular a deformation is, at all vertices of the template; F is the deformation gradient.

    Attributes
    ----------
    inverted : share (0..1) of the vertices where det F <= 0: there the template is folded, or turned inside out
    volume : mean of \\|det F - 1\\|, how much volume changes; other proportions than the template's change it too
    """

    inverted: float = 0.0
    volume: float = 0.0

    @classmethod
    def of(cls, gradients: Float[Floats, "V 3 3"]) -> Regularity:
        """Of deformation gradients."""
        found = np.linalg.det(gradients)
        return cls(float((found <= 0).mean()), float(np.abs(found - 1).mean()))


class Unfolding:
    """Opens the folds of a field that is linear in its K node vectors, and moves the rest as little as possible.

    The deformation gradient of every vertex that is folded, or nearly, is replaced by the nearest one whose stretches are
    all positive, and the node vectors follow by least squares that hold all vertices, and all other gradients, where they
    were; again until nothing is folded. These are the alternating steps by which maps of bounded distortion are found
    (Aigerman and Lipman, *Injective and bounded distortion mappings in 3D*, SIGGRAPH 2013); their matrix never changes.
    """

    def __init__(self, phi: Any, gradient: Any) -> None:
        """By shape functions (V, K) at the template's vertices, and their gradient (3 V, K)."""
        self._gradient = gradient.astype(np.float64)
        moved, squared_gradient = (each.T @ each for each in (phi.astype(np.float64), self._gradient))
        normal = moved + _LENGTH**2 * squared_gradient
        normal = normal if isinstance(normal, np.ndarray) else normal.toarray()
        normal[np.diag_indices_from(normal)] += _DAMPING * np.trace(normal) / len(normal)
        self._factor = cho_factor(normal, overwrite_a=True)

    def __call__(self, vectors: Float[Floats, "K 3"]) -> Float[Floats, "K 3"]:
        """Node vectors near the given ones, with fewer folds or none; the same ones where nothing is folded."""
        best, fewest = vectors, np.inf
        for _ in range(_ROUNDS):
            F = self._deformation_gradient(vectors)
            determinants = np.linalg.det(F)
            folds = int((determinants <= 0).sum())
            if folds < fewest:
                best, fewest = vectors, folds
            if folds == 0:
                break
            change = np.zeros_like(F)
            near = np.flatnonzero(determinants < _NEARLY)
            change[near] = opened(F[near]) - F[near]
            pull = self._gradient.T @ change.transpose(0, 2, 1).reshape(-1, 3)
            vectors = vectors + _AHEAD * _LENGTH**2 * cho_solve(self._factor, pull)
        return best

    def _deformation_gradient(self, vectors: Float[Floats, "K 3"]) -> Float[Floats, "V 3 3"]:
        return np.asarray((self._gradient @ vectors).reshape(-1, 3, 3).transpose(0, 2, 1) + np.eye(3))


def opened(F: Float[Floats, "N 3 3"]) -> Float[Floats, "N 3 3"]:
    """The nearest matrices whose stretches are at least `_THICK`, and whose determinants are therefore positive."""
    U, stretches, Vh = signed_svd(F)
    return (U * np.maximum(stretches, _THICK)[:, None, :]) @ Vh
