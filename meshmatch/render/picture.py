"""Shapes side by side in a PNG, each with its name, and a legend."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from PIL import Image

from meshmatch.arrays import UInts8
from meshmatch.errors import OptionError
from meshmatch.outputs import replace_on_success
from meshmatch.render import raster
from meshmatch.render.figures import Figure, Panel, build_figure, rotation_about_x
from meshmatch.render.layout import VIEWS, Page, lay_out
from meshmatch.render.legend import Ink, Legend, draw_legend, fitting, write
from meshmatch.render.scene import Ground, Scene
from meshmatch.shapes.colors import to_linear, to_srgb

MAX_SIDE, MAX_PIXELS = 8192, 36_000_000
_GLASS = 0.34  # opacity of glass seen straight on
_HIDDEN = 0.006  # glass further behind a surface than this is hidden by it
BACKGROUNDS: dict[str, Ink | None] = {"white": (255, 255, 255), "dark": (24, 26, 31), "transparent": None}


@dataclass(frozen=True)
class Look:
    """How shapes are drawn; `OptionError` for a size that is too small or too large, or an invalid background.

    ``size`` is width and height of the picture in pixels; by default `layout.HEIGHT` high and as wide as the shapes need.
    ``background`` is "white", "dark", "transparent", or a color as #rrggbb. ``up`` and ``front`` are the file's axes that
    point up and to the front of the shape: x, y, z, -x, -y or -z; by default guessed from the extents (tall is up, flat
    is to the front; the sign cannot be guessed). ``turn`` and ``tilt`` are degrees by which shapes are rotated to their
    own left, and tilted towards the viewer; 0, 0 is the front. ``ground``: the shapes cast a shadow there. ``legend`` is
    what the colors mean.
    """

    size: tuple[int, int] | None = None
    background: str = "white"
    up: str | None = None
    front: str | None = None
    turn: float = VIEWS["quarter"][0]
    tilt: float = VIEWS["quarter"][1]
    ground: bool = True
    legend: Legend | None = None

    def __post_init__(self) -> None:
        background_color(self.background)
        if self.size is None:
            return
        width, height = self.size
        if min(self.size) < 16:
            raise OptionError(f"a picture of {width} x {height} pixels shows nothing", "the minimum is 16 x 16")
        if max(self.size) > MAX_SIDE or width * height > MAX_PIXELS:
            raise OptionError(
                f"a picture of {width} x {height} pixels is too large",
                f"at most {MAX_SIDE} pixels per side and {MAX_PIXELS // 1_000_000} million in total",
            )


def background_color(background: str) -> Ink | None:
    """The color of a background in 0..255; None if it is transparent. `OptionError` if it is invalid."""
    if background in BACKGROUNDS:
        return BACKGROUNDS[background]
    if re.fullmatch("#[0-9A-Fa-f]{6}", background) is None:
        hint = f"choose {', '.join(BACKGROUNDS)}, or a color such as #e8f0f8"
        raise OptionError(f"invalid background '{background}'", hint)
    red, green, blue = bytes.fromhex(background[1:])
    return red, green, blue


def check_picture(path: str | Path) -> None:
    """Refuse a file name that is not .png (`OptionError`)."""
    if Path(path).suffix.lower() != ".png":
        raise OptionError(f"{Path(path).name}: a picture is a PNG", "end the name in .png")


def render_shapes(
    panels: Sequence[Panel | tuple[object, ArrayLike | None]], path: str | Path, look: Look | None = None
) -> tuple[int, int]:
    """Draw shapes side by side into a PNG, all on one ground and as large as the picture allows; its width and height.

    ``panels`` are `Panel` objects, or pairs ``(shape, colors or None)``. `OptionError` where there is nothing to draw, for
    a suffix other than .png, an invalid axis, or colors of the wrong shape; `OutputError` for a file that cannot be
    written.
    """
    check_picture(path)
    wanted = [panel if isinstance(panel, Panel) else Panel(*panel) for panel in panels]  # type: ignore[arg-type]
    if not wanted:
        raise OptionError("a picture needs a shape")
    with replace_on_success(path) as temporary:  # what cannot be written is told before the work
        image = _image(wanted, look or Look())
        image.save(temporary, format="PNG", compress_level=9)
    return image.size


def _image(panels: list[Panel], look: Look) -> Image.Image:
    figures = [build_figure(panel, look.up, look.front, look.turn, look.tilt) for panel in panels]
    names = [panel.label for panel in panels]
    page = lay_out([figure.box for figure in figures], any(names), look.legend, look.size)
    background = background_color(look.background)
    image = Image.fromarray(_on_background(_trace(figures, page, look), background))
    dark = background is not None and np.dot(background, (0.3, 0.59, 0.11)) < 110
    ink: Ink = (226, 228, 232) if dark else (52, 54, 60)
    for name, (x, y), room in zip(names, page.names.tolist(), page.room.tolist(), strict=True):
        text, size = fitting(name, page.font_size, room)
        if text:
            write(image, (x, y), text, size, ink)
    if look.legend is not None:
        draw_legend(image, look.legend, page.legend, 0.9 * page.font_size, ink)
    return image


def _trace(figures: list[Figure], page: Page, look: Look) -> raster.Layer:
    placed = list(zip(figures, page.feet, strict=True))
    solid = [part.moved(foot) for figure, foot in placed for part in figure.solid]
    glass = [part.moved(foot) for figure, foot in placed for part in figure.glass]
    ground = None
    if look.ground and look.tilt > 0:
        spots = np.stack([figure.spot for figure in figures])
        spots[:, 0] += page.feet
        ground = Ground(rotation_about_x(look.tilt) @ np.array([0.0, 1.0, 0.0]), 0.0, spots)
    hollow = all(figure.hollow for figure in figures)
    layer = None
    if solid:
        layer = raster.draw(Scene(solid, None if hollow else ground), page.viewport)
    if glass:
        veil = raster.draw(Scene(glass, ground if hollow else None, _GLASS), page.viewport)
        layer = veil if layer is None else raster.composite(veil, layer, _HIDDEN)
    assert layer is not None
    return layer


def _on_background(layer: raster.Layer, background: Ink | None) -> UInts8:
    """Bytes (H, W, 3) on a background, or (H, W, 4) without one."""
    rows = []
    for first in range(0, len(layer.alpha), 256):  # in parts: float64 of a large picture is much
        light, alpha = layer.light[first : first + 256], layer.alpha[first : first + 256, :, None]
        if background is None:
            clear = np.concatenate([to_srgb(light / np.maximum(alpha, 1e-6)), alpha], axis=2)
        else:
            clear = to_srgb(light + (1 - alpha) * to_linear(np.array(background) / 255))
        rows.append(np.round(255 * clear).astype(np.uint8))
    return np.concatenate(rows)
