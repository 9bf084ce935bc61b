"""Pictures that lie on surfaces: bytes of a file to pixels and back, within bounds."""

from __future__ import annotations

import struct
import warnings
import zlib
from io import BytesIO

import numpy as np
from PIL import Image

from meshmatch.arrays import UInts8
from meshmatch.errors import InputError

Pixels = UInts8

MAX_PIXELS = 8192 * 8192
"""Of one image. Pillow's own alarm stands a little higher."""
MAX_ALL_PIXELS = 2 * MAX_PIXELS
"""Of all images of one shape together."""
_FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TGA", "TIFF")
_DAMAGE = (OSError, SyntaxError, ValueError, EOFError, struct.error, zlib.error, TypeError, IndexError)


class ImageReader:
    """Decodes the images of one shape, and counts their pixels: a small file can promise gigabytes."""

    def __init__(self) -> None:
        self.left = MAX_ALL_PIXELS

    def decode(self, data: bytes, label: str) -> Pixels:
        """(H, W, 4) red, green, blue, alpha of the bytes of a png, jpeg, webp, bmp, tga or tiff, top row first.

        Raises
        ------
        InputError
            No image of these, damaged, or too large.
        """
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # the bomb is judged here; other warnings are of metadata
                with Image.open(BytesIO(data), formats=_FORMATS) as image:
                    width, height = image.size
                    self._count(width * height, label, f"{width} x {height}")
                    return _rgba(image)
        except Image.DecompressionBombError as error:
            raise _too_large(label, "over 179 million pixels") from error
        except Image.UnidentifiedImageError as error:
            raise InputError(f"{label} cannot be read as an image", "save it as png or jpg") from error
        except _DAMAGE as error:
            raise InputError(
                f"{label} is a damaged image ({_first_line(error)})", "export it or copy it again"
            ) from error

    def _count(self, pixels: int, label: str, size: str) -> None:
        if pixels > MAX_PIXELS:
            raise _too_large(label, f"{size} pixels")
        self.left -= pixels
        if self.left < 0:
            raise _too_large(label, f"{size} pixels, and the others before it nearly as many")


def png_bytes(pixels: Pixels) -> bytes:
    """A PNG of (H, W, 4) pixels; without alpha if that is 255 everywhere."""
    opaque = bool((pixels[..., 3] == 255).all())
    image = Image.fromarray(np.ascontiguousarray(pixels[..., :3]) if opaque else pixels)
    out = BytesIO()
    image.save(out, format="PNG", compress_level=4)  # 6 takes twice as long for 3 % less
    return out.getvalue()


def _rgba(image: Image.Image) -> Pixels:
    if image.mode.startswith("I") or image.mode == "F":  # 16 bits of grey, which Pillow would cut off
        grey = np.asarray(image).astype(np.float64)
        most = 65535.0 if image.mode.startswith("I") else 1.0
        byte = np.round(255 * np.clip(np.nan_to_num(grey) / most, 0, 1)).astype(np.uint8)
        return np.stack([byte, byte, byte, np.full_like(byte, 255)], axis=-1)
    return np.array(image.convert("RGBA"))


def _too_large(label: str, what: str) -> InputError:
    side = int(MAX_PIXELS**0.5)
    return InputError(f"{label} is too large: {what}", f"make it smaller: at most {side} x {side} pixels")


def _first_line(error: BaseException) -> str:
    return (str(error) or type(error).__name__).strip().splitlines()[0][:80]
