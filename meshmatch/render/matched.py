"""A map as a picture: matched places have one colour."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from meshmatch.maps.vertex_map import VertexMap
from meshmatch.render.colors import position_colors
from meshmatch.render.picture import Panel, render_shapes
from meshmatch.shapes.shape import Shape

FloatArray = NDArray[np.float64]


def render_match(
    source: Shape,
    target: Shape,
    vertex_map: VertexMap,
    path: str | Path,
    *,
    rotations: tuple[FloatArray | None, FloatArray | None] = (None, None),
    labels: tuple[str, str] | None = None,
) -> None:
    """Draw the target coloured by position, and the source in the colours that the map carries over.

    Parameters
    ----------
    rotations
        ``(3, 3)`` of source and target into y up, z front, as `Frame.rotation` of a fit; guessed if not given.
    labels
        Captions; the shapes' names if not given.

    Raises
    ------
    InputError
        The map is not of these shapes.
    OptionError
        The picture's suffix is not .png.
    OutputError
        It cannot be written.
    """
    there = position_colors(target, rotations[1])
    captions = labels or (source.name, target.name)
    panels = [
        Panel(source, carried_colors(there, vertex_map, target), captions[0], rotation=rotations[0]),
        Panel(target, there, captions[1], rotation=rotations[1]),
    ]
    render_shapes(panels, path)


def carried_colors(colors: FloatArray, vertex_map: VertexMap, target: Shape) -> FloatArray:
    """Colours ``(V_src, 3)`` of the matched points, from those ``(V_tgt, 3)`` of the target's vertices."""
    vertex_map.points(target)  # refuses another target
    carried: FloatArray = colors[vertex_map.index]
    inside = vertex_map.face >= 0
    corners = target.faces[vertex_map.face[inside]]
    carried[inside] = np.einsum("nk,nkc->nc", vertex_map.barycentric[inside], colors[corners])
    return carried
