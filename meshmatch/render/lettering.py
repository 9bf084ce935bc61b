"""Words in a picture, in the one font that Pillow brings along."""

from __future__ import annotations

from functools import lru_cache

from PIL import Image, ImageDraw, ImageFont

Ink = tuple[int, int, int]


@lru_cache(maxsize=64)
def font(size: float) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """The font at a size in pixels."""
    return ImageFont.load_default(size=max(size, 6.0))


def width_of(text: str, size: float) -> float:
    """How many pixels a line takes."""
    return float(font(size).getlength(text))


def fitting(text: str, size: float, room: float) -> tuple[str, float]:
    """The text and the size at which it fits into so many pixels: smaller first, then cut in the middle."""
    text = " ".join(text.split())
    while size > 9 and width_of(text, size) > room:
        size *= 0.95
    kept = len(text)
    whole = text
    while width_of(text, size) > room and kept > 2:
        kept -= 1
        text = f"{whole[: (kept + 1) // 2]}…{whole[len(whole) - kept // 2 :]}"
    return text, size


def write(
    image: Image.Image, place: tuple[float, float], text: str, size: float, ink: Ink, anchor: str = "mm"
) -> None:
    """Write a line; ``anchor`` as in Pillow. On a picture with alpha the letters are solid."""
    fill = (*ink, 255) if image.mode == "RGBA" else ink
    ImageDraw.Draw(image).text(place, text, fill=fill, font=font(size), anchor=anchor)
