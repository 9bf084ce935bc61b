"""Priors of the least squares: deformation gradients that a fit should have where the shape does not determine them.

A prior turns the current deformation gradients F_g at the gradient points into targets T_g. This is the local step of
local/global optimisation (Sorkine and Alexa, *As-rigid-as-possible surface modeling*, 2007); the linear system that holds
F_g near T_g is the global step. A new prior is a class with the one method of `Prior`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from scipy.sparse import csr_matrix

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.geometry.trees import cKDTree

_MAX_ITERATIONS = 20  # of Newton's method: usually five suffice, as it converges quadratically


class Prior(Protocol):
    """Targets for deformation gradients."""

    def targets(self, F: Float[Floats, "G 3 3"]) -> Float[Floats, "G 3 3"]:
        """Targets for the gradients of the next step, given the current ones."""


@dataclass(frozen=True, eq=False)
class RotatedReference:
    """As rigid as possible about a reference: R_g S_g, with R_g the rotation that brings S_g closest to F_g.

    The surface may bend, but keeps the stretch of the reference.
    """

    reference: Float[Floats, "G 3 3"]

    def targets(self, F: Float[Floats, "G 3 3"]) -> Float[Floats, "G 3 3"]:
        return nearest_rotations(F, self.reference) @ self.reference


@dataclass(frozen=True, eq=False)
class FixedGradient:
    """Known gradients."""

    wanted: Float[Floats, "G 3 3"]

    def targets(self, F: Float[Floats, "G 3 3"]) -> Float[Floats, "G 3 3"]:
        return self.wanted


@dataclass(frozen=True, eq=False)
class ViscousGradient:
    """The mean of the current gradients over the nearest gradient points.

    Any stretch is possible if it varies slowly over the surface, and the progress of a step is kept, as in a viscous fluid.
    """

    mean: Any  # sparse (G, G)

    @classmethod
    def over(cls, points: Float[Floats, "G 3"], count: int) -> ViscousGradient:
        """Averages over ``count`` nearest gradient points on the rest template, including the point itself."""
        return cls._of_neighbours(cKDTree(points).query(points, count)[1])

    @classmethod
    def by_distance(cls, distances: Float[Floats, "G G"], count: int) -> ViscousGradient:
        """The same with given distances between gradient points, such as those along the surface."""
        return cls._of_neighbours(np.argsort(distances, axis=1, kind="stable")[:, :count])

    @classmethod
    def _of_neighbours(cls, near: Int[Ints, "G N"]) -> ViscousGradient:
        rows = np.repeat(np.arange(len(near)), near.shape[1])
        return cls(csr_matrix((np.full(near.size, 1 / near.shape[1]), (rows, near.reshape(-1))), (len(near),) * 2))

    def targets(self, F: Float[Floats, "G 3 3"]) -> Float[Floats, "G 3 3"]:
        return np.asarray(self.mean @ F.reshape(-1, 9)).reshape(-1, 3, 3)


def nearest_rotations(F: Float[Floats, "G 3 3"], start: Float[Floats, "G 3 3"]) -> Float[Floats, "G 3 3"]:
    """Rotations R_g that bring start_g closest to F_g (orthogonal Procrustes).

    The orthogonal factor of F start^T is computed by Newton's iteration with scaling (Higham, 1986), for all matrices at
    once, in a sixth of the time of singular value decompositions. These are used for matrices that are nearly singular or
    inverted.
    """
    M = F @ start.transpose(0, 2, 1)
    X = np.ascontiguousarray(M.reshape(-1, 9).T)
    size = np.sqrt((X * X).sum(0))
    C = _cofactors(X)
    hard = (X[:3] * C[:3]).sum(0) <= 1e-4 * size**3
    X[:, hard] = np.eye(3).reshape(9, 1)
    for _ in range(_MAX_ITERATIONS):
        C = _cofactors(X)
        det = (X[:3] * C[:3]).sum(0)
        scale = np.sqrt(np.sqrt((C * C).sum(0) / (X * X).sum(0)) / det)
        last, X = X, 0.5 * (scale * X + C / (scale * det))
        if not (np.abs(X - last) > 1e-8).any():
            break
    R = np.ascontiguousarray(X.T).reshape(-1, 3, 3)
    if hard.any():
        U, _, Vh = np.linalg.svd(M[hard])
        U[:, :, 2] *= np.linalg.det(U @ Vh)[:, None]
        R[hard] = U @ Vh
    return R


def signed_svd(
    F: Float[Floats, "N 3 3"],
) -> tuple[Float[Floats, "N 3 3"], Float[Floats, "N 3"], Float[Floats, "N 3 3"]]:
    """Singular value decomposition U, s, V^T with a rotation U V^T: the smallest s is negative if F inverts orientation."""
    U, sizes, Vh = np.linalg.svd(F)
    side = np.where(np.linalg.det(U @ Vh) < 0, -1.0, 1.0)
    U[:, :, 2] *= side[:, None]
    sizes[:, 2] *= side
    return U, sizes, Vh


def _cofactors(X: Float[Floats, "9 G"]) -> Float[Floats, "9 G"]:
    a, b, c, d, e, f, g, h, i = X
    rows = (e * i - f * h, f * g - d * i, d * h - e * g, c * h - b * i, a * i - c * g, b * g - a * h)
    return np.stack([*rows, b * f - c * e, c * d - a * f, a * e - b * d])
