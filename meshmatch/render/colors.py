"""Colours that tell places on a shape apart."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from meshmatch.shapes.light import to_linear, to_srgb
from meshmatch.shapes.shape import Shape

FloatArray = NDArray[np.float64]

__all__ = ["CLAY", "oklab_to_linear", "position_colors", "to_linear", "to_srgb"]

CLAY: tuple[float, float, float] = (0.85, 0.82, 0.78)


def position_colors(shape: Shape, rotation: FloatArray | None = None) -> FloatArray:
    """A colour ``(V, 3)`` in 0..1 for every vertex, smooth over space: carried by a map, it shows where
    points went.

    Parameters
    ----------
    rotation
        ``(3, 3)`` into a frame with x to the shape's left, y up and z to its front; the file's own axes
        otherwise.

    Height turns the hue once round most of the circle; left and right shift it and are darker and lighter.
    """
    points = shape.verts if rotation is None else shape.verts @ np.asarray(rotation, dtype=np.float64).T
    used = points if shape.invalid is None else points[~shape.invalid]
    low, high = used.min(axis=0), used.max(axis=0)
    extent = np.where(high > low, high - low, 1.0)
    left, up, front = (2 * np.clip((points - low) / extent, 0.0, 1.0) - 1).T
    hue = np.radians(210.0 - 135.0 * up + 70.0 * left)
    lightness = 0.72 + 0.035 * front - 0.085 * left + 0.06 * np.cos(hue - np.radians(95.0))  # yellow is light
    chroma = 0.125
    lab = np.stack([lightness, chroma * np.cos(hue), chroma * np.sin(hue)], axis=1)
    return np.asarray(to_srgb(oklab_to_linear(lab)))


def oklab_to_linear(lab: FloatArray) -> FloatArray:
    """Light (N, 3) of colours (N, 3) in Oklab, where equal steps look equal (Ottosson 2020)."""
    roots = lab @ np.array(
        [
            [1.0, 1.0, 1.0],
            [0.3963377774, -0.1055613458, -0.0894841775],
            [0.2158037573, -0.0638541728, -1.291485548],
        ]
    )
    return np.asarray(
        roots**3
        @ np.array(
            [
                [4.0767416621, -1.2684380046, -0.0041960863],
                [-3.3077115913, 2.6097574011, -0.7034186147],
                [0.2309699292, -0.3413193965, 1.7076147010],
            ]
        )
    )
