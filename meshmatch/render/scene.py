"""Ray casting and shading: embree finds the triangles that rays hit; hits have position, normal and color.

The camera is orthographic and looks along -z. Light comes from a large soft key lamp, a fill light, and a sky with ambient
occlusion. Nothing is random: each lamp is a fixed set of directions, distributed over blocks of 4 x 4 pixels, on the ground
8 x 8. A filter over such blocks gives every pixel the mean over the whole set, hence soft shadows without noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from meshmatch.arrays import Bool, Bools, Float, Floats, Floats32
from meshmatch.render.surface import Rows, Surface, tangents

# Cosines of the angle between a facet and the smooth normal of a corner: smooth up to the first, a crease from the second.
_SMOOTH, _CREASE = np.cos(np.radians(28.0)), np.cos(np.radians(42.0))

_LIFT = 3e-3  # height above the surface at which rays to the lights start
_MAX_LAYERS = 12  # surfaces with holes, one behind the other, that a ray passes
Vectors = Float[Floats32, "N 3"]
Numbers = Float[Floats, " N"]
BLOCK, GROUND_BLOCK = 4, 8
"""Side of a block of pixels, on a surface and on the ground: each pixel of a block uses other directions."""
_SUBSETS = GROUND_BLOCK**2
_KEY_RAYS = 4  # per pixel
_SKY_RAYS = 8
_SKY_REACH = 0.75  # maximum distance at which something occludes the sky
_SHADOW_REACH = 1.6
Directions = tuple[Float[Floats32, "S R 3"], Float[Floats32, "S R"]]
"""Unit vectors, and maximum length of each ray, in S subsets of R rays."""
Shares = Float[Floats32, "N 2"]
"""Shares of the light of lamp and sky that reach a place."""
_CHUNK = 20_000  # rows; their data then fit into the processor's cache


@dataclass(frozen=True, eq=False)
class Ground:
    """A plane that only receives shadows: points x with ``x @ normal = height``, within ``spots`` of the picture, which are
    ellipses (x, y, half width, half height).
    """

    normal: Float[Floats, " 3"]
    height: float
    spots: Float[Floats, "K 4"]

    def strength(self, x: Numbers, y: Numbers) -> Float[Floats32, " N"]:
        """Strength of shadows, 0 to 1, at points of the picture; it fades out towards the rims of the spots."""
        strength = np.zeros(len(x), np.float32)
        for left, top, width, height in self.spots:
            near = np.clip(1 - ((x - left) / width) ** 2 - ((y - top) / height) ** 2, 0, 1)
            strength = np.maximum(strength, near * (2 - near))
        return strength.astype(np.float32)


@dataclass(frozen=True, eq=False)
class Hits:
    """Results of N rays; rows of misses are undefined.

    ``face`` is the triangle in the whole scene, -1 for a miss, -2 for the ground. ``flat`` is the facet's normal and
    ``normal`` the smooth one; both face the viewer. ``color`` is linear; on the ground it is the strength of shadows, three
    times. ``lift`` is the height above the surface at which rays to the lights start, so that it does not shade itself.
    """

    face: Rows
    place: Vectors
    flat: Vectors
    normal: Vectors
    color: Vectors
    lift: Float[Floats32, " N"]


class Scene:
    """Surfaces and optionally a ground, prepared for ray casting."""

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
        self._camera_z = max(part.extent[1, 2] for part in surfaces) + 1.0
        self._embree = EmbreeScene()
        # Referenced here because embree reads the vertices and triangles from these arrays.
        self._mesh = TriangleMesh(self._embree, self.verts, self.faces)

    def blocked(self, places: Vectors, directions: Vectors, reach: float) -> Bool[Bools, " N"]:
        """Whether anything lies within ``reach`` of each place along a unit direction."""
        found = self._embree.run(
            np.ascontiguousarray(places, np.float32),
            np.ascontiguousarray(directions, np.float32),
            dists=np.full(len(places), reach, np.float32),
            query="OCCLUDED",
        )
        return np.asarray(found >= 0)

    def trace(self, x: Numbers, y: Numbers, pixel: float) -> Hits:
        """What is visible at points of the picture plane; ``pixel`` is the size of a pixel, for textures."""
        count = len(x)
        face = np.full(count, -1, np.int64)
        place, flat, normal, color = np.zeros((4, count, 3), np.float32)
        hits = Hits(face, place, flat, normal, color, np.full(count, _LIFT, np.float32))
        rows, depth = np.arange(count), np.full(count, self._camera_z, np.float32)
        for _ in range(_MAX_LAYERS):  # again where a ray passes through a hole in a texture
            origins = np.stack([x[rows], y[rows], depth], axis=1).astype(np.float32)
            directions = np.tile(np.array([0, 0, -1], dtype=np.float32), (len(rows), 1))
            found = self._embree.run(origins, directions, output=1)
            face[rows] = found["primID"]
            hit = np.flatnonzero(face[rows] >= 0)
            u, v = found["u"][hit], found["v"][hit]
            weights = np.stack([1 - u - v, u, v], axis=1).astype(np.float32)
            holes = self._fill_hits(hits, rows[hit], weights, pixel)
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

    def _fill_hits(self, hits: Hits, rows: Rows, weights: Vectors, pixel: float) -> Bool[Bools, " N"]:
        """Fill in rows of the hits; return which are holes in a texture."""
        face = hits.face[rows]
        holes = np.zeros(len(rows), bool)
        corners = self.faces[face]
        hits.place[rows] = np.einsum("nk,nkc->nc", weights, self.verts[corners])
        flat = self._flat[face]
        smooth = self._normals[corners]
        # A corner whose smooth normal differs much from its facet's is a crease: the facet's normal is used there.
        agreement = np.einsum("nkc,nc->nk", smooth, flat)
        usable = np.abs(agreement) > 1e-6
        smoothness = np.clip((np.abs(agreement) - _CREASE) / (_SMOOTH - _CREASE), 0.0, 1.0) * usable
        smooth = smooth * np.where(agreement < 0, -1.0, 1.0)[..., None]
        bent = smoothness[..., None] * smooth + (1 - smoothness[..., None]) * flat[:, None]
        normal = np.einsum("nk,nkc->nc", weights, bent)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), np.float32(1e-30))
        # Winding may be wrong, but what is visible faces the viewer.
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
            hits.lift[rows[own]] += surface.thickness
            if surface.thickness:
                normal[own] = self._normals[corners[own, 0]]
        normal[:, 2] = np.maximum(normal[:, 2], 0.02)  # a smooth normal may face away at the outline
        hits.normal[rows] = normal / np.linalg.norm(normal, axis=1, keepdims=True)
        return holes


def _unit(x: float, y: float, z: float) -> Float[Floats32, " 3"]:
    return np.asarray((np.array([x, y, z]) / np.linalg.norm([x, y, z])).astype(np.float32))


_KEY, _FILL, _RIM = _unit(-0.50, 0.95, 0.85), _unit(0.85, 0.05, 0.55), _unit(0.5, 0.6, -0.6)
_KEY_COLOR = np.array([1.03, 1.0, 0.955], np.float32)
_FILL_COLOR = np.array([0.93, 0.98, 1.08], np.float32)
_LAMP = 0.40  # radius of the key lamp's disc at distance 1


def _r3_sequence(count: int) -> Float[Floats, "count 3"]:
    """(count, 3) evenly distributed numbers in 0..1, also in any run of them (Roberts' R3 sequence)."""
    root = 1.22074408460575947536  # positive root of x^4 = x + 1
    return np.asarray((0.5 + np.arange(1, count + 1)[:, None] * np.array([1 / root, root**-2, root**-3])) % 1.0)


def _key_directions() -> Directions:
    """Directions towards points of the key lamp."""
    numbers = _r3_sequence(_SUBSETS * _KEY_RAYS)
    side = np.cross(_KEY, [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    angle, radius = 2 * np.pi * numbers[:, 0], _LAMP * np.sqrt(numbers[:, 1])
    aim = _KEY + (radius * np.cos(angle))[:, None] * side + (radius * np.sin(angle))[:, None] * np.cross(side, _KEY)
    aim /= np.linalg.norm(aim, axis=1, keepdims=True)
    return _in_subsets(aim, _SHADOW_REACH * (0.15 + 0.85 * numbers[:, 2]))


def _sky_directions() -> Directions:
    """Cosine-distributed directions around +z."""
    numbers = _r3_sequence(_SUBSETS * _SKY_RAYS)
    angle, radius = 2 * np.pi * numbers[:, 0], np.sqrt(numbers[:, 1])
    local = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - radius**2)], axis=1)
    return _in_subsets(local, _SKY_REACH * (0.06 + 0.94 * numbers[:, 2] ** 1.5))


