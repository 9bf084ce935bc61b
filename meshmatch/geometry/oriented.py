"""Points with normals, and trees in which surfaces back to back are apart."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from meshmatch.arrays import Bool, Bools, Float, Floats, Floats32, Int, Ints
from meshmatch.geometry.frames import Frame, RigidPose
from meshmatch.geometry.trees import cKDTree

# How far a normal that points the other way (2 units) pushes a neighbour away, in units of sqrt(area). Set by hand.
NORMAL_WEIGHT = 0.15
# Points that far from a reference learn nothing from it about their normals.
_REACH = 0.5
_GROUPS = 16  # of points whose nearest neighbours are about equally far
_COMPARED = 65536  # distances at a time, which stay in a core's cache
_SPARE, _CLASH = 16, 256  # rows a multiple of 256 apart push one another out of the cache: spare numbers part them


@dataclass(frozen=True, eq=False)
class OrientedPoints:
    """Samples of a surface: points with unit normals."""

    points: Float[Floats, "P 3"]
    normals: Float[Floats, "P 3"]
    # False if the normals are estimated, as a cloud's are: which side is out is then a guess, wrong for whole regions
    # where points are few and noisy.
    signed: bool = True
    weights: Float[Floats, " P"] | None = None  # how far each point is trusted: 1 fully, 0 not at all

    @property
    def features(self) -> Float[Floats, "P 6"]:
        """Points and normals together, see `with_normals`."""
        return with_normals(self.points, self.normals)

    @cached_property
    def tree(self) -> cKDTree:
        """Over the features."""
        return feature_tree(self.features)

    @cached_property
    def _trees(self) -> dict[float, cKDTree]:
        return {}

    def pair_tree(self, weight: float) -> cKDTree:
        """The same, normals counting so much; built once for a weight."""
        if weight not in self._trees:
            self._trees[weight] = feature_tree(with_normals(self.points, self.normals, weight))
        return self._trees[weight]

    def to_local(self, pose: RigidPose) -> OrientedPoints:
        """The same samples in the local coordinates of a pose."""
        return replace(self, points=pose.to_local(self.points), normals=self.normals @ pose.rotation)

    def in_frame(self, frame: Frame) -> OrientedPoints:
        """The same samples through a frame: moved, turned and scaled; normals turned."""
        return replace(self, points=frame.apply(self.points), normals=self.normals @ frame.rotation.T)

    def first(self, count: int) -> OrientedPoints:
        """The first samples; itself, with its trees, where there are no more."""
        return self if count >= len(self.points) else self.rows(slice(count))

    def thinned(self, P: int) -> OrientedPoints:
        """About P of the samples, evenly taken from their order, which must be random."""
        step = len(self.points) // P
        return self if step <= 1 else self.rows(slice(None, None, step))

    def drawn(self, count: int, rng: np.random.Generator) -> Float[Floats, "N 3"]:
        """Points of at most ``count`` different samples, drawn evenly, or by their weights if they have some."""
        share = None if self.weights is None else self.weights / self.weights.sum()
        available = len(self.points) if share is None else np.count_nonzero(share)
        return self.points[rng.choice(len(self.points), min(count, available), replace=False, p=share)]

    def facing(self, reference: OrientedPoints) -> OrientedPoints:
        """The same samples; normals without a sure sign are turned to agree with those of the nearest reference points."""
        if self.signed:
            return self
        back = nearest_unsigned(reference.tree, self.points, self.normals, _REACH)[2]
        turned = np.where(back[:, None], -self.normals, self.normals)
        return replace(self, normals=turned, signed=True)

    def rows(self, rows: slice | Bool[Bools, " P"] | Int[Ints, " N"]) -> OrientedPoints:
        """Some of the samples."""
        arrays = {field.name: getattr(self, field.name) for field in fields(self)}
        taken: dict[str, Any] = {name: array[rows] for name, array in arrays.items() if isinstance(array, np.ndarray)}
        return replace(self, **taken)


def nearest_unsigned(
    tree: cKDTree, points: Float[Floats, "N 3"], normals: Float[Floats, "N 3"], reach: float
) -> tuple[Float[Floats, " N"], Int[Ints, " N"], Bool[Bools, " N"]]:
    """Distances to the nearest of a tree over features within ``reach`` (infinite if none), which it is (``tree.n``), and
    whether it is nearer with the normal turned: only what is nearer is looked for then, in groups of like distance.
    """
    distance, index = tree.query(with_normals(points, normals), distance_upper_bound=reach)
    back, turned = with_normals(points, -normals), np.zeros(len(points), bool)
    for rows in np.array_split(np.argsort(distance), _GROUPS):
        limit = min(distance[rows].max(initial=0.0), reach)
        found, at = tree.query(back[rows], distance_upper_bound=limit)
        turned[rows] = nearer = found < distance[rows]
        distance[rows[nearer]], index[rows[nearer]] = found[nearer], at[nearer]
    return distance, index, turned


def with_normals(
    points: Float[Floats, "... 3"], normals: Float[Floats, "... 3"], weight: float = NORMAL_WEIGHT
) -> Float[Floats, "... 6"]:
    """Six-dimensional positions in which surfaces back to back are apart."""
    return np.concatenate([points, weight * normals], -1)


def feature_tree(features: Float[Floats, "P D"]) -> cKDTree:
    """A tree for some thousands of queries: halves of the space rather than of the points are built in half the time."""
    return cKDTree(features, leafsize=32, balanced_tree=False)


def quick_tree(points: Float[Floats | Floats32, "P D"]) -> cKDTree:
    """A tree that is asked a few times only, by points far and near: built quickly rather than balanced."""
    return cKDTree(points, leafsize=32, balanced_tree=False, compact_nodes=False)


def nearest(points: Float[Floats | Floats32, "P D"], queries: Float[Floats | Floats32, "Q D"]) -> Int[Ints, " Q"]:
    """Which of a few thousand points at most is nearest to each query, by comparing all with all in float32.

    Faster than a tree, which is slow where queries are far away. Of points whose squared distances differ by less than
    rounding, about a millionth of the largest, any may be taken.
    """
    middle = points.mean(0)  # where numbers are small, they are exact
    points, queries = (np.asarray(each - middle, np.float32) for each in (points, queries))
    P, D = points.shape
    against = np.empty((D + 1, P if P % _CLASH else P + _SPARE), np.float32)
    against[:D, :P], against[D, :P] = -2 * points.T, np.square(points).sum(1)
    against[:D, P:], against[D, P:] = 0.0, np.inf  # nothing is nearest to what is spare
    lifted = np.concatenate([queries, np.ones((len(queries), 1), np.float32)], 1)
    rows = max(1, _COMPARED // P)
    # written again and again, rather than asked of the system
    compared = np.empty((rows, against.shape[1]), np.float32)
    found = np.empty(len(lifted), np.int64)
    for low in range(0, len(lifted), rows):
        some = lifted[low : low + rows]
        found[low : low + rows] = np.matmul(some, against, out=compared[: len(some)]).argmin(1)
    return found
