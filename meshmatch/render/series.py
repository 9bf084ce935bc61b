"""Measurements against something that was varied, as a picture: lines with error bars, one panel or several in a row."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from meshmatch.errors import OptionError
from meshmatch.outputs import replace_on_success
from meshmatch.render.lettering import fitting, font, readable, width_of
from meshmatch.render.lines import COLORS
from meshmatch.render.scales import nice_step

_FINE = 3  # drawn this many times larger and then shrunk: smooth lines
_SIZE = 1000, 460
_INK, _GREY, _GRID = "#34363c", "#70747c", "#e6e7ea"
_LETTERS = 16 * _FINE


@dataclass(frozen=True)
class Series:
    """One line: places, values of 0 or more, and how far each may be off (0: no bar)."""

    x: tuple[float, ...]
    y: tuple[float, ...]
    spread: tuple[float, ...] = ()


@dataclass(frozen=True)
class Panel:
    """One diagram: what is across, with its unit; its lines by name; the places that are written, and whether they are
    spaced by ratio.

    By ratio, a place of 0 is drawn at the left end, where the axis is broken.
    """

    across: str
    lines: Mapping[str, Series]
    ticks: tuple[float, ...] = ()
    by_ratio: bool = False


def draw_series(panels: Sequence[Panel], path: str | Path, up: str) -> None:
    """Draw panels with a common upward axis from 0 into a PNG; a name has the same colour in all of them.

    Parameters
    ----------
    path
        Ends in .png.
    up
        What the values are, with the unit.

    Raises
    ------
    OptionError
        The suffix is not .png, there is nothing to draw or too much, a number is negative or not finite, or a series
        has not as many values as places.
    OutputError
        The file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".png":
        raise OptionError(f"{path.name}: a picture is a PNG", "end the name in .png")
    names = list(dict.fromkeys(name for panel in panels for name in panel.lines))
    if not names or len(names) > len(COLORS):
        raise OptionError(f"a diagram needs 1 to {len(COLORS)} lines")
    for panel in panels:
        for series in panel.lines.values():
            _check(series)
    image = _picture(panels, names, up)
    with replace_on_success(path) as temporary:
        image.save(temporary, format="PNG", optimize=True)


def _check(series: Series) -> None:
    numbers = np.array([*series.x, *series.y, *series.spread])
    if not series.x or len(series.x) != len(series.y) or len(series.spread) not in (0, len(series.x)):
        raise OptionError("a line needs as many values as places, and one at least")
    if not np.isfinite(numbers).all() or numbers.min() < 0:
        raise OptionError("a line needs numbers of 0 or more")


def _picture(panels: Sequence[Panel], names: Sequence[str], up: str) -> Image.Image:
    image = Image.new("RGB", (_SIZE[0] * _FINE, _SIZE[1] * _FINE), "white")
    draw = ImageDraw.Draw(image)
    every = [series for panel in panels for series in panel.lines.values()]
    most = max(
        value + off
        for series in every
        for value, off in zip(series.y, series.spread or (0.0,) * len(series.y), strict=True)
    )
    step = nice_step(most or 1.0, 5)
    highest = step * np.ceil((most or 1.0) / step - 1e-9)
    colors = dict(zip(names, COLORS, strict=False))
    _legend(draw, colors, image.width)
    words, size = fitting(up, _LETTERS, image.width - 24 * _FINE)
    draw.text((12 * _FINE, 52 * _FINE), words, fill=_INK, font=font(size), anchor="lm")
    left, right = 62 * _FINE, image.width - 24 * _FINE
    gap = 60 * _FINE
    wide = (right - left - gap * (len(panels) - 1)) / len(panels)
    top, bottom = 74 * _FINE, image.height - 62 * _FINE
    for number, panel in enumerate(panels):
        start = left + number * (wide + gap)
        for value in np.arange(0.0, highest + 0.5 * step, step):
            y = bottom + (top - bottom) * value / highest
            draw.line([(start, y), (start + wide, y)], fill=_GRID, width=_FINE)
            draw.text((start - 8 * _FINE, y), f"{value:g}", fill=_GREY, font=font(_LETTERS), anchor="rm")
        _draw(draw, panel, (start, start + wide, top, bottom), highest, colors)
    return image.resize(_SIZE, Image.Resampling.LANCZOS)


def _legend(draw: ImageDraw.ImageDraw, colors: Mapping[str, str], width: int) -> None:
    at = 12.0 * _FINE
    room = (width - at) / len(colors) - 56 * _FINE
    for name, color in colors.items():
        words, size = fitting(name, _LETTERS, room)
        y = 22 * _FINE
        draw.line([(at, y), (at + 26 * _FINE, y)], fill=color, width=4 * _FINE)
        draw.text((at + 34 * _FINE, y), words, fill=_INK, font=font(size), anchor="lm")
        at += 60 * _FINE + width_of(words, size)


def _draw(
    draw: ImageDraw.ImageDraw,
    panel: Panel,
    box: tuple[float, float, float, float],
    highest: float,
    colors: Mapping[str, str],
) -> None:
    left, right, top, bottom = box
    places = _places(panel)

    def at(x: float, y: float) -> tuple[float, float]:
        inner = right - left - 40 * _FINE
        return left + 20 * _FINE + inner * places(x), bottom + (top - bottom) * y / highest

    for tick in panel.ticks:
        x = at(tick, 0.0)[0]
        draw.line([(x, bottom), (x, bottom + 5 * _FINE)], fill=_GREY, width=_FINE)
        draw.text((x, bottom + 9 * _FINE), f"{tick:g}", fill=_GREY, font=font(_LETTERS), anchor="mt")
    draw.line([(left, top), (left, bottom), (right, bottom)], fill=_INK, width=round(1.5 * _FINE))
    words, size = fitting(readable(panel.across), _LETTERS, right - left)
    draw.text(((left + right) / 2, bottom + 36 * _FINE), words, fill=_INK, font=font(size), anchor="mt")
    for name, series in panel.lines.items():
        points = [at(x, y) for x, y in zip(series.x, series.y, strict=True)]
        draw.line(points, fill=colors[name], width=round(2.6 * _FINE), joint="curve")
        for x, y, off in zip(series.x, series.y, series.spread, strict=False):
            if off > 0:
                low, high = at(x, max(y - off, 0.0)), at(x, y + off)
                draw.line([low, high], fill=colors[name], width=round(1.6 * _FINE))
                for end in (low, high):
                    cap = [(end[0] - 5 * _FINE, end[1]), (end[0] + 5 * _FINE, end[1])]
                    draw.line(cap, fill=colors[name], width=round(1.6 * _FINE))
        radius = 4.5 * _FINE
        for x, y in points:
            draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=colors[name])


def _places(panel: Panel):
    """Where a number stands on the axis, 0 (left) to 1."""
    numbers = sorted({x for series in panel.lines.values() for x in series.x} | set(panel.ticks))
    if not panel.by_ratio:
        low, high = numbers[0], max(numbers[-1], numbers[0] + 1e-9)
        return lambda x: (x - low) / (high - low)
    positive = [x for x in numbers if x > 0] or [1.0]
    low, high = np.log10(positive[0]), np.log10(positive[-1])
    start = 0.12 if numbers[0] <= 0 else 0.0  # room for what is at 0
    span = max(high - low, 1e-9)
    return lambda x: 0.0 if x <= 0 else start + (1 - start) * (np.log10(x) - low) / span
