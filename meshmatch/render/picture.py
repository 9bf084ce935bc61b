"""Shapes side by side in a PNG, each with its name, and a legend."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from meshmatch.errors import OptionError
from meshmatch.outputs import replace_on_success
from meshmatch.render import raster
from meshmatch.render.colors import to_linear, to_srgb
from meshmatch.render.figures import Figure, Panel, figures
from meshmatch.render.framing import VIEWS, leant
from meshmatch.render.layout import Page, lay_out
from meshmatch.render.legend import Legend, draw_legend
from meshmatch.render.lettering import Ink, fitting, write
from meshmatch.render.scene import Ground, Scene

FloatArray = NDArray[np.float64]

LARGEST = 8192, 36_000_000
"""The longest side and the most pixels that a picture may have."""
_GLASS = 0.34  # opacity of glass seen straight on
_NEAR = 0.006  # glass further behind a surface than this is hidden by it
BACKGROUNDS: dict[str, Ink | None] = {"white": (255, 255, 255), "dark": (24, 26, 31), "transparent": None}


@dataclass(frozen=True)
class Look:
    """What a picture has apart from its shapes.

    Parameters
    ----------
    size : (width, height), optional
        Of the whole picture, in pixels. Otherwise `layout.HEIGHT` high, and as wide as the shapes need.
    background : str
        "white", "dark", "transparent", or a colour as #rrggbb.
    up, front : str, optional
        The file's axis that points up, and the one that the shape faces: x, y, z, -x, -y or -z. Guessed from
        the extents if not given: tall is up, flat is to the front; the sign cannot be guessed.
    turn, tilt : float
        Degrees: turned to its own left, and leant towards the viewer. 0, 0 is straight from the front.
    ground : bool
        Whether the shapes throw a shadow on the ground.
    legend : Scale or Swatches, optional
        What the colours mean.

    Raises
    ------
    OptionError
        A size that is too small or too large, or a background that is none.
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
        if self.size is not None:
            check_size(self.size)
        paper_of(self.background)


def check_size(size: tuple[int, int]) -> None:
    """Refuse a picture too small to see, or too large to hold (`OptionError`)."""
    width, height = size
    side, pixels = LARGEST
    if min(size) < 16:
        raise OptionError(f"a picture of {width} x {height} pixels shows nothing", "16 x 16 is the smallest")
    if max(size) > side or width * height > pixels:
        raise OptionError(
            f"a picture of {width} x {height} pixels is too large",
            f"at most {side} a side and {pixels // 1_000_000} million pixels",
        )


def paper_of(background: str) -> Ink | None:
    """The colour of a background in 0..255; None if it is transparent. `OptionError` if it is none."""
    if background in BACKGROUNDS:
        return BACKGROUNDS[background]
    digits = background.removeprefix("#")
    if background.startswith("#") and len(digits) == 6 and set(digits.lower()) <= set("0123456789abcdef"):
        return int(digits[:2], 16), int(digits[2:4], 16), int(digits[4:], 16)
    raise OptionError(
        f"'{background}' is no background", f"choose {', '.join(BACKGROUNDS)}, or a colour such as #e8f0f8"
    )


def render_shapes(
    panels: Sequence[Panel | tuple[object, ArrayLike | None]],
    path: str | Path,
    look: Look | None = None,
    *,
    labels: Sequence[str] | None = None,
) -> tuple[int, int]:
    """Draw shapes side by side into a PNG, each on the same ground and as large as the picture allows.

    Parameters
    ----------
    panels
        `Panel` objects, or pairs ``(shape, colors or None)``.
    path
        Ends in .png.
    look
        Size, background, view and legend.
    labels
        Names, one for each panel; they override those of the panels.

    Returns
    -------
    (int, int)
        Width and height in pixels.

    Raises
    ------
    OptionError
        Nothing to draw, a suffix other than .png, an axis that is none, or colours of the wrong shape.
    OutputError
        The file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".png":
        raise OptionError(f"{path.name}: a picture is a PNG", "end the name in .png")
    wanted = [panel if isinstance(panel, Panel) else Panel(*panel) for panel in panels]  # type: ignore[arg-type]
    if not wanted:
        raise OptionError("a picture needs a shape")
    if labels is not None and len(labels) != len(wanted):
        raise OptionError(f"{len(wanted)} shapes need {len(wanted)} labels, not {len(labels)}")
    names = list(labels) if labels is not None else [panel.label for panel in wanted]
    image = _drawn(wanted, names, look or Look())
    with replace_on_success(path) as temporary:
        image.save(temporary, format="PNG", compress_level=9)
    return image.size


def _drawn(panels: list[Panel], names: list[str], look: Look) -> Image.Image:
    made = figures(panels, look.up, look.front, look.turn, look.tilt)
    page = lay_out([figure.box for figure in made], any(names), look.legend, look.size)
    paper = paper_of(look.background)
    image = Image.fromarray(_on_paper(_light(made, page, look), paper))
    dark = paper is not None and np.dot(paper, (0.3, 0.59, 0.11)) < 110
    ink: Ink = (226, 228, 232) if dark else (52, 54, 60)
    for name, place, room in zip(names, page.names.tolist(), page.room.tolist(), strict=True):
        text, size = fitting(name, page.letters, room)
        if text:
            write(image, (place[0], place[1]), text, size, ink)
    if look.legend is not None:
        draw_legend(image, look.legend, page.legend, 0.9 * page.letters, ink)
    return image


def _light(made: list[Figure], page: Page, look: Look) -> raster.Image:
    shifts = [np.array([foot, 0.0, 0.0]) for foot in page.feet]
    solid = [part.moved(shift) for figure, shift in zip(made, shifts, strict=True) for part in figure.solid]
    glass = [part.moved(shift) for figure, shift in zip(made, shifts, strict=True) for part in figure.glass]
    ground = None
    if look.ground and look.tilt > 0:
        lean = leant(look.tilt)
        spots = np.stack([figure.spot for figure in made])
        spots[:, 0] += page.feet
        ground = Ground(lean @ np.array([0.0, 1.0, 0.0]), 0.0, spots)
    through = all(figure.hollow for figure in made)
    drawn = None
    if solid:
        drawn = raster.draw(Scene(solid, None if through else ground), page.window)
    if glass:
        veil = raster.draw(Scene(glass, ground if through else None, _GLASS), page.window)
        drawn = veil if drawn is None else raster.laid_over(veil, drawn, _NEAR)
    assert drawn is not None
    return drawn


def _on_paper(drawn: raster.Image, paper: Ink | None) -> NDArray[np.uint8]:
    """Bytes (H, W, 3) on paper, or (H, W, 4) without."""
    rows = []
    for first in range(0, len(drawn.alpha), 256):  # by parts: float64 of a large picture is much
        light, alpha = drawn.light[first : first + 256], drawn.alpha[first : first + 256, :, None]
        if paper is None:
            clear = np.concatenate([to_srgb(light / np.maximum(alpha, 1e-6)), alpha], axis=2)
        else:
            clear = to_srgb(light + (1 - alpha) * to_linear(np.array(paper) / 255))
        rows.append(np.round(255 * clear).astype(np.uint8))
    return np.concatenate(rows)
