"""A map as a picture: matched places have one colour, or a heat of confidence or error."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from meshmatch.maps.evaluate import CM_PER_UNIT, Errors
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.render.colors import position_colors
from meshmatch.render.facing import facing, facing_alike, upright
from meshmatch.render.figures import Panel
from meshmatch.render.picture import Look, render_shapes
from meshmatch.render.scales import UNKNOWN, Scale
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.attributes import pull_values
from meshmatch.transfer.inverse_map import invert_map

FloatArray = NDArray[np.float64]
Rotations = tuple[FloatArray | None, FloatArray | None]
Unit = Literal["cm", "x100"]

# A target place that so small a share of the map's confidence reaches is one that nothing was matched to.
_REACHED = 0.05
# Known points closer than this (units of sqrt(area)) speak for the surface between them.
_CLOSE = 0.06
_UNITS = {
    "cm": (CM_PER_UNIT, "error (cm, on a body with 1.9 m2 of skin)"),
    "x100": (100.0, "error (hundredths of sqrt(area))"),
}


def render_match(
    source: Shape,
    target: Shape,
    vertex_map: VertexMap,
    path: str | Path,
    look: Look | None = None,
    *,
    rotations: Rotations = (None, None),
    labels: tuple[str, str] | None = None,
) -> None:
    """Draw the source coloured by position, and the target in the colours that the map brings there.

    Parameters
    ----------
    rotations
        ``(3, 3)`` of source and target into y up, z front, as `Frame.rotation` of a fit; guessed if not given.
    labels
        Names below; those of the shapes if not given.

    Raises
    ------
    InputError
        The map is not of these shapes.
    OptionError
        The picture's suffix is not .png.
    OutputError
        It cannot be written.
    """
    render_shapes(match_panels(source, target, vertex_map, rotations, labels, look), path, look)


def match_panels(
    source: Shape,
    target: Shape,
    vertex_map: VertexMap,
    rotations: Rotations = (None, None),
    labels: tuple[str, str] | None = None,
    look: Look | None = None,
) -> list[Panel]:
    """Source and target, matched places in one colour; grey where nothing was matched to. See `render_match`."""
    turns = same_side(source, target, vertex_map, rotations, look or Look())
    here = position_colors(source, turns[0])
    there = carried_colors(here, vertex_map, source, target)
    names = labels or (source.name, target.name)
    return [
        Panel(source, here, names[0], rotation=turns[0]),
        Panel(target, there, names[1], rotation=turns[1]),
    ]


def same_side(
    source: Shape, target: Shape, vertex_map: VertexMap, rotations: Rotations, look: Look
) -> tuple[FloatArray, FloatArray]:
    """Rotations that show both shapes from the same side."""
    first, second = (None if rotation is None else upright(rotation) for rotation in rotations)
    if first is None:
        first = facing(source, look.up, look.front)
    if second is None and (look.up is not None or look.front is not None):
        second = facing(target, look.up, look.front)
    elif second is None:
        known = slice(None) if source.invalid is None else ~source.invalid
        second = facing_alike(target, vertex_map.points(target)[known], source.verts[known] @ first.T)
    return first, second


def carried_colors(colors: FloatArray, vertex_map: VertexMap, source: Shape, target: Shape) -> FloatArray:
    """Colours ``(V_tgt, 3)`` of the target, from those ``(V_src, 3)`` of the source's vertices."""
    return brought(colors, vertex_map, invert_map(vertex_map, source, target), source)


def brought(colors: FloatArray, forward: VertexMap, back: VertexMap, source: Shape) -> FloatArray:
    """`carried_colors` where the map back is at hand; grey where nothing of the source was matched to near."""
    reached = back.confidence > _REACHED * forward.confidence[back.index]
    return np.where(reached[:, None], pull_values(back, colors), UNKNOWN)