def _in_subsets(aims: Float[Floats, "N 3"], reaches: Float[Floats, " N"]) -> Directions:
    return (aims.reshape(_SUBSETS, -1, 3).astype(np.float32), reaches.reshape(_SUBSETS, -1).astype(np.float32))


_KEY_SET, _KEY_FAR = _key_directions()
_SKY_SET, _SKY_FAR = _sky_directions()


def visibility(scene: Scene, hits: Hits, rows: Rows, row: Rows, column: Rows) -> Shares:
    """Shares of key lamp and sky that reach ``rows`` of the hits; pixel ``row`` and ``column`` select their directions."""
    result = np.empty((len(rows), 2), np.float32)
    ground = hits.face[rows] == -2
    side = np.where(ground, GROUND_BLOCK, BLOCK)
    group = row % side * side + column % side + _SUBSETS * ground
    order = np.argsort(group, kind="stable")
    ends = np.cumsum(np.bincount(group, minlength=2 * _SUBSETS))
    for number, end in enumerate(ends):  # all of one subset share their directions
        own = order[ends[number - 1] if number else 0 : end]
        subset = number % _SUBSETS
        rays = slice(None, None, 2 if number >= _SUBSETS else 1)  # the larger blocks of the ground need fewer per pixel
        for first in range(0, len(own), _CHUNK):
            chunk = own[first : first + _CHUNK]
            flat = hits.flat[rows[chunk]]
            places = hits.place[rows[chunk]] + hits.lift[rows[chunk], None] * flat
            result[chunk] = _visible_shares(scene, places, flat, hits.normal[rows[chunk]], subset, rays)
    return result


