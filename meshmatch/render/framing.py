"""Where things stand in a picture: which way a shape is turned, and how several stand in a row.

A figure is a shape on its own ground: turned to face the viewer, the middle of its footprint at the origin, its lowest
point at height 0, the square root of its surface area 1 long (bodies of one kind are then of one size, whatever their
pose and unit).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from meshmatch.shapes.shape import Shape

FloatArray = NDArray[np.float64]

VIEWS = {
    "quarter": (22.0, 10.0),
    "front": (0.0, 8.0),
    "left": (-90.0, 8.0),
    "right": (90.0, 8.0),
    "back": (180.0, 8.0),
    "above": (0.0, 65.0),
}
"""Named views: degrees turned, and leant towards the viewer. Left and right are the sides of the shape itself."""
GAP = 0.16
"""Least room between two figures, in units of sqrt(area)."""


def turned(degrees: float) -> FloatArray:
    """Rotation (3, 3) about the vertical: a shape turns to its own left."""
    a = np.radians(degrees)
    return np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])


def leant(degrees: float) -> FloatArray:
    """Rotation (3, 3) that leans the top towards the viewer."""
    b = np.radians(degrees)
    return np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])


@dataclass(frozen=True, eq=False)
class Stand:
    """How a shape of a file becomes a figure: ``((points @ rotation.T) - foot) / scale``.

    Parameters
    ----------
    rotation : (3, 3)
    foot : (3,)
        The middle of the footprint, after the rotation.
    scale : float
    half : (3,)
        Half the figure's width and depth, and its whole height (in the middle).
    """

    rotation: FloatArray
    foot: FloatArray
    scale: float
    half: FloatArray

    def place(self, points: FloatArray) -> FloatArray:
        """Points (N, 3) of the file on the figure's ground."""
        return np.asarray((points @ self.rotation.T - self.foot) / self.scale)


def stand(shape: Shape, points: FloatArray, rotation: FloatArray) -> Stand:
    """Put a shape on its ground. ``points`` (N, 3) are all that will be drawn of it."""
    placed = points @ rotation.T
    low, high = placed.min(axis=0), placed.max(axis=0)
    longest = float((high - low).max())
    scale = np.sqrt(shape.area)
    # A flat scrap or a lone point has no area to speak of; strays far away would shrink everything else.
    if not 0.2 * longest < scale < 2 * longest:
        scale = longest if longest > 0 else 1.0
    foot = np.array([(low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2])
    half = (high - low) / scale / np.array([2.0, 1.0, 2.0])
    return Stand(rotation, foot, float(scale), half)


@dataclass(frozen=True, eq=False)
class Row:
    """Figures beside each other: x of each one's foot (N,), and the box (2, 2) of all: left, bottom; right, top."""

    feet: FloatArray
    box: FloatArray


def in_a_row(boxes: list[FloatArray], aspect: float | None) -> Row:
    """Place figures beside each other.

    Parameters
    ----------
    boxes
        (2, 2) left, bottom; right, top of each as it is seen, its foot at 0.
    aspect
        Width over height to fill, by wider gaps; None for the narrowest row.
    """
    widths = np.array([box[1, 0] - box[0, 0] for box in boxes])
    bottom, top = min(box[0, 1] for box in boxes), max(box[1, 1] for box in boxes)
    gap = GAP * max(1.0, float(np.median(widths)))
    if aspect is not None and len(boxes) > 1:
        spare = aspect * (top - bottom) - widths.sum()
        gap = float(np.clip(spare / (len(boxes) - 0.5), gap, 3 * gap))
    lefts = np.concatenate([[0.0], np.cumsum(widths + gap)[:-1]])
    feet = lefts - np.array([box[0, 0] for box in boxes])
    return Row(feet, np.array([[0.0, bottom], [lefts[-1] + widths[-1], top]]))
