"""Colors of a picture (of positions, numbers and labels), and the legend that explains them.

Text is set in the font that Pillow includes.
"""

from __future__ import annotations

import unicodedata
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike
from PIL import Image, ImageDraw, ImageFont

from meshmatch.arrays import Float, Floats
from meshmatch.errors import OptionError
from meshmatch.shapes.colors import UNKNOWN, label_colors, oklab_to_linear, to_srgb
from meshmatch.shapes.shape import Shape

Color = tuple[float, float, float]
Ink = tuple[int, int, int]
CLAY: Color = (0.85, 0.82, 0.78)
# Lightness, chroma, hue in degrees (Oklab). Lightness is monotonic, so that scales can be read in grey prints.
_WARM = ((0.93, 0.025, 85), (0.86, 0.12, 88), (0.74, 0.165, 58), (0.58, 0.20, 28), (0.40, 0.15, 2), (0.27, 0.10, 335))
_COLD = ((0.93, 0.025, 85), (0.80, 0.09, 230), (0.62, 0.14, 252), (0.44, 0.15, 264), (0.30, 0.11, 275))
_N_COLORS = 256
_MAX_NUMBER = 1e300  # at the ends of a scale; positions on larger ones overflow
_NO_CHARACTER = "\ufffe"
# Latin letters that do not decompose into a letter and an accent.
_PLAIN = {"ß": "ss", "ẞ": "SS", "æ": "ae", "Æ": "AE", "œ": "oe", "Œ": "OE", "ø": "o", "Ø": "O", "ł": "l", "Ł": "L"}
_PLAIN |= {"đ": "d", "Đ": "D", "ð": "d", "Ð": "D", "þ": "th", "Þ": "Th", "ħ": "h", "Ħ": "H", "ı": "i"}
_SUPERSAMPLING = 4  # shapes are drawn this many times larger and then reduced, for smooth corners


def position_colors(shape: Shape, rotation: Float[Floats, "3 3"] | None = None) -> Float[Floats, "V 3"]:
    """An sRGB color in 0..1 for every vertex, smooth in space; transferred by a map, it shows where points went.

    Height turns the hue nearly once around the circle; left and right shift it, and are darker and lighter. ``rotation``
    leads into a frame with x to the shape's left, y up and z to its front; by default the file's axes are used.
    """
    points = shape.verts if rotation is None else shape.verts @ np.asarray(rotation, dtype=np.float64).T
    used = points[shape.on_surface]
    low, high = used.min(axis=0), used.max(axis=0)
    extent = np.where(high > low, high - low, 1.0)
    left, up, front = (2 * np.clip((points - low) / extent, 0.0, 1.0) - 1).T
    hue = np.radians(210.0 - 135.0 * up + 70.0 * left)
    lightness = 0.72 + 0.035 * front - 0.085 * left + 0.06 * np.cos(hue - np.radians(95.0))  # yellow is light
    lab = np.stack([lightness, 0.125 * np.cos(hue), 0.125 * np.sin(hue)], axis=1)
    return np.asarray(to_srgb(oklab_to_linear(lab)))


@dataclass(frozen=True)
class Scale:
    """A scale from numbers to colors; ``title`` is the quantity and its unit.

    Numbers beyond ``low`` and ``high`` have the colors of the ends; ``beyond`` says whether any are below, and above.
    ``reverse``: low numbers deserve attention, as with confidence. ``unknown``: whether some values are missing.
    """

    low: float
    high: float
    title: str = ""
    reverse: bool = False
    beyond: tuple[bool, bool] = (False, False)
    unknown: bool = False

    def __post_init__(self) -> None:
        if not (self.low < self.high and max(abs(self.low), abs(self.high)) < _MAX_NUMBER):
            hint = "the lower number comes first" if self.low >= self.high else f"give numbers below {_MAX_NUMBER:g}"
            raise OptionError(f"a scale cannot run from {self.low:g} to {self.high:g}", hint)

    @classmethod
    def of(cls, values: ArrayLike, title: str = "", limits: tuple[float, float] | None = None) -> Scale:
        """A scale with round ends for these numbers; it starts at 0 if they are not negative and come near 0. Outliers far
        above the others are cut off, which the legend then shows.
        """
        numbers = np.asarray(values, dtype=np.float64).ravel()
        finite = numbers[np.isfinite(numbers)]
        low, high = limits or (_round_ends(finite) if len(finite) else (0.0, 1.0))
        beyond = bool((finite < low - 1e-9 * abs(low)).any()), bool((finite > high + 1e-9 * abs(high)).any())
        return cls(float(low), float(high), title, beyond=beyond, unknown=len(finite) < len(numbers))

    def colors(self, values: ArrayLike) -> Float[Floats, "N 3"]:
        """sRGB colors (N, 3) in 0..1 of numbers (N,); grey for nan."""
        numbers = np.asarray(values, dtype=np.float64)
        known = np.isfinite(numbers)
        safe = np.where(known, numbers, self.low)
        if self.low < 0 < self.high and not self.reverse:  # both signs need a color
            share = np.clip(safe / max(-self.low, self.high), -1, 1)
        else:
            with np.errstate(over="ignore"):  # of a tiny range; clipped
                share = np.clip((safe - self.low) / (self.high - self.low), 0, 1)
            share = 1 - share if self.reverse else share
        at = np.round(np.abs(share) * (_N_COLORS - 1)).astype(int)
        return np.where(
            known[..., None], np.where((share < 0)[..., None], _color_ramp(_COLD)[at], _color_ramp(_WARM)[at]), UNKNOWN
        )

    def ticks(self) -> list[tuple[float, str]]:
        """Round numbers on the scale, including the ends, each with its text."""
        step = nice_step(self.high - self.low, 5)
        inner = np.arange(np.ceil(self.low / step), np.floor(self.high / step) + 1) * step
        inner = inner[(inner > self.low + 0.3 * step) & (inner < self.high - 0.3 * step)]
        places = [self.low, *inner.tolist(), self.high]
        words = [f"{0.0 if abs(place) < 1e-9 * step else place:.4g}" for place in places]
        for end, sign, some in zip((0, -1), "<>", self.beyond, strict=True):
            words[end] = f"{sign} {words[end]}" if some else words[end]
        return list(zip(places, words, strict=True))


