"""Light: a large soft key lamp, a fill, and a sky with ambient occlusion.

Nothing is random. Each lamp is a fixed set of directions, dealt out to the pixels in blocks of 4 x 4, on the ground of
8 x 8; a filter over such blocks gives every pixel the mean over the whole set: soft shadows without noise.
"""

from __future__ import annotations

import numpy as np

from meshmatch.arrays import Float, Floats, Floats32
from meshmatch.render.scene import Hits, Scene, Vectors
from meshmatch.render.surface import Rows

BLOCK, GROUND_BLOCK = 4, 8
"""Sides of a block of pixels on a surface and on the ground: each pixel of a block uses other directions."""
_SUBSETS = GROUND_BLOCK**2
_KEY_RAYS = 4  # a pixel
_SKY_RAYS = 8
_REACH = 0.75  # how far away something may be and still occlude the sky
_SHADOW_REACH = 1.6
Directions = tuple[Float[Floats32, "S R 3"], Float[Floats32, "S R"]]
"""Unit vectors, and how far each ray looks, in S subsets of R rays."""
Shares = Float[Floats32, "N 2"]
"""Of lamp and sky, that reach a place."""
_AT_ONCE = 20_000  # rows: what belongs to them then stays in the processor's cache


def _unit(x: float, y: float, z: float) -> Float[Floats32, " 3"]:
    return (np.array([x, y, z]) / np.linalg.norm([x, y, z])).astype(np.float32)


_KEY, _FILL, _RIM = _unit(-0.50, 0.95, 0.85), _unit(0.85, 0.05, 0.55), _unit(0.5, 0.6, -0.6)
_KEY_COLOR = np.array([1.03, 1.0, 0.955], np.float32)
_FILL_COLOR = np.array([0.93, 0.98, 1.08], np.float32)
_LAMP = 0.40  # radius of the key lamp's disc at distance 1


def _spread(count: int) -> Float[Floats, "count 3"]:
    """Numbers in 0..1, evenly spread, and any run of them too (Roberts' R3 sequence)."""
    root = 1.22074408460575947536  # of x^4 = x + 1
    return (0.5 + np.arange(1, count + 1)[:, None] * np.array([1 / root, root**-2, root**-3])) % 1.0


def _key_directions() -> Directions:
    """Towards points of the lamp."""
    numbers = _spread(_SUBSETS * _KEY_RAYS)
    side = np.cross(_KEY, [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    angle, radius = 2 * np.pi * numbers[:, 0], _LAMP * np.sqrt(numbers[:, 1])
    aim = _KEY + (radius * np.cos(angle))[:, None] * side + (radius * np.sin(angle))[:, None] * np.cross(side, _KEY)
    aim /= np.linalg.norm(aim, axis=1, keepdims=True)
    return _in_subsets(aim, _SHADOW_REACH * (0.15 + 0.85 * numbers[:, 2]))


def _sky_directions() -> Directions:
    """Around +z, distributed by their cosine."""
    numbers = _spread(_SUBSETS * _SKY_RAYS)
    angle, radius = 2 * np.pi * numbers[:, 0], np.sqrt(numbers[:, 1])
    local = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - radius**2)], axis=1)
    return _in_subsets(local, _REACH * (0.06 + 0.94 * numbers[:, 2] ** 1.5))


def _in_subsets(aims: Float[Floats, "N 3"], reaches: Float[Floats, " N"]) -> Directions:
    return (aims.reshape(_SUBSETS, -1, 3).astype(np.float32), reaches.reshape(_SUBSETS, -1).astype(np.float32))


_KEY_SET, _KEY_FAR = _key_directions()
_SKY_SET, _SKY_FAR = _sky_directions()


def visibility(scene: Scene, hits: Hits, rows: Rows, row: Rows, column: Rows) -> Shares:
    """Shares of the key lamp and of the sky that reach ``rows`` of the hits; their pixels select subsets of directions."""
    result = np.empty((len(rows), 2), np.float32)
    ground = hits.face[rows] == -2
    side = np.where(ground, GROUND_BLOCK, BLOCK)
    group = row % side * side + column % side + _SUBSETS * ground
    order = np.argsort(group, kind="stable")
    ends = np.cumsum(np.bincount(group, minlength=2 * _SUBSETS))
    for number, end in enumerate(ends):  # rows of one subset share their directions
        own = order[ends[number - 1] if number else 0 : end]
        subset = number % _SUBSETS
        few = slice(None, None, 2 if number >= _SUBSETS else 1)  # the larger blocks of the ground need fewer per pixel
        for first in range(0, len(own), _AT_ONCE):
            part = own[first : first + _AT_ONCE]
            flat = hits.flat[rows[part]]
            places = hits.place[rows[part]] + hits.lift[rows[part], None] * flat
            result[part] = _seen(scene, places, flat, hits.normal[rows[part]], subset, few)
    return result


