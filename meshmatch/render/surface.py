"""Triangle surfaces for rendering: vertices, smooth normals, and paint (color by face and barycentric weights).

View coordinates: x to the right, y up, z towards the viewer, lengths of about 1. Colors are linear.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshmatch.arrays import Bool, Bools, Float, Floats, Floats32, Int, Ints
from meshmatch.geometry.triangles import same_rows, vertex_normals
from meshmatch.shapes.appearance import Appearance, Material
from meshmatch.shapes.colors import INVISIBLE
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.texels import build_pyramids

AnyFloats = NDArray[np.floating[Any]]
Rows = Int[Ints, " N"]
Weights = Float[AnyFloats, "N 3"]
Places = Float[AnyFloats, "K 3"]
Paint = Callable[[Rows, Weights, float], Float[AnyFloats, "N C"]]
"""Gives triangles their color: called with faces (N,), barycentric weights (N, 3) and the size of a pixel in view
coordinates, below which detail is averaged; returns three or four columns. A fourth column below 0.5 is a hole.
"""


def corners_of(faces: Int[Ints, "F 3"]) -> Rows:
    """Sorted indices of the vertices that any face uses."""
    return np.flatnonzero(np.bincount(faces.ravel()))


@dataclass(frozen=True, eq=False)
class VertexPaint:
    """Vertex colors, interpolated in triangles; ``sharp``: each point has the color of its nearest corner, for labels."""

    colors: Float[AnyFloats, "V 3"]
    faces: Int[Ints, "F 3"]
    sharp: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "colors", np.asarray(self.colors, np.float32))

    def __call__(self, faces: Rows, weights: Weights, footprint: float) -> Float[AnyFloats, "N C"]:
        corners = self.faces[faces]
        if self.sharp:
            return self.colors[np.take_along_axis(corners, weights.argmax(axis=1)[:, None], axis=1)[:, 0]]
        return np.asarray(np.einsum("nk,nkc->nc", weights, self.colors[corners]))


def face_paint(colors: Float[AnyFloats, "F 3"]) -> Paint:
    """Paint with one color per triangle."""
    return lambda faces, weights, footprint: colors[faces]


class TexturePaint:
    """Paint by the materials of a file, as glTF defines it: image times factor times vertex color. ``scale`` is the length
    in the file's unit that becomes 1 in view coordinates.
    """

    def __init__(self, look: Appearance, shape: Shape, scale: float) -> None:
        self._look, self._faces = look, shape.faces
        self._colors = None if look.colors is None else np.nan_to_num(look.colors).astype(np.float32)
        self._pyramids = build_pyramids(look)
        texels = np.array([0.0 if m.image is None else m.image[..., 0].size for m in look.materials])
        self._max_alpha = [
            1.0 if m.image is None else float(m.image[..., 3].max(initial=0)) / 255.0 for m in look.materials
        ]
        # Texels per unit of length on each face: a pixel averages as many as it covers.
        a, b = look.uv[:, 1] - look.uv[:, 0], look.uv[:, 2] - look.uv[:, 0]
        flat = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
        solid = 2.0 * shape.face_areas / scale**2
        self._density = np.sqrt(flat * texels[look.material] / np.maximum(solid, 1e-20)).astype(np.float32)

    def __call__(self, faces: Rows, weights: Weights, footprint: float) -> Float[Floats32, "N 4"]:
        weights = np.asarray(weights, np.float32)
        out, tint = np.ones((2, len(faces), 4), np.float32)
        materials = self._look.material[faces]
        if self._colors is not None:
            tint = np.einsum("nk,nkc->nc", weights, self._colors[self._faces[faces]])
        for number in np.unique(materials).tolist():
            rows = np.flatnonzero(materials == number)
            material = self._look.materials[number]
            if number in self._pyramids:
                uv = np.einsum("nk,nkc->nc", weights[rows], self._look.uv[faces[rows]]).astype(np.float32)
                footprints = np.float32(footprint) * self._density[faces[rows]]
                out[rows] = self._pyramids[number].sample(uv[:, 0], uv[:, 1], footprints).T
            factors = tint[rows] * np.array(material.factor, np.float32)
            out[rows, :3] *= factors[:, :3]
            out[rows, 3] = _is_solid(material, out[rows, 3], factors[:, 3], self._max_alpha[number])
        return out


def _is_solid(
    material: Material, image: Float[Floats32, " N"], factor: Float[Floats32, " N"], max_alpha: float
) -> Bool[Bools, " N"]:
    """Whether there is any surface, by the alpha of the image and of its factor. Half-transparent glass is drawn solid; what
    an image cuts out, such as the card around hair, is not drawn. ``max_alpha`` is the largest alpha in the image.
    """
    if material.alpha == "opaque":
        return np.ones(len(image), bool)
    if material.alpha == "mask":
        return np.asarray(image * factor >= material.cutoff)
    return np.asarray((image >= 0.5 * max_alpha) & (factor >= INVISIBLE))


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles in view coordinates with their paint, which is called with indices of these faces.

    ``normals`` are unit vectors, or zero where the facet's normal is to be used. ``thickness`` is the largest distance
    between overlapping triangles of one surface, such as the discs of a cloud; with it, normals are not interpolated.
    """

    verts: Float[AnyFloats, "V 3"]
    faces: Int[Ints, "F 3"]
    normals: Float[AnyFloats, "V 3"]
    paint: Paint
    thickness: float = 0.0

    @cached_property
    def extent(self) -> Float[AnyFloats, "2 3"]:
        """Lower and upper corner of the bounding box of all triangles."""
        drawn = self.verts[corners_of(self.faces)]
        return np.stack([drawn.min(axis=0), drawn.max(axis=0)])

    def moved(self, right: float) -> Surface:
        """A copy of the surface, moved to the right."""
        return replace(self, verts=self.verts + np.array([right, 0.0, 0.0]))


