"""Better truths than the one that comes with SHREC'19.

That truth is a template (SMPL) registered to every shape: landmark k is vertex k of it. On some shapes more is known:

- *identity*: shapes whose arrays of triangles are the same (each triangle may be wound either way). Their makers mean
  vertex i of one by vertex i of the other, be it one person's poses or another person registered with the same mesh.
- *own order*: the shape that is the template itself. Its vertex k is landmark k.
- *consensus*: where three or more shapes have the same triangles, the landmarks of all can be put on each of them.
  The mean of what the others say of landmark k has less of the registrations' noise than the shape's own landmark.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from itertools import pairwise
from typing import Literal

import numpy as np
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.experiments.runner import spread
from meshmatch.experiments.sets import BenchSet, Pair
from meshmatch.maps.geodesics import GeodesicDistances
from meshmatch.shapes.shape import Shape

Kind = Literal["identity", "own order", "consensus", "own order and consensus", "the set's own"]
_OWN_ORDER = 0.1  # share of landmarks that hit the vertex of their own number; by chance one would
_NEAR = 0.12  # sqrt(area), 17 cm: Dijkstra ends there first, and goes on for the few points that lie beyond
_ROWS = 256


def same_triangles(a: Int[Ints, "F 3"], b: Int[Ints, "F2 3"]) -> float:
    """Share (0..1) of the triangles that are wound alike, where two arrays have the same triangles row by row, else 0."""
    if a.shape != b.shape or not np.array_equal(np.sort(a, axis=1), np.sort(b, axis=1)):
        return 0.0
    turned = [np.roll(b, turn, axis=1) for turn in range(3)]
    return float(np.any([(a == each).all(axis=1) for each in turned], axis=0).mean())


class NearDistances:
    """Distances along one shape between pairs of vertices that are mostly close: those of `GeodesicDistances`.

    A truth and what is measured against it are a few centimetres apart, and nobody needs the distances to all others.
    """

    def __init__(self, shape: Shape) -> None:
        self.whole = GeodesicDistances(shape)

    def between(self, a: Int[Ints, " N"], b: Int[Ints, " N"]) -> Float[Floats, " N"]:
        """Distances between vertices ``a[n]`` and ``b[n]``, in units of sqrt(area)."""
        found = np.zeros(len(a))
        starts, row = np.unique(a, return_inverse=True)
        order = np.argsort(row, kind="stable")
        bounds = np.searchsorted(row[order], np.arange(0, len(starts) + _ROWS, _ROWS))
        for first, (low, high) in zip(range(0, len(starts), _ROWS), pairwise(bounds.tolist()), strict=True):
            mine = order[low:high]
            limit = _NEAR * self.whole.unit
            rows = dijkstra(self.whole.graph, indices=starts[first : first + _ROWS], limit=limit)
            found[mine] = rows[row[mine] - first, b[mine]] / self.whole.unit
        if len(far := np.flatnonzero(~np.isfinite(found))):
            found[far] = self.whole.between(a[far], b[far])
        return found

    def among(self, ids: Int[Ints, " M"], most: float) -> Float[Floats, "M M"]:
        """Distances between all of some vertices, in units of sqrt(area); infinite beyond ``most``."""
        reach = most * self.whole.unit
        starts, row = np.unique(ids, return_inverse=True)
        blocks = [
            dijkstra(self.whole.graph, indices=starts[first : first + _ROWS], limit=reach)[:, ids]
            for first in range(0, len(starts), _ROWS)
        ]
        return np.asarray(np.concatenate(blocks)[row] / self.whole.unit)


@dataclass(frozen=True)
class Truths:
    """What is known of a set beyond its own landmarks; of so many of them, evenly spread, or of all."""

    bench: BenchSet
    marks: int | None = None

    def chosen(self, count: int) -> Int[Ints, " N"]:
        """Numbers of the landmarks that are looked at, of so many."""
        return np.array(spread(range(count), self.marks))

    def landmarks(self, name: str) -> Int[Ints, " N"]:
        """Vertices of these landmarks on one shape, as the set has them."""
        every = self.bench.landmarks(name)
        return every[self.chosen(len(every))]

    @cached_property
    def _distances(self) -> dict[str, NearDistances]:
        return {}

    def distances(self, name: str) -> NearDistances:
        """Distances along one of the shapes; its graph is built once."""
        if name not in self._distances:
            self._distances[name] = NearDistances(self.bench.shape(name))
        return self._distances[name]

    @cached_property
    def groups(self) -> list[list[str]]:
        """Names of shapes with the same triangles and as many vertices, in groups of at least two."""
        found: list[list[str]] = []
        for name in self.bench.shapes:
            shape = self.bench.shape(name)
            for group in found:
                first = self.bench.shape(group[0])
                if first.V == shape.V and same_triangles(first.faces, shape.faces):
                    group.append(name)
                    break
            else:
                found.append([name])
        return [group for group in found if len(group) > 1]

    @cached_property
    def templates(self) -> list[str]:
        """Names of shapes whose vertex k is landmark k: as many vertices as landmarks, and not by chance."""
        found = []
        for name in self.bench.shapes:
            landmarks = self.bench.landmarks(name)
            numbers = np.arange(len(landmarks))
            if self.bench.shape(name).V == len(numbers) and (landmarks == numbers).mean() > _OWN_ORDER:
                found.append(name)
        return found

    def wound_alike(self, pair: Pair) -> float:
        """Share (0..1) of the triangles of two shapes of a group that are wound alike."""
        a, b = (self.bench.shape(name).faces for name in pair)
        return same_triangles(a, b)

    def group_of(self, name: str) -> list[str]:
        """The group of a shape; itself alone where it has none."""
        return next((group for group in self.groups if name in group), [name])

    def known(self, name: str) -> tuple[Int[Ints, " N"], Kind]:
        """The best known vertex of every landmark on one shape, and how it is known."""
        if name in self.templates:
            return self.chosen(len(self.bench.landmarks(name))), "own order"
        if len(self.group_of(name)) > 2:
            return consensus(self, name), "consensus"
        return self.landmarks(name), "the set's own"

    def of_pair(self, pair: Pair) -> tuple[Int[Ints, " N"], Int[Ints, " N"], Kind]:
        """For every landmark the vertex of the source and the one it belongs to on the target, and how this is known."""
        source, target = pair
        if target in self.group_of(source):
            landmarks = self.landmarks(source)
            return landmarks, landmarks, "identity"
        (here, how), (there, how_there) = self.known(source), self.known(target)
        kinds = {how, how_there} - {"the set's own"}
        kind: Kind = "the set's own" if not kinds else how if how in kinds else how_there
        return here, there, "own order and consensus" if len(kinds) > 1 else kind


def consensus_points(truths: Truths, name: str) -> Float[Floats, "N 3"]:
    """Means of the points that the landmarks of the other shapes of a group have on this one."""
    others = [other for other in truths.group_of(name) if other != name]
    verts = truths.bench.shape(name).verts
    return np.asarray(np.mean([verts[truths.landmarks(other)] for other in others], axis=0))


@cache
def consensus(truths: Truths, name: str) -> Int[Ints, " N"]:
    """The vertices nearest to `consensus_points`."""
    points = consensus_points(truths, name)
    return np.asarray(cKDTree(truths.bench.shape(name).verts).query(points)[1], dtype=np.int64)
