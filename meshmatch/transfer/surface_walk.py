"""Closest points on the source's surface, by walking over it.

A search begins at a known face and moves from face to face over shared edges. Unlike a search in a tree, it never jumps to
another sheet that merely passes nearby, and neighbouring points end at neighbouring places.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from meshmatch.arrays import Bools, Floats, Floats32, Ints, Ints32
from meshmatch.geometry.trees import cKDTree
from meshmatch.geometry.triangles import blend, closest_on_triangles, same_rows, squared_lengths, triangle_areas
from meshmatch.maps.mapped_mesh import length_of
from meshmatch.shapes.shape import Shape

_MIN_WEIGHT = np.float32(-1e-5)
_MAX_STEPS, _MAX_STEPS_AGAIN = 32, 12


class SurfaceWalker:
    """A mesh prepared for walks; `verts` are relative to `center` and in units of `unit`."""

    def __init__(self, shape: Shape) -> None:
        self.center = shape.bounds.mean(axis=0)
        self.unit = length_of(shape)
        self.verts = (shape.verts - self.center) / self.unit
        self.faces = shape.faces
        self.welded = same_rows(shape.verts)[shape.faces]  # welded by position: seams do not separate
        self.opposite, self.opposite_edge = _face_neighbours(shape.faces, self.welded)
        corners = self.verts[shape.faces]
        self.areas = triangle_areas(self.verts, shape.faces)
        first, second = duals(corners)
        self._degenerate = (first == 0).all(axis=1) & (second == 0).all(axis=1)
        self._table = list(np.concatenate([corners[:, 0], first, second], axis=1).T.astype(np.float32, order="C"))
        self._opposite = list(np.ascontiguousarray(self.opposite.T))
        self.face_of_vertex = np.full(shape.V, -1, np.int64)  # some face at each vertex; -1 if there is none
        self.face_of_vertex[shape.faces[::-1].ravel()] = np.repeat(np.arange(shape.F - 1, -1, -1), 3)
        self._unusable = self._degenerate | ~shape.valid_faces
        self._tree: cKDTree | None = None

    def closest(self, points: Floats32, face: Ints32) -> tuple[Ints32, Floats32, Floats32]:
        """The closest places on the surface that walks from faces (N,) towards points (3, N) reach.

        Walks from face -1 start at the face with the nearest center. Returns faces (N,), weights (3, N), and distances
        (N,), which are 0 for all points whose projection lies inside its face.
        """
        unknown = np.flatnonzero(face < 0)
        if len(unknown):
            face = face.copy()
            face[unknown] = self._nearest_center(points[:, unknown])
        face, weights, outside, unfinished = self._walk(points, face, _MAX_STEPS)
        if self._degenerate.any():  # a walk cannot cross a face without area
            unfinished = np.union1d(unfinished, np.flatnonzero(self._degenerate[face]))
        if len(unfinished):  # a long or circular walk: start again near its end
            rest = points[:, unfinished]
            again = self._walk(rest, self._nearest_center(rest), _MAX_STEPS_AGAIN)
            face[unfinished], weights[:, unfinished], out, _ = again
            outside = np.concatenate([np.setdiff1d(outside, unfinished), unfinished[out]])
        distance = np.zeros(len(face), np.float32)
        if len(outside):
            corners = self.verts[self.faces[face[outside]]]
            queries = points[:, outside].T.astype(np.float64)
            inside = closest_on_triangles(queries, *corners.swapaxes(0, 1))
            foot = blend(corners, inside)
            weights[:, outside] = inside.T
            distance[outside] = np.sqrt(squared_lengths(foot - queries))
        np.maximum(weights, 0, out=weights)
        weights /= weights[0] + weights[1] + weights[2]
        return face, weights, distance

    def cut(self, edges: Bools) -> None:
        """Forbid walks over these edges (F, 3), each given by the opposite corner."""
        self.opposite[edges] = -1
        self._opposite = list(np.ascontiguousarray(self.opposite.T))

    def reach(self, points: Floats32, face: Ints32) -> tuple[Ints32, Floats32]:
        """Faces (N,) where walks from faces (N,) towards points (3, N) end, and weights (N, 3), which extrapolate the plane
        of a face beyond an edge that cannot be crossed.
        """
        face, weights, _, _ = self._walk(points, face, _MAX_STEPS)
        return face, np.ascontiguousarray(weights.T)

    def _walk(self, points: Floats32, face: Ints32, steps: int) -> tuple[Ints32, Floats32, Ints, Ints]:
        """Face and weights where each walk ended; the walks that ended at an edge; those that did not end.

        Computed column by column: reductions over three numbers are fifty times slower in NumPy.
        """
        N = len(face)
        face = face.copy()
        weights = np.empty((3, N), np.float32)
        active, previous = np.arange(N), np.full(N, -1, np.int32)
        at, current = points, face
        ended: list[Ints] = []
        for step in range(steps):
            offset = [at[k] - self._table[k].take(current) for k in range(3)]
            second = weighted_sum(offset, [column.take(current) for column in self._table[3:6]])
            third = weighted_sum(offset, [column.take(current) for column in self._table[6:9]])
            held = [1 - second - third, second, third]
            here = np.s_[:] if step == 0 else active
            for k in range(3):
                weights[k, here] = held[k]
            face[here] = current
            go = np.flatnonzero(np.minimum(np.minimum(held[0], second), third) < _MIN_WEIGHT)
            if not len(go):
                return face, weights, np.concatenate([active[:0], *ended]), active[:0]
            current, previous = current[go], previous[go]
            least = np.full(len(go), _MIN_WEIGHT)
            onward = np.full(len(go), -1, np.int32)
            for k in range(3):
                over, weight = self._opposite[k].take(current), held[k][go]
                better = (weight < least) & (over >= 0) & (over != previous)
                least = np.where(better, weight, least)
                onward = np.where(better, over, onward)
            on = onward >= 0
            ended.append(active[go[~on]])
            go, previous, current = go[on], current[on], onward[on]
            active, at = active[go], at[:, go]
        return face, weights, np.concatenate([*ended, active]), active

    def _nearest_center(self, points: Floats32) -> Ints32:
        if self._tree is None:
            centers = self.verts[self.faces].mean(axis=1)
            centers[self._unusable] = 1e6
            self._tree = cKDTree(centers)
        return np.asarray(self._tree.query(points.T)[1], np.int32)


class PointWalker(SurfaceWalker):
    """The same interface for a point cloud: each point with its two nearest neighbours acts as a face, walks are
    nearest-point searches, and weights fall with the squared distance.
    """

    def __init__(self, shape: Shape) -> None:
        valid = np.flatnonzero(shape.valid)
        near = cKDTree(shape.verts[valid]).query(shape.verts, min(3, len(valid)))[1].reshape(shape.V, -1)
        faces = np.concatenate([valid[near], valid[near[:, -1:]].repeat(3 - near.shape[1], axis=1)], axis=1)
        super().__init__(Shape(shape.verts, faces, shape.name, invalid=shape.invalid))
        self.unit = length_of(shape)
        self.verts = (shape.verts - self.center) / self.unit
        self.areas = shape.vertex_areas / self.unit**2
        self.face_of_vertex = np.arange(shape.V)
        self._valid, self._points = valid, cKDTree(self.verts[valid])

    def closest(self, points: Floats32, face: Ints32) -> tuple[Ints32, Floats32, Floats32]:
        """The nearest points, whatever the start; see `SurfaceWalker.closest`."""
        place = self._valid[self._points.query(points.T)[1]].astype(np.int32)
        away = self.verts[self.faces[place]] - points.T[:, None]
        near = 1.0 / np.maximum(np.einsum("nkd,nkd->kn", away, away), 1e-18)
        return place, (near / near.sum(axis=0)).astype(np.float32), np.zeros(len(place), np.float32)


def weighted_sum(a: list[Floats32] | Floats32, b: list[Floats32]) -> Floats32:
    """(N,) sum of the products of three pairs of columns."""
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


def duals(corners: Floats) -> tuple[Floats, Floats]:
    """Dual vectors (F, 3) of the edges at the first corner of triangles (F, 3, 3): their products with a point relative to
    that corner are the weights of the second and third corner. Zeros for a triangle without area.
    """
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    a, b, c = squared_lengths(first), np.einsum("ni,ni->n", first, second), squared_lengths(second)
    determinant = a * c - b * b
    flat = determinant <= 1e-14 * a * c
    share = np.where(flat, 0.0, 1.0 / np.where(flat, 1.0, determinant))[:, None]
    return share * (c[:, None] * first - b[:, None] * second), share * (a[:, None] * second - b[:, None] * first)


def _face_neighbours(faces: Ints, welded: Ints) -> tuple[Ints32, NDArray[np.int8]]:
    """The face across each edge (F, 3), -1 for none, and the number of the edge there; edge k is opposite to corner k.

    Edges are matched by vertices first, then by positions; edges of more than two faces cannot be crossed.
    """
    F = len(faces)
    opposite = np.full(3 * F, -1, np.int64)
    for corners in (faces, welded):
        start, end = corners[:, [1, 2, 0]].ravel(), corners[:, [2, 0, 1]].ravel()
        free = np.flatnonzero((opposite < 0) & (start != end))
        stride = int(corners.max()) + 1 if F else 1
        key = np.minimum(start, end)[free] * stride + np.maximum(start, end)[free]
        order = np.argsort(key, kind="stable")
        ordered = key[order]
        first = np.flatnonzero(np.diff(ordered, prepend=-1))
        two = first[np.diff(np.append(first, len(ordered))) == 2]
        a, b = free[order[two]], free[order[two + 1]]
        opposite[a], opposite[b] = b, a
    face, edge = np.divmod(opposite, 3)
    face[opposite < 0] = -1
    return face.reshape(F, 3).astype(np.int32), edge.reshape(F, 3).astype(np.int8)
