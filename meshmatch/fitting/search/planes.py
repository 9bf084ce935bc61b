"""Planes of approximate mirror symmetry of a shape.

Many planes are each moved to where the mirror image lies nearest, by iterative closest points with similar normals. Weights
are robust, so that a plane is also found if only half of the shape is symmetric: a face under a hat, a turned head.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from meshmatch.arrays import Float, Floats
from meshmatch.geometry.oriented import OrientedPoints, feature_tree, with_normals

# In units of sqrt(area). Set by hand, on busts and birds.
_N_DIRECTIONS, _FIRST_POINTS = 200, 300  # initial directions over a half sphere, and points for the first stage
_LAST_POINTS, _N_KEPT = 1500, 24  # points for the last stage, and planes that reach it
_NORMAL_WEIGHT = 0.1  # weight of unit normals against positions
_FAR = 0.08, 0.03  # scale of the robust weight when planes are compared, after the first and the last stage
_FIRST = (*(0.15,) * 3, *(0.1,) * 5)  # scales of the robust weight in the steps of the first stage
_LAST = (*np.geomspace(0.1, 0.02, 15), *(0.02,) * 8)  # and of the last stage
# Planes count as one if the cosine between their normals is larger than this, after the first and the last stage.
_ALIKE, _SAME = np.cos(np.radians(8)), np.cos(np.radians(5))
_APART = 0.05  # distance of planes that count as different after the first stage


@dataclass(frozen=True, eq=False)
class MirrorPlane:
    """The plane x . normal = offset; ``share`` (0..1) is how much of the surface it maps near to the surface."""

    normal: Float[Floats, " 3"]
    offset: float
    share: float = 1.0

    def reflect(self, points: Float[Floats, "V 3"]) -> Float[Floats, "V 3"]:
        """Mirror images of points."""
        return points - 2 * np.outer(points @ self.normal - self.offset, self.normal)

    def turn(self, vectors: Float[Floats, "V 3"]) -> Float[Floats, "V 3"]:
        """Mirror images of directions."""
        return vectors - 2 * np.outer(vectors @ self.normal, self.normal)

    @classmethod
    def between(
        cls, points: Float[Floats, "N 3"], others: Float[Floats, "N 3"], weights: Float[Floats, " N"]
    ) -> MirrorPlane:
        """The plane whose reflection takes points nearest to others, by weighted least squares."""
        middle = weights @ (points + others) / (2 * weights.sum())
        product = ((points - middle) * weights[:, None]).T @ (others - middle)
        normal = np.linalg.eigh(product + product.T)[1][:, 0]
        return cls(normal, float(normal @ middle))

    def is_like(self, other: MirrorPlane, angle: float, apart: float = np.inf) -> bool:
        """Whether two planes nearly coincide.

        The cosine of the angle between their normals must exceed ``angle``, and their distance must be below ``apart``.
        """
        cosine = float(self.normal @ other.normal)
        return abs(cosine) > angle and abs(self.offset - np.sign(cosine) * other.offset) < apart


def mirror_planes(samples: OrientedPoints, count: int) -> list[MirrorPlane]:
    """Planes of symmetry of a shape with area 1 about the origin.

    Parameters
    ----------
    samples
        Samples of its surface, in random order.
    count
        Maximum number of planes.

    Returns
    -------
    list of MirrorPlane
        Planes that map most of the surface near to itself, best first, no two alike.
    """
    first_samples, last_samples = samples.first(_FIRST_POINTS), samples.first(_LAST_POINTS)
    first_planes = [
        _refined(first_samples, MirrorPlane(each, 0.0), _FIRST, _FAR[0]) for each in _directions(_N_DIRECTIONS)
    ]
    kept = _distinct(first_planes, _N_KEPT, _ALIKE, _APART)
    return _distinct([_refined(last_samples, each, _LAST, _FAR[1]) for each in kept], count, _SAME)


def _refined(samples: OrientedPoints, plane: MirrorPlane, reach: Iterable[float], far: float) -> MirrorPlane:
    """Refine a plane by iterative closest points, with one scale of the robust weight for each step."""
    points, normals = samples.points, samples.normals
    tree = feature_tree(with_normals(points, normals, _NORMAL_WEIGHT))
    for near in reach:
        off, found = tree.query(with_normals(plane.reflect(points), plane.turn(normals), _NORMAL_WEIGHT))
        plane = MirrorPlane.between(points, points[found], _weights(off, near))
    off = tree.query(with_normals(plane.reflect(points), plane.turn(normals), _NORMAL_WEIGHT))[0]
    return MirrorPlane(plane.normal, plane.offset, float(_weights(off, far).mean()))


def _weights(off: Float[Floats, " N"], near: float) -> Float[Floats, " N"]:
    return np.asarray(1 / np.square(1 + np.square(off / near)))


def _distinct(planes: list[MirrorPlane], count: int, angle: float, apart: float = np.inf) -> list[MirrorPlane]:
    """The best planes, no two of which nearly coincide."""
    kept: list[MirrorPlane] = []
    for plane in sorted(planes, key=lambda each: -each.share):
        if len(kept) < count and not any(plane.is_like(other, angle, apart) for other in kept):
            kept.append(plane)
    return kept


def _directions(count: int) -> Float[Floats, "N 3"]:
    """Directions spread evenly over a half sphere, along a spiral."""
    number = np.arange(count) + 0.5
    height, turn = number / count, np.pi * (1 + np.sqrt(5)) * number
    across = np.sqrt(1 - np.square(height))
    return np.stack([across * np.cos(turn), across * np.sin(turn), height], axis=1)
