"""A few lines over time as a plain picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from meshmatch.errors import OptionError
from meshmatch.outputs import replace_on_success

# Okabe and Ito's colours, told apart by colour-blind readers too.
COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7")
_FINE = 3  # drawn this many times larger and then shrunk: smooth lines
_INK, _GREY, _GRID = "#222222", "#666666", "#e4e4e4"
_SIZE = 900, 500
_TICKS = 5


def draw_lines(
    path: str | Path,
    times: Sequence[float],
    lines: Mapping[str, Sequence[float]],
    caption: str,
    marks: Mapping[float, str] | None = None,
) -> None:
    """Draw lines over time into a PNG; their values start at 0.

    Parameters
    ----------
    path
        Ends in .png.
    times
        (N,) increasing.
    lines
        Name: (N,) values, each at least 0.
    caption
        Below the axis.
    marks
        Times that have a name.

    Raises
    ------
    OptionError
        The suffix is not .png, or there is no line with two points.
    OutputError
        The file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".png":
        raise OptionError(f"{path.name}: a plot is drawn as a PNG", "end the name in .png")
    if len(times) < 2 or not lines or len(lines) > len(COLORS):
        raise OptionError(f"a plot needs 1 to {len(COLORS)} lines of two points or more")
    image = _picture(np.asarray(times, float), lines, caption, marks or {})
    with replace_on_success(path) as temporary:
        image.save(temporary, format="PNG", optimize=True)


def _picture(
    times: np.ndarray, lines: Mapping[str, Sequence[float]], caption: str, marks: Mapping[float, str]
) -> Image.Image:
    width, height = (_FINE * side for side in _SIZE)
    unit = height / 500
    left, right, top, bottom = 84 * unit, width - 30 * unit, 58 * unit, height - 66 * unit
    image = Image.new("RGB", (width, height), "white")
    draw = ImageDraw.Draw(image)
    font = ImageFont.load_default(size=16 * unit)
    highest = _round_up(max(float(np.max(values)) for values in lines.values()))
    first, last = float(times[0]), float(times[-1])

    def x_of(time: float) -> float:
        return left + (right - left) * (time - first) / (last - first)

    def y_of(value: float) -> float:
        return bottom + (top - bottom) * value / highest

    thin = round(1.3 * unit)
    for value in np.linspace(0.0, highest, _TICKS + 1):
        draw.line([(left, y_of(value)), (right, y_of(value))], fill=_GRID, width=thin)
        draw.text((left - 10 * unit, y_of(value)), f"{value:.3g}", fill=_GREY, font=font, anchor="rm")
    for time in np.linspace(first, last, _TICKS):
        draw.text((x_of(time), bottom + 9 * unit), f"{time:.3g}", fill=_GREY, font=font, anchor="mt")
    for time, name in marks.items():
        if first <= time <= last:
            draw.line([(x_of(time), top), (x_of(time), bottom)], fill=_GREY, width=thin)
            # Names at the rims stay inside the picture.
            share = (time - first) / (last - first)
            anchor = "lb" if share < 0.2 else "rb" if share > 0.8 else "mb"
            draw.text((x_of(time), top - 5 * unit), name, fill=_GREY, font=font, anchor=anchor)
    draw.line([(left, top), (left, bottom), (right, bottom)], fill=_INK, width=round(1.6 * unit))
    draw.text(((left + right) / 2, height - 12 * unit), caption, fill=_INK, font=font, anchor="mb")
    at = left
    for color, (name, values) in zip(COLORS, lines.items(), strict=False):
        points = [(x_of(x), y_of(y)) for x, y in zip(times, values, strict=True)]
        draw.line(points, fill=color, width=round(3 * unit), joint="curve")
        for x, y in points:
            r = 4 * unit
            draw.ellipse((x - r, y - r, x + r, y + r), fill=color)
        draw.line([(at, 18 * unit), (at + 26 * unit, 18 * unit)], fill=color, width=round(4 * unit))
        draw.text((at + 34 * unit, 18 * unit), name, fill=_INK, font=font, anchor="lm")
        at += 64 * unit + draw.textlength(name, font=font)
    return image.resize(_SIZE, Image.Resampling.LANCZOS)


def _round_up(value: float) -> float:
    """The end of an axis with five parts: 1, 1.5, 2, 2.5, 3, 4, 5, 7.5 or 10 times a power of ten."""
    if value < 1e-6:
        return 1e-6
    power = 10.0 ** np.floor(np.log10(value))
    steps = (1, 1.5, 2, 2.5, 3, 4, 5, 7.5, 10)
    return float(power * next(step for step in steps if step * power >= value * (1 - 1e-9)))
