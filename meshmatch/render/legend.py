"""The legend of a picture: a color bar with numbers, or names with their colors."""

from __future__ import annotations

import numpy as np
from PIL import Image, ImageDraw

from meshmatch.render.lettering import Ink, fitting, width_of, write
from meshmatch.render.scales import UNKNOWN, Scale, Swatches

Legend = Scale | Swatches
_FINE = 4  # shapes are drawn this many times larger and then shrunk: smooth corners


def legend_height(legend: Legend, width: int, unit: float) -> int:
    """Rows of pixels that a legend needs under a picture of this width; ``unit`` is its font size."""
    if isinstance(legend, Scale):
        return round((4.1 if legend.title else 2.9) * unit)
    lines = len(_lines(legend, width, unit))
    return round((0.8 + 1.75 * lines + (1.6 if legend.title else 0)) * unit)


def draw_legend(image: Image.Image, legend: Legend, top: int, unit: float, ink: Ink) -> None:
    """Draw a centered legend into a picture, from row ``top`` on."""
    if isinstance(legend, Scale):
        _draw_bar(image, legend, top, unit, ink)
    else:
        _draw_swatches(image, legend, top, unit, ink)


def _draw_bar(image: Image.Image, scale: Scale, top: int, unit: float, ink: Ink) -> None:
    W = image.width
    y = top + 0.2 * unit
    if scale.title:
        text, size = fitting(scale.title, unit, 0.94 * W)
        write(image, (W / 2, y + 0.6 * unit), text, size, ink)
        y += 1.5 * unit
    length, thick = round(min(0.62 * W, 26 * unit)), max(4, round(0.75 * unit))
    left = (W - length) // 2
    share = (np.arange(length) + 0.5) / length
    row = np.round(255 * scale.colors(scale.low + share * (scale.high - scale.low))).astype(np.uint8)
    _paste(image, np.broadcast_to(row, (thick, length, 3)), left, round(y), thick / 2)
    y += thick + 0.35 * unit
    draw = ImageDraw.Draw(image)
    ends = []
    for place, words in scale.ticks():
        x = left + length * (place - scale.low) / (scale.high - scale.low)
        half = width_of(words, 0.9 * unit) / 2
        ends.append((x - half, x + half))
        if len(ends) > 1 and ends[-1][0] < ends[-2][1] + 0.4 * unit:
            ends.pop()  # no room beside the one before
            continue
        fill = (*ink, 255) if image.mode == "RGBA" else ink
        width = max(1, round(0.08 * unit))
        draw.line([(x, y - 0.25 * unit), (x, y - 0.02 * unit)], fill=fill, width=width)
        write(image, (x, y + 0.08 * unit), words, 0.9 * unit, ink, "mt")
    if scale.unknown:
        x, side = left + length + 1.6 * unit, thick
        words, size = fitting("no value", 0.9 * unit, W - x - side - unit)
        if W - x - side - unit > 3 * unit:
            patch = np.broadcast_to(np.round(255 * np.array(UNKNOWN)).astype(np.uint8), (side, side, 3))
            _paste(image, patch, round(x), round(y - thick - 0.35 * unit), 0.25 * side)
            write(image, (x + side + 0.5 * unit, y - thick / 2 - 0.35 * unit), words, size, ink, "lm")


def _lines(swatches: Swatches, width: int, unit: float) -> list[list[tuple[int, str, float]]]:
    """Entries (number, words, width in pixels) in lines that fit."""
    lines: list[list[tuple[int, str, float]]] = [[]]
    used = 0.0
    for number, name in enumerate(swatches.names):
        words, size = fitting(name, unit, 0.9 * width - 1.6 * unit)
        wide = width_of(words, size) + 2.7 * unit
        if lines[-1] and used + wide > 0.92 * width:
            lines.append([])
            used = 0.0
        lines[-1].append((number, words, wide))
        used += wide
    return lines


def _draw_swatches(image: Image.Image, swatches: Swatches, top: int, unit: float, ink: Ink) -> None:
    W = image.width
    y = top + 0.2 * unit
    if swatches.title:
        text, size = fitting(swatches.title, unit, 0.94 * W)
        write(image, (W / 2, y + 0.6 * unit), text, size, ink)
        y += 1.6 * unit
    side = max(4, round(0.95 * unit))
    for line in _lines(swatches, W, unit):
        x = (W - sum(wide for _, _, wide in line) + 1.2 * unit) / 2
        for number, words, wide in line:
            color = np.round(255 * np.array(swatches.colors[number])).astype(np.uint8)
            _paste(image, np.broadcast_to(color, (side, side, 3)), round(x), round(y + 0.4 * unit), 0.3 * side)
            room = wide - 2.7 * unit
            text, size = fitting(words, unit, room + 1)
            write(image, (x + side + 0.45 * unit, y + 0.4 * unit + side / 2), text, size, ink, "lm")
            x += wide
        y += 1.75 * unit


def _paste(image: Image.Image, pixels: np.ndarray, left: int, top: int, radius: float) -> None:
    """Put a patch (H, W, 3) into a picture, its corners round."""
    H, W = pixels.shape[:2]
    mask = Image.new("L", (W * _FINE, H * _FINE), 0)
    frame = (0, 0, W * _FINE - 1, H * _FINE - 1)
    ImageDraw.Draw(mask).rounded_rectangle(frame, radius=radius * _FINE, fill=255)
    patch = Image.fromarray(np.ascontiguousarray(pixels))
    if image.mode == "RGBA":
        patch = patch.convert("RGBA")
    image.paste(patch, (left, top), mask.resize((W, H), Image.Resampling.BOX))
