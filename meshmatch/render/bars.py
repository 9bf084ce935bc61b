"""Numbers side by side, as a picture: horizontal bars in groups, each with its number written out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from meshmatch.errors import OptionError
from meshmatch.outputs import replace_on_success
from meshmatch.render.lettering import fitting, font, readable, width_of
from meshmatch.render.scales import nice_step

_FINE = 3  # drawn this many times larger and then shrunk: smooth edges
_WIDTH, _LINE, _TITLE, _FOOT, _SIZE = 1000, 30, 40, 70, 16
_INK, _GREY, _GRID, _BAR = "#34363c", "#70747c", "#e6e7ea", "#7fb2d9"
_OWN = "#0072b2"
_LABELS = 0.3  # share of the width that names may take


@dataclass(frozen=True)
class Bar:
    """One bar: a name, a length (0 or more), words behind it, and whether it is drawn in the strong colour.

    ``mark`` is a second number, a tick across the bar: a median beside a mean.
    """

    name: str
    value: float
    words: str = ""
    strong: bool = False
    mark: float | None = None


def draw_bars(
    groups: Mapping[str, Sequence[Bar]], path: str | Path, axis: str, limit: float | None = None
) -> None:
    """Draw groups of bars into a PNG, all on one axis from 0.

    Parameters
    ----------
    groups
        Title: its bars, from top to bottom. A group without bars is left out.
    path
        Ends in .png.
    axis
        What the lengths are, with the unit.
    limit
        Right end of the axis, above 0: a longer bar is drawn broken off there. By default the largest number.

    Raises
    ------
    OptionError
        The suffix is not .png, there is no bar, or a number is negative or not finite.
    OutputError
        The file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".png":
        raise OptionError(f"{path.name}: a picture is a PNG", "end the name in .png")
    groups = {title: list(bars) for title, bars in groups.items() if bars}
    if not groups:
        raise OptionError("there are no bars to draw")
    numbers = [bar.value for bars in groups.values() for bar in bars]
    numbers += [bar.mark for bars in groups.values() for bar in bars if bar.mark is not None]
    if not np.isfinite(numbers).all() or min(numbers) < 0:
        raise OptionError("a bar needs a number of 0 or more")
    if limit is not None and not (np.isfinite(limit) and limit > 0):
        raise OptionError(f"an axis cannot end at {limit:g}")
    image = _picture(groups, max(numbers) if limit is None else limit, axis)
    with replace_on_success(path) as temporary:
        image.save(temporary, format="PNG", optimize=True)


def _picture(groups: Mapping[str, Sequence[Bar]], most: float, axis: str) -> Image.Image:
    every = [bar for bars in groups.values() for bar in bars]
    height = len(groups) * _TITLE + len(every) * _LINE + _FOOT
    image = Image.new("RGB", (_WIDTH * _FINE, height * _FINE), "white")
    draw = ImageDraw.Draw(image)
    size = _SIZE * _FINE
    widest = max(width_of(readable(bar.name), size) for bar in every)
    left = min(widest, _LABELS * image.width) + 30 * _FINE
    behind = max(width_of(readable(bar.words), size) for bar in every)
    right = max(image.width - behind - 30 * _FINE, left + 0.3 * (image.width - left))
    most = most or 1.0
    bottom = (height - _FOOT) * _FINE

    def place(value: float) -> float:
        return left + (right - left) * min(value / most, 1.0)

    stride = nice_step(most, 6)
    for value in np.arange(0.0, most + 1e-6 * stride, stride):
        draw.line([(place(value), 8 * _FINE), (place(value), bottom)], fill=_GRID, width=_FINE)
        spot = (place(value), bottom + 8 * _FINE)
        draw.text(spot, f"{value:g}", fill=_GREY, font=font(size), anchor="mt")
    y = 0.0
    for title, bars in groups.items():
        heading = (12 * _FINE, y + 0.6 * _TITLE * _FINE)
        words, fits = fitting(title, 1.1 * size, image.width - 24 * _FINE)
        box = draw.textbbox(heading, words, font=font(fits), anchor="lm")
        draw.rectangle((0, box[1], box[2] + 4 * _FINE, box[3]), fill="white")
        draw.text(heading, words, fill=_INK, font=font(fits), anchor="lm")
        y += _TITLE * _FINE
        for bar in bars:
            _draw(draw, bar, y, left, place, image.width, bar.value > most)
            y += _LINE * _FINE
        draw.line([(left, y - len(bars) * _LINE * _FINE), (left, y)], fill=_INK, width=_FINE)
    foot = (image.width / 2, (height - 14) * _FINE)
    draw.text(foot, readable(axis), fill=_INK, font=font(size), anchor="mb")
    return image.resize((_WIDTH, height), Image.Resampling.LANCZOS)


def _draw(
    draw: ImageDraw.ImageDraw, bar: Bar, y: float, left: float, place, width: int, broken: bool
) -> None:
    size, middle, half = _SIZE * _FINE, y + 0.5 * _LINE * _FINE, 0.34 * _LINE * _FINE
    name, fits = fitting(bar.name, size, left - 22 * _FINE)
    draw.text((left - 10 * _FINE, middle), name, fill=_INK, font=font(fits), anchor="rm")
    end = place(bar.value)
    draw.rectangle((left, middle - half, end, middle + half), fill=_OWN if bar.strong else _BAR)
    if broken:
        for gap in (14 * _FINE, 24 * _FINE):
            slash = [(end - gap - 4 * _FINE, middle + half), (end - gap + 4 * _FINE, middle - half)]
            draw.line(slash, fill="white", width=4 * _FINE)
    elif bar.mark is not None:
        at = place(bar.mark)
        draw.line([(at, middle - half), (at, middle + half)], fill=_INK, width=2 * _FINE)
        end = max(end, at)
    words, fits = fitting(bar.words, size, max(width - end - 16 * _FINE, 40 * _FINE))
    draw.text((end + 8 * _FINE, middle), words, fill=_INK, font=font(fits), anchor="lm")