def _visible_shares(scene: Scene, places: Vectors, flat: Vectors, normal: Vectors, subset: int, rays: slice) -> Shares:
    """Shares of lamp and sky at places on a surface, by the selected rays of a subset."""
    # At grazing angles a facet shades its neighbours although the smooth surface is lit: shadows fade out there.
    # At a grazing angle a facet shades its neighbours although the smooth surface is lit: shadows fade there.
    grazing = np.clip((flat @ _KEY) / np.float32(0.3), 0.0, 1.0)
    facing = np.flatnonzero((normal @ _KEY > -0.2) & (grazing > 0))
    hidden, occluded = np.zeros((2, len(places)), np.float32)
    lamp = _KEY_SET[subset, rays]
    places_facing = places[facing]
    for aim, reach in zip(lamp, _KEY_FAR[subset, rays], strict=True):
        hidden[facing] += scene.blocked(places_facing, np.broadcast_to(aim, places_facing.shape), reach)
    side, up = tangents(normal)
    sky = _SKY_SET[subset, rays]
    for (x, y, z), reach in zip(sky, _SKY_FAR[subset, rays], strict=True):
        aim = x * side + y * up + z * normal
        below = np.minimum(2 * np.einsum("ni,ni->n", aim, flat), 0)
        aim -= below[:, None] * flat  # a ray into the facet is mirrored out of it
        occluded += scene.blocked(places, aim, reach)
    return np.stack([1.0 - grazing * hidden / len(lamp), 1.0 - occluded / len(sky)], axis=1).astype(np.float32)


def shade(hits: Hits, rows: Rows, seen: Shares) -> Vectors:
    """Linear light that rows of the hits send to the viewer; ``seen`` are shares by `visibility`."""
    normal, color = hits.normal[rows], hits.color[rows]
    lamp, sky = seen[:, 0], seen[:, 1]
    key = np.clip((normal @ _KEY + 0.15) / 1.15, 0, None) * (0.25 + 0.75 * lamp)
    fill = np.clip((normal @ _FILL + 0.3) / 1.3, 0, None) * sky
    above = 0.62 + 0.38 * normal[:, 1]
    # Light that bounces in a hollow takes the color of its walls (Jimenez et al. 2016).
    first, second, third = 2.0404 * color - 0.3324, -4.7951 * color + 0.6417, 2.7552 * color + 0.6903
    sky_share = sky[:, None]
    around = np.maximum(sky_share, ((sky_share * first + second) * sky_share + third) * sky_share)
    light = 0.78 * key[:, None] * _KEY_COLOR + (0.14 * fill)[:, None] * _FILL_COLOR
    light = light + 0.44 * above[:, None] * around
    half = (_KEY + np.array([0, 0, 1.0], np.float32)) / np.linalg.norm(_KEY + np.array([0, 0, 1.0]))
    gloss = 0.055 * np.clip(normal @ half, 0, None) ** 28 * lamp
    edge = (1 - normal[:, 2]) ** 4 * np.clip(0.4 + normal @ _RIM, 0, None) * sky
    return np.asarray(color * light + (gloss + 0.06 * edge)[:, None], np.float32)


def shadow(seen: Shares) -> Float[Floats32, " N"]:
    """Darkness of the ground, 0 to 1, for shares ``seen`` of lamp and sky."""
    dark = 0.30 * (1.0 - seen[:, 0]) + 0.52 * (1.0 - seen[:, 1])
    return np.asarray(np.clip(dark, 0.0, 0.85), np.float32)
