"""What fitting sees of a shape: samples with normals in the scan frame, and a tree over them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

# How far a normal that points the other way (2 units) pushes a neighbour away, in units of sqrt(area).
NORMAL_WEIGHT = 0.15
# The same where points are paired for refinement: sheets are apart by then, and a normal that bends a little more must
# not drag its point along the surface.
PAIR_WEIGHT = 0.06


@dataclass(frozen=True, eq=False)
class Scan:
    """Samples of a shape: points (P, 3) with area 1 and centroid 0, outward unit normals (P, 3)."""

    points: np.ndarray
    normals: np.ndarray

    @cached_property
    def tree(self) -> cKDTree:
        return cKDTree(with_normals(self.points, self.normals))

    @cached_property
    def pair_tree(self) -> cKDTree:
        return cKDTree(with_normals(self.points, self.normals, PAIR_WEIGHT))

    def turned(self, rotation: np.ndarray, centre: np.ndarray) -> Scan:
        """The same samples in the core frame: R^T (x - centre)."""
        return Scan((self.points - centre) @ rotation, self.normals @ rotation)


def with_normals(points: np.ndarray, normals: np.ndarray, weight: float = NORMAL_WEIGHT) -> np.ndarray:
    """Six-dimensional positions in which surfaces back to back are apart."""
    return np.concatenate([points, weight * normals], 1)