def mesh_surface(
    verts: Float[AnyFloats, "V 3"], faces: Int[Ints, "F 3"], paint: Paint, chosen: Rows | None = None
) -> Surface:
    """A mesh, or the ``chosen`` of its triangles; normals are smooth, also across duplicate vertices as at texture seams and
    in stl files.
    """
    twin = same_rows(np.asarray(verts, np.float64))
    if chosen is None:
        return Surface(verts, faces, vertex_normals(verts, twin[faces])[twin], paint)
    normals = vertex_normals(verts, twin[faces[chosen]])[twin]
    return Surface(verts, faces[chosen], normals, lambda some, *where: paint(chosen[some], *where))


def balls(centers: Places, radius: float, colors: Places) -> Surface:
    """A ball around every center, in its color; the fewer balls, the finer their meshes."""
    verts, faces = _ball(4 if len(centers) <= 60 else 3 if len(centers) <= 1_000 else 2 if len(centers) <= 5_000 else 1)
    count = len(centers)
    return Surface(
        (centers[:, None] + radius * verts).reshape(-1, 3),
        (faces + len(verts) * np.arange(count)[:, None, None]).reshape(-1, 3),
        np.tile(verts, (count, 1)),
        face_paint(np.repeat(colors, len(faces), axis=0)),
    )


def discs(centers: Places, normals: Places, radius: Float[AnyFloats, " K"], colors: Places) -> Surface:
    """A flat octagon around every center, perpendicular to its normal, with the given radius."""
    turn = 2 * np.pi * np.arange(8) / 8
    first, second = tangents(normals)
    around = np.cos(turn)[:, None] * first[:, None] + np.sin(turn)[:, None] * second[:, None]
    rim = centers[:, None] + radius[:, None, None] * around
    fan = np.array([[0, k, k + 1] for k in range(1, 7)])
    faces = (fan + 8 * np.arange(len(centers))[:, None, None]).reshape(-1, 3)
    paint = face_paint(np.repeat(colors, len(fan), axis=0))
    return Surface(rim.reshape(-1, 3), faces, np.repeat(normals, 8, axis=0), paint, 0.6 * float(np.median(radius)))


def tangents(normal: Places) -> tuple[Places, Places]:
    """Two unit tangents of each normal (z > -1) that vary smoothly with it (Duff et al. 2017)."""
    x, y, z = normal[:, 0], normal[:, 1], np.maximum(normal[:, 2], -0.999)
    a = -1.0 / (1.0 + z)
    b = x * y * a
    return np.stack([1.0 + x * x * a, b, -x], axis=1), np.stack([b, 1.0 + y * y * a, -y], axis=1)


def _ball(subdivisions: int) -> tuple[Float[Floats, "V 3"], Int[Ints, "F 3"]]:
    verts = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=float)
    faces = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])
    for _ in range(subdivisions):
        a, b, c = np.moveaxis(verts[faces], 1, 0)
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        soup = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], axis=1).reshape(-1, 3)
        verts, inverse = np.unique(soup.round(12), axis=0, return_inverse=True)
        faces = inverse.reshape(-1, 3)
        verts = verts / np.linalg.norm(verts, axis=1, keepdims=True)
    return verts, faces.astype(np.int64)
