"""From texels of the target's atlas to places on the source."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from meshmatch.arrays import Floats, Ints
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.material_sampler import reach_of
from meshmatch.transfer.surface_walk import Faces, Near, SurfaceWalker, duals

# A triangle is torn if an edge of its image is this many times as long as usual, and a little more (sqrt(area)).
_STRETCH, _SLACK = 3.0, 0.02
# A place this far off, beside the size of its triangle's image, looks for a better one from the other corners.
_FAR = 0.1


class TexelLocator:
    """Where the target's triangles lie on the source, and where each point of their texels does.

    Parameters
    ----------
    walker : SurfaceWalker
        The source.
    target : Shape
    back : VertexMap
        From target to source.
    corners : (F, 3, 2) float64
        The target's triangles in the atlas, counted in texels.

    Attributes
    ----------
    torn : (F,) bool
        Triangles whose corners' images lie far apart. Their texels go on from the nearest corner as the surface
        around it does, and meet in the middle: a cut, where interpolation would smear.
    reach : (F,) float32
        Size of a texel on the source.
    """

    def __init__(self, walker: SurfaceWalker, target: Shape, back: VertexMap, corners: Floats) -> None:
        self.walker = walker
        self._sure = back.confidence.astype(np.float32)
        image, start = images_of(walker, back)
        self._faces, self._verts = target.faces, target.verts
        self._corners = list(np.ascontiguousarray(target.faces.T))
        self._image = image
        held = image[target.faces]
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
        self.torn = np.asarray((length > _STRETCH * scale * own_length + _SLACK).any(axis=1))
        if target.invalid is not None:
            self.torn |= target.invalid[target.faces].any(axis=1)
        if self.torn.any():
            self._slope = _slopes(target, held, ~self.torn)
            bend = np.maximum(self._size, 1e-12)
            self.reach[self.torn] *= (scale * own_length.max(axis=1) / bend).astype(np.float32)[self.torn]
        self._start = list(start[target.faces].T.astype(np.int32, order="C"))
        table = np.concatenate([corners[:, 0], flat, held[:, 0], first, second], axis=1)
        self._table = list(table.T.astype(np.float32, order="C"))

    def locate(self, face: Faces, x: Near, y: Near, start: Faces | None = None) -> tuple[Near, Faces, Near]:
        """Places of points (N,), (N,) of the atlas that belong to triangles (N,) of the target.

        Points outside their triangle are where the surface goes on.

        Returns
        -------
        weights (3, N) in the triangle of the target; face (N,) and weights (3, N) on the source.
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
        corner = np.where(weights[1] > weights[0], np.where(weights[2] > weights[1], 2, 1),
                          np.where(weights[2] > weights[0], 2, 0))  # fmt: skip
        torn = np.flatnonzero(self.torn.take(face))
        if len(torn):
            points[:, torn] = self._gone_on(face[torn], weights[:, torn], corner[torn])
        begin = self._begin(face, corner)
        if start is not None:
            begin = np.where(start >= 0, start, begin)
        place, held, distance = self.walker.closest(points, begin)
        far = np.flatnonzero(distance > _FAR * self._size.take(face))
        for k in (1, 2) if len(far) else ():
            other = self._begin(face[far], (corner[far] + k) % 3)
            there, weigh, gap = self.walker.closest(points[:, far], other)
            better = gap < distance[far]
            rows = far[better]
            place[rows], held[:, rows], distance[rows] = there[better], weigh[:, better], gap[better]
        return weights, place, held

    def _begin(self, face: Faces, corner: Ints) -> Faces:
        """Where the images of the corners lie: faces of the source."""
        start = [column.take(face) for column in self._start]
        return np.where(corner == 0, start[0], np.where(corner == 1, start[1], start[2]))

    def confidence(self, face: Faces, weights: Near) -> Near:
        """(N,) of the map at points (3, N) of triangles (N,)."""
        total, sure = np.zeros(len(face), np.float32), np.zeros(len(face), np.float32)
        for k in range(3):
            held = np.maximum(weights[k], 0)
            total += held
            sure += held * self._sure.take(self._corners[k].take(face))
        return sure / total

    def _gone_on(self, face: Faces, weights: Near, corner: Ints) -> Near:
        """Points (3, N) of torn triangles: from the nearest corner on, as its surroundings do."""
        vertex = self._faces[face, corner]
        corners = self._verts[self._faces[face]]
        away = np.einsum("kn,nkd->nd", weights, corners) - self._verts[vertex]
        points = self._image[vertex] + np.einsum("nij,nj->ni", self._slope[vertex], away)
        return np.asarray(points.T, np.float32)


def images_of(walker: SurfaceWalker, back: VertexMap) -> tuple[Floats, Ints]:
    """(V_tgt, 3) where each vertex of the target lies on the source, and (V_tgt,) a face of the source there."""
    image = walker.verts[back.index]
    inside = np.flatnonzero(back.face >= 0)
    image[inside] = walker.places(back.face[inside], back.barycentric[inside])
    return image, np.where(back.face >= 0, back.face, walker.face_of_vertex(back.index))


def _inverse(corners: Floats) -> Floats:
    """(F, 4) what turns a texel's way from the first corner into the weights of the second (2) and third (2)."""
    one, two = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    determinant = one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]
    share = np.where(determinant == 0, 0.0, 1.0 / np.where(determinant == 0, 1.0, determinant))
    return np.stack([two[:, 1], -two[:, 0], -one[:, 1], one[:, 0]], axis=1) * share[:, None]


def _slopes(target: Shape, image: Floats, sound: NDArray[np.bool_]) -> Floats:
    """(V, 3, 3) how a step on the target becomes a step on the source: the mean of the sound faces around."""
    a, b, c = (target.verts[target.faces[:, k]] for k in range(3))
    first, second = duals(b - a, c - a)
    steps = image[:, 1] - image[:, 0], image[:, 2] - image[:, 0]
    slope = np.einsum("fi,fj->fij", steps[0], first) + np.einsum("fi,fj->fij", steps[1], second)
    weight = np.where(sound, target.face_areas, 0.0)
    corner, many = target.faces.ravel(), np.repeat(weight, 3)
    total = np.bincount(corner, many, target.V)
    out = np.empty((target.V, 9))
    for k in range(9):
        out[:, k] = np.bincount(corner, many * np.repeat(slope.reshape(-1, 9)[:, k], 3), target.V)
    return (out / np.where(total > 0, total, 1.0)[:, None]).reshape(-1, 3, 3)
