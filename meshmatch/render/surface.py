"""Triangles as the picture needs them: vertices, smooth normals, and paint.

View coordinates: x to the right, y up, z towards the viewer, lengths of about 1. Colors are linear.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.geometry.topology import same_rows
from meshmatch.geometry.triangles import vertex_normals

AnyFloats = NDArray[np.floating[Any]]


class Paint(Protocol):
    """What gives a triangle its color at each of its points."""

    def at(self, faces: Int[Ints, " N"], weights: Float[AnyFloats, "N 3"], footprint: float) -> Float[AnyFloats, "N C"]:
        """Colors, three or four columns, at points of triangles given by barycentric weights; a fourth value below a
        half is a hole.

        ``footprint`` is the size of a pixel in view coordinates: finer detail is averaged.
        """
        ...


@dataclass(frozen=True, eq=False)
class VertexPaint:
    """Colors of the vertices of triangles.

    ``sharp``: each point has the color of the corner nearest to it, for labels; otherwise colors are interpolated.
    """

    colors: Float[AnyFloats, "V 3"]
    faces: Int[Ints, "F 3"]
    sharp: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "colors", np.asarray(self.colors, np.float32))

    def at(self, faces: Int[Ints, " N"], weights: Float[AnyFloats, "N 3"], footprint: float) -> Float[AnyFloats, "N C"]:
        corners = self.faces[faces]
        if self.sharp:
            return self.colors[np.take_along_axis(corners, weights.argmax(axis=1)[:, None], axis=1)[:, 0]]
        return np.asarray(np.einsum("nk,nkc->nc", weights, self.colors[corners]))


@dataclass(frozen=True, eq=False)
class FacePaint:
    """One color per triangle."""

    colors: Float[AnyFloats, "F 3"]

    def __post_init__(self) -> None:
        object.__setattr__(self, "colors", np.asarray(self.colors, np.float32))

    def at(self, faces: Int[Ints, " N"], weights: Float[AnyFloats, "N 3"], footprint: float) -> Float[AnyFloats, "N C"]:
        return self.colors[faces]


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles in view coordinates with their paint.

    Parameters
    ----------
    normals
        Unit, or zero where the triangle's own is to be used.
    paint
        Called with indices of these faces.
    loose
        How far triangles that belong to one surface may lie above each other, as the discs of a cloud do; their
        normals are then used as they are.
    """

    verts: Float[AnyFloats, "V 3"]
    faces: Int[Ints, "F 3"]
    normals: Float[AnyFloats, "V 3"]
    paint: Paint
    loose: float = 0.0

    @cached_property
    def extent(self) -> Float[AnyFloats, "2 3"]:
        """Lowest and highest corner of all triangles."""
        used = np.zeros(len(self.verts), bool)
        used[self.faces] = True
        drawn = self.verts[used]
        return np.stack([drawn.min(axis=0), drawn.max(axis=0)])

    def moved(self, shift: Float[Floats, " 3"]) -> Surface:
        """The surface translated by ``shift``."""
        return replace(self, verts=self.verts + shift)


@dataclass(frozen=True, eq=False)
class SomeFaces:
    """The paint of a mesh of which only some triangles are drawn."""

    paint: Paint
    chosen: Int[Ints, " N"]

    def at(self, faces: Int[Ints, " N"], weights: Float[AnyFloats, "N 3"], footprint: float) -> Float[AnyFloats, "N C"]:
        return self.paint.at(self.chosen[faces], weights, footprint)


def mesh_surface(
    verts: Float[AnyFloats, "V 3"], faces: Int[Ints, "F 3"], paint: Paint, chosen: Int[Ints, " N"] | None = None
) -> Surface:
    """A mesh, or the ``chosen`` of its triangles; normals are smooth, also across the duplicate vertices of texture
    seams and stl files.
    """
    if chosen is not None:
        faces, paint = faces[chosen], SomeFaces(paint, chosen)
    twin = same_rows(np.asarray(verts, np.float64))
    normals = vertex_normals(verts, twin[faces])[twin]
    return Surface(verts, faces, normals, paint)


def balls(centers: Float[AnyFloats, "K 3"], radius: float, colors: Float[AnyFloats, "K 3"]) -> Surface:
    """A ball around every center in its color; the fewer, the finer."""
    verts, faces = _ball(4 if len(centers) <= 60 else 3 if len(centers) <= 1_000 else 2 if len(centers) <= 5_000 else 1)
    count = len(centers)
    return Surface(
        (centers[:, None] + radius * verts).reshape(-1, 3),
        (faces + len(verts) * np.arange(count)[:, None, None]).reshape(-1, 3),
        np.tile(verts, (count, 1)),
        FacePaint(np.repeat(colors, len(faces), axis=0)),
    )


def discs(
    centers: Float[AnyFloats, "K 3"],
    normals: Float[AnyFloats, "K 3"],
    radius: Float[AnyFloats, " K"],
    colors: Float[AnyFloats, "K 3"],
) -> Surface:
    """A flat octagon for every center, perpendicular to its normal, with its radius."""
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


def _ball(subdivisions: int) -> tuple[Float[Floats, "V 3"], Int[Ints, "F 3"]]:
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
