"""The cumulative error curve as a picture: how many points have an error of at most this much."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from meshmatch.errors import OptionError
from meshmatch.maps.evaluate import CM_PER_UNIT, Errors
from meshmatch.outputs import replace_on_success

# Okabe and Ito's colours, told apart by colour-blind readers too.
COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")
_FINE = 3  # drawn this many times larger and then shrunk: smooth lines
_INK, _GREY, _GRID = "#222222", "#666666", "#e4e4e4"


# What the axis counts: units in one sqrt(area), the unit's name, the words under the axis.
_UNITS = {
    "cm": (CM_PER_UNIT, "cm", "cm (target scaled to 1.9 square metres of skin)"),
    "x100": (100.0, "x 0.01", "hundredths of the square root of the target's area"),
}


def draw_curves(
    curves: Mapping[str, Errors],
    path: str | Path,
    limit: float = 20.0,
    *,
    unit: Literal["cm", "x100"] = "cm",
    size: tuple[int, int] = (900, 600),
) -> None:
    """Draw one cumulative curve for each of ``curves`` (name: errors) into a PNG.

    Parameters
    ----------
    curves
        At least one; the legend lists them with their means, in this order.
    path
        Ends in .png.
    limit
        Right end of the axis, in the `unit`.
    unit
        "cm": centimetres at 1.9 m2 of skin, for people. "x100": sqrt(area) / 100, for everything else.
    size
        Width and height in pixels.

    Raises
    ------
    OptionError
        The suffix is not .png, or there is nothing to draw.
    OutputError
        The file cannot be written.
    """
    if Path(path).suffix.lower() != ".png":
        raise OptionError(f"{Path(path).name}: a curve is drawn as a PNG", "end the name in .png")
    if not curves or limit <= 0 or unit not in _UNITS:
        raise OptionError(f"a curve needs errors, an axis longer than 0 and a unit of {', '.join(_UNITS)}")
    image = _picture(curves, limit, unit, size)
    with replace_on_success(path) as temporary:
        image.save(temporary, format="PNG", optimize=True)


def _picture(
    curves: Mapping[str, Errors], limit: float, counted_in: str, size: tuple[int, int]
) -> Image.Image:
    per_unit, short, words = _UNITS[counted_in]
    width, height = size[0] * _FINE, size[1] * _FINE
    unit = height / 600
    left, right, top, bottom = 78 * unit, width - 30 * unit, 30 * unit, height - 70 * unit
    image = Image.new("RGB", (width, height), "white")
    draw = ImageDraw.Draw(image)
    font = ImageFont.load_default(size=17 * unit)

    def x_of(value: float) -> float:
        return left + (right - left) * value / limit

    def y_of(share: float) -> float:
        return bottom + (top - bottom) * share

    for share in (0.0, 0.2, 0.4, 0.6, 0.8, 1.0):
        draw.line([(left, y_of(share)), (right, y_of(share))], fill=_GRID, width=round(1.3 * unit))
        label = f"{round(100 * share)} %"
        draw.text((left - 10 * unit, y_of(share)), label, fill=_GREY, font=font, anchor="rm")
    step = _nice_step(limit)
    for value in np.arange(0.0, limit + 1e-6 * step, step):
        draw.line([(x_of(value), top), (x_of(value), bottom)], fill=_GRID, width=round(1.3 * unit))
        draw.text((x_of(value), bottom + 10 * unit), f"{value:g}", fill=_GREY, font=font, anchor="mt")
    draw.line([(left, bottom), (right, bottom)], fill=_INK, width=round(1.6 * unit))
    draw.line([(left, top), (left, bottom)], fill=_INK, width=round(1.6 * unit))
    middle = (left + right) / 2
    caption = f"share of the points with a geodesic error of at most ... {words}"
    draw.text((middle, height - 14 * unit), caption, fill=_INK, font=font, anchor="mb")

    values = np.linspace(0.0, limit, 800)
    legend = []
    for number, (name, errors) in enumerate(curves.items()):
        color = COLORS[number % len(COLORS)]
        shares = errors.curve(values / per_unit)
        points = [(x_of(x), y_of(y)) for x, y in zip(values, shares, strict=True)]
        draw.line(points, fill=color, width=round(3.2 * unit), joint="curve")
        mean, median = errors.mean * per_unit, errors.median * per_unit
        legend.append((color, f"{name}: mean {mean:.2f} {short}, median {median:.2f} {short}"))

    # The lower right is empty as long as a map is any good, and a bad one may hide behind the box.
    line = 27 * unit
    longest = max(draw.textlength(text, font=font) for _, text in legend)
    box_right, box_bottom = right - 14 * unit, bottom - 14 * unit
    box_left, box_top = box_right - longest - 62 * unit, box_bottom - line * len(legend) - 14 * unit
    frame = (box_left, box_top, box_right, box_bottom)
    draw.rounded_rectangle(frame, radius=6 * unit, fill="white", outline=_GRID, width=round(1.5 * unit))
    for number, (color, text) in enumerate(legend):
        y = box_top + 7 * unit + line * (number + 0.5)
        draw.line([(box_left + 12 * unit, y), (box_left + 40 * unit, y)], fill=color, width=round(3.6 * unit))
        draw.text((box_left + 50 * unit, y), text, fill=_INK, font=font, anchor="lm")
    return image.resize(size, Image.Resampling.LANCZOS)


def _nice_step(limit: float) -> float:
    rough = limit / 8
    power = 10.0 ** np.floor(np.log10(rough))
    return float(power * next(m for m in (1, 2, 2.5, 5, 10) if m * power >= rough * (1 - 1e-9)))
