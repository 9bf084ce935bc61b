"""Panels of a picture as surfaces that stand on their ground.

A figure is a shape on its own ground: rotated to face the viewer, with the center of its footprint at the origin, its lowest
point at height 0, and the square root of its surface area as the unit of length (bodies of one category then have one size,
whatever their pose and unit).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from meshmatch.arrays import Float, Floats
from meshmatch.errors import OptionError
from meshmatch.geometry.trees import cKDTree
from meshmatch.render import surface
from meshmatch.render.facing import guess_rotation
from meshmatch.render.scales import CLAY, Color
from meshmatch.shapes.appearance import Appearance
from meshmatch.shapes.colors import to_linear
from meshmatch.shapes.shape import Shape

MAX_POINTS = 60_000
"""Only every n-th point of a larger cloud is drawn: more would be smaller than a pixel."""
_MIN_DISCS = 12_000  # points; fewer are drawn as balls, more as discs that lie on the surface
_NODE_COLOR = (0.86, 0.30, 0.12)
_GLASS_COLOR = (0.06, 0.44, 0.92)
_SHADOW_REACH = 0.42  # distance around its foot at which a figure casts a shadow


@dataclass(frozen=True, eq=False)
class Panel:
    """One shape of a picture: a mesh, or a cloud, whose points are drawn as small discs or balls. Its ``label`` is below it.

    ``colors`` (V, 3 or 4) are sRGB in 0..1 per vertex, by default the shape's own, or clay; alpha is ignored. ``sharp``:
    each point has the color of its nearest vertex, for labels, which are not interpolated. ``face_colors`` (F, 3) are per
    triangle instead. ``appearance`` are the materials and textures of the shape's file, drawn if no other colors are given.
    ``glass``: the shape is transparent around its points. ``over`` is another shape in the same frame, drawn over this one
    as blue glass.

    ``points`` (K, 3) are drawn as balls on top, in the shape's own frame: nodes or landmarks, with ``point_colors`` (K, 3)
    and ``point_radius`` in the unit of the shape. ``rotation`` (3, 3) leads into a frame with y up and z to the front, like
    the `Frame.rotation` of a fit; it overrides the axes of the picture. ``unit`` is the length, in the unit of the shape,
    that is drawn as 1; with the same unit for all panels sizes can be compared. By default it is the square root of the
    shape's own area.
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
    unit: float | None = None


@dataclass(frozen=True, eq=False)
class Figure:
    """A panel in view coordinates, with its foot at the origin: its solid and its glass surfaces; the box (left, bottom;
    right, top) of all that is visible; the ellipse of its shadow (as in `Ground`); and whether the shape itself is glass.
    """

    solid: list[surface.Surface]
    glass: list[surface.Surface]
    box: Float[Floats, "2 2"]
    spot: Float[Floats, " 4"]
    hollow: bool


def rotation_about_x(degrees: float) -> Float[Floats, "3 3"]:
    """Rotation that tilts the top towards the viewer."""
    b = np.radians(degrees)
    return np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])


