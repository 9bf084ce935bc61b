"""Closest points on a surface among those that face the same way.

For many queries that lie near the surface, such as the vertices of a shape around a fitted template: the nearest vertex
in a space of positions and normals, then the closest of its triangles. It is fast and knows the resting template, but
not exact for triangles that are large compared with the distance. `meshmatch.transfer.mapped_mesh` is exact for
triangles of any size; `meshmatch.transfer.surface_walk` starts from a known face and never changes to another sheet.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from typing import Self

import numpy as np
from scipy.spatial import cKDTree

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.geometry.triangles import blend, closest_on_triangles, interpolate, squared_lengths
from meshmatch.maps.vertex_map import corners_of

# By how much a neighbour whose normal points the other way (2 units) is further away than it is, in units of
# sqrt(area): enough to separate the sides of a thin wall. A larger weight would move points along the surface to where
# it bends the same way. Set by hand.
NORMAL_WEIGHT = 0.02
# How much a distance on the resting template counts compared with one in space. Set by hand.
RESTING_WEIGHT = 0.4
# Queries at a time: what belongs to them then stays in the processor's cache.
_CHUNK = 8192


@dataclass(frozen=True, eq=False)
class Footpoints:
    """Closest points on a surface to N queries, and how far they are, in the unit of the surface.

    `vertex` is the corner with the largest weight, or the one that the search began with. `face` is -1 where the point
    is the vertex itself (always for a cloud); its corners' weights are then (1, 0, 0).
    """

    vertex: Int[Ints, " N"]
    face: Int[Ints, " N"]
    barycentric: Float[Floats, "N 3"]
    distance: Float[Floats, " N"]

    def values(self, faces: Int[Ints, "F 3"], values: Float[Floats, "V D"]) -> Float[Floats, "N D"]:
        """Values of the surface's vertices, interpolated at the points."""
        return interpolate(values, corners_of(faces, self.face, self.vertex), self.barycentric)

    def updated(self, rows: Int[Ints, " M"], other: Self) -> Self:
        """These points with M rows taken from `other`."""
        arrays = {field.name: getattr(self, field.name).copy() for field in fields(self)}
        for name, array in arrays.items():
            array[rows] = getattr(other, name)
        return replace(self, **arrays)


class Surface:
    """A mesh (or cloud) arranged for many closest-point queries; lengths in units of sqrt(area).

    `normals` are of unit length, zeros where unknown. `resting` is where each vertex belongs on the resting template:
    queries with such a place of their own find the right one of two sheets that touch, such as a hand on a thigh.
    """

    def __init__(
        self,
        verts: Float[Floats, "V 3"],
        faces: Int[Ints, "F 3"],
        normals: Float[Floats, "V 3"],
        resting: Float[Floats, "V 3"] | None = None,
    ) -> None:
        self.verts, self.faces = verts, faces
        # the faces at every vertex, one vertex after the other
        self._around = np.argsort(faces.reshape(-1), kind="stable") // 3
        self._start = np.concatenate([[0], np.cumsum(np.bincount(faces.reshape(-1), minlength=len(verts)))])
        self._used = np.flatnonzero(np.diff(self._start)) if len(faces) else np.arange(len(verts))
        self._tree = cKDTree(_features(verts, normals, resting)[self._used])

    def query(
        self,
        points: Float[Floats, "N 3"],
        normals: Float[Floats, "N 3"],
        workers: int = 1,
        resting: Float[Floats, "N 3"] | None = None,
    ) -> Footpoints:
        """Closest points to points with unit normals (zeros where unknown); ``resting`` if the surface has it."""
        N = len(points)
        vertex = np.empty(N, np.int64)
        face = np.full(N, -1, np.int64)
        weights = np.zeros((N, 3))
        distance = np.empty(N)

        def answer(low: int) -> None:
            part = slice(low, min(low + _CHUNK, N))
            features = _features(points[part], normals[part], None if resting is None else resting[part])
            vertex[part] = self._used[self._tree.query(features)[1]]
            if len(self.faces):
                face[part], weights[part], distance[part] = self._on_faces(points[part], vertex[part])
            else:
                distance[part] = np.linalg.norm(points[part] - self.verts[vertex[part]], axis=1)

        with ThreadPoolExecutor(workers) as pool:
            list(pool.map(answer, range(0, N, _CHUNK)))
        if not len(self.faces):
            weights[:, 0] = 1.0
        return Footpoints(vertex, face, weights, distance)

    def _on_faces(self, points: Floats, vertex: Ints) -> tuple[Ints, Floats, Floats]:
        """The closest of the faces around each vertex (N,), its weights (N, 3) and the distance (N,)."""
        counts = self._start[vertex + 1] - self._start[vertex]
        first = np.cumsum(counts) - counts
        within = np.arange(counts.sum()) - np.repeat(first, counts)
        face = self._around[np.repeat(self._start[vertex], counts) + within]
        corners = self.verts[self.faces[face]]  # N 3 3
        asked = np.repeat(points, counts, axis=0)
        weights = closest_on_triangles(asked, corners[:, 0], corners[:, 1], corners[:, 2])
        squared = squared_lengths(blend(corners, weights) - asked)
        # The first of the nearest of each query's faces.
        nearest = np.flatnonzero(squared == np.repeat(np.minimum.reduceat(squared, first), counts))
        best = nearest[np.searchsorted(nearest, first)]
        return face[best], weights[best], np.sqrt(squared[best])


def _features(points: Floats, normals: Floats, resting: Floats | None) -> Floats:
    parts = [points, NORMAL_WEIGHT * normals]
    return np.concatenate(parts if resting is None else [*parts, RESTING_WEIGHT * resting], 1)
