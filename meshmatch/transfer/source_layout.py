"""The texture coordinates of a source, carried over onto a target: seams lie where the source's do.

Each triangle of the target goes with the chart of the source that its center lies on. From there its corners are looked for
along the surface, without crossing a seam; a corner beyond one continues the plane of the last face before it. So no
triangle spans two charts, and those at a seam reach over it by less than their size.
"""

from __future__ import annotations

import numpy as np

from meshmatch.arrays import Float, Floats, Ints, Ints32
from meshmatch.errors import InputError, OptionError
from meshmatch.geometry.triangles import flat_areas, interpolate
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.appearance import Appearance
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.surface_walk import SurfaceWalker
from meshmatch.transfer.texel_colors import TexelLocator, charts_of, images_of, seams_of

# Beyond a seam coordinates go on at most this many times as fast as on the face before it.
_FASTEST = 2.0
# Corners of one vertex in one chart with coordinates this close are one.
_SAME = 1e-4
_SLACK = 1e-5


def check_layout(source: Shape, look: Appearance) -> None:
    """Refuse a source that has no coordinates to carry over (`OptionError`)."""
    if source.is_cloud or not look.textured:
        name = source.name or "the source"
        raise OptionError(f"{name} has no texture with coordinates that could be carried over", "leave out --uv source")


def source_layout(
    source: Shape, look: Appearance, target: Shape, back: VertexMap, polygons: Ints | None = None
) -> tuple[Float[Floats, "F_target 3 2"], int]:
    """Coordinates of the target's corners by a map from target to source, and how many charts the source has. No seam
    crosses one of the ``polygons`` that triangles (F_target,) are parts of.

    `InputError`: a chart of the source does not fit into one image, as tiles do not.
    """
    whole, within = SurfaceWalker(source), SurfaceWalker(source)
    charts = charts_of(whole, look)
    within.cut(seams_of(whole, look))
    own = _in_one_tile(look.uv, charts, source.name or "the source")
    at, begin = _images(whole, target, back)
    center = at.mean(axis=1).T.astype(np.float32, order="C")
    place = whole.closest(center, begin)[0]
    if polygons is not None:  # all triangles of one go with its first
        first, number = np.unique(polygons, return_index=True, return_inverse=True)[1:]
        place = place[first][number.reshape(-1)]
    size = np.sqrt(flat_areas(own) / np.maximum(whole.areas, 1e-300))  # of the image, for a length on the source
    out = np.empty((target.F, 3, 2))
    for k in range(3):
        face, weights = within.reach(at[:, k].T.astype(np.float32, order="C"), place)
        held = np.maximum(weights, 0)
        held /= held.sum(axis=1, keepdims=True)
        foot, uv = (np.einsum("fk,fkd->fd", each, own[face]) for each in (held, weights))
        away = np.linalg.norm(interpolate(whole.verts, whole.faces[face], held) - at[:, k], axis=1)
        length = np.linalg.norm(uv - foot, axis=1)
        most = _FASTEST * size[face] * away
        out[:, k] = foot + (uv - foot) * np.minimum(1.0, most / np.maximum(length, 1e-300))[:, None]
    return np.clip(_joined(out, target.faces, charts[place]), 0.0, 1.0), len(np.unique(charts))


def _in_one_tile(uv: Floats, charts: Ints32, name: str) -> Floats:
    """Coordinates (F, 3, 2) with each chart (F,) in 0..1; whole numbers change nothing."""
    number = np.unique(charts, return_inverse=True)[1]
    low = np.full((number.max() + 1, 2), np.inf)
    np.minimum.at(low, number, uv.min(axis=1))
    uv = uv - np.floor(low + _SLACK)[number][:, None]
    if uv.max() > 1.0 + _SLACK:
        tiled = (
            f"{name} has charts that reach over the edge of their image, as tiles do: its layout cannot be carried over"
        )
        raise InputError(tiled, "leave out --uv source")
    return np.asarray(uv)


def _images(walker: SurfaceWalker, target: Shape, back: VertexMap) -> tuple[Floats, Ints32]:
    """Where the corners (F, 3, 3) of the target's triangles lie on the source, and a face near each triangle (F,). One that
    the map tears apart lies around its most certain corner.
    """
    image, start = images_of(walker, back)
    locator = TexelLocator(walker, target, back, np.zeros((target.F, 3, 2)))
    at, begin = image[target.faces], start[target.faces[:, 0]].astype(np.int32)
    torn = np.flatnonzero(locator.discontinuous)
    if len(torn):
        faces = target.faces[torn]
        sure = back.assumed_confidence[faces].argmax(axis=1)
        vertex = faces[np.arange(len(torn)), sure]
        away = target.verts[faces] - target.verts[vertex][:, None]
        at[torn] = image[vertex][:, None] + np.einsum("fij,fkj->fki", locator.jacobian[vertex], away)
        begin[torn] = start[vertex]
    return at, begin


def _joined(uv: Floats, faces: Ints, charts: Ints32) -> Floats:
    """Coordinates (F, 3, 2) that are the same at corners of one vertex and one chart where they are nearly so."""
    key = faces * (int(charts.max()) + 1) + charts[:, None]
    first, back = np.unique(key.ravel(), return_index=True, return_inverse=True)[1:]
    flat = uv.reshape(-1, 2)
    usual = flat[first][back.reshape(-1)]
    near = np.abs(flat - usual).max(axis=1) < _SAME
    return np.where(near[:, None], usual, flat).reshape(uv.shape)
