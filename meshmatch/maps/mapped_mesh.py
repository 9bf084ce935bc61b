"""The source as it lies on the target: every source vertex at its matched point, with the source's own faces.

A point of the target finds its place on the source as the closest point of that image; those of all its vertices are
the inverse of a map. Where several parts of the image pass by, the most trustworthy wins: facing the same way, mapped
with confidence, near, on the same connected part of the target, and never a triangle that the map has pulled apart.

The search is exact for triangles of any size, which an image needs: a map stretches some and shrinks others, and
leaves vertices without a triangle. `meshmatch.maps.footpoints` says how other searches differ.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints
from meshmatch.derived import derived
from meshmatch.geometry.trees import cKDTree
from meshmatch.geometry.triangles import closest_on_triangles, covering_balls, face_parts, interpolate, squared_lengths
from meshmatch.maps.folds import known_normals, normals_at
from meshmatch.maps.footpoints import Footpoints, reassign_islands
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.faces import seams
from meshmatch.shapes.shape import Shape
from meshmatch.threads import parallel_map

# All set by hand; lengths in units of sqrt(area).
# Distance to the image at which confidence is 1/e = 0.37, as in maps.
_DISTANCE_SCALE = 0.03
# By how much a part of the image that faces the other way is further away than it is.
_FACING = 0.15
# By how much a part of the image that lies on another connected part of the target is further away than it is: walls of
# two chambers may touch.
_ELSEWHERE = 0.03
# How much a distance on the source counts compared with one on the target, where a nearby point of the source is given.
_NEAR = 0.2
# Above this confidence the closest point wins. A less certain part of the image counts as further away, by little: by
# 1.2 % of sqrt(area) where the map knows nothing, so that of parts that lie on one another the certain one wins.
_TRUSTED, _UNCERTAIN = 0.5, 0.003
# An edge of the image may be this many times as long as the source's, and a little more.
_STRETCH, _SLACK = 3.0, 0.02
# Balls are searched by size, each class up to twice as large as the one before, and at most so many classes.
_CLASSES = 12
# Queries at a time; how many balls are tried first, and at most.
_CHUNK, _FIRST, _MAX_TRIED = 8192, 12, 512
_LEAST = 256  # queries of one of several threads
# Rounds in which islands of an inverse are searched again.
_ROUNDS = 2
# Of the source vertices that meet on a target vertex, those with this share of the highest confidence count.
_MEETING = 0.5


@dataclass(frozen=True, eq=False)
class MappedFootpoints(Footpoints):
    """Where N points of the target lie on the source; distances are to the image, in the unit of the target's file."""

    confidence: Float[Floats, " N"]  # that of the map there, falling with the distance to the image