def _color_ramp(stops: Sequence[Color]) -> Float[Floats, "256 3"]:
    """(256, 3) sRGB colors between stops, in even steps through Oklab."""
    light, chroma, hue = np.array(stops, dtype=np.float64).T
    points = light, chroma * np.cos(np.radians(hue)), chroma * np.sin(np.radians(hue))
    at, fine = np.linspace(0, 1, len(stops)), np.linspace(0, 1, _N_COLORS)
    lab = np.stack([np.interp(fine, at, each) for each in points], axis=1)
    return np.asarray(to_srgb(oklab_to_linear(lab)))


def _round_ends(finite: Float[Floats, " N"]) -> tuple[float, float]:
    low, high = float(finite.min()), float(finite.max())
    bulk = float(np.quantile(finite, 0.99))
    if bulk > 0 and high > 1.6 * bulk:
        high = bulk
    if low < 0 < high:
        low, high = min(low, -high), max(-low, high)
    elif 0 <= low < 0.4 * high:
        low = 0.0
    if not high > low:
        spread = abs(high) if high else 1.0
        low, high = (0.0, spread) if low >= 0 else (low, low + spread)
    step = nice_step(high - low, 5)
    return (float(np.floor(low / step + 1e-9) * step), float(np.ceil(high / step - 1e-9) * step))


def nice_step(span: float, parts: int) -> float:
    """1, 2 or 5 times a power of ten, such that about ``parts`` steps make up the span."""
    rough = span / parts
    power = 10.0 ** np.floor(np.log10(rough))
    return float(power * next(m for m in (1, 2, 5, 10) if m * power >= rough * (1 - 1e-9)))


@dataclass(frozen=True)
class Swatches:
    """Names and their sRGB colors, as a legend."""

    names: tuple[str, ...]
    colors: tuple[Color, ...]
    title: str = ""


def label_swatches(labels: ArrayLike, names: Sequence[str] = (), most: int = 24) -> Swatches:
    """The legend of labels (N,) that occur, with at most ``most`` entries. Negative labels are called "none"."""
    present = np.unique(np.asarray(labels, dtype=np.int64))
    present = np.concatenate([present[present >= 0], present[present < 0][:1]])
    shown = present if len(present) <= most else present[: most - 1]
    entry_names = ["none" if k < 0 else names[k] if k < len(names) else str(k) for k in shown.tolist()]
    entries = [tuple(color) for color in label_colors(shown).tolist()]
    if len(shown) < len(present):
        entry_names.append(f"and {len(present) - len(shown)} more")
        entries.append(UNKNOWN)
    return Swatches(tuple(entry_names), tuple(entries))


Legend = Scale | Swatches


@lru_cache(maxsize=64)
def _font(size: float) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size=max(size, 6.0))


def text_width(text: str, size: float) -> float:
    """Width in pixels of a line of text at this font size in pixels."""
    return float(_font(size).getlength(text))


def readable(text: str, has_glyph: Callable[[str], bool] | None = None) -> str:
    """The text on one line, in letters that the font has: Latin letters without accents if necessary, others as "?".

    ``has_glyph`` says whether the font has a letter; by default the font is that of pictures.
    """
    known = has_glyph or _has_glyph
    out = []
    for letter in unicodedata.normalize("NFC", " ".join(text.split())):
        plain = letter if known(letter) else _PLAIN.get(letter) or unicodedata.normalize("NFKD", letter)
        kept = "".join(part for part in plain if known(part) and not unicodedata.combining(part))
        out.append(kept or ("" if unicodedata.combining(letter) else "?"))
    return "".join(out)


def short(text: str, most: int = 60, has_glyph: Callable[[str], bool] | None = None) -> str:
    """The text as by `readable`, cut in the middle if it is longer than ``most`` letters."""
    text = readable(text, has_glyph)
    return text if len(text) <= most else f"{text[: most // 2]}…{text[-(most // 2 - 1) :]}"


