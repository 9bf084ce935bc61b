"""The image of the source on the target: every source vertex at its matched point, with the source's faces.

The closest point of this image takes a point of the target to the source; doing so for all vertices of the target inverts
a map. Where several parts of the image are near, the search prefers parts with similar normals, high confidence, small
distance, and on the same connected part of the target. Triangles that the map tears apart are excluded.

The search is exact for triangles of any size, which an image needs: a map stretches some triangles, shrinks others, and
leaves vertices without any. `meshmatch.maps.footpoints` lists the other searches.
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
from meshmatch.maps.folds import normals_at, normals_or_zeros
from meshmatch.maps.footpoints import Footpoints, reassign_islands
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.faces import seam_representatives
from meshmatch.shapes.shape import Shape
from meshmatch.threads import parallel_map

# All set by hand; lengths in units of sqrt(area).
# Distance to the image at which confidence is 1/e = 0.37.
_DISTANCE_SCALE = 0.03
# Penalties are lengths that are added to the distance, as squares. For opposite normals:
_OPPOSED_PENALTY = 0.15
# For a part of the image on another connected part of the target: walls of two chambers may touch.
_OTHER_PART_PENALTY = 0.03
# Weight of a distance on the source relative to one on the target, where a nearby point of the source is given.
_SOURCE_WEIGHT = 0.2
# Below this confidence, lower confidence is penalised slightly: by 1.1 % of sqrt(area) at 0, so that of parts that coincide
# the more certain one wins.
_SURE_CONFIDENCE, _DOUBT_PENALTY = 0.5, 0.003
# An edge of the image may be this many times as long as the source's, plus a constant.
_MAX_STRETCH, _STRETCH_OFFSET = 3.0, 0.02
# Covering balls are grouped by size, in classes of up to twice the size of the one before; number of classes.
_CLASSES = 12
# Queries per chunk; number of balls that are tried first, and at most.
_CHUNK, _FIRST_TRIED, _MAX_TRIED = 8192, 12, 512
_MIN_CHUNK = 256  # queries per chunk with several threads
# Rounds in which islands of an inverse are searched again.
_ROUNDS = 2
# Of the source vertices mapped to one target vertex, those with at least this share of the highest confidence count.
_MIN_RELATIVE_CONFIDENCE = 0.5


@dataclass(frozen=True, eq=False)
class MappedFootpoints(Footpoints):
    """Points on the source for N points of the target; distances are to the image, in the unit of the target's file."""

    confidence: Float[Floats, " N"]  # the map's confidence, reduced by the distance to the image


