"""Images in ever smaller sizes, made of their known texels alone.

Every texel of a smaller level is the mean, in light, of those known among its four; texels that nobody painted
then take the colour of the next smaller level. So a mip level that a viewer makes of a filled image never shows
a background: each of its texels that touches a chart is the mean of chart texels.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from meshmatch.arrays import Bools, Floats32, Ints, Ints32, UInts8
from meshmatch.shapes.appearance import Material, Pixels, Wrap
from meshmatch.shapes.colors import LINEAR_OF_BYTE, bytes_of

_ROWS = 256  # at a time


def fill(pixels: Pixels, weight: Floats32) -> list[Pixels]:
    """Smaller levels of (H, W, 4) pixels, each half as large, down to one texel; unknown texels are filled.

    Parameters
    ----------
    pixels : (H, W, 4) uint8
        Changed in place where `weight` is 0.
    weight : (H, W) float32
        How much each texel counts: 0 unknown.

    Returns
    -------
    list of (h, w, 4) uint8
        All levels, `pixels` first. If nothing at all is known, everything counts.
    """
    levels, weights = [pixels], [weight if (weight > 0).any() else np.ones_like(weight)]
    while max(levels[-1].shape[:2]) > 1:
        smaller, lighter = _halved(levels[-1], weights[-1])
        levels.append(smaller)
        weights.append(lighter)
    for k in range(len(levels) - 2, -1, -1):
        for low in range(0, len(levels[k]), _ROWS):
            part = levels[k][low : low + _ROWS]
            unknown = weights[k][low : low + _ROWS] <= 0
            if unknown.any():
                row = np.arange(low, low + len(part)) // 2
                larger = levels[k + 1][row][:, np.arange(part.shape[1]) // 2]
                part[unknown] = larger[unknown]
    return levels


def _halved(pixels: Pixels, weight: Floats32) -> tuple[Pixels, Floats32]:
    height, width = pixels.shape[:2]
    out = np.zeros(((height + 1) // 2, (width + 1) // 2, 4), np.uint8)
    total = np.zeros(out.shape[:2], np.float32)
    for low in range(0, height, 2 * _ROWS):
        part, heavy = pixels[low : low + 2 * _ROWS], weight[low : low + 2 * _ROWS]
        odd = ((0, len(part) % 2), (0, width % 2))
        if odd != ((0, 0), (0, 0)):
            part, heavy = np.pad(part, (*odd, (0, 0))), np.pad(heavy, odd)
        rows = slice(low // 2, low // 2 + len(part) // 2)
        light = np.empty((*part.shape[:2], 4), np.float32)
        light[..., :3] = LINEAR_OF_BYTE.take(part[..., :3])
        light[..., 3] = part[..., 3]
        known = _sum_of_fours(heavy[..., None])
        mean = (_sum_of_fours(light * heavy[..., None]) / np.maximum(known, 1e-20)).astype(np.float32)
        out[rows, :, :3] = bytes_of(mean[..., :3])
        out[rows, :, 3] = np.round(mean[..., 3])
        total[rows] = known[..., 0]
    return out, np.minimum(total, 1.0)


def _sum_of_fours(values: Floats32) -> Floats32:
    return (values[0::2, 0::2] + values[1::2, 0::2]) + (values[0::2, 1::2] + values[1::2, 1::2])


@dataclass(frozen=True, eq=False)
class Pyramid:
    """An image with its smaller levels, ready to be looked up.

    Parameters
    ----------
    texels : (N,) uint32
        All levels one after the other: red, green, blue and alpha in one number.
    starts, widths, heights : (L,) int64
    wrap : two of "repeat", "clamp", "mirror"
    nearest : bool
        True: the largest level is not blended.
    """

    texels: NDArray[np.uint32]
    starts: Ints
    widths: Ints
    heights: Ints
    wrap: tuple[Wrap, Wrap] = ("repeat", "repeat")
    nearest: bool = False

    @classmethod
    def of(cls, material: Material, known: Bools | None = None) -> Pyramid:
        """The pyramid of a material's image; what is not `known` (H, W), or fully transparent, is made up from
        its surroundings.
        """
        assert material.image is not None
        pixels = material.image.copy()
        weight = np.ones(pixels.shape[:2], np.float32) if known is None else known.astype(np.float32)
        if material.alpha == "opaque":
            pixels[..., 3] = 255
        else:
            weight *= pixels[..., 3] / np.float32(255)
            alpha = pixels[..., 3].copy()
        levels = fill(pixels, weight)
        if material.alpha != "opaque":  # colours are made up, not the holes between them
            pixels[..., 3] = alpha
            levels[1:] = [
                np.concatenate([level[..., :3], share[..., None]], axis=-1)
                for level, share in zip(levels[1:], _means(alpha), strict=True)
            ]
        sizes = [level.shape[:2] for level in levels]
        counts = np.array([height * width for height, width in sizes])
        flat = np.concatenate([np.ascontiguousarray(level).view(np.uint32).ravel() for level in levels])
        return cls(
            flat,
            np.cumsum(counts) - counts,
            np.array([width for _, width in sizes]),
            np.array([height for height, _ in sizes]),
            material.wrap,
            material.nearest,
        )

    def look(self, u: Floats32, v: Floats32, footprint: Floats32) -> Floats32:
        """Linear colours and alpha (4, N) at (N,), (N,), as wide as `footprint` (N,) texels of the largest level."""
        level = np.log2(np.maximum(footprint, np.float32(1.0)))
        level = np.minimum(level, np.float32(len(self.starts) - 1))
        whole = level.astype(np.int32)
        rest = level - whole.astype(np.float32)
        out = self._blended(u, v, whole)
        between = np.flatnonzero(rest > 0)
        if len(between):
            next_level = self._blended(u[between], v[between], whole[between] + 1)
            out[:, between] = _mixed(out[:, between], next_level, rest[between])
        return out

    def _blended(self, u: Floats32, v: Floats32, level: Ints32) -> Floats32:
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
        columns = [wrapped(left + k, width, self.wrap[0]) for k in (0, 1)]
        rows = [start + width * wrapped(top + k, height, self.wrap[1]) for k in (0, 1)]
        corners = [self.texels.take(row + column) for row in rows for column in columns]
        out = np.empty((4, len(u)), np.float32)
        for k in range(4):
            a, b, c, d = (_light(texel, k) for texel in corners)
            out[k] = _mixed(_mixed(a, b, across), _mixed(c, d, across), down)
        return out


_SHARE: Floats32 = (np.arange(256) / 255.0).astype(np.float32)


def _light(texels: NDArray[np.uint32], channel: int) -> Floats32:
    """Floats32 of red, green or blue, or alpha as it is, of texels whose bytes come in this order."""
    shift = 8 * channel if sys.byteorder == "little" else 24 - 8 * channel
    byte = (texels >> np.uint32(shift)).astype(np.uint8)
    return (_SHARE if channel == 3 else LINEAR_OF_BYTE).take(byte)


def _mixed(a: Floats32, b: Floats32, share: Floats32) -> Floats32:
    return a + share * (b - a)


def _means(alpha: UInts8) -> list[UInts8]:
    """Smaller levels of an alpha channel; beyond its edge there is nothing that counts."""
    values, weight = alpha.astype(np.float32), np.ones(alpha.shape, np.float32)
    out = []
    while max(values.shape) > 1:
        odd = tuple((0, n % 2) for n in values.shape)
        values, weight = np.pad(values, odd), np.pad(weight, odd)
        total, many = (_sum_of_fours(a[..., None])[..., 0] for a in (values * weight, weight))
        values, weight = total / many, np.minimum(many, 1.0)
        out.append(np.round(values).astype(np.uint8))
    return out


def wrapped(index: Ints, size: Ints | int, wrap: Wrap) -> Ints:
    """Texel numbers brought into 0 <= index < size as a sampler does."""
    if wrap == "clamp":
        return np.clip(index, 0, np.asarray(size) - 1)
    if wrap == "repeat":
        return index % size
    folded = index % (2 * np.asarray(size))
    return np.minimum(folded, 2 * size - 1 - folded)
