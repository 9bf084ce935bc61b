"""Where everything goes: shapes on a common ground, side by side on the page, with their names and the legend.

A figure is a shape on its own ground: rotated to face the viewer, the middle of its footprint at the origin, its lowest
point at height 0, the square root of its surface area 1 long (bodies of one kind are then of one size, whatever their
pose and unit).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshmatch.arrays import Float, Floats
from meshmatch.errors import OptionError
from meshmatch.render.legend import Legend, legend_height
from meshmatch.shapes.shape import Shape

VIEWS = {
    "quarter": (22.0, 10.0),
    "front": (0.0, 8.0),
    "left": (-90.0, 8.0),
    "right": (90.0, 8.0),
    "back": (180.0, 8.0),
    "above": (0.0, 65.0),
}
"""Named views: turn and tilt in degrees. Left and right are the sides of the shape itself."""
HEIGHT = 800
"""Of a picture whose size is not given, in pixels; its width is what the shapes need."""
_GAP = 0.16  # minimum distance between two figures, in units of sqrt(area)
_WIDEST, _NARROWEST = 2000, 0.62  # pixels; share of the height
_MARGIN = 0.045  # of the height, free around the shapes


def rotation_about_y(degrees: float) -> Float[Floats, "3 3"]:
    """Rotation about the vertical: a shape turns to its own left."""
    a = np.radians(degrees)
    return np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])


def rotation_about_x(degrees: float) -> Float[Floats, "3 3"]:
    """Rotation that tilts the top towards the viewer."""
    b = np.radians(degrees)
    return np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])


@dataclass(frozen=True, eq=False)
class GroundPose:
    """How a shape of a file becomes a figure: ``((points @ rotation.T) - foot) / scale``.

    Parameters
    ----------
    foot
        The middle of the footprint, after the rotation.
    half
        Half the figure's width, its height, and half its depth.
    """

    rotation: Float[Floats, "3 3"]
    foot: Float[Floats, " 3"]
    scale: float
    half: Float[Floats, " 3"]

    def apply(self, points: Float[Floats, "N 3"]) -> Float[Floats, "N 3"]:
        """Points of the file on the figure's ground."""
        return np.asarray((points @ self.rotation.T - self.foot) / self.scale)


