"""Words in a picture, in the font that Pillow includes, and its legend: a bar with numbers, or names with colors."""

from __future__ import annotations

import unicodedata
from functools import lru_cache

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from meshmatch.render.scales import Color, Scale, Swatches
from meshmatch.shapes.colors import UNKNOWN

Ink = tuple[int, int, int]
Legend = Scale | Swatches
_NO_CHARACTER = "\ufffe"
_FINE = 4  # shapes are drawn this many times larger and then shrunk: smooth corners


@lru_cache(maxsize=64)
def _font(size: float) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size=max(size, 6.0))


def width_of(text: str, size: float) -> float:
    """How many pixels a line takes whose font has this size in pixels."""
    return float(_font(size).getlength(text))


def readable(text: str) -> str:
    """The text on one line in letters that the font has: without accents if necessary, else "?"."""
    out = []
    for letter in " ".join(text.split()):
        plain = letter if _has(letter) else unicodedata.normalize("NFKD", letter)
        kept = "".join(part for part in plain if _has(part) and not unicodedata.combining(part))
        out.append(kept or ("" if unicodedata.combining(letter) else "?"))
    return "".join(out)


@lru_cache(maxsize=4096)
def _has(letter: str) -> bool:
    if unicodedata.category(letter).startswith("C"):
        return False
    wanted, missing = (_font(32.0).getmask(part) for part in (letter, _NO_CHARACTER))
    return (wanted.size, bytes(wanted)) != (missing.size, bytes(missing))


def fitting(text: str, size: float, room: float) -> tuple[str, float]:
    """The text and its size so that it fits into ``room`` pixels: smaller first, then cut in the middle."""
    text = readable(text)
    while size > 9 and width_of(text, size) > room:
        size *= 0.95
    kept, whole = min(len(text), 400), text
    while width_of(text, size) > room and kept > 2:
        kept -= 1
        text = f"{whole[: (kept + 1) // 2]}…{whole[len(whole) - kept // 2 :]}"
    return text, size


def write(image: Image.Image, place: tuple[float, float], text: str, size: float, ink: Ink, anchor: str = "mm") -> None:
    """Write a line; ``anchor`` as in Pillow. On a picture with alpha the letters are opaque."""
    ImageDraw.Draw(image).text(place, text, fill=ink, font=_font(size), anchor=anchor)


def legend_height(legend: Legend, width: int, unit: float) -> int:
    """Rows of pixels that a legend needs under a picture of this width; ``unit`` is its font size."""
    if isinstance(legend, Scale):
        return round((4.1 if legend.title else 2.9) * unit)
    lines = len(_lines(legend, width, unit))
    return round((0.8 + 1.75 * lines + (1.6 if legend.title else 0)) * unit)


def draw_legend(image: Image.Image, legend: Legend, top: int, unit: float, ink: Ink) -> None:
    """Draw a centered legend into a picture, from row ``top`` on."""
    y = top + 0.2 * unit
    if legend.title:
        text, size = fitting(legend.title, unit, 0.94 * image.width)
        write(image, (image.width / 2, y + 0.6 * unit), text, size, ink)
        y += (1.5 if isinstance(legend, Scale) else 1.6) * unit
    if isinstance(legend, Scale):
        _draw_bar(image, legend, y, unit, ink)
    else:
        _draw_swatches(image, legend, y, unit, ink)


def _draw_bar(image: Image.Image, scale: Scale, y: float, unit: float, ink: Ink) -> None:
    W = image.width
    length, thick = round(min(0.62 * W, 26 * unit)), max(4, round(0.75 * unit))
    left = (W - length) // 2
    share = (np.arange(length) + 0.5) / length
    row = np.round(255 * scale.colors(scale.low + share * (scale.high - scale.low))).astype(np.uint8)
    _paste(image, Image.fromarray(np.tile(row, (thick, 1, 1))), left, round(y), thick / 2)
    y += thick + 0.35 * unit
    taken = -np.inf
    for place, words in scale.ticks():
        x = left + length * (place - scale.low) / (scale.high - scale.low)
        half = width_of(words, 0.9 * unit) / 2
        if x - half < taken + 0.4 * unit:
            continue  # no room beside the one before
        taken = x + half
        ends = (x, y - 0.25 * unit), (x, y - 0.02 * unit)
        ImageDraw.Draw(image).line(ends, fill=ink, width=max(1, round(0.08 * unit)))
        write(image, (x, y + 0.08 * unit), words, 0.9 * unit, ink, "mt")
    x = left + length + 1.6 * unit
    room = W - x - thick - unit
    if scale.unknown and room > 3 * unit:
        words, size = fitting("no value", 0.9 * unit, room)
        _paste(image, _patch(thick, UNKNOWN), round(x), round(y - thick - 0.35 * unit), 0.25 * thick)
        write(image, (x + thick + 0.5 * unit, y - thick / 2 - 0.35 * unit), words, size, ink, "lm")


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


def _draw_swatches(image: Image.Image, swatches: Swatches, y: float, unit: float, ink: Ink) -> None:
    side = max(4, round(0.95 * unit))
    for line in _lines(swatches, image.width, unit):
        x = (image.width - sum(wide for _, _, wide in line) + 1.2 * unit) / 2
        for number, words, wide in line:
            _paste(image, _patch(side, swatches.colors[number]), round(x), round(y + 0.4 * unit), 0.3 * side)
            text, size = fitting(words, unit, wide - 2.7 * unit + 1)
            write(image, (x + side + 0.45 * unit, y + 0.4 * unit + side / 2), text, size, ink, "lm")
            x += wide
        y += 1.75 * unit


def _patch(side: int, color: Color) -> Image.Image:
    red, green, blue = (round(255 * part) for part in color)
    return Image.new("RGB", (side, side), (red, green, blue))


def _paste(image: Image.Image, patch: Image.Image, left: int, top: int, radius: float) -> None:
    """Put a patch into a picture, its corners round."""
    W, H = patch.size
    mask = Image.new("L", (W * _FINE, H * _FINE), 0)
    frame = (0, 0, W * _FINE - 1, H * _FINE - 1)
    ImageDraw.Draw(mask).rounded_rectangle(frame, radius=radius * _FINE, fill=255)
    image.paste(patch, (left, top), mask.resize((W, H), Image.Resampling.BOX))
