"""Points with normals, and k-d trees over both, in which the two sides of a thin part are apart."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from meshmatch.arrays import Bool, Bools, Float, Floats, Floats32, Int, Ints
from meshmatch.geometry.frames import Frame, RigidPose
from meshmatch.geometry.trees import cKDTree

# Weight of normals in the distance of `with_normals`, in units of sqrt(area); opposite normals differ by 2. Set by
# hand.
NORMAL_WEIGHT = 0.15
_MAX_REFERENCE_DISTANCE = 0.5  # up to this distance a reference point determines the sign of a normal, see `facing`
_GROUPS = 16  # groups of queries with similar nearest distances
_BLOCK_SIZE = 65536  # distances computed at a time; they fit into a core's cache
# Rows whose length is a multiple of `_CONFLICT_STRIDE` evict one another from the cache: they get `_PADDING` columns.
_PADDING, _CONFLICT_STRIDE = 16, 256


@dataclass(frozen=True, eq=False)
class OrientedPoints:
    """Samples of a surface: points with unit normals."""

    points: Float[Floats, "P 3"]
    normals: Float[Floats, "P 3"]
    # False if the normals are estimated, as a cloud's are: their signs are then guesses, and wrong for whole regions where
    # points are sparse and noisy.
    signed: bool = True
    weights: Float[Floats, " P"] | None = None  # trust in each point, 0 to 1

    @property
    def features(self) -> Float[Floats, "P 6"]:
        """Points and normals as six coordinates, see `with_normals`."""
        return with_normals(self.points, self.normals)

    @cached_property
    def tree(self) -> cKDTree:
        """A k-d tree over the features."""
        return feature_tree(self.features)

    @cached_property
    def _trees(self) -> dict[float, cKDTree]:
        return {}

    def weighted_tree(self, weight: float) -> cKDTree:
        """A k-d tree over the features with another ``weight`` of normals; built once for each weight."""
        if weight not in self._trees:
            self._trees[weight] = feature_tree(with_normals(self.points, self.normals, weight))
        return self._trees[weight]

    def to_local(self, pose: RigidPose) -> OrientedPoints:
        """The samples in the local coordinates of a pose."""
        return replace(self, points=pose.to_local(self.points), normals=self.normals @ pose.rotation)

    def in_frame(self, frame: Frame) -> OrientedPoints:
        """The samples transformed by a frame; normals are rotated only."""
        return replace(self, points=frame.apply(self.points), normals=self.normals @ frame.rotation.T)

    def first(self, count: int) -> OrientedPoints:
        """The first ``count`` samples; this object itself, with its trees, if there are no more."""
        return self if count >= len(self.points) else self.rows(slice(count))

    def thinned(self, P: int) -> OrientedPoints:
        """About P samples at regular steps through their order, which must be random."""
        step = len(self.points) // P
        return self if step <= 1 else self.rows(slice(None, None, step))

    def drawn(self, count: int, rng: np.random.Generator) -> Float[Floats, "N 3"]:
        """At most ``count`` distinct points, drawn uniformly, or with probability proportional to the weights."""
        share = None if self.weights is None else self.weights / self.weights.sum()
        available = len(self.points) if share is None else np.count_nonzero(share)
        return self.points[rng.choice(len(self.points), min(count, available), replace=False, p=share)]

    def facing(self, reference: OrientedPoints) -> OrientedPoints:
        """The samples; normals with unreliable signs are flipped to agree with the nearest points of ``reference``."""
        if self.signed:
            return self
        flipped = nearest_unsigned(reference.tree, self.points, self.normals, _MAX_REFERENCE_DISTANCE)[2]
        normals = np.where(flipped[:, None], -self.normals, self.normals)
        return replace(self, normals=normals, signed=True)

    def rows(self, rows: slice | Bool[Bools, " P"] | Int[Ints, " N"]) -> OrientedPoints:
        """A subset of the samples."""
        arrays = {field.name: getattr(self, field.name) for field in fields(self)}
        selected: dict[str, Any] = {
            name: array[rows] for name, array in arrays.items() if isinstance(array, np.ndarray)
        }
        return replace(self, **selected)


def nearest_unsigned(
    tree: cKDTree, points: Float[Floats, "N 3"], normals: Float[Floats, "N 3"], reach: float
) -> tuple[Float[Floats, " N"], Int[Ints, " N"], Bool[Bools, " N"]]:
    """Nearest neighbours in a feature tree, with each query's normal in whichever direction brings it nearer.

    The second search, with flipped normals, only looks for points nearer than the first found. Queries are searched in
    groups of similar distance, which share one bound.

    Returns
    -------
    distance
        (N,) to the nearest point; infinite if there is none within ``reach``.
    index
        (N,) of that point; ``tree.n`` if there is none.
    flipped
        (N,) whether the flipped normal is nearer.
    """
    distance, index = tree.query(with_normals(points, normals), distance_upper_bound=reach)
    flipped_queries, flipped = with_normals(points, -normals), np.zeros(len(points), bool)
    for rows in np.array_split(np.argsort(distance), _GROUPS):
        limit = min(distance[rows].max(initial=0.0), reach)
        found, nearest_index = tree.query(flipped_queries[rows], distance_upper_bound=limit)
        flipped[rows] = nearer = found < distance[rows]
        distance[rows[nearer]], index[rows[nearer]] = found[nearer], nearest_index[nearer]
    return distance, index, flipped


def with_normals(
    points: Float[Floats, "... 3"], normals: Float[Floats, "... 3"], weight: float = NORMAL_WEIGHT
) -> Float[Floats, "... 6"]:
    """Six coordinates: the point and its weighted normal; points on opposite sides of a thin part are far apart."""
    return np.concatenate([points, weight * normals], -1)


def feature_tree(features: Float[Floats, "P D"]) -> cKDTree:
    """A k-d tree for some thousands of queries; splitting space rather than points in half halves the time to build it."""
    return cKDTree(features, leafsize=32, balanced_tree=False)


def quick_tree(points: Float[Floats | Floats32, "P D"]) -> cKDTree:
    """A k-d tree for a few scattered queries: quick to build rather than balanced."""
    return cKDTree(points, leafsize=32, balanced_tree=False, compact_nodes=False)


def nearest_by_brute_force(
    points: Float[Floats | Floats32, "P D"], queries: Float[Floats | Floats32, "Q D"]
) -> Int[Ints, " Q"]:
    """Index of the point nearest to each query, by comparing all pairs in float32; for a few thousand points at most.

    Faster than a k-d tree, which is slow for queries far from the points. Among points whose squared distances differ
    by less than rounding, about a millionth of the largest, any may be returned.
    """
    middle = points.mean(0)  # centring keeps float32 accurate
    points, queries = (np.asarray(each - middle, np.float32) for each in (points, queries))
    P, D = points.shape
    matrix = np.empty((D + 1, P if P % _CONFLICT_STRIDE else P + _PADDING), np.float32)
    matrix[:D, :P], matrix[D, :P] = -2 * points.T, np.square(points).sum(1)
    matrix[:D, P:], matrix[D, P:] = 0.0, np.inf  # padding is never the nearest
    homogeneous = np.concatenate([queries, np.ones((len(queries), 1), np.float32)], 1)
    rows = max(1, _BLOCK_SIZE // P)
    # reused by every block, instead of allocating each time
    buffer = np.empty((rows, matrix.shape[1]), np.float32)
    result = np.empty(len(homogeneous), np.int64)
    for low in range(0, len(homogeneous), rows):
        block = homogeneous[low : low + rows]
        result[low : low + rows] = np.matmul(block, matrix, out=buffer[: len(block)]).argmin(1)
    return result
