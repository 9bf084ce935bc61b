"""Pictures (PNG) of shapes side by side on a common ground, with their names and a legend."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from PIL import Image

from meshmatch.arrays import Float, Floats, UInts8
from meshmatch.errors import OptionError
from meshmatch.outputs import as_path, replace_on_success
from meshmatch.render import raster
from meshmatch.render.figures import Figure, Panel, build_figure, rotation_about_x
from meshmatch.render.scales import Ink, Legend, draw_legend, draw_text, fit_text, legend_height
from meshmatch.render.scene import Ground, Scene
from meshmatch.shapes.colors import to_linear, to_srgb

VIEWS = {
    "quarter": (22.0, 10.0),
    "front": (0.0, 8.0),
    "left": (-90.0, 8.0),
    "right": (90.0, 8.0),
    "back": (180.0, 8.0),
    "above": (0.0, 65.0),
}
"""Named views: turn and tilt in degrees. Left and right are the shape's own sides."""
HEIGHT = 800
"""Height in pixels of a picture whose size is not given; its width is what the shapes need."""
_GAP = 0.16  # minimum distance between two figures, in units of sqrt(area)
_MAX_WIDTH, _MIN_ASPECT = 2000, 0.62  # of a picture whose size is not given: pixels, and width over `HEIGHT`
_MARGIN = 0.045  # free space around the shapes, as a share of the height
MAX_SIDE, MAX_PIXELS = 8192, 36_000_000
_GLASS_OPACITY = 0.34  # of glass seen straight on
_HIDDEN_DEPTH = 0.006  # glass farther behind a surface than this is hidden by it
BACKGROUNDS: dict[str, Ink | None] = {"white": (255, 255, 255), "dark": (24, 26, 31), "transparent": None}


