"""Light on triangles: embree finds what a ray hits, NumPy decides its colour.

View coordinates: x to the right, y up, z towards the viewer; the picture is an orthographic look along -z.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray
from scipy.spatial import cKDTree

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

RAYS_AT_ONCE = 400_000
_SKY_RAYS = 48  # to judge how much of the sky a vertex sees
_SKY_VERTICES = 60_000  # of a larger surface so many are asked, the others take their neighbours' answer
_SHADOW_RAYS = 4  # for every ray of the picture
_KEY = np.array([-0.45, 0.65, 0.75]) / np.linalg.norm([-0.45, 0.65, 0.75])
_FILL = np.array([0.80, 0.10, 0.60]) / np.linalg.norm([0.80, 0.10, 0.60])


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles in view coordinates, about 1 large, with what light needs to know about them.

    Parameters
    ----------
    verts, normals, colors : (V, 3) float64
        Positions, unit normals (zero: use the face's), linear colours.
    faces : (F, 3) int64
    """

    verts: FloatArray
    faces: IntArray
    normals: FloatArray
    colors: FloatArray

    @classmethod
    def joined(cls, parts: list[Surface]) -> Surface:
        """Several surfaces as one."""
        starts = np.cumsum([0, *(len(part.verts) for part in parts[:-1])])
        return cls(
            np.concatenate([part.verts for part in parts]),
            np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=True)]),
            np.concatenate([part.normals for part in parts]),
            np.concatenate([part.colors for part in parts]),
        )


def spheres(centers: FloatArray, radius: float, colors: FloatArray) -> Surface:
    """A ball for every centre ``(K, 3)``, round enough for its number."""
    verts, faces = _ball(2 if len(centers) <= 1_000 else 1 if len(centers) <= 5_000 else 0)
    count = len(centers)
    return Surface(
        (centers[:, None] + radius * verts).reshape(-1, 3),
        (faces + len(verts) * np.arange(count)[:, None, None]).reshape(-1, 3),
        np.tile(verts, (count, 1)),
        np.repeat(colors, len(verts), axis=0),
    )


def _ball(subdivisions: int) -> tuple[FloatArray, IntArray]:
    verts = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=float)
    faces = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])
    for _ in range(subdivisions + 1):
        corners = verts[faces]
        middles = (corners + np.roll(corners, -1, axis=1)) / 2
        a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
        ab, bc, ca = middles[:, 0], middles[:, 1], middles[:, 2]
        soup = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], axis=1).reshape(-1, 3)
        verts, inverse = np.unique(soup.round(12), axis=0, return_inverse=True)
        faces = inverse.reshape(-1, 3)
        verts = verts / np.linalg.norm(verts, axis=1, keepdims=True)
    return verts, faces.astype(np.int64)