def build_figure(panel: Panel, up: str | None, front: str | None, turn: float, tilt: float) -> Figure:
    """The surfaces of a panel in view coordinates (`Look` describes the parameters). `OptionError` for an invalid axis, or
    colors of the wrong shape.
    """
    shape = panel.shape
    facing_rotation = (
        guess_rotation(shape, up, front) if panel.rotation is None else np.asarray(panel.rotation, np.float64)
    )
    points = np.empty((0, 3)) if panel.points is None else np.asarray(panel.points, dtype=np.float64)
    a = np.radians(turn)
    rotation = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]]) @ facing_rotation
    drawn = [each.verts[_drawn_vertices(each)] for each in (shape, panel.over) if each is not None]
    rotated = np.concatenate([*drawn, points]) @ rotation.T
    low, high = rotated.min(axis=0), rotated.max(axis=0)
    longest = float((high - low).max())
    scale = float(np.sqrt(shape.area))
    # A flat scrap or a lone point has hardly any area; distant outliers would shrink everything else.
    if not 0.2 * longest < scale < 2 * longest:
        scale = longest if longest > 0 else 1.0
    scale = panel.unit or scale
    foot = np.array([(low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2])
    camera = rotation_about_x(tilt)

    def view(points: Float[Floats, "N 3"]) -> Float[Floats, "N 3"]:
        return np.asarray((points @ rotation.T - foot) / scale @ camera.T)

    body = _shape_surface(shape, view(shape.verts), _paint(panel, scale), camera @ rotation)
    solid, glass = ([], [body]) if panel.glass else ([body], [])
    if len(points):
        radius = 0.011 if panel.point_radius is None else panel.point_radius / scale
        solid.append(surface.balls(view(points), radius, _linear(panel.point_colors, len(points), _NODE_COLOR)))
    if panel.over is not None:
        glass_paint = surface.VertexPaint(_linear(None, panel.over.V, _GLASS_COLOR), panel.over.faces)
        glass.append(_shape_surface(panel.over, view(panel.over.verts), glass_paint, camera @ rotation))
    used = np.concatenate([part.extent for part in [*solid, *glass]])[:, :2]
    width, _, depth = (high - low) / scale / 2
    spot = np.array([0.0, 0.0, width + _SHADOW_REACH, (depth + _SHADOW_REACH) * max(np.sin(np.radians(tilt)), 0.0)])
    return Figure(solid, glass, np.stack([used.min(axis=0), used.max(axis=0)]), spot, panel.glass)


def _drawn_vertices(shape: Shape) -> surface.Rows:
    """Vertices with a position that a face uses; in a cloud, all with a position. At least one."""
    if shape.is_cloud:
        return np.flatnonzero(shape.valid)
    used = surface.corners_of(shape.faces[shape.valid_faces])
    return used if len(used) else np.zeros(1, np.int64)


def _paint(panel: Panel, scale: float) -> surface.Paint:
    shape = panel.shape
    if panel.face_colors is not None:
        return surface.face_paint(_linear(panel.face_colors, shape.F, CLAY))
    look = panel.appearance
    if panel.colors is None and look is not None and not shape.is_cloud:
        return surface.TexturePaint(look, shape, scale)
    if panel.colors is None and look is not None and look.colors is not None:
        return surface.VertexPaint(np.nan_to_num(look.colors[:, :3]), shape.faces)
    given = panel.colors if panel.colors is not None else shape.colors
    return surface.VertexPaint(_linear(given, shape.V, CLAY), shape.faces, panel.sharp)


def _shape_surface(
    shape: Shape, verts: Float[Floats, "V 3"], paint: surface.Paint, rotation: Float[Floats, "3 3"]
) -> surface.Surface:
    """Surface of a shape whose vertices are in view coordinates; the rotation is for its normals."""
    if not shape.is_cloud:
        valid = np.flatnonzero(shape.valid_faces)
        if not len(valid):  # embree needs a triangle even for an empty scene
            return surface.mesh_surface(verts[:1], np.zeros((1, 3), np.int64), surface.face_paint(np.ones((1, 3))))
        return surface.mesh_surface(verts, shape.faces, paint, None if len(valid) == shape.F else valid)
    colors = paint.colors if isinstance(paint, surface.VertexPaint) else _linear(None, shape.V, CLAY)
    drawn = _drawn_vertices(shape)
    drawn = drawn[:: max(1, -(-len(drawn) // MAX_POINTS))]
    # Distance of each point to its fifth neighbour: discs of that size nearly close the surface.
    near = cKDTree(verts[drawn]).query(verts[drawn], k=min(6, len(drawn)))[0].reshape(len(drawn), -1)
    spacing = near[:, -1] if len(drawn) > 1 else np.full(len(drawn), 0.05)
    typical = float(np.clip(np.median(spacing), 1e-3, 0.06))
    if len(drawn) < _MIN_DISCS:
        return surface.balls(verts[drawn], 0.5 * typical, colors[drawn])
    normals = shape.vertex_normals[drawn] @ rotation.T
    return surface.discs(verts[drawn], normals, 1.1 * np.clip(spacing, 0.4 * typical, 1.6 * typical), colors[drawn])


def _linear(colors: ArrayLike | None, count: int, plain: Color) -> Float[Floats, "count 3"]:
    """Linear colors of given sRGB ones, or of the plain one if none are given."""
    if colors is None:
        return np.tile(to_linear(np.array(plain)), (count, 1))
    array = np.asarray(colors, dtype=np.float64)
    if array.shape not in ((count, 3), (count, 4)):
        raise OptionError(f"colors must be an array of ({count}, 3) or ({count}, 4), not {array.shape}")
    return to_linear(np.clip(np.nan_to_num(array[:, :3]), 0.0, 1.0))
