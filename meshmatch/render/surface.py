"""Triangles as the picture needs them: places, smooth normals, and paint.

View coordinates everywhere in this room: x to the right, y up, z towards the viewer, lengths of about 1.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from meshmatch.geometry.topology import same_rows
from meshmatch.geometry.triangles import vertex_normals

FloatArray = NDArray[np.floating[Any]]
IntArray = NDArray[np.int64]


class Paint(Protocol):
    """What gives a triangle its colour at each of its points."""

    def at(self, faces: IntArray, weights: FloatArray, footprint: float) -> FloatArray:
        """Linear colours (N, 3) at points of triangles (N,) with weights (N, 3) of their corners; or (N, 4), where
        the last below a half is a hole.

        ``footprint`` is the size of a pixel in view coordinates: what is finer than that is averaged.
        """
        ...


@dataclass(frozen=True, eq=False)
class VertexPaint:
    """Linear colours (V, 3) of the vertices of triangles (F, 3).

    ``sharp``: each point has the colour of the corner nearest to it, for labels; otherwise colours are mixed.
    """

    colors: FloatArray
    faces: IntArray
    sharp: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "colors", np.asarray(self.colors, np.float32))

    def at(self, faces: IntArray, weights: FloatArray, footprint: float) -> FloatArray:
        corners = self.faces[faces]
        if self.sharp:
            return self.colors[np.take_along_axis(corners, weights.argmax(axis=1)[:, None], axis=1)[:, 0]]
        return np.asarray(np.einsum("nk,nkc->nc", weights, self.colors[corners]))


@dataclass(frozen=True, eq=False)
class FacePaint:
    """One linear colour for each triangle (F, 3)."""

    colors: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "colors", np.asarray(self.colors, np.float32))

    def at(self, faces: IntArray, weights: FloatArray, footprint: float) -> FloatArray:
        return self.colors[faces]


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles in view coordinates with their paint.

    Parameters
    ----------
    verts : (V, 3)
    faces : (F, 3) int64
    normals : (V, 3)
        Unit, or zero where the triangle's own is to be used.
    paint
        Asked with numbers of these faces.
    loose : float
        How far triangles that belong to one surface may lie above each other, as the discs of a cloud do; their
        normals are then taken as they are.
    """

    verts: FloatArray
    faces: IntArray
    normals: FloatArray
    paint: Paint
    loose: float = 0.0

    @cached_property
    def extent(self) -> FloatArray:
        """(2, 3) lowest and highest corner of all triangles."""
        used = np.zeros(len(self.verts), bool)
        used[self.faces] = True
        drawn = self.verts[used]
        return np.stack([drawn.min(axis=0), drawn.max(axis=0)])

    def moved(self, shift: FloatArray) -> Surface:
        """The same elsewhere."""
        return replace(self, verts=self.verts + shift)


@dataclass(frozen=True, eq=False)
class SomeFaces:
    """The paint of a mesh of which only some triangles, ``chosen`` (N,), are drawn."""

    paint: Paint
    chosen: IntArray

    def at(self, faces: IntArray, weights: FloatArray, footprint: float) -> FloatArray:
        return self.paint.at(self.chosen[faces], weights, footprint)


def mesh_surface(verts: FloatArray, faces: IntArray, paint: Paint, chosen: IntArray | None = None) -> Surface:
    """A mesh, or the ``chosen`` of its triangles; normals are smooth, also across the double vertices of texture
    seams and stl files.
    """
    if chosen is not None:
        faces, paint = faces[chosen], SomeFaces(paint, chosen)
    twin = same_rows(np.asarray(verts, np.float64))
    normals = vertex_normals(verts, twin[faces])[twin]
    return Surface(verts, faces, normals, paint)


def balls(centers: FloatArray, radius: float, colors: FloatArray) -> Surface:
    """A ball for every center (K, 3) in its linear colour (K, 3), round enough for its number."""
    verts, faces = _ball(
        4 if len(centers) <= 60 else 3 if len(centers) <= 1_000 else 2 if len(centers) <= 5_000 else 1
    )
    return _copies(verts, faces, verts, centers, radius, colors)


def discs(centers: FloatArray, normals: FloatArray, radius: FloatArray, colors: FloatArray) -> Surface:
    """A flat disc of eight sides for every center (K, 3), across its normal (K, 3), with its radius (K,)."""
    turn = 2 * np.pi * np.arange(8) / 8
    side = np.where(np.abs(normals[:, :1]) < 0.8, [[1.0, 0, 0]], [[0, 1.0, 0]])
    first = np.cross(normals, side)
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-30)
    second = np.cross(normals, first)
    around = np.cos(turn)[:, None] * first[:, None] + np.sin(turn)[:, None] * second[:, None]
    rim = centers[:, None] + radius[:, None, None] * around
    fan = np.array([[0, k, k + 1] for k in range(1, 7)])
    count = len(centers)
    faces = (fan + 8 * np.arange(count)[:, None, None]).reshape(-1, 3)
    paint = FacePaint(np.repeat(colors, len(fan), axis=0))
    loose = 0.6 * float(np.median(radius))
    return Surface(rim.reshape(-1, 3), faces, np.repeat(normals, 8, axis=0), paint, loose)


def _copies(
    verts: FloatArray,
    faces: IntArray,
    normals: FloatArray,
    centers: FloatArray,
    radius: float,
    colors: FloatArray,
) -> Surface:
    count = len(centers)
    return Surface(
        (centers[:, None] + radius * verts).reshape(-1, 3),
        (faces + len(verts) * np.arange(count)[:, None, None]).reshape(-1, 3),
        np.tile(normals, (count, 1)),
        FacePaint(np.repeat(colors, len(faces), axis=0)),
    )


def _ball(subdivisions: int) -> tuple[FloatArray, IntArray]:
    verts = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=float)
    faces = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])
    for _ in range(subdivisions):
        corners = verts[faces]
        middles = (corners + np.roll(corners, -1, axis=1)) / 2
        a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
        ab, bc, ca = middles[:, 0], middles[:, 1], middles[:, 2]
        soup = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], axis=1).reshape(-1, 3)
        verts, inverse = np.unique(soup.round(12), axis=0, return_inverse=True)
        faces = inverse.reshape(-1, 3)
        verts = verts / np.linalg.norm(verts, axis=1, keepdims=True)
    return verts, faces.astype(np.int64)