def confidence_panels(
    source: Shape,
    target: Shape,
    vertex_map: VertexMap,
    rotations: Rotations = (None, None),
    labels: tuple[str, str] | None = None,
    look: Look | None = None,
) -> tuple[list[Panel], Scale]:
    """Source and target in the heat of the map's confidence, and its scale: dark is doubt."""
    turns = same_side(source, target, vertex_map, rotations, look or Look())
    back = invert_map(vertex_map, source, target)
    scale = Scale(0.0, 1.0, "confidence of the map", reverse=True)
    names = labels or (source.name, target.name)
    panels = [
        Panel(shape, scale.colors(values), name, rotation=rotation)
        for shape, values, name, rotation in zip(
            (source, target), (vertex_map.confidence, back.confidence), names, turns, strict=True
        )
    ]
    return panels, scale


def render_errors(
    source: Shape,
    target: Shape,
    vertex_map: VertexMap,
    known: tuple[NDArray[np.int64], NDArray[np.int64]],
    errors: Errors,
    path: str | Path,
    *,
    unit: Unit = "cm",
) -> None:
    """Draw `error_panels` with their scale."""
    panels, scale = error_panels(source, target, vertex_map, known, errors, unit)
    render_shapes(panels, path, Look(legend=scale))


def error_panels(
    source: Shape,
    target: Shape,
    vertex_map: VertexMap,
    known: tuple[NDArray[np.int64], NDArray[np.int64]],
    errors: Errors,
    unit: Unit = "cm",
    labels: tuple[str, str] | None = None,
    limits: tuple[float, float] | None = None,
    look: Look | None = None,
) -> tuple[list[Panel], Scale]:
    """Source and target in the heat of the errors at known points, and its scale.

    Parameters
    ----------
    known : (N,) and (N,) int64
        The same points as vertices of source and target.
    errors
        At these points.
    """
    factor, title = _UNITS[unit]
    values = np.asarray(errors.values, np.float64) * factor
    scale = Scale.of(values, title, limits)
    names = labels or (source.name, target.name)
    panels = []
    turns = same_side(source, target, vertex_map, (None, None), look or Look())
    for shape, vertices, name, rotation in zip((source, target), known, names, turns, strict=True):
        panels.append(replace(heat_panel(shape, vertices, values, scale), label=name, rotation=rotation))
    return panels, replace(scale, unknown=any(panel.points is None and _gaps(panel) for panel in panels))


def heat_panel(shape: Shape, vertices: NDArray[np.int64], values: FloatArray, scale: Scale) -> Panel:
    """A shape with numbers (N,) at some of its vertices (N,): painted where these lie close, balls where not.

    Between them a vertex takes the mean of the nearest; one that is far from all has no value.
    """
    sums = np.bincount(vertices, values, shape.V)
    count = np.bincount(vertices, minlength=shape.V)
    own = np.flatnonzero(count)
    means = sums[own] / count[own]
    unit = float(np.sqrt(shape.area)) or 1.0
    tree = cKDTree(shape.verts[own])
    spacing = float(np.median(tree.query(shape.verts[own], 2)[0][:, 1])) if len(own) > 3 else np.inf
    if spacing < _CLOSE * unit:
        distance, place = tree.query(shape.verts, 4)
        weight = 1.0 / (distance + 1e-3 * unit) ** 2
        painted = (weight * means[place]).sum(axis=1) / weight.sum(axis=1)
        painted[own] = means
        return Panel(shape, scale.colors(np.where(distance[:, 0] < 2 * spacing, painted, np.nan)))
    return Panel(
        shape,
        np.tile(PALE, (shape.V, 1)),
        points=shape.verts[own],
        point_colors=scale.colors(means),
        point_radius=0.016 * unit,
    )


PALE = (0.88, 0.88, 0.89)
"""Of a shape that only carries points."""


def _gaps(panel: Panel) -> bool:
    return bool((np.asarray(panel.colors) == UNKNOWN).all(axis=1).any())