@dataclass(frozen=True)
class Look:
    """How shapes are drawn; `OptionError` for a size that is too small or too large, or an invalid background.

    ``size`` is the width and height of the picture in pixels; by default it is `HEIGHT` high and as wide as the shapes need.
    ``background`` is "white", "dark", "transparent", or a color as #rrggbb. ``up`` and ``front`` are the file's axes that
    point up and to the front of the shape: x, y, z, -x, -y or -z. By default they are guessed from the shape (see
    `meshmatch.render.facing`); name them where the guess is wrong. ``turn`` and ``tilt`` are degrees by which shapes are
    rotated to their own left, and tilted towards the viewer; 0, 0 is the front. ``ground``: whether shapes cast a shadow on
    the ground. ``legend`` explains the colors.
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
            hint = f"at most {MAX_SIDE} pixels per side and {MAX_PIXELS // 1_000_000} million in total"
            raise OptionError(f"a picture of {width} x {height} pixels is too large", hint)


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
    """Raise `OptionError` for a file name that is not .png."""
    path = as_path(path)
    if path.suffix.lower() != ".png":
        raise OptionError(f"{path.name}: a picture is a PNG", "end the name in .png")


def render_shapes(
    panels: Sequence[Panel | tuple[object, ArrayLike | None]], path: str | Path, look: Look | None = None
) -> tuple[int, int]:
    """Draw shapes side by side into a PNG, on one ground and as large as the picture allows; return its width and height.

    ``panels`` are `Panel` objects, or pairs ``(shape, colors or None)``. `OptionError` if there is nothing to draw, or for a
    suffix other than .png, an invalid axis, or colors of the wrong shape; `OutputError` for a file that cannot be written.
    """
    check_picture(path)
    wanted = [panel if isinstance(panel, Panel) else Panel(*panel) for panel in panels]  # type: ignore[arg-type]
    if not wanted:
        raise OptionError("a picture needs a shape")
    with replace_on_success(path) as temporary:  # opened first, so that a path that cannot be written fails early
        image = _render(wanted, look or Look())
        image.save(temporary, format="PNG", compress_level=9)
    return image.size


def draw_apart(panels: Sequence[Panel], side: int, look: Look = Look()) -> list[UInts8]:
    """Pictures (H, W, 4) in sRGB of single shapes, transparent, without labels and ground. All are at one scale, at which
    the longest side of the largest has ``side`` pixels. Errors as in `render_shapes`.
    """
    figures = [build_figure(panel, look.up, look.front, look.turn, look.tilt) for panel in panels]
    pixel = max([1e-9, *(float(np.ptp(figure.box, axis=0).max()) for figure in figures)]) / (side - 2)
    pictures = []
    for figure in figures:
        (left, bottom), (right, top) = figure.box.tolist()
        width, height = (int(np.ceil(length / pixel)) + 2 for length in (right - left, top - bottom))
        viewport = raster.Viewport(width, height, left - pixel, top + pixel, pixel)
        pictures.append(_on_background(_trace([figure], np.zeros(1), viewport, replace(look, ground=False)), None))
    return pictures


def _render(panels: list[Panel], look: Look) -> Image.Image:
    figures = [build_figure(panel, look.up, look.front, look.turn, look.tilt) for panel in panels]
    names = [panel.label for panel in panels]
    page = lay_out([figure.box for figure in figures], any(names), look.legend, look.size)
    background = background_color(look.background)
    image = Image.fromarray(_on_background(_trace(figures, page.feet, page.viewport, look), background))
    dark = background is not None and np.dot(background, (0.3, 0.59, 0.11)) < 110
    ink: Ink = (226, 228, 232) if dark else (52, 54, 60)
    places = list(zip(names, page.names.tolist(), page.room.tolist(), strict=True))
    size = min(fit_text(name, page.font_size, room)[1] for name, _, room in places)
    for name, (x, y), room in places:
        if name:
            draw_text(image, (x, y), fit_text(name, size, room)[0], size, ink)
    if look.legend is not None:
        draw_legend(image, look.legend, page.legend, 0.9 * page.font_size, ink)
    return image


def _trace(figures: list[Figure], feet: Float[Floats, " N"], viewport: raster.Viewport, look: Look) -> raster.Layer:
    placed = list(zip(figures, feet, strict=True))
    solid = [part.moved(foot) for figure, foot in placed for part in figure.solid]
    glass = [part.moved(foot) for figure, foot in placed for part in figure.glass]
    ground = None
    if look.ground and look.tilt > 0:
        spots = np.stack([figure.spot for figure in figures])
        spots[:, 0] += feet
        ground = Ground(rotation_about_x(look.tilt) @ np.array([0.0, 1.0, 0.0]), 0.0, spots)
    hollow = all(figure.hollow for figure in figures)
    layer = None
    if solid:
        layer = raster.draw(Scene(solid, None if hollow else ground), viewport)
    if glass:
        veil = raster.draw(Scene(glass, ground if hollow else None, _GLASS_OPACITY), viewport)
        layer = veil if layer is None else raster.composite(veil, layer, _HIDDEN_DEPTH)
    assert layer is not None
    return layer


def _on_background(layer: raster.Layer, background: Ink | None) -> UInts8:
    """Pixels of a layer: (H, W, 3) bytes on a background, or (H, W, 4) without one."""
    rows = []
    for first in range(0, len(layer.alpha), 256):  # in parts, to limit the memory for float64
        light, alpha = layer.light[first : first + 256], layer.alpha[first : first + 256, :, None]
        if background is None:
            clear = np.concatenate([to_srgb(light / np.maximum(alpha, 1e-6)), alpha], axis=2)
        else:
            clear = to_srgb(light + (1 - alpha) * to_linear(np.array(background) / 255))
        rows.append(np.round(255 * clear).astype(np.uint8))
    return np.concatenate(rows)


@dataclass(frozen=True, eq=False)
class PageLayout:
    """Layout of a picture: the viewport, and x of each figure's foot in view coordinates; in pixels the font size, the
    center of each name and the width available for it, and the first row of the legend.
    """

    viewport: raster.Viewport
    feet: Float[Floats, " N"]
    font_size: float
    names: Float[Floats, "N 2"]
    room: Float[Floats, " N"]
    legend: int


def lay_out(
    boxes: list[Float[Floats, "2 2"]], named: bool, legend: Legend | None, size: tuple[int, int] | None
) -> PageLayout:
    """Place figures on a page, by their boxes (left, bottom; right, top) in view coordinates with the foot at 0.

    `OptionError` if the size leaves no room for the shapes above names and legend.
    """
    stacked = np.stack(boxes)
    shorter = min(size[1], 1.6 * size[0]) if size else HEIGHT
    font_size = float(np.clip(0.027 * shorter, 9, 60))
    names = round(2.3 * font_size) if named else 0
    width, height = size or _natural_size(stacked, names, legend, font_size)
    below = names + _legend_rows(legend, width, font_size)
    margin = _MARGIN * min(height, 1.5 * width)
    available = np.array([width - 2 * margin, height - below - (1.6 if below else 2) * margin])
    if available.min() < 8 and below:
        raise OptionError(f"{width} x {height} pixels leave no room above names and legend", "make the picture larger")
    feet, box = _arrange(stacked, available[0] / available[1])
    pixel = max(*((box[1] - box[0]) / available), 1e-9)
    middle = box.mean(axis=0)
    upper = height - below - (0.3 * margin if below else 0.0)
    left = float(middle[0] - width / 2 * pixel)
    viewport = raster.Viewport(width, height, left, float(middle[1] + (upper / 2 + 0.15 * margin) * pixel), pixel)
    at = (feet + stacked[:, :, 0].mean(axis=1) - left) / pixel
    places = np.stack([at, np.full(len(at), height - below + 0.42 * names)], axis=1)
    room = 2 * (np.minimum(at, width - at) - 0.4 * margin)  # to the edges of the page
    if len(boxes) > 1:
        gap = feet[1] + stacked[1, 0, 0] - feet[0] - stacked[0, 1, 0]
        room = np.minimum(room, (np.ptp(stacked[:, :, 0], axis=1) + 0.8 * gap) / pixel)
    return PageLayout(viewport, feet, font_size, places, room, height - below + names)


def _arrange(boxes: Float[Floats, "N 2 2"], aspect: float) -> tuple[Float[Floats, " N"], Float[Floats, "2 2"]]:
    """x of each foot, and the box of all; gaps widen to fill an ``aspect`` (width over height), where 0 is the narrowest."""
    widths = boxes[:, 1, 0] - boxes[:, 0, 0]
    bottom, top = boxes[:, 0, 1].min(), boxes[:, 1, 1].max()
    gap = _GAP * max(1.0, float(np.median(widths)))
    spare = aspect * (top - bottom) - widths.sum()
    gap = float(np.clip(spare / (len(boxes) - 0.5), gap, 3 * gap))
    lefts = np.concatenate([[0.0], np.cumsum(widths + gap)[:-1]])
    return lefts - boxes[:, 0, 0], np.array([[0.0, bottom], [lefts[-1] + widths[-1], top]])


def _legend_rows(legend: Legend | None, width: int, font_size: float) -> int:
    return legend_height(legend, width, 0.9 * font_size) + round(0.5 * font_size) if legend else 0


def _natural_size(
    boxes: Float[Floats, "N 2 2"], names: int, legend: Legend | None, font_size: float
) -> tuple[int, int]:
    """Width and height in pixels; a legend adds to the usual height, so that shapes do not get smaller."""
    _, whole = _arrange(boxes, 0.0)
    wide, tall = whole[1] - whole[0]
    margin = _MARGIN * HEIGHT
    pixel = tall / (HEIGHT - names - 2 * margin)
    width, height = wide / pixel + 2 * margin, float(HEIGHT - names)
    if width > _MAX_WIDTH:
        pixel = wide / (_MAX_WIDTH - 2 * margin)
        width, height = float(_MAX_WIDTH), max(tall / pixel + 2 * margin, 0.25 * HEIGHT)
    width = max(width, _MIN_ASPECT * HEIGHT)
    return round(width), round(height + names + _legend_rows(legend, round(width), font_size))
