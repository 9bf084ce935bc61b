"""Transfer of a source's texture coordinates to a target, so that seams lie where the source's do.

Each triangle of the target takes the chart of the source that its center lies on. Its corners are found from there by walks
that do not cross seams; a corner beyond a seam extrapolates the plane of the last face. So no triangle spans two charts, and
triangles at a seam reach over it by less than their size.
"""

from __future__ import annotations

import numpy as np

from meshmatch.arrays import Float, Floats, Ints, Ints32
from meshmatch.errors import InputError, OptionError
from meshmatch.geometry.triangles import interpolate, planar_areas
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.appearance import Appearance
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.surface_walk import SurfaceWalker
from meshmatch.transfer.texel_colors import TexelLocator, find_charts, find_seams, image_points

# Beyond a seam, coordinates change at most this many times as fast as on the face before it.
_MAX_RATE = 2.0
# Corners of one vertex and chart whose coordinates differ less than this become one.
_TOLERANCE = 1e-4
_SLACK = 1e-5


def check_layout(source: Shape, look: Appearance) -> None:
    """Raise `OptionError` for a source without coordinates to transfer."""
    if source.is_cloud or not look.textured:
        name = source.name or "the source"
        raise OptionError(f"{name} has no texture with coordinates that could be carried over", "leave out --uv source")


def source_layout(
    source: Shape, look: Appearance, target: Shape, back: VertexMap, polygons: Ints | None = None
) -> tuple[Float[Floats, "F_target 3 2"], int]:
    """Coordinates of the target's corners by a map from target to source, and the number of charts of the source. Seams do
    not cross ``polygons`` (F_target,) that triangles belong to.

    `InputError`: a chart of the source does not fit into one image (tiles).
    """
    walker, bounded = SurfaceWalker(source), SurfaceWalker(source)
    charts = find_charts(walker, look)
    bounded.cut(find_seams(walker, look))
    uv_in_tile = _in_one_tile(look.uv, charts, source.name or "the source")
    images, begin = _corner_images(walker, target, back)
    center = images.mean(axis=1).T.astype(np.float32, order="C")
    place = walker.closest(center, begin)[0]
    if polygons is not None:  # all triangles of a polygon take the place of its first
        first, number = np.unique(polygons, return_index=True, return_inverse=True)[1:]
        place = place[first][number.reshape(-1)]
    size = np.sqrt(planar_areas(uv_in_tile) / np.maximum(walker.areas, 1e-300))  # image length per length on the source
    out = np.empty((target.F, 3, 2))
    for k in range(3):
        face, weights = bounded.reach(images[:, k].T.astype(np.float32, order="C"), place)
        clamped = np.maximum(weights, 0)
        clamped /= clamped.sum(axis=1, keepdims=True)
        foot, uv = (np.einsum("fk,fkd->fd", each, uv_in_tile[face]) for each in (clamped, weights))
        distance = np.linalg.norm(interpolate(walker.verts, walker.faces[face], clamped) - images[:, k], axis=1)
        length = np.linalg.norm(uv - foot, axis=1)
        limit = _MAX_RATE * size[face] * distance
        out[:, k] = foot + (uv - foot) * np.minimum(1.0, limit / np.maximum(length, 1e-300))[:, None]
    return np.clip(_merge_corners(out, target.faces, charts[place]), 0.0, 1.0), len(np.unique(charts))


def _in_one_tile(uv: Floats, charts: Ints32, name: str) -> Floats:
    """Coordinates (F, 3, 2) with each chart (F,) moved into 0..1 by whole numbers."""
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


def _corner_images(walker: SurfaceWalker, target: Shape, back: VertexMap) -> tuple[Floats, Ints32]:
    """Images (F, 3, 3) of the corners of the target's triangles on the source, and a face near each triangle (F,).

    A triangle that the map tears is placed around its most confident corner.
    """
    image, start = image_points(walker, back)
    locator = TexelLocator(walker, target, back, np.zeros((target.F, 3, 2)))
    at, begin = image[target.faces], start[target.faces[:, 0]].astype(np.int32)
    discontinuous = np.flatnonzero(locator.discontinuous)
    if len(discontinuous):
        faces = target.faces[discontinuous]
        most_confident = back.assumed_confidence[faces].argmax(axis=1)
        vertex = faces[np.arange(len(discontinuous)), most_confident]
        away = target.verts[faces] - target.verts[vertex][:, None]
        at[discontinuous] = image[vertex][:, None] + np.einsum("fij,fkj->fki", locator.jacobian[vertex], away)
        begin[discontinuous] = start[vertex]
    return at, begin


def _merge_corners(uv: Floats, faces: Ints, charts: Ints32) -> Floats:
    """Coordinates (F, 3, 2), made equal at corners of one vertex and chart where they nearly are."""
    key = faces * (int(charts.max()) + 1) + charts[:, None]
    first, back = np.unique(key.ravel(), return_index=True, return_inverse=True)[1:]
    flat = uv.reshape(-1, 2)
    first_uv = flat[first][back.reshape(-1)]
    near = np.abs(flat - first_uv).max(axis=1) < _TOLERANCE
    return np.where(near[:, None], first_uv, flat).reshape(uv.shape)
