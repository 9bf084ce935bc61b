"""Shapes side by side in a PNG, each with its caption."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageDraw, ImageFont
from scipy.spatial import cKDTree

from meshmatch.errors import OptionError
from meshmatch.outputs import replace_on_success
from meshmatch.render.colors import CLAY, to_linear, to_srgb
from meshmatch.render.rays import Scene, Surface, spheres
from meshmatch.shapes.shape import Shape

FloatArray = NDArray[np.float64]

_MARGIN = 0.04  # of the panel, free on every side
_AXES = {
    sign + name: (-1.0 if sign else 1.0) * np.eye(3)[k] for k, name in enumerate("xyz") for sign in ("", "-")
}
_MOST_BALLS = 60_000  # of a larger cloud every n-th point is drawn: more would be smaller than a pixel
_NODE_COLOR = (0.85, 0.25, 0.10)


@dataclass(frozen=True, eq=False)
class Panel:
    """One shape of a picture.

    Parameters
    ----------
    shape
        A mesh, or a cloud: its points are drawn as small balls.
    colors : (V, 3) or (V, 4) float, optional
        0..1 for each vertex; the shape's own colours, or the colour of clay, if there are none. Alpha is
        ignored.
    label
        Caption below it.
    points : (K, 3) float, optional
        Drawn as balls on top, in the shape's own frame: nodes, landmarks.
    point_colors : (K, 3) float, optional
        Their colours.
    point_radius : float, optional
        Their radius, in the unit of the shape.
    rotation : (3, 3) float, optional
        Into a frame with y up and z to the front, as `Frame.rotation` of a fit has it; overrides ``up`` and
        ``front``.
    """

    shape: Shape
    colors: ArrayLike | None = None
    label: str = ""
    points: ArrayLike | None = None
    point_colors: ArrayLike | None = None
    point_radius: float | None = None
    rotation: ArrayLike | None = None


def render_shapes(
    panels: Sequence[Panel | tuple[Shape, ArrayLike | None]],
    path: str | Path,
    *,
    size: tuple[int, int] = (480, 640),
    labels: Sequence[str] | None = None,
    up: str | None = None,
    front: str | None = None,
    turn: float = 20.0,
    tilt: float = 8.0,
    samples: int = 3,
) -> None:
    """Draw shapes side by side into a PNG: white background, soft light, each shape as large as its panel
    allows.

    Parameters
    ----------
    panels
        `Panel` objects, or pairs ``(shape, colors or None)``.
    path
        Ends in .png.
    size
        Width and height of one panel without its caption, in pixels.
    labels
        Captions, one for each panel; they override those of the panels.
    up, front
        The file's axis that points up, and the one that points to the viewer: x, y, z, -x, -y or -z. Guessed
        from the extents if not given: tall is up, flat is to the front; the sign cannot be guessed.
    turn, tilt
        Degrees: turned to its own left, and leant towards the viewer. 0, 0 is straight from the front.
    samples
        ``samples x samples`` rays a pixel.

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
    wanted = [panel if isinstance(panel, Panel) else Panel(*panel) for panel in panels]
    if not wanted:
        raise OptionError("a picture needs a shape")
    if labels is not None and len(labels) != len(wanted):
        raise OptionError(f"{len(wanted)} shapes need {len(wanted)} labels, not {len(labels)}")
    if min(size) < 16 or samples < 1:
        raise OptionError("a panel needs 16 x 16 pixels and a ray for each")
    captions = list(labels) if labels is not None else [panel.label for panel in wanted]
    view = _lean(turn, tilt)
    images = [_panel_image(panel, view, (up, front), size, samples) for panel in wanted]
    image = _side_by_side(images, captions)
    with replace_on_success(path) as temporary:
        image.save(temporary, format="PNG", optimize=True)


def facing(shape: Shape, up: str | None = None, front: str | None = None) -> FloatArray:
    """Rotation ``(3, 3)`` into y up, z front, by named axes of the file; what is not named is guessed from
    extents.

    Raises
    ------
    OptionError
        An axis that is none of x, y, z, -x, -y, -z, or the same axis twice.
    """
    for name, axis in (("up", up), ("front", front)):
        if axis is not None and axis.lstrip("+").lower() not in _AXES:
            raise OptionError(f"{name} is no axis: '{axis}'", f"choose from {', '.join(_AXES)}")
    extents = shape.bounds[1] - shape.bounds[0]
    free = [k for k in range(3) if front is None or _axis(front)[k] == 0]
    # Tall is up; where nothing is clearly tall y is the usual answer of modelling programs.
    tallest = max(free, key=lambda k: extents[k] * (1.1 if k == 1 else 1.0))
    upward = _axis(up) if up is not None else np.eye(3)[tallest]
    free = [k for k in range(3) if upward[k] == 0]
    forward = _axis(front) if front is not None else np.eye(3)[min(free, key=lambda k: extents[k])]
    if abs(upward @ forward) > 0:
        raise OptionError(f"up and front are the same axis: '{up}' and '{front}'")
    return np.stack([np.cross(upward, forward), upward, forward])


def _axis(name: str) -> FloatArray:
    return _AXES[name.lstrip("+").lower()]


def _lean(turn: float, tilt: float) -> FloatArray:
    a, b = np.radians([turn, tilt])
    about_y = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    about_x = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
    return np.asarray(about_x @ about_y)


