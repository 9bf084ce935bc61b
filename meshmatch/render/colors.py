"""Colours that tell places on a shape apart."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from meshmatch.shapes.shape import Shape

FloatArray = NDArray[np.float64]

CLAY: tuple[float, float, float] = (0.80, 0.79, 0.77)


def position_colors(shape: Shape, rotation: FloatArray | None = None) -> FloatArray:
    """A colour ``(V, 3)`` in 0..1 for every vertex, smooth over space: carried by a map, it shows where
    points went.

    Parameters
    ----------
    rotation
        ``(3, 3)`` into a frame with x to the shape's left, y up and z to its front; the file's own axes
        otherwise.

    Left and right, up and down, front and back change red, green and blue, each over the shape's whole
    extent.
    """
    points = shape.verts if rotation is None else shape.verts @ np.asarray(rotation, dtype=np.float64).T
    used = points if shape.invalid is None else points[~shape.invalid]
    low, high = used.min(axis=0), used.max(axis=0)
    extent = np.where(high > low, high - low, 1.0)
    colors: FloatArray = 0.14 + 0.82 * np.clip((points - low) / extent, 0.0, 1.0)
    return colors


def to_linear(srgb: FloatArray) -> FloatArray:
    """Light of a colour as files and screens write it (IEC 61966-2-1)."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def to_srgb(linear: FloatArray) -> FloatArray:
    """A colour as files and screens write it, of an amount of light; the inverse of `to_linear`."""
    linear = np.clip(linear, 0.0, 1.0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