def _seen(scene: Scene, places: Vectors, flat: Vectors, normal: Vectors, subset: int, few: slice) -> Shares:
    """Shares of lamp and sky at places on a surface, by ``few`` of the rays of a subset."""
    # At a grazing angle a facet shades its neighbors although the smooth surface is lit: shadows fade there.
    grazing = np.clip((flat @ _KEY) / np.float32(0.3), 0.0, 1.0)
    facing = np.flatnonzero((normal @ _KEY > -0.2) & (grazing > 0))
    hidden, taken = np.zeros((2, len(places)), np.float32)
    lamp = _KEY_SET[subset, few]
    asked = places[facing]
    for aim, reach in zip(lamp, _KEY_FAR[subset, few], strict=True):
        hidden[facing] += scene.blocked(asked, np.broadcast_to(aim, asked.shape), reach)
    side, up = _tangents(normal)
    sky = _SKY_SET[subset, few]
    for (x, y, z), reach in zip(sky, _SKY_FAR[subset, few], strict=True):
        aim = x * side + y * up + z * normal
        below = np.minimum(2 * np.einsum("ni,ni->n", aim, flat), 0)
        aim -= below[:, None] * flat  # a ray into the facet is reflected out
        taken += scene.blocked(places, aim, reach)
    return np.stack([1.0 - grazing * hidden / len(lamp), 1.0 - taken / len(sky)], axis=1).astype(np.float32)


def _tangents(normal: Vectors) -> tuple[Vectors, Vectors]:
    """Two unit tangents of each normal (z > -1) that change smoothly with it (Duff et al. 2017)."""
    x, y, z = normal[:, 0], normal[:, 1], np.maximum(normal[:, 2], -0.999)
    a = -1.0 / (1.0 + z)
    b = x * y * a
    return (
        np.stack([1.0 + x * x * a, b, -x], axis=1).astype(np.float32),
        np.stack([b, 1.0 + y * y * a, -y], axis=1).astype(np.float32),
    )


def shade(hits: Hits, rows: Rows, seen: Shares) -> Vectors:
    """Linear light that rows of the hits send to the viewer; ``seen`` as from `visibility`."""
    normal, color = hits.normal[rows], hits.color[rows]
    lamp, sky = seen[:, 0], seen[:, 1]
    key = np.clip((normal @ _KEY + 0.15) / 1.15, 0, None) * (0.25 + 0.75 * lamp)
    fill = np.clip((normal @ _FILL + 0.3) / 1.3, 0, None) * sky
    above = 0.62 + 0.38 * normal[:, 1]
    # Light that bounces in a hollow takes the color of its walls (Jimenez et al. 2016).
    first, second, third = 2.0404 * color - 0.3324, -4.7951 * color + 0.6417, 2.7552 * color + 0.6903
    deep = sky[:, None]
    around = np.maximum(deep, ((deep * first + second) * deep + third) * deep)
    light = 0.78 * key[:, None] * _KEY_COLOR + (0.14 * fill)[:, None] * _FILL_COLOR
    light = light + 0.44 * above[:, None] * around
    half = (_KEY + np.array([0, 0, 1.0], np.float32)) / np.linalg.norm(_KEY + np.array([0, 0, 1.0]))
    gloss = 0.055 * np.clip(normal @ half, 0, None) ** 28 * lamp
    edge = (1 - normal[:, 2]) ** 4 * np.clip(0.4 + normal @ _RIM, 0, None) * sky
    return np.asarray(color * light + (gloss + 0.06 * edge)[:, None], np.float32)


def shadow(seen: Shares) -> Float[Floats32, " N"]:
    """How dark the ground is, 0 to 1, where shares ``seen`` of lamp and sky reach it."""
    dark = 0.30 * (1.0 - seen[:, 0]) + 0.52 * (1.0 - seen[:, 1])
    return np.asarray(np.clip(dark, 0.0, 0.85), np.float32)
