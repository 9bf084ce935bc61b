"""What fitting sees of a shape: samples with normals in the scan frame, and a tree over them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

# How far a normal that points the other way (2 units) pushes a neighbour away, in units of sqrt(area).
NORMAL_WEIGHT = 0.15
# The same where points are paired for refinement: sheets are apart by then, and a normal that bends a little more must
# not drag its point along the surface.
PAIR_WEIGHT = 0.06
# Points that far from a template learn nothing from it about their normals.
_REACH = 0.5


@dataclass(frozen=True, eq=False)
class Scan:
    """Samples of a shape: points (P, 3) with area 1 and centroid 0, outward unit normals (P, 3).

    The normals of a cloud are estimated, and which side is out is a guess, wrong for whole regions where points are few
    and noisy: then ``signed`` is False, and a template tells (`facing`).
    """

    points: np.ndarray
    normals: np.ndarray
    signed: bool = True

    @cached_property
    def tree(self) -> cKDTree:
        return cKDTree(with_normals(self.points, self.normals))

    @cached_property
    def pair_tree(self) -> cKDTree:
        return cKDTree(with_normals(self.points, self.normals, PAIR_WEIGHT))

    def turned(self, rotation: np.ndarray, center: np.ndarray) -> Scan:
        """The same samples in the core frame: R^T (x - center)."""
        return replace(self, points=(self.points - center) @ rotation, normals=self.normals @ rotation)

    def first(self, count: int) -> Scan:
        """The first samples."""
        return replace(self, points=self.points[:count], normals=self.normals[:count])

    def facing(self, points: np.ndarray, normals: np.ndarray) -> Scan:
        """The same samples, normals without a sure sign turned as those (V, 3) of the template's points (V, 3) near."""
        if self.signed:
            return self
        tree = cKDTree(with_normals(points, normals))
        out, back = (
            tree.query(with_normals(self.points, sign * self.normals), distance_upper_bound=_REACH)[0]
            for sign in (1, -1)
        )
        return Scan(self.points, np.where((back < out)[:, None], -self.normals, self.normals))


def with_normals(points: np.ndarray, normals: np.ndarray, weight: float = NORMAL_WEIGHT) -> np.ndarray:
    """Six-dimensional positions in which surfaces back to back are apart."""
    return np.concatenate([points, weight * normals], 1)
