"""How a training went, as a picture: losses over the steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from meshmatch.errors import OptionError
from meshmatch.outputs import replace_on_success
from meshmatch.render.lettering import font, readable
from meshmatch.render.scales import label_colors, nice_step

FloatArray = NDArray[np.float64]

_FINE = 3  # drawn this many times larger and then shrunk: smooth lines
_SIZE = 1000, 600
_INK, _GREY, _GRID = "#34363c", "#70747c", "#e6e7ea"
_MOST = 12


def draw_losses(
    path: str | Path,
    steps: Sequence[int],
    terms: Mapping[str, Sequence[float]],
    validation: Mapping[int, float],
) -> None:
    """Draw losses over the steps of a training into a PNG, on a logarithmic axis.

    Parameters
    ----------
    path
        Ends in .png.
    steps
        (N,) increasing.
    terms
        Name: (N,) values. What is not positive or not finite is left out.
    validation
        Step: the error on shapes that are held out; drawn as dots joined by a line.

    Raises
    ------
    OptionError
        The suffix is not .png, or there is nothing to draw.
    OutputError
        The file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".png":
        raise OptionError(f"{path.name}: a picture is a PNG", "end the name in .png")
    lines: dict[str, tuple[FloatArray, FloatArray]] = {}
    for name, values in list(terms.items())[:_MOST]:
        lines[name] = _drawable(np.asarray(steps, float), np.asarray(values, float))
    if validation:
        at = sorted(validation)
        lines["validation"] = _drawable(np.array(at, float), np.array([validation[step] for step in at]))
    lines = {name: line for name, line in lines.items() if len(line[0])}
    if not lines:
        raise OptionError("the training has no losses to draw", "train for more steps")
    image = _picture(lines)
    with replace_on_success(path) as temporary:
        image.save(temporary, format="PNG", optimize=True)


def _drawable(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    kept = np.isfinite(y) & (y > 0)
    return x[kept], y[kept]


def _picture(lines: Mapping[str, tuple[FloatArray, FloatArray]]) -> Image.Image:
    width, height = (_FINE * side for side in _SIZE)
    unit = height / 600
    left, right, top, bottom = 90 * unit, width - 30 * unit, 30 * unit, height - 70 * unit
    image = Image.new("RGB", (width, height), "white")
    draw = ImageDraw.Draw(image)
    small = font(17 * unit)
    steps = np.concatenate([x for x, _ in lines.values()])
    values = np.log10(np.concatenate([y for _, y in lines.values()]))
    first, last = float(steps.min()), max(float(steps.max()), float(steps.min()) + 1)
    low, high = float(values.min()), float(values.max())
    room = max(0.05 * (high - low), 0.02)
    low, high = low - room, high + room

    def place(x: float, y: float) -> tuple[float, float]:
        return (
            left + (right - left) * (x - first) / (last - first),
            bottom + (top - bottom) * (np.log10(y) - low) / (high - low),
        )

    thin = round(1.3 * unit)
    for value in log_ticks(low, high):
        y = place(first, value)[1]
        draw.line([(left, y), (right, y)], fill=_GRID, width=thin)
        draw.text((left - 10 * unit, y), f"{value:.3g}", fill=_GREY, font=small, anchor="rm")
    stride = max(1.0, nice_step(last - first, 6))
    for step in np.arange(np.ceil(first / stride), np.floor(last / stride) + 1) * stride:
        draw.text(
            (place(step, 1.0)[0], bottom + 10 * unit), f"{step:,.0f}", fill=_GREY, font=small, anchor="mt"
        )
    draw.line([(left, top), (left, bottom), (right, bottom)], fill=_INK, width=round(1.6 * unit))
    draw.text(((left + right) / 2, height - 14 * unit), "step", fill=_INK, font=small, anchor="mb")
    colors = _inks(len(lines))
    for color, (name, (across, along)) in zip(colors, lines.items(), strict=True):
        points = [place(a, b) for a, b in zip(across, along, strict=True)]
        draw.line(points, fill=color, width=round(2.6 * unit), joint="curve")
        radius = (4.5 if name == "validation" or len(points) == 1 else 1.3) * unit
        for px, py in points:
            draw.ellipse((px - radius, py - radius, px + radius, py + radius), fill=color)
    _legend(draw, list(lines), colors, (right, top), unit)
    return image.resize(_SIZE, Image.Resampling.LANCZOS)


def log_ticks(low: float, high: float) -> list[float]:
    """Round numbers (1, 2 or 5 times a power of ten) between two powers of ten, not more than a dozen."""
    for factors in ((1, 2, 5), (1, 3), (1,)):
        powers = range(int(np.floor(low)), int(np.ceil(high)) + 1)
        ticks = [f * 10.0**p for p in powers for f in factors if low <= np.log10(f) + p <= high]
        if len(ticks) <= 12:
            break
    if len(ticks) > 12:
        ticks = ticks[:: -(-len(ticks) // 12)]
    return ticks or [float(f"{10 ** ((low + high) / 2):.2g}")]


def _inks(count: int) -> list[tuple[int, ...]]:
    """Colours of lines: those of labels, dark enough for white paper."""
    return [tuple(color) for color in np.round(215 * label_colors(np.arange(count))).astype(int).tolist()]


def _legend(
    draw: ImageDraw.ImageDraw,
    names: list[str],
    colors: list[tuple[int, ...]],
    corner: tuple[float, float],
    unit: float,
) -> None:
    small = font(17 * unit)
    words = [readable(name) for name in names]
    wide = max(draw.textlength(word, font=small) for word in words) + 66 * unit
    line = 26 * unit
    right, top = corner[0] - 10 * unit, corner[1] + 10 * unit
    box = (right - wide, top, right, top + line * len(names) + 14 * unit)
    draw.rounded_rectangle(box, radius=6 * unit, fill="white", outline=_GRID, width=round(1.5 * unit))
    for number, (word, color) in enumerate(zip(words, colors, strict=True)):
        y = top + 7 * unit + line * (number + 0.5)
        draw.line([(box[0] + 12 * unit, y), (box[0] + 40 * unit, y)], fill=color, width=round(3.4 * unit))
        draw.text((box[0] + 50 * unit, y), word, fill=_INK, font=small, anchor="lm")