class MappedMesh:
    """The image of the source on the target under a map for these two shapes; see `VertexMap.for_shapes`."""

    @classmethod
    def of(cls, shape: Shape) -> MappedMesh:
        """Make the identity's image, to find closest points on a shape itself."""
        return cls(VertexMap.identity(shape), shape, shape)

    def __init__(self, source_to_target: VertexMap, source: Shape, target: Shape) -> None:
        self.points = source_to_target.points(target)
        self.confidence = source_to_target.assumed_confidence.astype(np.float64)
        self.unit = length_of(target)
        self.normals = normals_at(source_to_target, target)
        self._target, self._index = target, source_to_target.index
        kept = np.flatnonzero(~discontinuous_faces(source_to_target, source, target) & source.valid_faces)
        in_no_face = source.valid
        in_no_face[source.faces[kept].ravel()] = False
        self._source_unit = length_of(source)
        self._source = source.verts / self._source_unit
        loose = np.flatnonzero(in_no_face)
        # Triangles, then the vertices that are in no kept triangle: those of a cloud, or between discontinuities.
        self.corners = np.concatenate([source.faces[kept], np.repeat(loose[:, None], 3, axis=1)])
        self.face = np.concatenate([kept, np.full(len(loose), -1)])
        corner_points = self.points[self.corners]
        self._center = corner_points.mean(axis=1)
        # For balls of each size class: a tree of their centers, the items they cover, their radii, and the largest.
        item, center, radius = covering_balls(corner_points)
        largest = float(radius.max()) or 1.0
        size = np.floor(np.log2(np.maximum(radius / largest, 0.5**_CLASSES)))
        groups = [np.flatnonzero(size == k) for k in np.unique(size)]
        self._trees = [(cKDTree(center[own]), item[own], radius[own], float(radius[own].max())) for own in groups]
        # Gaps between the points of a cloud do not reduce confidence.
        self._gap = self.unit / np.sqrt(len(np.unique(self.points, axis=0))) if source.is_cloud else 0.0

    @cached_property
    def part(self) -> Int[Ints, " V_source"]:
        """The target's connected part (`connected_parts`) that each vertex of the source is mapped to."""
        return connected_parts(self._target)[self._index]

    def query(
        self,
        points: Float[Floats, "N 3"],
        normals: Float[Floats, "N 3"] | None = None,
        workers: int = 1,
        near: Float[Floats, "N 3"] | None = None,
        parts: Int[Ints, " N"] | None = None,
    ) -> MappedFootpoints:
        """Find the points on the source that correspond to points on the target.

        ``points`` are in the target's frame; ``normals`` are the target's unit normals there, zeros where unknown. ``near``
        are approximate points on the source, in its frame, which select one of two sheets that touch. ``parts`` are the
        target's `connected_parts` of the points.
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
        confidence *= np.exp(-np.square(_OPPOSED_PENALTY / _DISTANCE_SCALE * self._opposition(facing, corners)))
        face = self.face[item]
        vertex = corners[np.arange(len(points)), weights.argmax(axis=1)]
        weights[face < 0] = (1.0, 0.0, 0.0)
        return MappedFootpoints(vertex, face, weights, distance, confidence)

    def _search(
        self, points: Floats, normals: Floats, workers: int, near: Floats | None, parts: Ints | None
    ) -> tuple[Ints, Floats]:
        """Best item (triangle or lone vertex) of each point, with barycentric weights.

        Exact unless `_MAX_TRIED` balls of a size class were tried for a point.
        """
        N = len(points)
        best, item, weights = np.full(N, np.inf), np.zeros(N, np.int64), np.zeros((N, 3))

        def attempt(rows: Ints, items: Ints) -> None:
            if not len(rows):
                return
            found, costs = self._costs(points[rows], normals[rows], items)
            if near is not None:
                place = interpolate(self._source, self.corners[items], found)
                costs = costs + (_SOURCE_WEIGHT * self.unit) ** 2 * squared_lengths(place - near[rows])
            if parts is not None:
                elsewhere = (self.part[self.corners[items]] != parts[rows][:, None]).all(axis=1)
                costs = costs + (_OTHER_PART_PENALTY * self.unit) ** 2 * elsewhere
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
                pending, n_done, count = rows, 0, min(_FIRST_TRIED, len(which))
                while len(pending):
                    reach = (np.sqrt(best[pending].max()) + largest) * (1 + 1e-9)
                    found = tree.query(points[pending], count, distance_upper_bound=reach)
                    distance, close = (each.reshape(len(pending), -1) for each in found)
                    row, column = np.nonzero(np.isfinite(distance[:, n_done:]))
                    ball = close[row, column + n_done]
                    lower = np.maximum(distance[row, column + n_done] - radius[ball], 0.0)
                    worth = lower**2 <= best[pending[row]]
                    attempt(pending[row[worth]], which[ball[worth]])
                    if count >= min(len(which), _MAX_TRIED):
                        break
                    pending = pending[np.maximum(distance[:, -1] - largest, 0.0) ** 2 <= best[pending]]
                    n_done, count = count, min(3 * count, len(which), _MAX_TRIED)

        # points near the image first, in common chunks: their searches are shorter
        order = np.argsort(best, kind="stable")
        size = min(_CHUNK, max(_MIN_CHUNK, -(-N // (4 * workers)))) if workers > 1 else _CHUNK
        parallel_map(search, [order[low : low + size] for low in range(0, N, size)], threads=workers)
        return item, weights

    def _costs(self, points: Floats, normals: Floats, items: Ints) -> tuple[Floats, Floats]:
        """Barycentric weights (N, 3) of the closest points on items (N,), and their costs: squared lengths."""
        corners = self.corners[items]
        a, b, c = (self.points[corners[:, k]] for k in range(3))
        weights = closest_on_triangles(points, a, b, c)
        foot = weights[:, :1] * a + weights[:, 1:2] * b + weights[:, 2:] * c
        confidence = np.einsum("nk,nk->n", weights, self.confidence[corners])
        doubt = np.log(_SURE_CONFIDENCE / np.clip(confidence, 1e-6, _SURE_CONFIDENCE))
        opposed = self._opposition(normals, corners)
        squared = squared_lengths(foot - points)
        return weights, squared + self.unit**2 * (_DOUBT_PENALTY**2 * doubt + (_OPPOSED_PENALTY * opposed) ** 2)

    def _opposition(self, normals: Floats, corners: Ints) -> Floats:
        """(N,) 0 where the normal of any corner makes an acute angle with the given one, up to 1 where all are opposite."""
        cosine = np.einsum("nd,nkd->nk", normals, self.normals[corners]).max(axis=1)
        return np.asarray(np.maximum(-cosine, 0.0))


def discontinuous_faces(source_to_target: VertexMap, source: Shape, target: Shape) -> Bool[Bools, " F_source"]:
    """True for faces that the map tears: those with an edge whose image is much longer than the edge.

    Where images are vertices of the target, edges may be longer by the target's edges, as by rounding.
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
    allowed = _MAX_STRETCH * scale * own + rounded[source.faces] + rounded[around] + _STRETCH_OFFSET * length_of(target)
    return np.asarray((image > allowed).any(axis=1))


