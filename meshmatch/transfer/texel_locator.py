"""From texels of the target's atlas to places on the source."""

from __future__ import annotations

import numpy as np

from meshmatch.arrays import Bools, Floats, Floats32, Ints, Ints32
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.material_sampler import reach_of
from meshmatch.transfer.surface_walk import SurfaceWalker, duals

# The map is discontinuous on a triangle if an edge of its image is this many times as long as usual, and a little
# more (sqrt(area)). Set by hand, as in `mapped_mesh`.
_STRETCH, _SLACK = 3.0, 0.02
# A place this far off, in sizes of its triangle's image, is searched again from the other corners. Set by hand.
_FAR = 0.1


class TexelLocator:
    """Where the target's triangles lie on the source, and where each point of their texels does.

    The walker is that of the source, `back` a map from target to source, and corners (F, 3, 2) are those of the
    target's triangles in the atlas, counted in texels. `discontinuous` (F,) are triangles whose corners' images lie far
    apart. Their texels continue the surface around the nearest corner, and meet in the middle: a cut, where
    interpolation would smear. `reach` (F,) is the size of a texel on the source.
    """

    def __init__(self, walker: SurfaceWalker, target: Shape, back: VertexMap, corners: Floats) -> None:
        self.walker = walker
        self._confidence = back.confidence.astype(np.float32)
        self._image, start = images_of(walker, back)
        self._faces, self._verts = target.faces, target.verts
        self._corners = list(np.ascontiguousarray(target.faces.T))
        held = self._image[target.faces]
        first, second = held[:, 1] - held[:, 0], held[:, 2] - held[:, 0]
        flat = _inverse(corners)
        right = flat[:, 0:1] * first + flat[:, 2:3] * second
        down = flat[:, 1:2] * first + flat[:, 3:4] * second
        self.reach = reach_of(right, down).astype(np.float32)
        around = np.roll(held, -1, axis=1)
        length = np.linalg.norm(held - around, axis=2)
        own = target.verts[target.faces]
        own_length = np.linalg.norm(own - np.roll(own, -1, axis=1), axis=2)
        self._size = length.max(axis=1).astype(np.float32)
        scale = float(np.median(length.ravel() / np.maximum(own_length.ravel(), 1e-300)))
        self.discontinuous = np.asarray((length > _STRETCH * scale * own_length + _SLACK).any(axis=1))
        if target.invalid is not None:
            self.discontinuous |= target.invalid[target.faces].any(axis=1)
        if self.discontinuous.any():
            self._jacobian = _jacobians(target, held, ~self.discontinuous)
            bend = (scale * own_length.max(axis=1) / np.maximum(self._size, 1e-12)).astype(np.float32)
            self.reach[self.discontinuous] *= bend[self.discontinuous]
        self._start = list(start[target.faces].T.astype(np.int32, order="C"))
        table = np.concatenate([corners[:, 0], flat, held[:, 0], first, second], axis=1)
        self._table = list(table.T.astype(np.float32, order="C"))

    def locate(
        self, face: Ints32, x: Floats32, y: Floats32, start: Ints32 | None = None
    ) -> tuple[Floats32, Ints32, Floats32]:
        """Places of points (N,), (N,) of the atlas that belong to triangles (N,) of the target: weights (3, N) in the
        triangle; face (N,) and weights (3, N) on the source. Points outside their triangle continue its plane.
        """
        column = [values.take(face) for values in self._table]
        right, down = x - column[0], y - column[1]
        weights = np.empty((3, len(face)), np.float32)
        weights[1] = column[2] * right + column[3] * down
        weights[2] = column[4] * right + column[5] * down
        weights[0] = 1 - weights[1] - weights[2]
        wild = np.flatnonzero(np.minimum(np.minimum(weights[0], weights[1]), weights[2]) < -1)
        if len(wild):  # slivers: one texel aside is many triangles aside
            held = np.clip(weights[:, wild], 0, 1)
            weights[:, wild] = held / held.sum(axis=0)
        points = np.empty((3, len(face)), np.float32)
        for k in range(3):
            points[k] = column[6 + k] + weights[1] * column[9 + k] + weights[2] * column[12 + k]
        corner = np.where(weights[2] > np.maximum(weights[0], weights[1]), 2, weights[1] > weights[0])
        cut = np.flatnonzero(self.discontinuous.take(face))
        if len(cut):
            points[:, cut] = self._continued(face[cut], weights[:, cut], corner[cut])
        begin = self._begin(face, corner)
        begin = begin if start is None else np.where(start >= 0, start, begin)
        place, held, distance = self.walker.closest(points, begin)
        far = np.flatnonzero(distance > _FAR * self._size.take(face))
        for k in (1, 2) if len(far) else ():
            other = self._begin(face[far], (corner[far] + k) % 3)
            there, weigh, gap = self.walker.closest(points[:, far], other)
            better = gap < distance[far]
            rows = far[better]
            place[rows], held[:, rows], distance[rows] = there[better], weigh[:, better], gap[better]
        return weights, place, held

    def _begin(self, face: Ints32, corner: Ints) -> Ints32:
        """Where the images of the corners lie: faces of the source."""
        start = [column.take(face) for column in self._start]
        return np.where(corner == 0, start[0], np.where(corner == 1, start[1], start[2]))

    def confidence(self, face: Ints32, weights: Floats32) -> Floats32:
        """(N,) of the map at points (3, N) of triangles (N,)."""
        total, sure = np.zeros(len(face), np.float32), np.zeros(len(face), np.float32)
        for k in range(3):
            held = np.maximum(weights[k], 0)
            total += held
            sure += held * self._confidence.take(self._corners[k].take(face))
        return sure / total

    def _continued(self, face: Ints32, weights: Floats32, corner: Ints) -> Floats32:
        """Points (3, N) of discontinuous triangles: the surface around the nearest corner, continued."""
        vertex = self._faces[face, corner]
        corners = self._verts[self._faces[face]]
        away = np.einsum("kn,nkd->nd", weights, corners) - self._verts[vertex]
        points = self._image[vertex] + np.einsum("nij,nj->ni", self._jacobian[vertex], away)
        return np.asarray(points.T, np.float32)


