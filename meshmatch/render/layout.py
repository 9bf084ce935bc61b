"""Where on the paper everything goes: the shapes, their names, the legend."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from meshmatch.errors import OptionError
from meshmatch.render.framing import GAP, in_a_row
from meshmatch.render.legend import Legend, legend_height
from meshmatch.render.viewport import Window

FloatArray = NDArray[np.float64]

HEIGHT = 800
"""Of a picture whose size is not given; its width is what the shapes need."""
_WIDEST, _NARROWEST = 2000, 0.62  # pixels; share of the height
_MARGIN = 0.045  # of the height, free around the shapes


@dataclass(frozen=True, eq=False)
class Page:
    """A laid-out picture.

    window
        All of it, in view coordinates.
    feet : (N,)
        x of each figure's foot.
    letters : float
        Size of the letters, in pixels.
    names : (N, 2)
        Middle of each name, in pixels, and the room for it (N,).
    legend : int
        First row of the legend.
    """

    window: Window
    feet: FloatArray
    letters: float
    names: FloatArray
    room: FloatArray
    legend: int


def lay_out(
    boxes: list[FloatArray], named: bool, legend: Legend | None, size: tuple[int, int] | None
) -> Page:
    """Place figures, whose boxes (2, 2) are as they are seen, on a page.

    Raises
    ------
    OptionError
        The size leaves no room for the shapes above names and legend.
    """
    height = size[1] if size else HEIGHT
    letters = float(np.clip(0.027 * min(height, 1.6 * (size[0] if size else height)), 9, 60))
    row = in_a_row(boxes, None)
    wide, tall = row.box[1] - row.box[0]
    if size is None:
        size = _natural_size(wide, tall, named, legend, letters)
    width, height = size
    strips = _strips(named, legend, width, letters)
    margin = _MARGIN * min(height, 1.5 * width)
    free = np.array([width - 2 * margin, height - sum(strips) - (1.6 if sum(strips) else 2) * margin])
    if free.min() < 8 and sum(strips):
        raise OptionError(
            f"{width} x {height} pixels leave no room above names and legend", "make the picture larger"
        )
    row = in_a_row(boxes, free[0] / free[1])
    wide, tall = row.box[1] - row.box[0]
    pixel = max(wide / free[0], tall / free[1], 1e-9)
    middle = row.box.mean(axis=0)
    upper = height - sum(strips) - (0.3 * margin if sum(strips) else 0.0)
    window = Window(
        width,
        height,
        float(middle[0] - width / 2 * pixel),
        float(middle[1] + (upper / 2 + 0.15 * margin) * pixel),
        pixel,
    )
    widths = np.array([box[1, 0] - box[0, 0] for box in boxes])
    at = (row.feet + np.array([box[:, 0].mean() for box in boxes]) - window.left) / pixel
    names = np.stack([at, np.full(len(at), height - sum(strips) + 0.42 * strips[0])], axis=1)
    room = np.minimum((widths + GAP) / pixel, 0.94 * width) if len(boxes) > 1 else np.array([0.94 * width])
    return Page(window, row.feet, letters, names, room, height - strips[1])


def _strips(named: bool, legend: Legend | None, width: int, letters: float) -> tuple[int, int]:
    """Rows of pixels for the names and for the legend."""
    return (
        round(2.3 * letters) if named else 0,
        0 if legend is None else legend_height(legend, width, 0.9 * letters) + round(0.5 * letters),
    )


def _natural_size(
    wide: float, tall: float, named: bool, legend: Legend | None, letters: float
) -> tuple[int, int]:
    """A legend comes on top of the usual height, so that it takes nothing from the shapes."""
    names = _strips(named, None, HEIGHT, letters)[0]
    margin = _MARGIN * HEIGHT
    pixel = tall / (HEIGHT - names - 2 * margin)
    width, height = wide / pixel + 2 * margin, float(HEIGHT - names)
    if width > _WIDEST:
        pixel = wide / (_WIDEST - 2 * margin)
        width, height = float(_WIDEST), max(tall / pixel + 2 * margin, 0.25 * HEIGHT)
    width = max(width, _NARROWEST * HEIGHT)
    return round(width), round(height + sum(_strips(named, legend, round(width), letters)))
