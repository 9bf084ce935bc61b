"""Text in a picture, in the font that Pillow includes."""

from __future__ import annotations

import unicodedata
from functools import lru_cache

from PIL import Image, ImageDraw, ImageFont

Ink = tuple[int, int, int]
_NO_CHARACTER = "\ufffe"


@lru_cache(maxsize=64)
def font(size: float) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """The font at a size in pixels."""
    return ImageFont.load_default(size=max(size, 6.0))


def width_of(text: str, size: float) -> float:
    """How many pixels a line takes."""
    return float(font(size).getlength(text))


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
    if letter == " ":
        return True
    if unicodedata.category(letter).startswith("C"):
        return False
    wanted, missing = (font(32.0).getmask(part) for part in (letter, _NO_CHARACTER))
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
    fill = (*ink, 255) if image.mode == "RGBA" else ink
    ImageDraw.Draw(image).text(place, text, fill=fill, font=font(size), anchor=anchor)
