"""Rendering of a scene to pixels, with one ray per pixel, and more where edges would look jagged.

Visibility of the lights is computed once per pixel, filtered over neighbours on the same surface, and then shared by all
rays of the pixel. Rows are processed in bands, so that memory does not grow with the picture.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshmatch.arrays import Bool, Bools, Float, Floats, Floats32
from meshmatch.render.scene import BLOCK, GROUND_BLOCK, Hits, Scene, Shares, Vectors, shade, shadow, visibility
from meshmatch.render.surface import Rows

BAND = 100_000
"""Pixels that are processed together."""
MAX_POINTS = 6_000_000
"""Maximum number of points along each of the three sides of all triangles."""
_HALO = GROUND_BLOCK // 2 + 2  # rows above and below a band that its filter and its edges need
_CONTRAST = 0.035  # sRGB difference between neighbours above which a pixel gets more rays


def _lattice(count: int, step: int) -> Float[Floats, "count 2"]:
    """Offsets from the middle of a pixel, one in every row and column: edges of any slope are anti-aliased well."""
    return (np.stack([np.arange(count), (step * np.arange(count)) % count], axis=1) + 0.5) / count - 0.5


_OUTLINE_SAMPLES, _INNER_SAMPLES = _lattice(16, 7), _lattice(8, 3)  # at outlines; where colors meet


@dataclass(frozen=True)
class Viewport:
    """The part of the picture plane that is shown: the upper left corner of the first pixel, and the size of a pixel."""

    width: int
    height: int
    left: float
    top: float
    pixel: float

    def at(self, column: NDArray[Any], row: NDArray[Any]) -> tuple[Float[Floats, " ..."], Float[Floats, " ..."]]:
        """x and y in the picture plane of positions in pixels from the upper left corner."""
        return self.left + self.pixel * column, self.top - self.pixel * row


@dataclass(frozen=True, eq=False)
class Layer:
    """Linear light times alpha, alpha, and depth: z of the visible surface, -inf where there is none."""

    light: Float[Floats32, "H W 3"]
    alpha: Float[Floats32, "H W"]
    depth: Float[Floats32, "H W"]


def draw(scene: Scene, viewport: Viewport) -> Layer:
    """Draw a scene. The result does not depend on the size of bands."""
    H, W = viewport.height, viewport.width
    layer = Layer(np.zeros((H, W, 3), np.float32), np.zeros((H, W), np.float32), np.full((H, W), -np.inf, np.float32))
    edges = edge_points(scene, viewport)
    rows = max(1, BAND // W)
    for first in range(0, H, rows):
        _draw_band(scene, viewport, edges, first, min(H, first + rows), layer)
    return layer


def _draw_band(scene: Scene, viewport: Viewport, edges: Vectors, first: int, last: int, layer: Layer) -> None:
    """Draw rows ``first`` to ``last`` of a viewport into ``layer``."""
    low, high = max(0, first - _HALO), min(viewport.height, last + _HALO)
    shape = (high - low, viewport.width)
    row, column = np.divmod(np.arange(shape[0] * shape[1]), viewport.width)
    row += low
    hits = scene.trace(*viewport.at(column + 0.5, row + 0.5), viewport.pixel)
    hit_rows = np.flatnonzero(hits.face != -1)
    visible = np.ones((len(hits.face), 2), np.float32)
    visible[hit_rows] = visibility(scene, hits, hit_rows, row[hit_rows], column[hit_rows])
    for side, which in ((BLOCK, hits.face >= 0), (GROUND_BLOCK, hits.face == -2)):
        _filter_visibility(visible.reshape(*shape, 2), hits, which.reshape(shape), viewport.pixel, side)
    light, alpha = _shade_hits(scene, hits, visible)
    light, alpha = light.reshape(*shape, 3), alpha.reshape(shape)
    depth = np.where(hits.face >= 0, hits.place[:, 2], -np.inf).reshape(shape).astype(np.float32)
    is_surface = hits.face.reshape(shape) >= 0
    outline = _has_contrast(is_surface.astype(np.float32)[..., None], 0.5) | _find_slivers(edges, low, depth, viewport)
    inner = (
        _has_contrast(np.sqrt(np.clip(np.concatenate([light, alpha[..., None]], axis=2), 0, 1)), _CONTRAST) & ~outline
    )
    for chosen, places in ((outline, _OUTLINE_SAMPLES), (inner, _INNER_SAMPLES)):
        chosen[: first - low] = chosen[last - low :] = False
        found = np.flatnonzero(chosen)
        if len(found):
            supersampled = _supersample(scene, viewport, hits, visible, low, found, places)
            light.reshape(-1, 3)[found], alpha.reshape(-1)[found] = supersampled
    inner_rows = slice(first - low, last - low)
    layer.light[first:last], layer.alpha[first:last] = light[inner_rows], alpha[inner_rows]
    layer.depth[first:last] = depth[inner_rows]


def _shade_hits(scene: Scene, hits: Hits, seen: Shares) -> tuple[Vectors, Float[Floats32, " N"]]:
    """Light times alpha, and alpha, of all rays."""
    light, alpha = np.zeros((len(hits.face), 3), np.float32), np.zeros(len(hits.face), np.float32)
    solid = np.flatnonzero(hits.face >= 0)
    light[solid] = shade(hits, solid, seen[solid])
    alpha[solid] = 1.0
    if scene.opacity < 1:  # glass: clear in the middle, dense at the rim
        rim = (1 - hits.normal[solid, 2]) ** 2
        alpha[solid] = scene.opacity + (1 - scene.opacity) * 0.7 * rim
        light[solid] *= alpha[solid, None]
    ground = np.flatnonzero(hits.face == -2)
    alpha[ground] = shadow(seen[ground]) * hits.color[ground, 0]
    return light, alpha


def composite(glass: Layer, base: Layer, reach: float) -> Layer:
    """Put glass over a base layer, which hides it gradually where it lies up to ``reach`` behind."""
    with np.errstate(invalid="ignore"):
        ahead = np.nan_to_num((glass.depth - base.depth) / np.float32(reach) + 1, nan=1.0, posinf=1.0, neginf=0.0)
    uncovered = np.clip(ahead, 0, 1).astype(np.float32)
    transmitted = 1 - glass.alpha * uncovered
    return Layer(
        glass.light * uncovered[..., None] + base.light * transmitted[..., None],
        glass.alpha * uncovered + base.alpha * transmitted,
        np.maximum(glass.depth, base.depth),
    )


def _filter_visibility(
    values: Float[Floats32, "H W 2"], hits: Hits, which: Bool[Bools, "H W"], pixel: float, side: int
) -> None:
    """Filter visibility of pixels ``which`` in place over blocks with this side, without mixing different surfaces."""
    if not which.any():
        return
    rows, columns = (np.flatnonzero(which.any(axis=axis)) for axis in (1, 0))
    part = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    shape = which.shape
    place, flat, normal = (a.reshape(*shape, 3)[part] for a in (hits.place, hits.flat, hits.normal))
    which, found = which[part], values[part]
    half = side // 2
    for axis in (0, 1):
        total, weights = found.copy(), np.ones(which.shape, np.float32)
        for step in (*range(-half, 0), *range(1, half + 1)):
            here, there = _shifted_slices(step, axis, (len(which), which.shape[1]))
            gap = np.einsum("hwi,hwi->hw", place[there] - place[here], flat[here])
            turn = np.einsum("hwi,hwi->hw", normal[there], normal[here])
            weight = _same_surface(gap, turn, pixel)
            # Half the weight at both ends: each position in a block then weighs the same.
            weight *= np.float32(0.5 if abs(step) == half else 1.0) * (which[there] & which[here])
            total[here] += weight[..., None] * found[there]
            weights[here] += weight
        found = total / weights[..., None]
    values[part] = np.where(which[..., None], found, values[part])


def _same_surface(gap: Floats32, cosine: Floats32, pixel: float) -> Floats32:
    """Weight 0..1 of a pair of places: 1 if they are within two pixels of one plane (``gap``) with similar normals."""
    return np.asarray(np.clip(3.0 - np.abs(gap) / np.float32(pixel), 0, 1) * np.clip(4 * cosine - 2.4, 0, 1))


def _shifted_slices(step: int, axis: int, shape: tuple[int, int]) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    """Slices that select each pixel, and the one ``step`` further along the axis."""
    count, before = max(0, shape[axis] - abs(step)), (slice(None),) * axis
    here, there = max(0, -step), max(0, step)
    return (*before, slice(here, here + count)), (*before, slice(there, there + count))


def _has_contrast(values: Float[Floats32, "H W C"], by: float) -> Bool[Bools, "H W"]:
    """Pixels that differ from a neighbour by more than ``by``, so that an edge may pass through them."""
    shape = values.shape[0], values.shape[1]
    result = np.zeros(shape, bool)
    for axis in (0, 1):
        here, there = _shifted_slices(1, axis, shape)
        differs = (np.abs(values[there] - values[here]) > by).any(axis=2)
        result[here] |= differs
        result[there] |= differs
    return result


def _supersample(
    scene: Scene,
    viewport: Viewport,
    hits: Hits,
    seen: Float[Floats32, "P 2"],
    low: int,
    chosen: Rows,
    places: Float[Floats, "R 2"],
) -> tuple[Vectors, Float[Floats32, " N"]]:
    """Light times alpha, and alpha, of chosen pixels of a band, each averaged over places in it. Visibility is taken from
    surrounding pixels on the same surface, where there are any.
    """
    shape = (len(hits.face) // viewport.width, viewport.width)
    row, column = np.divmod(np.repeat(chosen, len(places)), shape[1])
    right, down = np.tile(places, (len(chosen), 1)).T
    rays = viewport.at(column + 0.5 + right, row + low + 0.5 + down)
    finer = scene.trace(*rays, viewport.pixel / np.sqrt(len(places)))
    hit_rows = np.flatnonzero(finer.face != -1)
    total, weights = np.zeros((len(hit_rows), 2), np.float32), np.zeros(len(hit_rows), np.float32)
    for down, right in ((0, 0), (0, 1), (1, 0), (0, -1), (-1, 0)):
        there = np.clip(row[hit_rows] + down, 0, shape[0] - 1) * shape[1] + np.clip(
            column[hit_rows] + right, 0, shape[1] - 1
        )
        gap = np.einsum("ni,ni->n", hits.place[there] - finer.place[hit_rows], finer.flat[hit_rows])
        turn = np.einsum("ni,ni->n", hits.normal[there], finer.normal[hit_rows])
        face = hits.face[there]
        same_kind = ((face >= 0) == (finer.face[hit_rows] >= 0)) & (face != -1)
        weight = _same_surface(gap, turn, viewport.pixel) * same_kind
        total += weight[:, None] * seen[there]
        weights += weight
    known = weights > 0.05
    light_seen = np.ones((len(row), 2), np.float32)
    light_seen[hit_rows[known]] = total[known] / weights[known, None]
    missing = hit_rows[~known]
    # Each ray of a pixel uses other directions, independent of the band.
    number = missing % len(places)
    block_row, block_column = (row[missing] + low) * BLOCK + number // BLOCK, column[missing] * BLOCK + number % BLOCK
    light_seen[missing] = visibility(scene, finer, missing, block_row, block_column)
    light, alpha = _shade_hits(scene, finer, light_seen)
    return light.reshape(len(chosen), -1, 3).mean(axis=1), alpha.reshape(len(chosen), -1).mean(axis=1)


def edge_points(scene: Scene, viewport: Viewport) -> Vectors:
    """(N, 3) points along all edges of the scene, at most a pixel apart: column, row, depth."""
    column = (scene.verts[:, 0] - np.float32(viewport.left)) / np.float32(viewport.pixel)
    row = (np.float32(viewport.top) - scene.verts[:, 1]) / np.float32(viewport.pixel)
    points = np.stack([column, row, scene.verts[:, 2]], axis=1)
    parts = [points]
    for first, second in ((0, 1), (1, 2), (2, 0)):
        a, b = points[scene.faces[:, first]], points[scene.faces[:, second]]
        steps = np.ceil(np.abs(b[:, :2] - a[:, :2]).max(axis=1)) - 1
        crowd = steps.sum(dtype=np.float64) / MAX_POINTS
        steps = (steps / max(1.0, crowd)).astype(np.int64)  # among millions of long edges most are hidden anyway
        long = np.flatnonzero(steps > 0)
        count = steps[long]
        which = np.repeat(long, count)
        number = 1 + np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        share = (number / np.repeat(count + 1, count)).astype(np.float32)[:, None]
        parts.append((1 - share) * a[which] + share * b[which])
    return np.concatenate(parts)


def _find_slivers(edges: Vectors, low: int, depth: Float[Floats32, "H W"], viewport: Viewport) -> Bool[Bools, "H W"]:
    """Pixels, from row ``low`` on, in which an edge lies in front of everything that the rays around it hit: triangles
    thinner than a pixel.
    """
    H, W = depth.shape
    row, column = edges[:, 1] - low, edges[:, 0]
    inside = np.flatnonzero((row >= 0) & (row < H) & (column >= 0) & (column < W))
    row, column = row[inside].astype(np.int64), column[inside].astype(np.int64)
    padded = np.pad(depth, 1, constant_values=-np.inf)
    front = np.max([padded[i : i + H, j : j + W] for i in range(3) for j in range(3)], axis=0)
    in_front = edges[inside, 2] > front[row, column] + 1.5 * viewport.pixel
    result = np.zeros((H, W), bool)
    result[row[in_front], column[in_front]] = True
    return result
