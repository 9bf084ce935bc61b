"""Rigid alignment of one sampled shape to another: from the orientation that is given, or from any.

Iterative closest points (Besl and McKay 1992) with normals, both ways and with robust weights. It finds the nearest
minimum, so a search begins from many turns: the axes of both files, and the principal axes of both shapes, in all
24 ways. Where several fit nearly as well, the orientation that the file has is believed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from meshmatch.shapes.shape import Floats

Align = Literal["none", "near", "rigid"]
ALIGNS: tuple[Align, ...] = get_args(Align)

# How far a normal that points the other way (2 units) pushes a neighbour away, in units of sqrt(area).
_NORMAL_WEIGHT = 0.15
_SCALE = 0.1  # of the robust weight, units of sqrt(area)
_CAP = 0.2  # of a distance in the residual
_CLEARLY = 0.9  # a turn must fit better than the given orientation by this factor
_CLOSE = 15.0  # degrees: two alignments nearer than that are one


@dataclass(frozen=True, eq=False)
class Oriented:
    """Points (P, 3) with unit normals (P, 3); a tree over both."""

    points: Floats
    normals: Floats

    def thinned(self, P: int) -> Oriented:
        """About P of the points, evenly taken from their order, which must be random."""
        step = max(1, len(self.points) // P)
        return Oriented(self.points[::step], self.normals[::step])

    def moved(self, rotation: Floats, center: Floats) -> Oriented:
        """In the frame of a target: R^T (x - center)."""
        return Oriented((self.points - center) @ rotation, self.normals @ rotation)

    @property
    def six(self) -> Floats:
        """(P, 6) positions in which surfaces back to back are apart."""
        return np.concatenate([self.points, _NORMAL_WEIGHT * self.normals], axis=1)


@dataclass(frozen=True, eq=False)
class Alignment:
    """shape = R target + center, as in a core frame; residual: mean capped distance both ways, normals included."""

    rotation: Floats
    center: Floats
    residual: float


def align(shape: Oriented, target: Oriented, how: Align, keep: int = 1) -> list[Alignment]:
    """Rigid motions that bring a target onto a shape, the best one first.

    Parameters
    ----------
    shape, target : Oriented
        Both centred, of one scale, their points in random order.
    how : {"none", "near", "rigid"}
        Take the orientation as it is; improve it; search all orientations.
    keep : int
        How many to return at most. "none" and "near" have one.
    """
    coarse_shape, coarse_target = shape.thinned(200), target.thinned(300)
    fine_shape, fine_target = shape.thinned(1200), target.thinned(1200)
    if how == "none":
        still = Alignment(np.eye(3), np.zeros(3), residual(fine_shape, fine_target))
        return [still]
    given = _icp(fine_shape, fine_target, Alignment(np.eye(3), np.zeros(3), np.inf), 25)
    if how == "near":
        return [given]
    rough = [
        _icp(coarse_shape, coarse_target, Alignment(start, np.zeros(3), np.inf), 6)
        for start in _starts(shape.points, target.points)
    ]
    chosen: list[Alignment] = []
    for each in sorted(rough, key=lambda found: found.residual):
        if len(chosen) < max(keep, 4) and all(_apart(each, other) > _CLOSE for other in chosen):
            chosen.append(each)
    fine = sorted(
        (_icp(fine_shape, fine_target, each, 25) for each in chosen), key=lambda found: found.residual
    )
    if fine[0].residual > _CLEARLY * given.residual:
        fine.insert(0, given)
    else:
        fine.append(given)
    distinct: list[Alignment] = []
    for each in fine:
        if all(_apart(each, other) > _CLOSE for other in distinct):
            distinct.append(each)
    return distinct[:keep]


def residual(shape: Oriented, target: Oriented, cap: float = _CAP) -> float:
    """Mean of the capped six-dimensional nearest distances, one way and back; of where both lie."""
    there, here = shape.six, target.six
    forward = cKDTree(here).query(there)[0]
    back = cKDTree(there).query(here)[0]
    return float(0.5 * np.minimum(forward, cap).mean() + 0.5 * np.minimum(back, cap).mean())


def rigid_motion(source: Floats, target: Floats, weights: Floats | None = None) -> tuple[Floats, Floats]:
    """Best rigid motion target ~ R source + t (Kabsch); rows are points, weights (N,) not negative."""
    weights = np.ones(len(source)) if weights is None else weights
    weights = weights / max(weights.sum(), 1e-30)
    a, b = weights @ source, weights @ target
    U, _, Vh = np.linalg.svd((target - b).T @ (weights[:, None] * (source - a)))
    U[:, 2] *= np.sign(np.linalg.det(U @ Vh))
    R = U @ Vh
    return R, b - R @ a


def _icp(shape: Oriented, target: Oriented, start: Alignment, steps: int) -> Alignment:
    rotation, center = start.rotation, start.center
    tree = cKDTree(target.six)
    for _ in range(steps):
        here = shape.moved(rotation, center)
        six = here.six
        to_target = tree.query(six)[1]
        to_shape = cKDTree(six).query(target.six)[1]
        source = np.concatenate([target.points[to_target], target.points])
        place = np.concatenate([here.points, here.points[to_shape]])
        weights = 1.0 / np.square(1.0 + np.square(source - place).sum(1) / _SCALE**2)
        weights[: len(six)] /= len(six)
        weights[len(six) :] /= len(target.points)
        R, t = rigid_motion(source, place, weights)
        rotation, center = rotation @ R, rotation @ t + center
        if np.abs(R - np.eye(3)).max() < 1e-4 and np.abs(t).max() < 1e-4:
            break
    return Alignment(rotation, center, residual(shape.moved(rotation, center), target))


def _starts(shape: Floats, target: Floats) -> list[Floats]:
    """The 24 turns of a cube in the files' own axes, and in the principal axes of both."""
    turns = Rotation.create_group("O").as_matrix()
    own, theirs = (_principal_axes(points) for points in (shape, target))
    return [*turns, *(own @ turn @ theirs.T for turn in turns)]


def _principal_axes(points: Floats) -> Floats:
    axes = np.linalg.eigh(np.cov(points.T))[1]
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    return np.asarray(axes)


def _apart(a: Alignment, b: Alignment) -> float:
    """Angle between two alignments, degrees."""
    cosine = (np.trace(a.rotation.T @ b.rotation) - 1) / 2
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