def ground_pose(shape: Shape, points: Float[Floats, "N 3"], rotation: Float[Floats, "3 3"]) -> GroundPose:
    """Put a shape on its ground; ``points`` are all that will be drawn of it."""
    rotated = points @ rotation.T
    low, high = rotated.min(axis=0), rotated.max(axis=0)
    longest = float((high - low).max())
    scale = np.sqrt(shape.area)
    # A flat scrap or a lone point has no area to speak of; outliers far away would shrink everything else.
    if not 0.2 * longest < scale < 2 * longest:
        scale = longest if longest > 0 else 1.0
    foot = np.array([(low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2])
    return GroundPose(rotation, foot, float(scale), (high - low) / scale / np.array([2.0, 1.0, 2.0]))


@dataclass(frozen=True)
class Viewport:
    """The part of the picture plane that the pixels show: the first one's upper left corner, and the size of one."""

    width: int
    height: int
    left: float
    top: float
    pixel: float

    def at(self, column: NDArray[Any], row: NDArray[Any]) -> tuple[Float[Floats, " ..."], Float[Floats, " ..."]]:
        """x and y of places in the picture, counted in pixels from its upper left corner."""
        return self.left + self.pixel * column, self.top - self.pixel * row


@dataclass(frozen=True, eq=False)
class Page:
    """A laid-out picture.

    Parameters
    ----------
    viewport
        The whole picture, in view coordinates.
    feet
        x of each figure's foot.
    font_size
        In pixels.
    names, room
        Middle of each name and the width for it, in pixels.
    legend
        First row of the legend.
    """

    viewport: Viewport
    feet: Float[Floats, " N"]
    font_size: float
    names: Float[Floats, "N 2"]
    room: Float[Floats, " N"]
    legend: int


def lay_out(
    boxes: list[Float[Floats, "2 2"]], named: bool, legend: Legend | None, size: tuple[int, int] | None
) -> Page:
    """Place figures on a page; their boxes (left, bottom; right, top) are as they are seen, the foot at 0.

    Raises
    ------
    OptionError
        The size leaves no room for the shapes above names and legend.
    """
    height = size[1] if size else HEIGHT
    font_size = float(np.clip(0.027 * min(height, 1.6 * (size[0] if size else height)), 9, 60))
    if size is None:
        _, whole = _row(boxes, None)
        wide, tall = whole[1] - whole[0]
        size = _natural_size(wide, tall, named, legend, font_size)
    width, height = size
    strips = _strips(named, legend, width, font_size)
    margin = _MARGIN * min(height, 1.5 * width)
    free = np.array([width - 2 * margin, height - sum(strips) - (1.6 if sum(strips) else 2) * margin])
    if free.min() < 8 and sum(strips):
        raise OptionError(f"{width} x {height} pixels leave no room above names and legend", "make the picture larger")
    feet, whole = _row(boxes, free[0] / free[1])
    wide, tall = whole[1] - whole[0]
    pixel = max(wide / free[0], tall / free[1], 1e-9)
    middle = whole.mean(axis=0)
    upper = height - sum(strips) - (0.3 * margin if sum(strips) else 0.0)
    left = float(middle[0] - width / 2 * pixel)
    viewport = Viewport(width, height, left, float(middle[1] + (upper / 2 + 0.15 * margin) * pixel), pixel)
    at = (feet + np.array([box[:, 0].mean() for box in boxes]) - left) / pixel
    names = np.stack([at, np.full(len(at), height - sum(strips) + 0.42 * strips[0])], axis=1)
    widths = np.array([box[1, 0] - box[0, 0] for box in boxes])
    room = np.minimum((widths + _GAP) / pixel, 0.94 * width) if len(boxes) > 1 else np.array([0.94 * width])
    return Page(viewport, feet, font_size, names, room, height - strips[1])


def _row(boxes: list[Float[Floats, "2 2"]], aspect: float | None) -> tuple[Float[Floats, " N"], Float[Floats, "2 2"]]:
    """Figures beside each other: x of each one's foot, and the box of all.

    ``aspect`` is width over height to fill, by wider gaps; None for the narrowest row.
    """
    widths = np.array([box[1, 0] - box[0, 0] for box in boxes])
    bottom, top = min(box[0, 1] for box in boxes), max(box[1, 1] for box in boxes)
    gap = _GAP * max(1.0, float(np.median(widths)))
    if aspect is not None and len(boxes) > 1:
        spare = aspect * (top - bottom) - widths.sum()
        gap = float(np.clip(spare / (len(boxes) - 0.5), gap, 3 * gap))
    lefts = np.concatenate([[0.0], np.cumsum(widths + gap)[:-1]])
    feet = lefts - np.array([box[0, 0] for box in boxes])
    return feet, np.array([[0.0, bottom], [lefts[-1] + widths[-1], top]])


def _strips(named: bool, legend: Legend | None, width: int, font_size: float) -> tuple[int, int]:
    """Rows of pixels for the names and for the legend."""
    legend_rows = legend_height(legend, width, 0.9 * font_size) + round(0.5 * font_size) if legend else 0
    return round(2.3 * font_size) if named else 0, legend_rows


def _natural_size(wide: float, tall: float, named: bool, legend: Legend | None, font_size: float) -> tuple[int, int]:
    """A legend comes on top of the usual height, so that it takes nothing from the shapes."""
    names = _strips(named, None, HEIGHT, font_size)[0]
    margin = _MARGIN * HEIGHT
    pixel = tall / (HEIGHT - names - 2 * margin)
    width, height = wide / pixel + 2 * margin, float(HEIGHT - names)
    if width > _WIDEST:
        pixel = wide / (_WIDEST - 2 * margin)
        width, height = float(_WIDEST), max(tall / pixel + 2 * margin, 0.25 * HEIGHT)
    width = max(width, _NARROWEST * HEIGHT)
    return round(width), round(height + sum(_strips(named, legend, round(width), font_size)))