def _edge_lengths(shape: Shape) -> Floats:
    """(V,) mean length of the edges at each vertex; for a cloud, of the gaps between its points."""
    if shape.is_cloud:
        return np.sqrt(shape.vertex_areas)
    edges = shape.edges.vertices
    return mean_around(edges, np.linalg.norm(shape.verts[edges[:, 0]] - shape.verts[edges[:, 1]], axis=1), shape.V)


def mean_around(corners: Int[NDArray[Any], "N K"], values: Float[Floats, " N"], V: int) -> Float[Floats, " V"]:
    """Mean over the edges, or faces, at each vertex; 0 where there are none."""
    total = np.bincount(corners.T.ravel(), np.tile(values, corners.shape[1]), V)
    return np.asarray(total / np.maximum(np.bincount(corners.ravel(), minlength=V), 1))


@derived
def connected_parts(shape: Shape) -> Int[Ints, " V"]:
    """Label the connected parts of a mesh, per vertex; copies of vertices along seams are connected, -1 without a face."""
    faces = shape.faces[shape.valid_faces]
    part = np.full(shape.V, -1, np.int64)
    if len(faces):
        twin = seam_representatives(shape.verts, faces)
        part[faces] = face_parts(twin[faces], shape.V)[:, None]
    return part


def length_of(shape: Shape) -> float:
    """Characteristic length of a shape: sqrt(area), or the diagonal of a shape without area."""
    return float(np.sqrt(shape.area)) or shape.diagonal or 1.0


def invert_map(source_to_target: VertexMap, source: Shape, target: Shape, workers: int = 1) -> VertexMap:
    """Compute a map from target to source, given one from source to target; `InputError` as `VertexMap.for_shapes`.

    Confidence decreases with the distance to the image of the source, so it is low where the map does not reach. A map of
    unknown confidence is treated as certain.
    """
    checked = source_to_target.for_shapes(source, target)
    identical = bool((checked.index == np.arange(source.V)).all() and (checked.face < 0).all())
    if source.hash == target.hash and target.invalid is None and identical:
        return replace(checked, source=target.name, target=source.name)
    image = MappedMesh(checked, source, target)
    normals, parts = normals_or_zeros(target), connected_parts(target)
    found = image.query(target.verts, normals, workers, parts=parts)
    shared, vertex = _shared_images(checked, source, target.V)
    weights = np.tile([1.0, 0.0, 0.0], (len(shared), 1))
    confidence = checked.assumed_confidence[vertex].astype(np.float64)
    replacements = MappedFootpoints(vertex, np.full(len(shared), -1), weights, found.distance[shared], confidence)
    found = found.updated(shared, replacements)
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
    confidence_to = np.where(target.valid, np.clip(found.confidence, 0.0, 1.0), 0.0)
    rest: dict[str, Any] = {"face": found.face, "barycentric": found.barycentric, "confidence": confidence_to}
    rest |= {"source_up": checked.target_up, "target_up": checked.source_up}
    return VertexMap.between(target, source, found.vertex, verdict=checked.verdict, reasons=checked.reasons, **rest)


def _shared_images(found: VertexMap, source: Shape, V: int) -> tuple[Int[Ints, " N"], Int[Ints, " N"]]:
    """Target vertices to which several source vertices are mapped, and for each the source vertex nearest to their mean."""
    highest = np.zeros(V)
    rows = np.flatnonzero(found.on_vertex)
    at = found.index[rows]
    np.maximum.at(highest, at, found.assumed_confidence[rows])
    trusted = (found.assumed_confidence[rows] >= _MIN_RELATIVE_CONFIDENCE * highest[at]) & source.valid[rows]
    rows, at = rows[trusted], at[trusted]
    count = np.bincount(at, minlength=V)
    sums = np.stack([np.bincount(at, source.verts[rows, k], V) for k in range(3)], axis=1)
    mean = sums / np.maximum(count, 1)[:, None]
    distance = np.linalg.norm(source.verts[rows] - mean[at], axis=1)
    order = np.lexsort((rows, distance, at))
    vertex, first = np.unique(at[order], return_index=True)
    several = count[vertex] > 1
    return vertex[several], rows[order[first[several]]]