class MappedMesh:
    """The source laid on the target by a map that was made for these two shapes; see `VertexMap.for_shapes`."""

    @classmethod
    def of(cls, shape: Shape) -> MappedMesh:
        """A shape as it is, to find the closest points of its surface."""
        return cls(VertexMap.identity(shape), shape, shape)

    def __init__(self, source_to_target: VertexMap, source: Shape, target: Shape) -> None:
        self.points = source_to_target.points(target)
        self.confidence = source_to_target.assumed_confidence.astype(np.float64)
        self.unit = length_of(target)
        self.normals = normals_at(source_to_target, target)
        self._target, self._index = target, source_to_target.index
        kept = np.flatnonzero(~discontinuous_faces(source_to_target, source, target) & source.valid_faces)
        lone = source.valid
        lone[source.faces[kept].ravel()] = False
        self._source_unit = length_of(source)
        self._source = source.verts / self._source_unit
        single = np.flatnonzero(lone)
        # Triangles, then the points that no triangle holds: those of a cloud, or between discontinuities.
        self.corners = np.concatenate([source.faces[kept], np.repeat(single[:, None], 3, axis=1)])
        self.face = np.concatenate([kept, np.full(len(single), -1)])
        held = self.points[self.corners]
        self._center = held.mean(axis=1)
        # For balls of each size: a tree of their centers, which triangles they cover, their radii, and the largest.
        item, center, radius = covering_balls(held)
        largest = float(radius.max()) or 1.0
        size = np.floor(np.log2(np.maximum(radius / largest, 0.5**_CLASSES)))
        groups = [np.flatnonzero(size == k) for k in np.unique(size)]
        self._trees = [(cKDTree(center[own]), item[own], radius[own], float(radius[own].max())) for own in groups]
        # A cloud has gaps between its points, which are no reason for low confidence.
        self._gap = self.unit / np.sqrt(len(np.unique(self.points, axis=0))) if source.is_cloud else 0.0

    @cached_property
    def part(self) -> Int[Ints, " V_source"]:
        """Which of the target's `connected_parts` the vertices of the source are on."""
        return connected_parts(self._target)[self._index]

    def query(
        self,
        points: Float[Floats, "N 3"],
        normals: Float[Floats, "N 3"] | None = None,
        workers: int = 1,
        near: Float[Floats, "N 3"] | None = None,
        parts: Int[Ints, " N"] | None = None,
    ) -> MappedFootpoints:
        """Points on the source of points on the target, in its file's frame, where it has these unit normals (zeros
        where unknown). `near` are points of the source, in its file's frame, which select one of two sheets that touch;
        ``parts`` are the `connected_parts` of the target that the points are on.
        """
        points = np.asarray(points, np.float64)
        facing = np.zeros((len(points), 3)) if normals is None else normals
        near = None if near is None else near / self._source_unit
        parts = None if parts is None or (self.part == self.part[0]).all() else parts
        item, weights = self._search(points, facing, workers, near, parts)
        corners = self.corners[item]
        distance = np.sqrt(squared_lengths(interpolate(self.points, corners, weights) - points))
        beyond = np.maximum(distance - self._gap, 0.0)
        confidence = np.einsum("nk,nk->n", weights, self.confidence[corners])
        confidence = np.clip(confidence, 0, 1) * np.exp(-np.square(beyond / (_DISTANCE_SCALE * self.unit)))
        confidence *= np.exp(-np.square(_FACING / _DISTANCE_SCALE * self._opposed(facing, corners)))
        face = self.face[item]
        vertex = corners[np.arange(len(points)), weights.argmax(axis=1)]
        weights[face < 0] = (1.0, 0.0, 0.0)
        return MappedFootpoints(vertex, face, weights, distance, confidence)

    def _search(
        self, points: Floats, normals: Floats, workers: int, near: Floats | None, parts: Ints | None
    ) -> tuple[Ints, Floats]:
        """The best triangle or lone vertex of each point, with weights: exact until `_MAX_TRIED` of a size were tried."""
        N = len(points)
        best, item, weights = np.full(N, np.inf), np.zeros(N, np.int64), np.zeros((N, 3))

        def attempt(rows: Ints, items: Ints) -> None:
            if not len(rows):
                return
            found, costs = self._costs(points[rows], normals[rows], items)
            if near is not None:
                place = interpolate(self._source, self.corners[items], found)
                costs = costs + (_NEAR * self.unit) ** 2 * squared_lengths(place - near[rows])
            if parts is not None:
                elsewhere = (self.part[self.corners[items]] != parts[rows][:, None]).all(axis=1)
                costs = costs + (_ELSEWHERE * self.unit) ** 2 * elsewhere
            order = np.lexsort((items, costs, rows))
            first = order[np.flatnonzero(np.diff(rows[order], prepend=-1))]
            row = rows[first]
            better = (costs[first] < best[row]) | ((costs[first] == best[row]) & (items[first] < item[row]))
            first, row = first[better], row[better]
            best[row], item[row], weights[row] = costs[first], items[first], found[first]

        nearest = cKDTree(self._center).query(points, workers=workers)[1]
        for low in range(0, N, _CHUNK):
            some = np.arange(low, min(low + _CHUNK, N))
            attempt(some, nearest[some])

        def search(rows: Ints) -> None:
            for tree, which, radius, largest in self._trees:
                asking, done, ask = rows, 0, min(_FIRST, len(which))
                while len(asking):
                    reach = (np.sqrt(best[asking].max()) + largest) * (1 + 1e-9)
                    found = tree.query(points[asking], ask, distance_upper_bound=reach)
                    distance, close = (each.reshape(len(asking), -1) for each in found)
                    row, column = np.nonzero(np.isfinite(distance[:, done:]))
                    ball = close[row, column + done]
                    lower = np.maximum(distance[row, column + done] - radius[ball], 0.0)
                    worth = lower**2 <= best[asking[row]]
                    attempt(asking[row[worth]], which[ball[worth]])
                    if ask >= min(len(which), _MAX_TRIED):
                        break
                    asking = asking[np.maximum(distance[:, -1] - largest, 0.0) ** 2 <= best[asking]]
                    done, ask = ask, min(3 * ask, len(which), _MAX_TRIED)

        easy = np.argsort(best, kind="stable")  # those near the image together: their searches reach less far
        size = min(_CHUNK, max(_LEAST, -(-N // (4 * workers)))) if workers > 1 else _CHUNK
        parallel_map(search, [easy[low : low + size] for low in range(0, N, size)], threads=workers)
        return item, weights

    def _costs(self, points: Floats, normals: Floats, items: Ints) -> tuple[Floats, Floats]:
        """Weights (N, 3) of the closest points of items (N,), and what they cost: squared lengths."""
        corners = self.corners[items]
        a, b, c = (self.points[corners[:, k]] for k in range(3))
        weights = closest_on_triangles(points, a, b, c)
        foot = weights[:, :1] * a + weights[:, 1:2] * b + weights[:, 2:] * c
        confidence = np.einsum("nk,nk->n", weights, self.confidence[corners])
        doubt = np.log(_TRUSTED / np.clip(confidence, 1e-6, _TRUSTED))
        opposed = self._opposed(normals, corners)
        squared = squared_lengths(foot - points)
        return weights, squared + self.unit**2 * (_UNCERTAIN**2 * doubt + (_FACING * opposed) ** 2)

    def _opposed(self, normals: Floats, corners: Ints) -> Floats:
        """(N,) 0 where one of three corners faces into one half of space with a normal, up to 1 where all face away."""
        cosine = np.einsum("nd,nkd->nk", normals, self.normals[corners]).max(axis=1)
        return np.asarray(np.maximum(-cosine, 0.0))


def discontinuous_faces(source_to_target: VertexMap, source: Shape, target: Shape) -> Bool[Bools, " F_source"]:
    """True for a face whose image on the target is far longer than the face itself, and than the edges of a target to
    whose vertices the map was rounded.
    """
    if source.is_cloud:
        return np.zeros(0, bool)
    points = source_to_target.points(target)
    around = source.faces[:, [1, 2, 0]]
    own = np.linalg.norm(source.verts[source.faces] - source.verts[around], axis=2)
    image = np.linalg.norm(points[source.faces] - points[around], axis=2)
    usual = image <= np.quantile(image, 0.95)
    total = float(own[usual].sum())
    scale = float(image[usual].sum()) / total if total > 0 else 0.0
    rounded = np.where(source_to_target.on_vertex, _edge_lengths(target)[source_to_target.index], 0.0)
    allowed = _STRETCH * scale * own + rounded[source.faces] + rounded[around] + _SLACK * length_of(target)
    return np.asarray((image > allowed).any(axis=1))


def _edge_lengths(shape: Shape) -> Floats:
    """(V,) mean length of the edges at each vertex; of a cloud, of the gaps between its points."""
    if shape.is_cloud:
        return np.sqrt(shape.vertex_areas)
    edges = shape.edges.vertices
    return mean_around(edges, np.linalg.norm(shape.verts[edges[:, 0]] - shape.verts[edges[:, 1]], axis=1), shape.V)


def mean_around(corners: Int[NDArray[Any], "N K"], values: Float[Floats, " N"], V: int) -> Float[Floats, " V"]:
    """Mean of the values of the edges, or faces, at each vertex; 0 where there is none."""
    total = np.bincount(corners.T.ravel(), np.tile(values, corners.shape[1]), V)
    return np.asarray(total / np.maximum(np.bincount(corners.ravel(), minlength=V), 1))


@derived
def connected_parts(shape: Shape) -> Int[Ints, " V"]:
    """The number of the connected part that each vertex of a mesh is in, copies along the seams of a file being one;
    -1 without a face.
    """
    faces = shape.faces[shape.valid_faces]
    part = np.full(shape.V, -1, np.int64)
    if len(faces):
        twin = seams(shape.verts, faces)
        part[faces] = face_parts(twin[faces], shape.V)[:, None]
    return part


def length_of(shape: Shape) -> float:
    """The length that others are compared with: sqrt(area), or the diagonal of a shape without area."""
    return float(np.sqrt(shape.area)) or shape.diagonal or 1.0


def invert_map(source_to_target: VertexMap, source: Shape, target: Shape, workers: int = 1) -> VertexMap:
    """A map from target to source, from one from source to target; `InputError` as `VertexMap.for_shapes`. Its
    confidence falls with the distance to the image: it is low where nothing of the source was mapped to, and that is
    all it says where the confidence of the map is not known.
    """
    checked = source_to_target.for_shapes(source, target)
    identical = bool((checked.index == np.arange(source.V)).all() and (checked.face < 0).all())
    if source.hash == target.hash and target.invalid is None and identical:
        return replace(checked, source=target.name, target=source.name)
    image = MappedMesh(checked, source, target)
    normals, parts = known_normals(target), connected_parts(target)
    found = image.query(target.verts, normals, workers, parts=parts)
    several, vertex = _meeting_vertices(checked, source, target.V)
    weights = np.tile([1.0, 0.0, 0.0], (len(several), 1))
    confidence = checked.assumed_confidence[vertex].astype(np.float64)
    met = MappedFootpoints(vertex, np.full(len(several), -1), weights, found.distance[several], confidence)
    found = found.updated(several, met)
    if not target.is_cloud:
        length, source_length = (float(np.sqrt(shape.area)) or 1.0 for shape in (target, source))
        found, _ = reassign_islands(
            target.verts / length,
            target.edges.vertices,
            target.vertex_areas,
            found,
            lambda places: places.values(source.faces, source.verts) / source_length,
            lambda rows, near: image.query(
                target.verts[rows], normals[rows], workers, near * source_length, parts[rows]
            ),
            _ROUNDS,
        )
    sure = np.where(target.valid, np.clip(found.confidence, 0.0, 1.0), 0.0)
    rest: dict[str, Any] = {"face": found.face, "barycentric": found.barycentric, "confidence": sure}
    rest |= {"source_up": checked.target_up, "target_up": checked.source_up}
    return VertexMap.between(target, source, found.vertex, verdict=checked.verdict, reasons=checked.reasons, **rest)


def _meeting_vertices(found: VertexMap, source: Shape, V: int) -> tuple[Int[Ints, " N"], Int[Ints, " N"]]:
    """Target vertices on which several source vertices meet, and of these the one nearest to their mean."""
    highest = np.zeros(V)
    rows = np.flatnonzero(found.on_vertex)
    at = found.index[rows]
    np.maximum.at(highest, at, found.assumed_confidence[rows])
    trusted = (found.assumed_confidence[rows] >= _MEETING * highest[at]) & source.valid[rows]
    rows, at = rows[trusted], at[trusted]
    count = np.bincount(at, minlength=V)
    sums = np.stack([np.bincount(at, source.verts[rows, k], V) for k in range(3)], axis=1)
    mean = sums / np.maximum(count, 1)[:, None]
    distance = np.linalg.norm(source.verts[rows] - mean[at], axis=1)
    order = np.lexsort((rows, distance, at))
    vertex, first = np.unique(at[order], return_index=True)
    several = count[vertex] > 1
    return vertex[several], rows[order[first[several]]]
