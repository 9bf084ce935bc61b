"""Colours as files write them (sRGB), and the light that they stand for, in which averages are taken.

IEC 61966-2-1. Half black and half white seen from afar is 188 of 255, not 128: so colours are mixed as light.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from meshmatch.arrays import Float, Floats, Floats32, UInt8, UInts8

_STEPS = 1 << 14  # of the table of `bytes_of`


def to_linear(srgb: ArrayLike) -> Float[Floats, ...]:
    """Light of a colour in 0..1 as files and screens write it."""
    srgb = np.asarray(srgb, np.float64)
    return np.where(srgb <= 0.04045, srgb / 12.92, ((np.maximum(srgb, 0.0) + 0.055) / 1.055) ** 2.4)


def to_srgb(linear: ArrayLike) -> Float[Floats, ...]:
    """A colour in 0..1 as files and screens write it, of an amount of light; the inverse of `to_linear`."""
    light = np.clip(np.asarray(linear, np.float64), 0.0, 1.0)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


LINEAR_OF_BYTE: Floats32 = to_linear(np.arange(256) / 255.0).astype(np.float32)
"""(256,) light of each byte of an image."""

# By the square root of the light, which spreads the dark end: a step of the table is below a tenth of a byte's.
_BYTE_OF_ROOT: UInts8 = np.round(255.0 * to_srgb((np.arange(_STEPS + 1) / _STEPS) ** 2)).astype(np.uint8)


def bytes_of(linear: Float[Floats32, ...]) -> UInt8[UInts8, ...]:
    """The nearest byte of an image for amounts of light in 0..1, of any shape; what lies outside is clipped."""
    root = np.sqrt(np.clip(linear, 0.0, 1.0, dtype=np.float32))
    return _BYTE_OF_ROOT.take((root * np.float32(_STEPS) + np.float32(0.5)).astype(np.int32))
