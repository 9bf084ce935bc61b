"""Where everything goes on a picture: shapes side by side on a common ground, with their names and the legend."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshmatch.arrays import Float, Floats
from meshmatch.errors import OptionError
from meshmatch.render.legend import Legend, legend_height

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
    """A laid-out picture: what of the view coordinates it shows, and x of each figure's foot there; in pixels, the font
    size, the middle of each name and the width for it, and the first row of the legend.
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

    `OptionError` where the size leaves no room for the shapes above names and legend.
    """
    seen = np.stack(boxes)
    shorter = min(size[1], 1.6 * size[0]) if size else HEIGHT
    font_size = float(np.clip(0.027 * shorter, 9, 60))
    names = round(2.3 * font_size) if named else 0
    width, height = size or _natural_size(seen, names, legend, font_size)
    under = names + _legend_rows(legend, width, font_size)
    margin = _MARGIN * min(height, 1.5 * width)
    free = np.array([width - 2 * margin, height - under - (1.6 if under else 2) * margin])
    if free.min() < 8 and under:
        raise OptionError(f"{width} x {height} pixels leave no room above names and legend", "make the picture larger")
    feet, whole = _row(seen, free[0] / free[1])
    pixel = max(*((whole[1] - whole[0]) / free), 1e-9)
    middle = whole.mean(axis=0)
    upper = height - under - (0.3 * margin if under else 0.0)
    left = float(middle[0] - width / 2 * pixel)
    viewport = Viewport(width, height, left, float(middle[1] + (upper / 2 + 0.15 * margin) * pixel), pixel)
    at = (feet + seen[:, :, 0].mean(axis=1) - left) / pixel
    places = np.stack([at, np.full(len(at), height - under + 0.42 * names)], axis=1)
    room = np.minimum((np.ptp(seen[:, :, 0], axis=1) + _GAP) / pixel if len(boxes) > 1 else np.inf, 0.94 * width)
    return Page(viewport, feet, font_size, places, np.broadcast_to(room, len(at)), height - under + names)


def _row(boxes: Float[Floats, "N 2 2"], aspect: float) -> tuple[Float[Floats, " N"], Float[Floats, "2 2"]]:
    """Figures beside each other: x of each one's foot, and the box of all.

    ``aspect`` is width over height to fill, by wider gaps; 0 for the narrowest row.
    """
    widths = boxes[:, 1, 0] - boxes[:, 0, 0]
    bottom, top = boxes[:, 0, 1].min(), boxes[:, 1, 1].max()
    gap = _GAP * max(1.0, float(np.median(widths)))
    spare = aspect * (top - bottom) - widths.sum()
    gap = float(np.clip(spare / (len(boxes) - 0.5), gap, 3 * gap))
    lefts = np.concatenate([[0.0], np.cumsum(widths + gap)[:-1]])
    return lefts - boxes[:, 0, 0], np.array([[0.0, bottom], [lefts[-1] + widths[-1], top]])


def _legend_rows(legend: Legend | None, width: int, font_size: float) -> int:
    return legend_height(legend, width, 0.9 * font_size) + round(0.5 * font_size) if legend else 0


def _natural_size(
    boxes: Float[Floats, "N 2 2"], names: int, legend: Legend | None, font_size: float
) -> tuple[int, int]:
    """A legend comes on top of the usual height, so that it takes nothing from the shapes."""
    _, whole = _row(boxes, 0.0)
    wide, tall = whole[1] - whole[0]
    margin = _MARGIN * HEIGHT
    pixel = tall / (HEIGHT - names - 2 * margin)
    width, height = wide / pixel + 2 * margin, float(HEIGHT - names)
    if width > _WIDEST:
        pixel = wide / (_WIDEST - 2 * margin)
        width, height = float(_WIDEST), max(tall / pixel + 2 * margin, 0.25 * HEIGHT)
    width = max(width, _NARROWEST * HEIGHT)
    return round(width), round(height + names + _legend_rows(legend, round(width), font_size))
