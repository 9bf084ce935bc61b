"""What a panel of a picture holds, as surfaces that stand on their ground."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from meshmatch.errors import OptionError
from meshmatch.render.colors import CLAY, to_linear
from meshmatch.render.facing import facing
from meshmatch.render.framing import Stand, leant, stand, turned
from meshmatch.render.surface import FacePaint, Paint, Surface, VertexPaint, balls, discs, mesh_surface
from meshmatch.render.texture import TexturePaint
from meshmatch.shapes.appearance import Appearance
from meshmatch.shapes.shape import Shape

FloatArray = NDArray[np.float64]

MOST_POINTS = 60_000
"""Of a larger cloud every n-th point is drawn: more would be smaller than a pixel."""
_SPARSE = 12_000  # points; fewer are balls, more are discs that lie on the surface
_NODE_COLOR = (0.86, 0.30, 0.12)
_VEIL_COLOR = (0.06, 0.44, 0.92)
_SHADOW = 0.42  # how far around its foot a figure throws a shadow


@dataclass(frozen=True, eq=False)
class Panel:
    """One shape of a picture.

    Parameters
    ----------
    shape
        A mesh, or a cloud: its points are drawn as small discs or balls.
    colors : (V, 3) or (V, 4) float, optional
        0..1 for each vertex; the shape's own colours, or the colour of clay, if there are none. Alpha is
        ignored.
    sharp
        Each point takes the colour of its nearest vertex: for labels, which have no mixtures.
    label
        Name below it.
    face_colors : (F, 3) float, optional
        0..1 for each triangle, instead of ``colors``.
    appearance : Appearance, optional
        Materials and textures of the shape's file, drawn if no other colours are given.
    points : (K, 3) float, optional
        Drawn as balls on top, in the shape's own frame: nodes, landmarks.
    point_colors : (K, 3) float, optional
        Their colours.
    point_radius : float, optional
        Their radius, in the unit of the shape.
    rotation : (3, 3) float, optional
        Into a frame with y up and z to the front, as `Frame.rotation` of a fit has it; overrides the axes of
        the picture.
    glass : bool
        The shape is clear around its points.
    over : Shape, optional
        Another shape in the same frame, laid over this one as coloured glass.
    """

    shape: Shape
    colors: ArrayLike | None = None
    label: str = ""
    sharp: bool = False
    face_colors: ArrayLike | None = None
    appearance: Appearance | None = None
    points: ArrayLike | None = None
    point_colors: ArrayLike | None = None
    point_radius: float | None = None
    rotation: ArrayLike | None = None
    glass: bool = False
    over: Shape | None = None


@dataclass(frozen=True, eq=False)
class Figure:
    """A panel in view coordinates, its foot at the origin.

    solid, glass : lists of Surface
    box : (2, 2) left, bottom; right, top of all that is seen
    spot : (4,) where its shadow falls: x, y, half width, half height of an ellipse in the picture plane
    hollow : whether the shape itself is glass
    """

    solid: list[Surface]
    glass: list[Surface]
    box: FloatArray
    spot: FloatArray
    hollow: bool


def figures(
    panels: Sequence[Panel], up: str | None, front: str | None, turn: float, tilt: float
) -> list[Figure]:
    """Build the surfaces of all panels, all seen from the same side.

    Raises
    ------
    OptionError
        An axis that is none, or colours of the wrong shape.
    """
    return [_figure(panel, up, front, turn, tilt) for panel in panels]


def _figure(panel: Panel, up: str | None, front: str | None, turn: float, tilt: float) -> Figure:
    shape = panel.shape
    towards = facing(shape, up, front) if panel.rotation is None else np.asarray(panel.rotation, np.float64)
    points = np.empty((0, 3)) if panel.points is None else np.asarray(panel.points, dtype=np.float64)
    parts = [drawn_points(shape), points]
    if panel.over is not None:
        parts.append(drawn_points(panel.over))
    on_ground = stand(shape, np.concatenate(parts), turned(turn) @ towards)
    lean = leant(tilt)

    def seen(positions: FloatArray) -> FloatArray:
        return np.asarray(on_ground.place(positions) @ lean.T)

    skin = _skin(shape, _paint(panel, on_ground.scale), seen, on_ground, lean)
    solid, glass = ([], [skin]) if panel.glass else ([skin], [])
    if len(points):
        radius = 0.011 if panel.point_radius is None else panel.point_radius / on_ground.scale
        tint = _given(panel.point_colors, len(points), _NODE_COLOR)
        solid.append(balls(seen(points), radius, tint))
    if panel.over is not None:
        veil = VertexPaint(_given(None, panel.over.V, _VEIL_COLOR), panel.over.faces)
        glass.append(_skin(panel.over, veil, seen, on_ground, lean))
    used = np.concatenate([part.extent for part in [*solid, *glass]])[:, :2]
    width, _, depth = on_ground.half
    flat = max(np.sin(np.radians(tilt)), 0.0)
    spot = np.array([0.0, 0.0, width + _SHADOW, (depth + _SHADOW) * flat])
    return Figure(solid, glass, np.stack([used.min(axis=0), used.max(axis=0)]), spot, panel.glass)


def drawn_points(shape: Shape) -> FloatArray:
    """The vertices that will be seen: not those without a position, nor strays that no face uses."""
    if shape.is_cloud:
        return shape.verts if shape.invalid is None else shape.verts[~shape.invalid]
    used = np.zeros(shape.V, bool)
    used[shape.faces[_sound(shape)]] = True
    return shape.verts[used] if used.any() else shape.verts[:1]


def _sound(shape: Shape) -> NDArray[np.int64]:
    """Numbers of the faces whose corners all have a position."""
    if shape.invalid is None:
        return np.arange(shape.F)
    return np.flatnonzero(~shape.invalid[shape.faces].any(axis=1))


def _paint(panel: Panel, scale: float) -> Paint:
    shape = panel.shape
    if panel.face_colors is not None:
        return FacePaint(_given(panel.face_colors, shape.F, CLAY))
    look = panel.appearance
    if panel.colors is None and look is not None and not shape.is_cloud:
        return TexturePaint(look, shape, scale)
    if panel.colors is None and look is not None and look.colors is not None:
        return VertexPaint(np.nan_to_num(look.colors[:, :3]), shape.faces)
    given = panel.colors if panel.colors is not None else shape.colors
    return VertexPaint(_given(given, shape.V, CLAY), shape.faces, panel.sharp)


def _skin(
    shape: Shape, paint: Paint, seen: Callable[[FloatArray], FloatArray], placed: Stand, lean: FloatArray
) -> Surface:
    verts = seen(shape.verts)
    if not shape.is_cloud:
        sound = _sound(shape)
        if not len(sound):  # nothing that has a place: a speck, for even an empty scene needs a triangle
            return mesh_surface(verts[:1], np.zeros((1, 3), np.int64), FacePaint(np.ones((1, 3))))
        return mesh_surface(verts, shape.faces, paint, None if len(sound) == shape.F else sound)
    colors = (
        paint.colors if isinstance(paint, VertexPaint) else np.tile(to_linear(np.array(CLAY)), (shape.V, 1))
    )
    drawn = np.arange(shape.V) if shape.invalid is None else np.flatnonzero(~shape.invalid)
    step = max(1, -(-len(drawn) // MOST_POINTS))
    drawn = drawn[::step]
    gaps = _gaps(verts[drawn])
    usual = float(np.clip(np.median(gaps), 1e-3, 0.06))
    if len(drawn) < _SPARSE:
        return balls(verts[drawn], 0.5 * usual, colors[drawn])
    normals = shape.vertex_normals[drawn] @ (lean @ placed.rotation).T
    return discs(verts[drawn], normals, 1.1 * np.clip(gaps, 0.4 * usual, 1.6 * usual), colors[drawn])


def _given(colors: ArrayLike | None, count: int, plain: tuple[float, float, float]) -> FloatArray:
    """Linear colours (count, 3) of written ones, or of the plain one if none are given."""
    if colors is None:
        return np.tile(to_linear(np.array(plain)), (count, 1))
    array = np.asarray(colors, dtype=np.float64)
    if array.shape not in ((count, 3), (count, 4)):
        raise OptionError(f"colours must be an array of ({count}, 3) or ({count}, 4), not {array.shape}")
    return to_linear(np.clip(np.nan_to_num(array[:, :3]), 0.0, 1.0))


def _gaps(points: FloatArray) -> FloatArray:
    """Distance (N,) of each point of a cloud to its fifth neighbour: discs as large nearly close the surface."""
    if len(points) < 2:
        return np.full(len(points), 0.05)
    return np.asarray(cKDTree(points).query(points, k=min(6, len(points)))[0][:, -1])
