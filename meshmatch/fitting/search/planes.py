"""Planes in which a shape is nearly its own mirror image.

Each of many planes is moved to where the mirror image lies nearest, by closest points of like normals. What lies far off
counts little, so that a plane is found that half of a shape has: a face under a hat, a head that is turned.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from meshmatch.arrays import Float, Floats
from meshmatch.geometry.oriented import OrientedPoints, feature_tree, with_normals

# In units of sqrt(area). Set by hand, on busts and birds.
_BEGUN, _FEW = 200, 300  # directions all around, and points by which they are compared
_POINTS, _KEPT = 1500, 24  # of the planes that go on
_NORMALS = 0.1
_FAR = 0.08, 0.03  # what counts a quarter, where planes are compared first and last
_FIRST = (*(0.15,) * 3, *(0.1,) * 5)  # the same of each step
_LAST = (*np.geomspace(0.1, 0.02, 15), *(0.02,) * 8)
_ALIKE, _SAME = np.cos(np.radians(8)), np.cos(np.radians(5))  # of planes that count as one
_APART = 0.05


@dataclass(frozen=True, eq=False)
class MirrorPlane:
    """All x with x . normal = offset; ``share`` (0..1) is how much of the surface it brings near to the surface."""

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
        """Whether the normals enclose an angle with less than a cosine, and the planes lie no further apart than that."""
        cosine = float(self.normal @ other.normal)
        return abs(cosine) > angle and abs(self.offset - np.sign(cosine) * other.offset) < apart


def mirror_planes(samples: OrientedPoints, count: int) -> list[MirrorPlane]:
    """Planes of symmetry of a shape with an area of 1 about the origin.

    Parameters
    ----------
    samples
        Of its surface, in random order.
    count
        How many planes at most.

    Returns
    -------
    list of MirrorPlane
        Those that bring most of the surface near to itself, best first, no two alike.
    """
    few, more = samples.first(_FEW), samples.first(_POINTS)
    begun = [_moved(few, MirrorPlane(each, 0.0), _FIRST, _FAR[0]) for each in _directions(_BEGUN)]
    kept = _distinct(begun, _KEPT, _ALIKE, _APART)
    return _distinct([_moved(more, each, _LAST, _FAR[1]) for each in kept], count, _SAME)


def _moved(samples: OrientedPoints, plane: MirrorPlane, reach: Iterable[float], far: float) -> MirrorPlane:
    """A plane after closest points, of which those that are further than the reach of a step count little."""
    points, normals = samples.points, samples.normals
    tree = feature_tree(with_normals(points, normals, _NORMALS))
    for near in reach:
        off, found = tree.query(with_normals(plane.reflect(points), plane.turn(normals), _NORMALS))
        plane = MirrorPlane.between(points, points[found], _weights(off, near))
    off = tree.query(with_normals(plane.reflect(points), plane.turn(normals), _NORMALS))[0]
    return MirrorPlane(plane.normal, plane.offset, float(_weights(off, far).mean()))


def _weights(off: Float[Floats, " N"], near: float) -> Float[Floats, " N"]:
    return np.asarray(1 / np.square(1 + np.square(off / near)))


def _distinct(planes: list[MirrorPlane], count: int, angle: float, apart: float = np.inf) -> list[MirrorPlane]:
    kept: list[MirrorPlane] = []
    for plane in sorted(planes, key=lambda each: -each.share):
        if len(kept) < count and not any(plane.is_like(other, angle, apart) for other in kept):
            kept.append(plane)
    return kept


def _directions(count: int) -> Float[Floats, "N 3"]:
    """Evenly over half of the sphere, along a spiral."""
    number = np.arange(count) + 0.5
    height, turn = number / count, np.pi * (1 + np.sqrt(5)) * number
    across = np.sqrt(1 - np.square(height))
    return np.stack([across * np.cos(turn), across * np.sin(turn), height], axis=1)