def images_of(walker: SurfaceWalker, back: VertexMap) -> tuple[Floats, Ints]:
    """(V_target, 3) where each vertex of the target lies on the source, and (V_target,) a face of the source there."""
    image = walker.verts[back.index]
    inside = np.flatnonzero(back.face >= 0)
    image[inside] = walker.places(back.face[inside], back.barycentric[inside])
    return image, np.where(back.face >= 0, back.face, walker.face_of_vertex(back.index))


def _inverse(corners: Floats) -> Floats:
    """(F, 4) the linear map from an offset (2,) from the first corner, in texels, to the weights of the second and third."""
    one, two = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    determinant = one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]
    share = np.where(determinant == 0, 0.0, 1.0 / np.where(determinant == 0, 1.0, determinant))
    return np.stack([two[:, 1], -two[:, 0], -one[:, 1], one[:, 0]], axis=1) * share[:, None]


def _jacobians(target: Shape, image: Floats, continuous: Bools) -> Floats:
    """(V, 3, 3) the Jacobian of the map at each vertex: the area-weighted mean of the continuous faces around."""
    a, b, c = (target.verts[target.faces[:, k]] for k in range(3))
    first, second = duals(b - a, c - a)
    steps = image[:, 1] - image[:, 0], image[:, 2] - image[:, 0]
    jacobian = np.einsum("fi,fj->fij", steps[0], first) + np.einsum("fi,fj->fij", steps[1], second)
    weight = np.where(continuous, target.face_areas, 0.0)
    corner, many = target.faces.ravel(), np.repeat(weight, 3)
    total = np.bincount(corner, many, target.V)
    out = np.empty((target.V, 9))
    for k in range(9):
        out[:, k] = np.bincount(corner, many * np.repeat(jacobian.reshape(-1, 9)[:, k], 3), target.V)
    return (out / np.where(total > 0, total, 1.0)[:, None]).reshape(-1, 3, 3)
