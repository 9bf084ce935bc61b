"""What the colors of a picture mean: places on a shape, numbers, and labels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from meshmatch.arrays import Float, Floats
from meshmatch.errors import OptionError
from meshmatch.shapes.colors import UNKNOWN, label_colors, oklab_to_linear, to_srgb
from meshmatch.shapes.shape import Shape

Color = tuple[float, float, float]
CLAY: Color = (0.85, 0.82, 0.78)
# Lightness, chroma, hue in degrees (Oklab). Lightness alone orders them, so a grey print can be read too.
_WARM = ((0.93, 0.025, 85), (0.86, 0.12, 88), (0.74, 0.165, 58), (0.58, 0.20, 28), (0.40, 0.15, 2), (0.27, 0.10, 335))
_COLD = ((0.93, 0.025, 85), (0.80, 0.09, 230), (0.62, 0.14, 252), (0.44, 0.15, 264), (0.30, 0.11, 275))
_FINE = 256


def position_colors(shape: Shape, rotation: Float[Floats, "3 3"] | None = None) -> Float[Floats, "V 3"]:
    """An sRGB color in 0..1 for every vertex, smooth over space: transferred by a map, it shows where points went.

    Height turns the hue nearly once around the circle; left and right shift it and are darker and lighter.
    ``rotation`` leads into a frame with x to the shape's left, y up and z to its front; by default the file's own axes.
    """
    points = shape.verts if rotation is None else shape.verts @ np.asarray(rotation, dtype=np.float64).T
    used = points if shape.invalid is None else points[~shape.invalid]
    low, high = used.min(axis=0), used.max(axis=0)
    extent = np.where(high > low, high - low, 1.0)
    left, up, front = (2 * np.clip((points - low) / extent, 0.0, 1.0) - 1).T
    hue = np.radians(210.0 - 135.0 * up + 70.0 * left)
    lightness = 0.72 + 0.035 * front - 0.085 * left + 0.06 * np.cos(hue - np.radians(95.0))  # yellow is light
    lab = np.stack([lightness, 0.125 * np.cos(hue), 0.125 * np.sin(hue)], axis=1)
    return np.asarray(to_srgb(oklab_to_linear(lab)))


@dataclass(frozen=True)
class Scale:
    """A scale from numbers to colors.

    Numbers beyond ``low`` and ``high`` take the color of the end; ``beyond`` says whether there are some below, and above.
    ``title`` is what is measured, with its unit. ``reverse``: low numbers deserve attention, such as confidence.
    ``unknown``: some have no value.
    """

    low: float
    high: float
    title: str = ""
    reverse: bool = False
    beyond: tuple[bool, bool] = (False, False)
    unknown: bool = False

    def __post_init__(self) -> None:
        if not (np.isfinite(self.low) and np.isfinite(self.high) and self.low < self.high):
            raise OptionError(f"a scale cannot run from {self.low:g} to {self.high:g}", "the lower number comes first")

    @classmethod
    def of(
        cls, values: ArrayLike, title: str = "", limits: tuple[float, float] | None = None, *, reverse: bool = False
    ) -> Scale:
        """A scale for these numbers: round ends, from 0 if they are not negative and reach down to it.

        A few numbers far above the others do not count; the legend then says that there are some.
        """
        numbers = np.asarray(values, dtype=np.float64).ravel()
        finite = numbers[np.isfinite(numbers)]
        low, high = limits or (_round_ends(finite) if len(finite) else (0.0, 1.0))
        beyond = bool((finite < low - 1e-9 * abs(low)).any()), bool((finite > high + 1e-9 * abs(high)).any())
        return cls(float(low), float(high), title, reverse, beyond, len(finite) < len(numbers))

    def colors(self, values: ArrayLike) -> Float[Floats, "N 3"]:
        """sRGB colors in 0..1 of numbers (N,); grey for nan."""
        numbers = np.asarray(values, dtype=np.float64)
        known = np.isfinite(numbers)
        safe = np.where(known, numbers, self.low)
        if self.low < 0 < self.high and not self.reverse:  # both signs need a color
            share = np.clip(safe / max(-self.low, self.high), -1, 1)
        else:
            share = np.clip((safe - self.low) / (self.high - self.low), 0, 1)
            share = 1 - share if self.reverse else share
        at = np.round(np.abs(share) * (_FINE - 1)).astype(int)
        return np.where(known[..., None], np.where((share < 0)[..., None], _ramp(_COLD)[at], _ramp(_WARM)[at]), UNKNOWN)

    def ticks(self) -> list[tuple[float, str]]:
        """Round numbers on the scale, each as text; the ends are among them."""
        step = nice_step(self.high - self.low, 5)
        inner = np.arange(np.ceil(self.low / step), np.floor(self.high / step) + 1) * step
        inner = inner[(inner > self.low + 0.3 * step) & (inner < self.high - 0.3 * step)]
        places = [self.low, *inner.tolist(), self.high]
        words = [f"{0.0 if abs(place) < 1e-9 * step else place:.4g}" for place in places]
        if self.beyond[0]:
            words[0] = f"< {words[0]}"
        if self.beyond[1]:
            words[-1] = f"> {words[-1]}"
        return list(zip(places, words, strict=True))


def _ramp(stops: Sequence[Color]) -> Float[Floats, "256 3"]:
    """sRGB colors between stops, in even steps through Oklab."""
    light, chroma, hue = np.array(stops, dtype=np.float64).T
    points = light, chroma * np.cos(np.radians(hue)), chroma * np.sin(np.radians(hue))
    at, fine = np.linspace(0, 1, len(stops)), np.linspace(0, 1, _FINE)
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
    """1, 2 or 5 times a power of ten, such that about ``parts`` of them make the span."""
    rough = span / parts
    power = 10.0 ** np.floor(np.log10(rough))
    return float(power * next(m for m in (1, 2, 5, 10) if m * power >= rough * (1 - 1e-9)))


@dataclass(frozen=True)
class Swatches:
    """Names and their sRGB colors, for a legend."""

    names: tuple[str, ...]
    colors: tuple[Color, ...]
    title: str = ""


def label_swatches(labels: ArrayLike, names: Sequence[str] = (), most: int = 24) -> Swatches:
    """The legend of the labels (N,) that occur, at most ``most``. Negative ones are called "none"."""
    present = np.unique(np.asarray(labels, dtype=np.int64))
    present = np.concatenate([present[present >= 0], present[present < 0][:1]])
    shown = present if len(present) <= most else present[: most - 1]
    words = ["none" if k < 0 else names[k] if k < len(names) else str(k) for k in shown.tolist()]
    entries = [tuple(color) for color in label_colors(shown).tolist()]
    if len(shown) < len(present):
        words.append(f"and {len(present) - len(shown)} more")
        entries.append(UNKNOWN)
    return Swatches(tuple(words), tuple(entries))