@lru_cache(maxsize=4096)
def _has_glyph(letter: str) -> bool:
    if unicodedata.category(letter).startswith("C"):
        return False
    glyph, missing_glyph = (_font(32.0).getmask(part) for part in (letter, _NO_CHARACTER))
    return (glyph.size, bytes(glyph)) != (missing_glyph.size, bytes(missing_glyph))


def fit_text(text: str, size: float, room: float) -> tuple[str, float]:
    """The text and its font size such that it fits into ``room`` pixels: reduced first, then cut in the middle."""
    text = short(text, 400)
    while size > 9 and text_width(text, size) > room:
        size *= 0.95
    kept, whole = len(text), text
    while text_width(text, size) > room and kept > 2:
        kept -= 1
        text = f"{whole[: (kept + 1) // 2]}…{whole[len(whole) - kept // 2 :]}"
    return text, size


def draw_text(
    image: Image.Image, place: tuple[float, float], text: str, size: float, ink: Ink, anchor: str = "mm"
) -> None:
    """Write a line of text; ``anchor`` as in Pillow. On a picture with alpha the letters are opaque."""
    ImageDraw.Draw(image).text(place, text, fill=ink, font=_font(size), anchor=anchor)


def legend_height(legend: Legend, width: int, unit: float) -> int:
    """Height in pixels of a legend under a picture of this width; ``unit`` is its font size."""
    if isinstance(legend, Scale):
        return round((4.1 if legend.title else 2.9) * unit)
    lines = len(_lines(legend, width, unit))
    return round((0.8 + 1.75 * lines + (1.6 if legend.title else 0)) * unit)


def draw_legend(image: Image.Image, legend: Legend, top: int, unit: float, ink: Ink) -> None:
    """Draw a centred legend into a picture, starting at row ``top``."""
    y = top + 0.2 * unit
    if legend.title:
        text, size = fit_text(legend.title, unit, 0.94 * image.width)
        draw_text(image, (image.width / 2, y + 0.6 * unit), text, size, ink)
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
    _paste_rounded(image, Image.fromarray(np.tile(row, (thick, 1, 1))), left, round(y), thick / 2)
    y += thick + 0.35 * unit
    right_end = -np.inf
    for place, words in scale.ticks():
        x = left + length * (place - scale.low) / (scale.high - scale.low)
        half = text_width(words, 0.9 * unit) / 2
        if x - half < right_end + 0.4 * unit:
            continue  # no room next to the previous one
        right_end = x + half
        ends = (x, y - 0.25 * unit), (x, y - 0.02 * unit)
        ImageDraw.Draw(image).line(ends, fill=ink, width=max(1, round(0.08 * unit)))
        draw_text(image, (x, y + 0.08 * unit), words, 0.9 * unit, ink, "mt")
    x = left + length + 1.6 * unit
    room = W - x - thick - unit
    if scale.unknown and room > 3 * unit:
        words, size = fit_text("no value", 0.9 * unit, room)
        _paste_rounded(image, _color_patch(thick, UNKNOWN), round(x), round(y - thick - 0.35 * unit), 0.25 * thick)
        draw_text(image, (x + thick + 0.5 * unit, y - thick / 2 - 0.35 * unit), words, size, ink, "lm")


def _lines(swatches: Swatches, width: int, unit: float) -> list[list[tuple[int, str, float]]]:
    """Entries (number, text, width in pixels), broken into lines that fit."""
    lines: list[list[tuple[int, str, float]]] = [[]]
    used = 0.0
    for number, name in enumerate(swatches.names):
        words, size = fit_text(name, unit, 0.9 * width - 1.6 * unit)
        wide = text_width(words, size) + 2.7 * unit
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
            _paste_rounded(
                image, _color_patch(side, swatches.colors[number]), round(x), round(y + 0.4 * unit), 0.3 * side
            )
            text, size = fit_text(words, unit, wide - 2.7 * unit + 1)
            draw_text(image, (x + side + 0.45 * unit, y + 0.4 * unit + side / 2), text, size, ink, "lm")
            x += wide
        y += 1.75 * unit


def _color_patch(side: int, color: Color) -> Image.Image:
    red, green, blue = (round(255 * part) for part in color)
    return Image.new("RGB", (side, side), (red, green, blue))


def _paste_rounded(image: Image.Image, patch: Image.Image, left: int, top: int, radius: float) -> None:
    """Paste a patch with rounded corners into a picture."""
    W, H = patch.size
    mask = Image.new("L", (W * _SUPERSAMPLING, H * _SUPERSAMPLING), 0)
    frame = (0, 0, W * _SUPERSAMPLING - 1, H * _SUPERSAMPLING - 1)
    ImageDraw.Draw(mask).rounded_rectangle(frame, radius=radius * _SUPERSAMPLING, fill=255)
    image.paste(patch, (left, top), mask.resize((W, H), Image.Resampling.BOX))
