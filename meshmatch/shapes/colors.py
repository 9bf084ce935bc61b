"""Colors: as files write them (sRGB), the light that they stand for, in which averages are taken, and those of labels.

IEC 61966-2-1. Half black and half white seen from afar is 188 of 255, not 128: so colors are mixed as light.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from meshmatch.arrays import Float, Floats, Floats32, UInt8, UInts8

UNKNOWN = (0.62, 0.64, 0.67)
"""What has no value."""
INVISIBLE = 0.05
"""An alpha below this is not seen."""
_STEPS = 1 << 14  # of the table of `bytes_of`


def to_linear(srgb: ArrayLike) -> Float[Floats, ...]:
    """Light of a color in 0..1 as files and screens write it."""
    srgb = np.asarray(srgb, np.float64)
    return np.where(srgb <= 0.04045, srgb / 12.92, ((np.maximum(srgb, 0.0) + 0.055) / 1.055) ** 2.4)


def to_srgb(linear: ArrayLike) -> Float[Floats, ...]:
    """A color in 0..1 as files and screens write it, of an amount of light; the inverse of `to_linear`."""
    light = np.clip(np.asarray(linear, np.float64), 0.0, 1.0)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def light(colors: Float[Floats, "*N C"]) -> Float[Floats, "*N C"]:
    """Light of colors (..., 3 or 4) as screens show them; alpha is left as it is."""
    return np.concatenate([to_linear(colors[..., :3]), colors[..., 3:]], axis=-1)


def seen(amounts: Float[Floats, "V 4"]) -> Float[Floats, "V 4"]:
    """Colors as screens show them (sRGB, 0..1) of light; nan is black."""
    amounts = np.clip(np.nan_to_num(amounts), 0.0, 1.0)
    return np.concatenate([to_srgb(amounts[:, :3]), amounts[:, 3:]], axis=1)


LINEAR_OF_BYTE: Floats32 = to_linear(np.arange(256) / 255.0).astype(np.float32)
"""(256,) light of each byte of an image."""

# By the square root of the light, which spreads the dark end: a step of the table is below a tenth of a byte's.
_BYTE_OF_ROOT: UInts8 = np.round(255.0 * to_srgb((np.arange(_STEPS + 1) / _STEPS) ** 2)).astype(np.uint8)


def bytes_of(linear: Float[Floats32, ...]) -> UInt8[UInts8, ...]:
    """The nearest byte of an image for amounts of light in 0..1, of any shape; what lies outside is clipped."""
    root = np.sqrt(np.clip(linear, 0.0, 1.0, dtype=np.float32))
    return np.asarray(_BYTE_OF_ROOT.take((root * np.float32(_STEPS) + np.float32(0.5)).astype(np.int32)))


_ROOTS_OF_OKLAB = np.array(
    [[1.0, 1.0, 1.0], [0.3963377774, -0.1055613458, -0.0894841775], [0.2158037573, -0.0638541728, -1.291485548]]
)
_LIGHT_OF_CUBES = np.array(
    [
        [4.0767416621, -1.2684380046, -0.0041960863],
        [-3.3077115913, 2.6097574011, -0.7034186147],
        [0.2309699292, -0.3413193965, 1.7076147010],
    ]
)


def oklab_to_linear(lab: Float[Floats, "N 3"]) -> Float[Floats, "N 3"]:
    """Light of colors in Oklab, where equal steps look equal (Ottosson 2020)."""
    return np.asarray((lab @ _ROOTS_OF_OKLAB) ** 3 @ _LIGHT_OF_CUBES)


def label_colors(labels: ArrayLike) -> Float[Floats, "N 3"]:
    """Written colors of labels (N,): the same for the same label always, and neighbours far apart."""
    number = np.asarray(labels, dtype=np.int64)
    # Hue by the golden angle; three rings of lightness, so that many labels stay apart.
    hue = np.radians(28.0 + 137.50776 * (number % 1000))
    light = np.array([0.68, 0.80, 0.55])[number % 3]
    chroma = np.array([0.145, 0.115, 0.12])[number % 3]
    lab = np.stack([light, chroma * np.cos(hue), chroma * np.sin(hue)], axis=-1)
    return np.where((number >= 0)[..., None], to_srgb(oklab_to_linear(lab)), UNKNOWN)
