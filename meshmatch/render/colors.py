"""Colors that distinguish places on a shape."""

from __future__ import annotations

import numpy as np

from meshmatch.arrays import Float, Floats
from meshmatch.shapes.colors import oklab_to_linear, to_linear, to_srgb
from meshmatch.shapes.shape import Shape

__all__ = ["CLAY", "oklab_to_linear", "position_colors", "to_linear", "to_srgb"]

CLAY: tuple[float, float, float] = (0.85, 0.82, 0.78)


def position_colors(shape: Shape, rotation: Float[Floats, "3 3"] | None = None) -> Float[Floats, "V 3"]:
    """An sRGB color in 0..1 for every vertex, smooth over space: transferred by a map, it shows where points went.

    Height turns the hue nearly once around the circle; left and right shift it and are darker and lighter.
    ``rotation`` leads into a frame with x to the shape's left, y up and z to its front; by default the file's own axes.
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