class Scene:
    """A surface with light on it, ready to be asked for the colour along any ray of the view."""

    def __init__(self, surface: Surface, rng: np.random.Generator, skin: int | None = None) -> None:
        self.surface = surface
        # Only the first vertices ask how much sky they see: small balls hide little from themselves.
        self._skin = len(surface.verts) if skin is None else skin
        self._embree = EmbreeScene()
        # Kept: embree reads the vertices and triangles of the arrays that it was given.
        self._mesh = TriangleMesh(
            self._embree, surface.verts.astype(np.float32), surface.faces.astype(np.int32)
        )
        corners = surface.verts[surface.faces]
        flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        self._flat = flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-30)
        self._near = float(surface.verts[:, 2].max()) + 1.0
        self._sky = self._sky_seen(rng)

    def _occluded(self, origins: FloatArray, directions: FloatArray, reach: float) -> NDArray[np.bool_]:
        result = np.empty(len(origins), dtype=bool)
        for first in range(0, len(origins), RAYS_AT_ONCE):
            part = slice(first, first + RAYS_AT_ONCE)
            count = len(origins[part])
            found = self._embree.run(
                np.ascontiguousarray(origins[part], dtype=np.float32),
                np.ascontiguousarray(directions[part], dtype=np.float32),
                dists=np.full(count, reach, dtype=np.float32),
                query="OCCLUDED",
            )
            result[part] = found >= 0
        return result

    def _sky_seen(self, rng: np.random.Generator) -> FloatArray:
        """Share of the hemisphere above each vertex ``(V,)`` that is not blocked nearby (ambient
        occlusion).
        """
        surface = self.surface
        size = self._skin
        asked = (
            np.arange(size)
            if size <= _SKY_VERTICES
            else np.sort(rng.choice(size, _SKY_VERTICES, replace=False))
        )
        normals = surface.normals[asked]
        # The same directions for all vertices: smooth shades instead of noise.
        k = np.arange(_SKY_RAYS) + 0.5
        radius, angle = np.sqrt(k / _SKY_RAYS), np.pi * (1 + np.sqrt(5)) * k
        local = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - radius**2)], axis=1)
        side = np.cross(normals, np.where(np.abs(normals[:, :1]) < 0.8, [[1.0, 0, 0]], [[0, 1.0, 0]]))
        side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-30)
        up = np.cross(normals, side)
        blocked = np.zeros(len(asked))
        origins = surface.verts[asked] + 2e-3 * normals
        for x, y, z in local:
            blocked += self._occluded(origins, x * side + y * up + z * normals, reach=0.35)
        seen = 1.0 - blocked / _SKY_RAYS
        result = np.ones(len(surface.verts))
        if len(asked) == size:
            result[:size] = seen
        else:
            _, nearest = cKDTree(surface.verts[asked]).query(surface.verts[:size], k=4)
            result[:size] = seen[nearest].mean(axis=1)
        return result

    def _shadow(self, places: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Share of the key light hidden from each place ``(N,)``: a soft shadow, for the light is a disc."""
        side = np.cross(_KEY, [0.0, 1.0, 0.0])
        side /= np.linalg.norm(side)
        up = np.cross(side, _KEY)
        hidden = np.zeros(len(places))
        for quarter in range(_SHADOW_RAYS):
            angle = 2 * np.pi * (quarter + rng.random((len(places), 1))) / _SHADOW_RAYS
            radius = 0.2 * np.sqrt(rng.random((len(places), 1)))
            aim = _KEY + radius * (np.cos(angle) * side + np.sin(angle) * up)
            hidden += self._occluded(places, aim, reach=10.0)
        return hidden / _SHADOW_RAYS

    def look(
        self, x: FloatArray, y: FloatArray, rng: np.random.Generator
    ) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Linear colours ``(N, 3)`` seen at points ``(N,)`` of the picture plane, and whether anything is
        there.
        """
        colors = np.ones((len(x), 3))
        seen = np.zeros(len(x), dtype=bool)
        for first in range(0, len(x), RAYS_AT_ONCE):
            part = slice(first, first + RAYS_AT_ONCE)
            count = len(x[part])
            origins = np.empty((count, 3), dtype=np.float32)
            origins[:, 0], origins[:, 1], origins[:, 2] = x[part], y[part], self._near
            directions = np.tile(np.array([0, 0, -1], dtype=np.float32), (count, 1))
            found = self._embree.run(origins, directions, output=1)
            hit = np.flatnonzero(found["primID"] >= 0)
            seen[first + hit] = True
            colors[first + hit] = self._shade(
                found["primID"][hit],
                found["u"][hit].astype(np.float64),
                found["v"][hit].astype(np.float64),
                rng,
            )
        return colors, seen

    def _shade(self, face: IntArray, u: FloatArray, v: FloatArray, rng: np.random.Generator) -> FloatArray:
        surface = self.surface
        corners = surface.faces[face]
        weights = np.stack([1 - u - v, u, v], axis=1)

        def mixed(values: FloatArray) -> FloatArray:
            return np.asarray(np.einsum("nk,nk...->n...", weights, values[corners]))

        flat = self._flat[face]
        # Winding may be wrong, but what is seen faces the viewer.
        flat = flat * np.where(flat[:, 2:] < 0, -1.0, 1.0)
        normals = mixed(surface.normals)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
        agreement = np.einsum("ni,ni->n", normals, flat)
        normals = normals * np.where(agreement < 0, -1.0, 1.0)[:, None]
        sharp = np.abs(agreement) < 0.5  # a crease: smooth shading would smear it
        normals[sharp] = flat[sharp]

        sky = mixed(self._sky)
        places = mixed(surface.verts) + 4e-3 * flat
        lit = np.clip(normals @ _KEY, 0, None)
        # At a grazing angle a facet shades its neighbours although the smooth surface is lit: fade shadows
        # out there.
        grazing = np.clip((flat @ _KEY) / 0.3, 0.0, 1.0)
        facing = np.flatnonzero((lit > 0) & (grazing > 0))
        shadow = np.zeros(len(face))
        shadow[facing] = self._shadow(places[facing], rng) * grazing[facing]
        key = lit * (1 - 0.55 * shadow)
        fill = np.clip(normals @ _FILL, 0, None) * sky
        ambient = (0.6 + 0.4 * normals[:, 1]) * sky**1.3
        half = (_KEY + np.array([0, 0, 1.0])) / np.linalg.norm(_KEY + np.array([0, 0, 1.0]))
        gloss = 0.05 * np.clip(normals @ half, 0, None) ** 30 * (1 - shadow)
        light = 0.66 * key + 0.16 * fill + 0.46 * ambient
        return mixed(surface.colors) * light[:, None] + gloss[:, None]
