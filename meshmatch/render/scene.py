"""What rays hit: embree finds the triangles, and a hit knows its position, normal and color.

The camera is orthographic and looks along -z.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from meshmatch.arrays import Bool, Bools, Float, Floats, Floats32
from meshmatch.render.surface import Rows, Surface

# Cosines of the angle between a facet and the smooth normal of a corner: up to here smooth, from there on a crease.
_SMOOTH, _CREASE = np.cos(np.radians(28.0)), np.cos(np.radians(42.0))

_LIFT = 3e-3
_LAYERS = 12  # of surfaces with holes behind each other
Vectors = Float[Floats32, "N 3"]
Numbers = Float[Floats, " N"]


@dataclass(frozen=True, eq=False)
class Ground:
    """A plane that only receives shadows: points x with ``x @ normal = height``, within ``spots`` of the picture: ellipses
    by x, y, half width, half height.
    """

    normal: Float[Floats, " 3"]
    height: float
    spots: Float[Floats, "K 4"]

    def strength(self, x: Numbers, y: Numbers) -> Float[Floats32, " N"]:
        """How strongly shadows are drawn at points of the picture, 0 to 1: they fade out towards the rims."""
        strength = np.zeros(len(x), np.float32)
        for left, top, width, height in self.spots:
            near = np.clip(1 - ((x - left) / width) ** 2 - ((y - top) / height) ** 2, 0, 1)
            strength = np.maximum(strength, near * (2 - near))
        return strength.astype(np.float32)


@dataclass(frozen=True, eq=False)
class Hits:
    """What N rays met. Rows of misses hold nothing of use.

    ``face`` is the triangle in the whole scene, -1 for a miss, -2 for the ground. ``flat`` and ``normal`` are that of
    the facet and the smooth one; both face the viewer. ``color`` is linear; of the ground the strength of its shadows,
    three times. ``lift`` is the height above the surface from which light is looked for, so that it does not shade
    itself.
    """

    face: Rows
    place: Vectors
    flat: Vectors
    normal: Vectors
    color: Vectors
    lift: Float[Floats32, " N"]


class Scene:
    """Surfaces, and perhaps a ground, ready for rays."""

    def __init__(self, surfaces: list[Surface], ground: Ground | None = None, opacity: float = 1.0) -> None:
        self.surfaces, self.ground, self.opacity = surfaces, ground, opacity
        starts = np.cumsum([0, *(len(part.verts) for part in surfaces[:-1])])
        self._first = np.cumsum([0, *(len(part.faces) for part in surfaces)])
        self.verts = np.concatenate([part.verts for part in surfaces]).astype(np.float32)
        faces = [part.faces + start for part, start in zip(surfaces, starts, strict=True)]
        self.faces = np.concatenate(faces).astype(np.int32)
        self._normals = np.concatenate([part.normals for part in surfaces]).astype(np.float32)
        corners = self.verts[self.faces]
        flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        self._flat = flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), np.float32(1e-30))
        self._before = max(part.extent[1, 2] for part in surfaces) + 1.0
        self._embree = EmbreeScene()
        # Kept: embree reads the vertices and triangles of the arrays that it was given.
        self._mesh = TriangleMesh(self._embree, self.verts, self.faces)

    @cached_property
    def bounds(self) -> Float[Floats, "2 2"]:
        """Left, bottom; right, top of the part of the picture where anything can be."""
        ends = [part.extent[:, :2] for part in self.surfaces]
        if self.ground is not None:
            ends += [np.stack([spot[:2] - spot[2:], spot[:2] + spot[2:]]) for spot in self.ground.spots]
        return np.stack([np.min(ends, axis=(0, 1)), np.max(ends, axis=(0, 1))])

    def blocked(self, places: Vectors, directions: Vectors, reach: float) -> Bool[Bools, " N"]:
        """Whether anything lies within reach of each place along a unit direction."""
        found = self._embree.run(
            np.ascontiguousarray(places, np.float32),
            np.ascontiguousarray(directions, np.float32),
            dists=np.full(len(places), reach, np.float32),
            query="OCCLUDED",
        )
        return np.asarray(found >= 0)

    def look(self, x: Numbers, y: Numbers, pixel: float) -> Hits:
        """What is seen at points of the picture plane; ``pixel`` is the size of a pixel, for textures."""
        count = len(x)
        face = np.full(count, -1, np.int64)
        place, flat, normal, color = np.zeros((4, count, 3), np.float32)
        hits = Hits(face, place, flat, normal, color, np.full(count, _LIFT, np.float32))
        rows, depth = np.arange(count), np.full(count, self._before, np.float32)
        for _ in range(_LAYERS):  # again where a ray went through a hole that a texture cuts out
            origins = np.stack([x[rows], y[rows], depth], axis=1).astype(np.float32)
            directions = np.tile(np.array([0, 0, -1], dtype=np.float32), (len(rows), 1))
            found = self._embree.run(origins, directions, output=1)
            face[rows] = found["primID"]
            hit = np.flatnonzero(face[rows] >= 0)
            u, v = found["u"][hit], found["v"][hit]
            weights = np.stack([1 - u - v, u, v], axis=1).astype(np.float32)
            holes = self._describe(hits, rows[hit], weights, pixel)
            if not holes.any():
                break
            rows = rows[hit][holes]
            face[rows] = -1
            depth = hits.place[rows, 2] - np.float32(1e-5)
        if self.ground is not None:
            missed = np.flatnonzero(face < 0)
            strength = self.ground.strength(x[missed], y[missed])
            there, strength = missed[strength > 0], strength[strength > 0]
            face[there] = -2
            a, b, c = self.ground.normal
            depth = (self.ground.height - a * x[there] - b * y[there]) / c
            hits.place[there] = np.stack([x[there], y[there], depth], axis=1)
            hits.flat[there] = hits.normal[there] = self.ground.normal
            hits.color[there] = strength[:, None]
        return hits

    def _describe(self, hits: Hits, rows: Rows, weights: Vectors, pixel: float) -> Bool[Bools, " N"]:
        """Fill in rows of the hits; whether each is a hole in its texture."""
        face = hits.face[rows]
        holes = np.zeros(len(rows), bool)
        corners = self.faces[face]
        hits.place[rows] = np.einsum("nk,nkc->nc", weights, self.verts[corners])
        flat = self._flat[face]
        given = self._normals[corners]
        # A corner whose smooth normal leans far from its facet is a crease: there the facet's own counts.
        agreement = np.einsum("nkc,nc->nk", given, flat)
        known = np.abs(agreement) > 1e-6
        lean = np.clip((np.abs(agreement) - _CREASE) / (_SMOOTH - _CREASE), 0.0, 1.0) * known
        given = given * np.where(agreement < 0, -1.0, 1.0)[..., None]
        bent = lean[..., None] * given + (1 - lean[..., None]) * flat[:, None]
        normal = np.einsum("nk,nkc->nc", weights, bent)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), np.float32(1e-30))
        # Winding may be wrong, but what is seen faces the viewer.
        side = np.where(flat[:, 2:] < 0, np.float32(-1), np.float32(1))
        hits.flat[rows] = flat * side
        normal = normal * side
        for number, surface in enumerate(self.surfaces):
            first, last = self._first[number], self._first[number + 1]
            own = np.flatnonzero((face >= first) & (face < last))
            if not len(own):
                continue
            color = surface.paint(face[own] - first, weights[own], pixel)
            hits.color[rows[own]] = color[:, :3]
            if color.shape[1] == 4:
                holes[own] = color[:, 3] < 0.5
            hits.lift[rows[own]] += surface.loose
            if surface.loose:
                normal[own] = self._normals[corners[own, 0]]
        normal[:, 2] = np.maximum(normal[:, 2], 0.02)  # a smooth normal may look away at the rim
        hits.normal[rows] = normal / np.linalg.norm(normal, axis=1, keepdims=True)
        return holes
