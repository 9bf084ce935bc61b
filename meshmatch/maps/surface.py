"""Closest points on a surface among those that face the same way."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from meshmatch.geometry.triangles import blend, closest_on_triangles, squared_lengths

# How far a normal that points the other way (2 units) pushes a neighbour away, in units of sqrt(area): enough to tell
# the sides of a thin wall. More would drag points along the surface to where it bends the same way.
NORMAL_WEIGHT = 0.02
# How much a distance on the resting template counts beside one in space.
RESTING_WEIGHT = 0.4
# Queries at a time: what belongs to them then stays in the processor's cache.
_CHUNK = 8192


@dataclass(frozen=True, eq=False)
class Footpoints:
    """Closest points of N queries: vertex (N,), face (N,) or -1, barycentric (N, 3), distance (N,)."""

    vertex: NDArray[np.int64]
    face: NDArray[np.int64]
    barycentric: NDArray[np.float64]
    distance: NDArray[np.float64]


class Surface:
    """A mesh (or cloud) arranged for many closest-point queries; lengths in units of sqrt(area).

    Parameters
    ----------
    verts : (V, 3)
    faces : (F, 3), F = 0 for a cloud
    normals : (V, 3) unit normals, zeros where unknown
    resting : (V, 3), optional
        Where on the resting template each vertex belongs. Queries that know the same then find the right one of
        two sheets that touch, such as a hand on a thigh.
    """

    def __init__(
        self, verts: np.ndarray, faces: np.ndarray, normals: np.ndarray, resting: np.ndarray | None = None
    ) -> None:
        self.verts, self.faces = verts, faces
        self._start, self._around = _faces_around(faces, len(verts))
        self._used = np.flatnonzero(np.diff(self._start)) if len(faces) else np.arange(len(verts))
        self._tree = cKDTree(_features(verts, normals, resting)[self._used])

    def query(
        self, points: np.ndarray, normals: np.ndarray, workers: int = 1, resting: np.ndarray | None = None
    ) -> Footpoints:
        """Closest points to (N, 3) points with normals (N, 3); ``resting`` (N, 3) if the surface has it."""
        N = len(points)
        vertex = np.empty(N, np.int64)
        face = np.full(N, -1, np.int64)
        weights = np.zeros((N, 3))
        distance = np.empty(N)

        def answer(low: int) -> None:
            part = slice(low, min(low + _CHUNK, N))
            sought = _features(points[part], normals[part], None if resting is None else resting[part])
            vertex[part] = self._used[self._tree.query(sought)[1]]
            if len(self.faces):
                face[part], weights[part], distance[part] = self._on_faces(points[part], vertex[part])
            else:
                distance[part] = np.linalg.norm(points[part] - self.verts[vertex[part]], axis=1)

        with ThreadPoolExecutor(workers) as pool:
            list(pool.map(answer, range(0, N, _CHUNK)))
        if not len(self.faces):
            weights[:, 0] = 1.0
        return Footpoints(vertex, face, weights, distance)

    def _on_faces(self, points: np.ndarray, vertex: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
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


def _features(points: np.ndarray, normals: np.ndarray, resting: np.ndarray | None) -> np.ndarray:
    parts = [points, NORMAL_WEIGHT * normals]
    return np.concatenate(parts if resting is None else [*parts, RESTING_WEIGHT * resting], 1)


def _faces_around(faces: np.ndarray, V: int) -> tuple[np.ndarray, np.ndarray]:
    """Faces at every vertex in compressed rows: start (V + 1,), face (3 F,)."""
    corner = faces.reshape(-1)
    order = np.argsort(corner, kind="stable")
    start = np.concatenate([[0], np.cumsum(np.bincount(corner, minlength=V))])
    return start, order // 3
