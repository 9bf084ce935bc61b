"""The source as it lies on the target: every source vertex at its matched point, with the source's own faces.

A point of the target finds its place on the source as the closest point of that image. Where several parts of
the image pass by, the most trustworthy wins: facing the same way, confidently mapped, near, and never a triangle
that the map has torn apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from meshmatch.arrays import Floats, Ints
from meshmatch.geometry.topology import edges_of
from meshmatch.geometry.triangles import closest_on_triangles, interpolate, squared_lengths
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.shape import Shape

# Distance to the image (units of sqrt(area)) at which confidence has fallen to about 0.37, as in maps.
SCALE = 0.03
# How far a part of the image that faces the other way is pushed off, in units of sqrt(area).
_FACING = 0.15
# How much a distance on the source counts beside one on the target, where it is known where a place should be.
_NEAR = 0.2
# Above this confidence the map is simply believed, and the closest point wins. A guess is pushed off, by little:
# by 1.2 % of sqrt(area) where the map knows nothing, so that of parts that lie on one another the sure one wins.
_BELIEVED, _DOUBT = 0.5, 0.003
# An edge of the image may be this many times as long as the source's, and a little more (units of sqrt(area)).
_STRETCH, _SLACK = 3.0, 0.02
# Triangles are searched by size, each class up to twice as large as the one before, and at most so many classes.
_CLASSES = 12
# Queries at a time; how many triangles are tried first, and at most.
_CHUNK, _FIRST, _MOST = 8192, 12, 512


@dataclass(frozen=True, eq=False)
class MappedFootpoints:
    """Where N points of the target lie on the source.

    Parameters
    ----------
    vertex : (N,) int64
        The source vertex nearest in weight.
    face : (N,) int64
        Source face; -1 where only the vertex is known (always for a cloud).
    barycentric : (N, 3) float64
        Weights of the face's corners; (1, 0, 0) where the face is -1.
    confidence : (N,) float64
        That of the map there, falling with the distance to the image.
    distance : (N,) float64
        Distance to the image, units of the target's file.
    """

    vertex: Ints
    face: Ints
    barycentric: Floats
    confidence: Floats
    distance: Floats


class MappedMesh:
    """The source laid on the target by a map from source to target.

    Parameters
    ----------
    source_to_target : VertexMap
        Made for these two shapes; see `VertexMap.for_shapes`.
    """

    def __init__(self, source_to_target: VertexMap, source: Shape, target: Shape) -> None:
        self.points = source_to_target.points(target)
        self.confidence = source_to_target.confidence.astype(np.float64)
        self.unit = float(np.sqrt(target.area)) or target.diagonal or 1.0
        self.normals = _normals_at(source_to_target, target)
        kept = np.flatnonzero(~discontinuous_faces(source_to_target, source, target, self.points, self.unit))
        lone = np.ones(source.V, bool)
        if source.invalid is not None:  # their places are stand-ins
            kept = kept[~source.invalid[source.faces[kept]].any(axis=1)]
            lone &= ~source.invalid
        lone[source.faces[kept].ravel()] = False
        self._source_unit = float(np.sqrt(source.area)) or source.diagonal or 1.0
        self._source = source.verts / self._source_unit
        single = np.flatnonzero(lone)
        # Triangles, then the points that no triangle holds: those of a cloud, or between tears.
        self.corners = np.concatenate([source.faces[kept], np.repeat(single[:, None], 3, axis=1)])
        self.face = np.concatenate([kept, np.full(len(single), -1)])
        held = self.points[self.corners]
        self._center = held.mean(axis=1)
        self._radius = np.sqrt(((held - self._center[:, None]) ** 2).sum(axis=2).max(axis=1))
        self._trees = self._by_size()
        # A cloud has gaps between its points, which are no reason for doubt.
        distinct = len(np.unique(self.points, axis=0)) if source.is_cloud else 1
        self._gap = self.unit / np.sqrt(distinct) if source.is_cloud else 0.0

    def _by_size(self) -> list[tuple[cKDTree, Ints, float]]:
        """For triangles of each size: a tree of their centers, their numbers, and the largest radius."""
        largest = float(self._radius.max()) or 1.0
        size = np.floor(np.log2(np.maximum(self._radius / largest, 0.5**_CLASSES)))
        groups = [np.flatnonzero(size == k) for k in np.unique(size)]
        return [(cKDTree(self._center[own]), own, float(self._radius[own].max())) for own in groups]

    def query(
        self,
        points: Floats,
        normals: Floats | None = None,
        workers: int = 1,
        near: Floats | None = None,
    ) -> MappedFootpoints:
        """Points on the source of (N, 3) points on the target, in its file's frame.

        Parameters
        ----------
        normals : (N, 3), optional
            Unit normals of the target there; zeros where unknown.
        near : (N, 3), optional
            Points of the source, in its file's frame, near which the places should be. They tell the right one
            of two sheets that touch.
        """
        points = np.asarray(points, np.float64)
        N = len(points)
        facing = np.zeros((N, 3)) if normals is None else np.asarray(normals, np.float64)
        about = None if near is None else np.asarray(near, np.float64) / self._source_unit
        item, weights, _ = self._search(points, facing, workers, about)
        corners = self.corners[item]
        foot = interpolate(self.points, corners, weights)
        distance = np.sqrt(squared_lengths(foot - points))
        beyond = np.maximum(distance - self._gap, 0.0)
        confidence = np.einsum("nk,nk->n", weights, self.confidence[corners])
        confidence = np.clip(confidence, 0, 1) * np.exp(-np.square(beyond / (SCALE * self.unit)))
        against = self._against(facing, corners)
        confidence *= np.exp(-np.square(_FACING / SCALE * against))
        face = self.face[item]
        vertex = corners[np.arange(N), weights.argmax(axis=1)]
        weights[face < 0] = (1.0, 0.0, 0.0)
        return MappedFootpoints(vertex, face, weights, confidence, distance)

    def _search(
        self, points: Floats, normals: Floats, workers: int, near: Floats | None = None
    ) -> tuple[Ints, Floats, Floats]:
        """The best item of each point, the weights of its corners, and its cost.

        Centres come nearest first, so that a search ends where no further item can be better. That is exact
        until `_MOST` items of a size have been tried for a point.
        """
        N = len(points)
        best, item, weights = np.full(N, np.inf), np.zeros(N, np.int64), np.zeros((N, 3))

        def attempt(rows: Ints, items: Ints) -> None:
            if not len(rows):
                return
            found, costs = self._costs(points[rows], normals[rows], items)
            if near is not None:
                place = interpolate(self._source, self.corners[items], found)
                costs = costs + (_NEAR * self.unit) ** 2 * squared_lengths(place - near[rows])
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
        easy = np.argsort(best, kind="stable")  # those near the image together: their searches reach less far
        for low in range(0, N, _CHUNK):
            for tree, which, largest in self._trees:
                rows, done, ask = easy[low : low + _CHUNK], 0, min(_FIRST, len(which))
                while len(rows):
                    reach = np.sqrt(best[rows].max()) + largest
                    distance, close = tree.query(
                        points[rows], ask, distance_upper_bound=reach * (1 + 1e-9), workers=workers
                    )
                    distance, close = distance.reshape(len(rows), -1), close.reshape(len(rows), -1)
                    row, column = np.nonzero(np.isfinite(distance[:, done:]))
                    items = which[close[row, column + done]]
                    lower = np.maximum(distance[row, column + done] - self._radius[items], 0.0)
                    worth = lower**2 <= best[rows[row]]
                    attempt(rows[row[worth]], items[worth])
                    if ask >= min(len(which), _MOST):
                        break
                    rows = rows[np.maximum(distance[:, -1] - largest, 0.0) ** 2 <= best[rows]]
                    done, ask = ask, min(3 * ask, len(which), _MOST)
        return item, weights, best

    def _costs(self, points: Floats, normals: Floats, items: Ints) -> tuple[Floats, Floats]:
        """Weights (N, 3) of the closest points of items (N,), and what they cost: squared lengths."""
        corners = self.corners[items]
        a, b, c = (self.points[corners[:, k]] for k in range(3))
        weights = closest_on_triangles(points, a, b, c)
        foot = weights[:, :1] * a + weights[:, 1:2] * b + weights[:, 2:] * c
        sure = np.einsum("nk,nk->n", weights, self.confidence[corners])
        doubt = np.log(_BELIEVED / np.clip(sure, 1e-6, _BELIEVED))
        against = self._against(normals, corners)
        squared = squared_lengths(foot - points)
        return weights, squared + self.unit**2 * (_DOUBT**2 * doubt + (_FACING * against) ** 2)

    def _against(self, normals: Floats, corners: Ints) -> Floats:
        """(N,) 0 where one of three corners faces into one half of space with a normal, up to 1 where all of
        them face the opposite way. At a sharp edge their mean may face anywhere.
        """
        cosine = np.einsum("nd,nkd->nk", normals, self.normals[corners]).max(axis=1)
        return np.maximum(-cosine, 0.0)


def discontinuous_faces(
    source_to_target: VertexMap, source: Shape, target: Shape, points: Floats, unit: float
) -> NDArray[np.bool_]:
    """(F_src,) True for a face whose image `points` (V_src, 3) is far longer than the face itself.

    A map that names vertices alone moves each point by up to an edge of the target, which is allowed for.
    """
    if source.is_cloud:
        return np.zeros(0, bool)
    around = source.faces[:, [1, 2, 0]]
    own = np.linalg.norm(source.verts[source.faces] - source.verts[around], axis=2)
    image = np.linalg.norm(points[source.faces] - points[around], axis=2)
    usual = image <= np.quantile(image, 0.95)
    whole = float(own[usual].sum())
    scale = float(image[usual].sum()) / whole if whole > 0 else 0.0
    rounded = np.where(source_to_target.on_vertex, _edge_lengths(target)[source_to_target.index], 0.0)
    allowed = _STRETCH * scale * own + rounded[source.faces] + rounded[around] + _SLACK * unit
    return np.asarray((image > allowed).any(axis=1))


def _edge_lengths(shape: Shape) -> Floats:
    """(V,) mean length of the edges at each vertex; of a cloud, of the gaps between its points."""
    if shape.is_cloud:
        return np.sqrt(shape.vertex_areas)
    edges = edges_of(shape.faces).vertices
    length = np.linalg.norm(shape.verts[edges[:, 0]] - shape.verts[edges[:, 1]], axis=1)
    ends = edges.T.ravel()
    total = np.bincount(ends, np.tile(length, 2), shape.V)
    return total / np.maximum(np.bincount(ends, minlength=shape.V), 1)


def _normals_at(found: VertexMap, target: Shape) -> Floats:
    """(V_src, 3) the target's normals at the matched points; zeros on a cloud, whose signs are unsure."""
    if target.is_cloud:
        return np.zeros((found.source_vertices, 3))
    normals = target.vertex_normals[found.index]
    inside = found.face >= 0
    corners = target.faces[found.face[inside]]
    normals[inside] = interpolate(target.vertex_normals, corners, found.barycentric[inside])
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
