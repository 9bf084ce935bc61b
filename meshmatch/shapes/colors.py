"""Color conversions between sRGB and linear light, and colors of labels.

Files store colors as sRGB (IEC 61966-2-1), but averages must be taken of linear light: an even mix of black and white
is 188 of 255 in sRGB, not 128.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from meshmatch.arrays import Float, Floats, Floats32, UInt8, UInts8

UNKNOWN = (0.62, 0.64, 0.67)
"""Color of what has no value."""
INVISIBLE = 0.05
"""Alpha below this is treated as invisible."""
_TABLE_SIZE = 1 << 14  # size of the table for `linear_to_bytes`


def to_linear(srgb: ArrayLike) -> Float[Floats, ...]:
    """Convert sRGB values in 0..1 to linear light."""
    srgb = np.asarray(srgb, np.float64)
    return np.where(srgb <= 0.04045, srgb / 12.92, ((np.maximum(srgb, 0.0) + 0.055) / 1.055) ** 2.4)


def to_srgb(linear: ArrayLike) -> Float[Floats, ...]:
    """Convert linear light to sRGB values in 0..1; the inverse of `to_linear`."""
    light = np.clip(np.asarray(linear, np.float64), 0.0, 1.0)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def srgb_to_linear_alpha(colors: Float[Floats, "*N C"]) -> Float[Floats, "*N C"]:
    """Convert sRGB colors (..., 3 or 4) to linear light; alpha is unchanged."""
    return np.concatenate([to_linear(colors[..., :3]), colors[..., 3:]], axis=-1)


def linear_to_srgb_alpha(amounts: Float[Floats, "V 4"]) -> Float[Floats, "V 4"]:
    """Convert linear colors with alpha to sRGB in 0..1; nan becomes black."""
    amounts = np.clip(np.nan_to_num(amounts), 0.0, 1.0)
    return np.concatenate([to_srgb(amounts[:, :3]), amounts[:, 3:]], axis=1)


BYTE_TO_LINEAR: Floats32 = to_linear(np.arange(256) / 255.0).astype(np.float32)
"""(256,) linear light of each byte of an sRGB image."""

# Indexed by the square root of linear light, which spreads dark values: one step of the table is below a tenth of a
# byte.
_ROOT_TO_BYTE: UInts8 = np.round(255.0 * to_srgb((np.arange(_TABLE_SIZE + 1) / _TABLE_SIZE) ** 2)).astype(np.uint8)


def linear_to_bytes(linear: Float[Floats32, ...]) -> UInt8[UInts8, ...]:
    """Convert linear light in 0..1, of any shape, to the nearest sRGB bytes; values outside are clipped."""
    root = np.sqrt(np.clip(linear, 0.0, 1.0, dtype=np.float32))
    return np.asarray(_ROOT_TO_BYTE.take((root * np.float32(_TABLE_SIZE) + np.float32(0.5)).astype(np.int32)))


_OKLAB_TO_ROOTS = np.array(
    [[1.0, 1.0, 1.0], [0.3963377774, -0.1055613458, -0.0894841775], [0.2158037573, -0.0638541728, -1.291485548]]
)
_CUBES_TO_LINEAR = np.array(
    [
        [4.0767416621, -1.2684380046, -0.0041960863],
        [-3.3077115913, 2.6097574011, -0.7034186147],
        [0.2309699292, -0.3413193965, 1.7076147010],
    ]
)


def oklab_to_linear(lab: Float[Floats, "N 3"]) -> Float[Floats, "N 3"]:
    """Convert Oklab, which is perceptually uniform (Ottosson 2020), to linear light."""
    return np.asarray((lab @ _OKLAB_TO_ROOTS) ** 3 @ _CUBES_TO_LINEAR)


def label_colors(labels: ArrayLike) -> Float[Floats, "N 3"]:
    """sRGB colors of labels (N,): constant for each label, and very different for consecutive labels."""
    label = np.asarray(labels, dtype=np.int64)
    # Hues by the golden angle, and three levels of lightness, so that many labels are distinct.
    hue = np.radians(28.0 + 137.50776 * (label % 1000))
    lightness = np.array([0.68, 0.80, 0.55])[label % 3]
    chroma = np.array([0.145, 0.115, 0.12])[label % 3]
    oklab = np.stack([lightness, chroma * np.cos(hue), chroma * np.sin(hue)], axis=-1)
    return np.where((label >= 0)[..., None], to_srgb(oklab_to_linear(oklab)), UNKNOWN)
