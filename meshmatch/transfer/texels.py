"""Rasterization of texture coordinates, and image pyramids (mipmaps).

A pyramid is built from known texels alone: every texel of a smaller level is the mean, in linear light, of the known ones
among its four, and unknown texels then take the color of the next smaller level. A mip level that a viewer makes of a filled
image therefore never shows a background: each of its texels that touches a chart is the mean of texels of charts.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshmatch.arrays import Bools, Floats, Floats32, Ints, Ints32, UInts8
from meshmatch.shapes.appearance import Appearance, Material, Pixels, Wrap
from meshmatch.shapes.colors import BYTE_TO_LINEAR, linear_to_bytes

_CHUNK = 1 << 21  # texels
_BAND = 64  # rows of an image that are processed together
MAX_ROWS = 40_000_000
"""Maximum number of rows that all triangles cross together; coordinates with more are no atlas."""
# Neighbours of a texel, as offsets down and to the right: direct ones before diagonal ones.
_NEIGHBOURS = ((1, 0), (0, 1), (0, -1), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1))
# The four texels that become one of the next level.
_QUADS = tuple((slice(row, None, 2), slice(column, None, 2)) for column in (0, 1) for row in (0, 1))
_BYTE_VALUES: Floats32 = np.arange(256, dtype=np.float32)
_BYTE_SHARES: Floats32 = (np.arange(256) / 255.0).astype(np.float32)


def count_rows(corners: Floats) -> Ints:
    """(F,) number of rows of texel centers that each triangle (F, 3, 2) crosses; coordinates count texels."""
    y = corners[:, :, 1]
    return np.asarray(np.ceil(y.max(axis=1) - 0.5) - np.ceil(y.min(axis=1) - 0.5), np.int64)


def covered_texels(corners: Floats) -> Iterator[tuple[Ints, Ints, Ints]]:
    """Yield face, column and row of the texels, not limited to an image, whose center lies in a triangle (F, 3, 2).

    Coordinates count texels; some millions are yielded at a time. A center on an edge belongs to exactly one of the two
    triangles that share the edge.
    """
    order = np.lexsort((corners[:, :, 0], corners[:, :, 1]), axis=1)
    top, middle, low = (np.take_along_axis(corners, order[:, k, None, None], axis=1)[:, 0] for k in range(3))
    first_row = np.ceil(top[:, 1] - 0.5).astype(np.int64)
    rows = np.ceil(low[:, 1] - 0.5).astype(np.int64) - first_row
    face = np.repeat(np.arange(len(corners)), rows)
    row = np.arange(len(face)) - np.repeat(np.cumsum(rows) - rows, rows) + first_row[face]
    y = row + 0.5
    long_edge = _crossing(top[face], low[face], y)
    upper = (y < middle[face, 1])[:, None]
    short_edge = _crossing(np.where(upper, top[face], middle[face]), np.where(upper, middle[face], low[face]), y)
    first = np.ceil(np.minimum(long_edge, short_edge) - 0.5).astype(np.int64)
    length = np.ceil(np.maximum(long_edge, short_edge) - 0.5).astype(np.int64) - first
    some = length > 0
    face, row, first, length = face[some], row[some], first[some], length[some]
    ends = np.cumsum(length)
    begin, done = 0, 0
    while begin < len(ends):
        end = max(int(np.searchsorted(ends, done + _CHUNK, side="right")), begin + 1)
        run = np.repeat(np.arange(begin, end), length[begin:end])
        column = first[run] + np.arange(done, ends[end - 1]) - (ends - length)[run]
        yield face[run], column, row[run]
        begin, done = end, int(ends[end - 1])


def _crossing(begin: Floats, end: Floats, y: Floats) -> Floats:
    """x where edges cross rows. A shared edge is passed in one order, so both triangles get the same number."""
    height = end[:, 1] - begin[:, 1]
    share = (y - begin[:, 1]) / np.where(height == 0, 1.0, height)
    return np.asarray(begin[:, 0] + (end[:, 0] - begin[:, 0]) * share)


def draw_triangles(corners: Floats, size: int) -> tuple[Ints32, int]:
    """The triangle (size, size) at each texel of a square image, the last one where several overlap, -1 for none; and the
    number of surplus triangles, summed over texels.
    """
    found = np.full(size * size, -1, np.int32)
    total = 0
    for face, column, row in covered_texels(corners):
        inside = (column >= 0) & (column < size) & (row >= 0) & (row < size)
        found[(row * size + column)[inside]] = face[inside]
        total += int(inside.sum())
    return found.reshape(size, size), total - int((found >= 0).sum())


def grow(found: Ints32, steps: int) -> None:
    """Let each free texel (-1) of (H, W) take the value of a neighbour that is not free; `steps` times, in place."""
    height, width = found.shape
    for _ in range(steps):
        known = found >= 0
        padded = np.pad(known, 1)
        padded = padded[:-2] | padded[1:-1] | padded[2:]
        row, column = np.nonzero((padded[:, :-2] | padded[:, 1:-1] | padded[:, 2:]) & ~known)
        values = np.full(len(row), -1, np.int32)
        for down, right in _NEIGHBOURS:
            r, c = row + down, column + right
            usable = (r >= 0) & (r < height) & (c >= 0) & (c < width) & (values < 0)
            values[usable] = found[r[usable], c[usable]]
        found[row, column] = values


def borders_another(values: Ints32) -> Bools:
    """(H, W) True for texels with a value of 0 or more that have a neighbour (not diagonal) with a different one."""
    out = np.zeros(values.shape, bool)
    for a, b in ((np.s_[1:], np.s_[:-1]), (np.s_[:, 1:], np.s_[:, :-1])):
        differ = (values[a] != values[b]) & (values[a] >= 0) & (values[b] >= 0)
        out[a] |= differ
        out[b] |= differ
    return out


def fill(pixels: Pixels, weight: UInts8, linear: bool = False) -> list[Pixels]:
    """All pyramid levels of (H, W, 4) pixels, largest first, each half as large as the one before, down to one texel.

    Texels with weight (H, W) 0 are filled in, in place; if all weights are 0, all texels count. ``linear`` pixels are plain
    numbers and are averaged without conversion to linear light.
    """
    levels: list[Pixels] = [pixels]
    weights: list[UInts8 | Floats32] = [weight if weight.any() else np.ones_like(weight)]
    while max(levels[-1].shape[:2]) > 1:
        smaller, smaller_weights = _next_level(levels[-1], weights[-1], linear)
        levels.append(smaller)
        weights.append(smaller_weights)
    for k in range(len(levels) - 2, -1, -1):
        for low in range(0, len(levels[k]), _BAND):
            part = levels[k][low : low + _BAND]
            unknown = weights[k][low : low + _BAND] <= 0
            if unknown.any():
                row = np.arange(low, low + len(part)) // 2
                larger = levels[k + 1][row][:, np.arange(part.shape[1]) // 2]
                part[unknown] = larger[unknown]
    return levels


def _next_level(pixels: Pixels, weight: UInts8 | Floats32, linear: bool) -> tuple[Pixels, Floats32]:
    """Weighted means of 2 x 2 pixels, and the weight sums, at most 1; outside the image weights are 0."""
    out = np.zeros((*_half_shape(weight.shape), 4), np.uint8)
    total = np.zeros(out.shape[:2], np.float32)
    table = _BYTE_VALUES if linear else BYTE_TO_LINEAR
    for rows, whole in _bands(weight.shape):
        part, part_weights = _pad_even(pixels[whole]), _pad_even(weight[whole])
        shares = part_weights if part_weights.dtype == np.float32 else _BYTE_SHARES.take(part_weights)
        weights_sum = _sum_of_quads([shares[at] for at in _QUADS])
        safe = np.maximum(weights_sum, 1e-20)
        for k in range(4):
            amounts = _BYTE_VALUES if k == 3 else table
            sums = _sum_of_quads([amounts.take(part[(*at, k)]) * shares[at] for at in _QUADS])
            mean = (sums / safe).astype(np.float32)
            out[rows, :, k] = np.round(mean) if amounts is _BYTE_VALUES else linear_to_bytes(mean)
        total[rows] = np.minimum(weights_sum, np.float32(1.0))
    return out, total


def _halve(values: UInts8 | Floats32, weight: Floats32) -> tuple[Floats32, Floats32]:
    """The same for single channels (H, W), which are not rounded."""
    means, total = np.zeros(_half_shape(weight.shape), np.float32), np.zeros(_half_shape(weight.shape), np.float32)
    for rows, whole in _bands(weight.shape):
        shares = _pad_even(weight[whole])
        products = _pad_even(values[whole]) * shares
        sums, known = (_sum_of_quads([each[at] for at in _QUADS]) for each in (products, shares))
        means[rows] = sums / np.maximum(known, 1e-20)
        total[rows] = np.minimum(known, np.float32(1.0))
    return means, total


def _half_shape(shape: tuple[int, ...]) -> tuple[int, int]:
    return (shape[0] + 1) // 2, (shape[1] + 1) // 2


def _bands(shape: tuple[int, ...]) -> Iterator[tuple[slice, slice]]:
    """Yield slices of rows of the next level, and of the rows they are computed from."""
    for low in range(0, shape[0], 2 * _BAND):
        high = min(low + 2 * _BAND, shape[0])
        yield slice(low // 2, (high + 1) // 2), slice(low, high)


def _pad_even(values: NDArray[Any]) -> NDArray[Any]:
    """Pad the last row and column with zeros where their number is odd."""
    odd = tuple((0, n % 2) for n in values.shape[:2])
    return values if odd == ((0, 0), (0, 0)) else np.pad(values, (*odd, *((0, 0),) * (values.ndim - 2)))


def _sum_of_quads(four: list[Floats32]) -> Floats32:
    return (four[0] + four[1]) + (four[2] + four[3])


class Pyramid:
    """A material's image with its smaller levels; texels that are not `known` (H, W), or fully transparent, are filled in
    from their surroundings.
    """

    def __init__(self, material: Material, known: Bools | None = None) -> None:
        assert material.image is not None
        pixels = material.image.copy()
        alpha = pixels[..., 3].copy()
        weight = np.full_like(alpha, 255) if material.alpha == "opaque" else alpha.copy()
        if material.alpha == "opaque":
            pixels[..., 3] = 255
        if known is not None:
            weight *= known
        levels = fill(pixels, weight, material.linear)
        self.table = _BYTE_SHARES if material.linear else BYTE_TO_LINEAR
        if material.alpha != "opaque":  # colors are filled in, but not the holes between them
            pixels[..., 3] = alpha
            means: UInts8 | Floats32 = alpha
            share: Floats32 = np.broadcast_to(np.float32(1.0), alpha.shape)
            for level in levels[1:]:
                means, share = _halve(means, share)
                level[..., 3] = np.round(means)
        self.heights, self.widths = np.array([level.shape[:2] for level in levels]).T
        # All levels in one array; a texel's red, green, blue and alpha are one number.
        self.texels = np.concatenate([np.ascontiguousarray(level).view(np.uint32).ravel() for level in levels])
        self.starts = np.cumsum(self.heights * self.widths) - self.heights * self.widths
        self.wrap, self.nearest = material.wrap, material.nearest

    def sample(self, u: Floats32, v: Floats32, footprint: Floats32) -> Floats32:
        """(4, N) linear colors and alpha at u, v (N,), averaged over `footprint` (N,) texels of the largest level."""
        level = np.log2(np.maximum(footprint, np.float32(1.0)))
        level = np.minimum(level, np.float32(len(self.starts) - 1))
        whole = level.astype(np.int32)
        rest = level - whole.astype(np.float32)
        out = self._bilinear(u, v, whole)
        between = np.flatnonzero(rest > 0)
        if len(between):
            next_level = self._bilinear(u[between], v[between], whole[between] + 1)
            out[:, between] = _lerp(out[:, between], next_level, rest[between])
        return out

    def _bilinear(self, u: Floats32, v: Floats32, level: Ints32) -> Floats32:
        one = len(level) == 0 or bool((level == level[0]).all())
        pick = level[0] if one and len(level) else level
        width, height, start = self.widths[pick], self.heights[pick], self.starts[pick]
        # a texel of level k covers 2^k texels of level 0, also where the size is odd
        smaller = np.float32(0.5) ** np.asarray(pick, np.float32)
        x = u * (np.float32(self.widths[0]) * smaller) - np.float32(0.5)
        y = v * (np.float32(self.heights[0]) * smaller) - np.float32(0.5)
        left, top = np.floor(x), np.floor(y)
        across, down = x - left, y - top
        if self.nearest:
            sharp = level == 0
            across, down = (np.where(sharp, np.round(s), s).astype(np.float32) for s in (across, down))
        left, top = left.astype(np.int64), top.astype(np.int64)
        columns = [wrap_index(left + k, width, self.wrap[0]) for k in (0, 1)]
        rows = [start + width * wrap_index(top + k, height, self.wrap[1]) for k in (0, 1)]
        corners = [self.texels.take(row + column) for row in rows for column in columns]
        out = np.empty((4, len(u)), np.float32)
        for k in range(4):
            a, b, c, d = (_channel(texel, k, _BYTE_SHARES if k == 3 else self.table) for texel in corners)
            out[k] = _lerp(_lerp(a, b, across), _lerp(c, d, across), down)
        return out


def build_pyramids(
    look: Appearance, known: Callable[[Material, Floats], Bools | None] = lambda material, uv: None
) -> dict[int, Pyramid]:
    """Pyramids by material number, of the materials that have an image and a face; materials with the same image and sampler
    share one.

    ``known`` returns the known texels (H, W) of a material, given the coordinates (F, 3, 2) of all faces that share it.
    """
    keys = [(id(m.image), m.wrap, m.nearest, m.alpha == "opaque", m.linear) for m in look.materials]
    used = [k for k in np.unique(look.material).tolist() if look.materials[k].image is not None]
    by_key: dict[tuple[object, ...], Pyramid] = {}
    group = {key: k for k, key in enumerate(dict.fromkeys(keys))}
    group_of_face = np.array([group[key] for key in keys], np.int64)[look.material] if keys else look.material
    order = np.argsort(group_of_face, kind="stable")
    begins = np.searchsorted(group_of_face[order], np.arange(len(group) + 1))
    for number in used:
        if keys[number] not in by_key:
            k = group[keys[number]]
            material = look.materials[number]
            by_key[keys[number]] = Pyramid(material, known(material, look.uv[order[begins[k] : begins[k + 1]]]))
    return {number: by_key[keys[number]] for number in used}


def _channel(texels: NDArray[np.uint32], channel: int, table: Floats32) -> Floats32:
    """Table entries of the bytes of one channel (0 red, 1 green, 2 blue, 3 alpha) of packed texels."""
    shift = 8 * channel if sys.byteorder == "little" else 24 - 8 * channel
    return table.take((texels >> np.uint32(shift)).astype(np.uint8))


def _lerp(a: Floats32, b: Floats32, share: Floats32) -> Floats32:
    return a + share * (b - a)


def wrap_index(index: Ints, size: Ints | int, wrap: Wrap) -> Ints:
    """Texel indices wrapped into 0 <= index < size, as by a sampler."""
    if wrap == "clamp":
        return np.clip(index, 0, np.asarray(size) - 1)
    if wrap == "repeat":
        return index % size
    folded = index % (2 * np.asarray(size))
    return np.asarray(np.minimum(folded, 2 * size - 1 - folded))