def _panel_image(
    panel: Panel, view: FloatArray, axes: tuple[str | None, str | None], size: tuple[int, int], samples: int
) -> Image.Image:
    shape = panel.shape
    towards = facing(shape, *axes) if panel.rotation is None else np.asarray(panel.rotation, dtype=np.float64)
    rotation = view @ towards
    points = np.empty((0, 3)) if panel.points is None else np.asarray(panel.points, dtype=np.float64)
    placed = np.concatenate([_drawn(shape), points]) @ rotation.T
    low, high = placed.min(axis=0), placed.max(axis=0)
    scale = max(float((high - low).max()), 1e-300)
    middle = (low + high) / 2

    def seen(positions: FloatArray) -> FloatArray:
        return (positions @ rotation.T - middle) / scale

    parts = [_skin(panel, seen, rotation)]
    if len(points):
        tint = _given_colors(panel.point_colors, len(points), _NODE_COLOR)
        radius = 0.008 if panel.point_radius is None else panel.point_radius / scale
        parts.append(spheres(seen(points), radius, tint))
    surface = Surface.joined(parts)
    width, height = size
    used = surface.verts[np.unique(surface.faces)]
    extent, centre = np.ptp(used, axis=0), (used.max(axis=0) + used.min(axis=0)) / 2
    free = 1 - 2 * _MARGIN
    pixel = max(extent[0] / (free * width), extent[1] / (free * height), 1e-9)

    rng = np.random.default_rng(0)
    fine_x = centre[0] + ((np.arange(width * samples) + 0.5) / samples - width / 2) * pixel
    fine_y = centre[1] - ((np.arange(height * samples) + 0.5) / samples - height / 2) * pixel
    x, y = np.meshgrid(fine_x, fine_y)
    colors, _ = Scene(surface, rng, skin=0 if shape.is_cloud else shape.V).look(x.ravel(), y.ravel(), rng)
    # Averaged as written, not as light: edges against white stay as thin as the eye expects.
    written = to_srgb(colors).reshape(height, samples, width, samples, 3).mean(axis=(1, 3))
    return Image.fromarray(np.round(255 * written).astype(np.uint8))


def _drawn(shape: Shape) -> FloatArray:
    """The vertices that will be seen: not those without a position, nor strays that no face uses."""
    if shape.is_cloud:
        return shape.verts if shape.invalid is None else shape.verts[~shape.invalid]
    return shape.verts[np.unique(_sound_faces(shape))]


def _sound_faces(shape: Shape) -> NDArray[np.int64]:
    if shape.invalid is None:
        return shape.faces
    faces: NDArray[np.int64] = shape.faces[~shape.invalid[shape.faces].any(axis=1)]
    return faces


def _skin(panel: Panel, seen: Callable[[FloatArray], FloatArray], rotation: FloatArray) -> Surface:
    shape = panel.shape
    given = panel.colors if panel.colors is not None else shape.colors
    colors = _given_colors(given, shape.V, CLAY)
    valid = np.ones(shape.V, dtype=bool) if shape.invalid is None else ~shape.invalid
    verts = seen(shape.verts)
    if shape.is_cloud:
        drawn = np.flatnonzero(valid)
        drawn = drawn[:: max(1, -(-len(drawn) // _MOST_BALLS))]
        return spheres(verts[drawn], _spacing(verts[drawn]), colors[drawn])
    return Surface(verts, _sound_faces(shape), shape.vertex_normals @ rotation.T, colors)


def _given_colors(colors: ArrayLike | None, count: int, plain: tuple[float, float, float]) -> FloatArray:
    if colors is None:
        return to_linear(np.tile(np.array(plain), (count, 1)))
    array = np.asarray(colors, dtype=np.float64)
    if array.shape not in ((count, 3), (count, 4)):
        raise OptionError(f"colours must be an array of ({count}, 3) or ({count}, 4), not {array.shape}")
    return to_linear(np.clip(array[:, :3], 0.0, 1.0))


def _spacing(points: FloatArray) -> float:
    """A radius with which the balls of a cloud nearly touch: a closed skin, and gaps where there are gaps."""
    if len(points) < 2:
        return 0.02
    chosen = points[:: max(1, len(points) // 2_000)]
    gap, _ = cKDTree(points).query(chosen, k=min(6, len(points)))
    return float(np.clip(0.5 * np.median(gap[:, -1]), 5e-4, 0.02))


def _side_by_side(images: list[Image.Image], captions: list[str]) -> Image.Image:
    width, height = images[0].size
    unit = max(height / 640, 0.5)
    strip = round(46 * unit) if any(captions) else 0
    whole = Image.new("RGB", (width * len(images), height + strip), "white")
    draw = ImageDraw.Draw(whole)
    for k, (image, caption) in enumerate(zip(images, captions, strict=True)):
        whole.paste(image, (k * width, 0))
        points = 20 * unit
        font = ImageFont.load_default(size=points)
        while draw.textlength(caption, font=font) > 0.94 * width and points > 7:
            points *= 0.94
            font = ImageFont.load_default(size=points)
        draw.text(((k + 0.5) * width, height + strip / 2), caption, fill="#333333", font=font, anchor="mm")
    return whole
