"""What a picture shows: from shapes, maps, numbers, labels, points, textures and fits to panels with a legend.

Colors are sRGB in 0..1 unless they are called linear. Maps go from the source, the first shape, to the target.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.spatial import cKDTree

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.errors import InputError, OptionError
from meshmatch.maps.evaluate import CM_PER_UNIT, Errors
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.render.facing import Rotations, same_side, upright
from meshmatch.render.figures import Panel
from meshmatch.render.legend import Legend
from meshmatch.render.picture import Look, render_shapes
from meshmatch.render.scales import CLAY, Scale, label_swatches, position_colors
from meshmatch.shapes.appearance import Appearance
from meshmatch.shapes.colors import UNKNOWN, label_colors, to_srgb
from meshmatch.shapes.shape import Shape
from meshmatch.templates.template import Template
from meshmatch.transfer.attributes import pull_values
from meshmatch.transfer.label_files import Labels
from meshmatch.transfer.mapped_mesh import MappedMesh, invert_map

ErrorUnit = Literal["cm", "x100"]

# A target vertex whose confidence is a smaller share of that of its match than this is unmatched.
_MATCHED = 0.05
# Known points closer than this (units of sqrt(area)) are interpolated over the surface between them.
_CLOSE = 0.06
_ERROR_UNITS = {
    "cm": (CM_PER_UNIT, "error (cm, on a body with 1.9 m2 of skin)"),
    "x100": (100.0, "error (hundredths of sqrt(area))"),
}
PALE = (0.88, 0.88, 0.89)
"""Color of a shape that only shows points."""


@dataclass(frozen=True, eq=False)
class Composition:
    """Panels side by side and the meaning of their colors, ready to be rendered.

    Parameters
    ----------
    caption
        What is shown, for people.
    record
        Numbers about it, as JSON can hold them.
    """

    panels: tuple[Panel, ...]
    legend: Legend | None = None
    caption: str = ""
    record: dict[str, Any] = field(default_factory=dict)

    def named(self, names: Sequence[str]) -> Composition:
        """With these names below the panels."""
        panels = [replace(panel, label=name) for panel, name in zip(self.panels, names, strict=True)]
        return replace(self, panels=tuple(panels))

    def rotated(self, rotations: Sequence[Float[Floats, "3 3"] | None]) -> Composition:
        """With these rotations into y up, z to the viewer."""
        pairs = zip(self.panels, rotations, strict=True)
        return replace(self, panels=tuple(replace(panel, rotation=turn) for panel, turn in pairs))

    def render(self, path: str | Path, look: Look | None = None) -> tuple[int, int]:
        """Draw it as a PNG; width and height in pixels. See `render_shapes` for the errors."""
        return render_shapes(self.panels, path, replace(look or Look(), legend=self.legend))


def compose_shapes(
    subjects: Sequence[tuple[Shape | Template, Appearance | None]], *, plain: bool = False
) -> Composition:
    """Shapes with their textures or colors, and templates as glass around their nodes; ``plain``: all of them in clay."""
    panels = []
    for subject, look in subjects:
        shape = subject.shape if isinstance(subject, Template) else subject
        if plain:
            panels.append(Panel(shape, np.tile(CLAY, (shape.V, 1)), subject.name))
        elif isinstance(subject, Template):
            label = f"{subject.name}: {subject.K} nodes"
            panels.append(Panel(shape, label=label, points=subject.nodes, glass=True))
        else:
            panels.append(Panel(shape, label=shape.name, appearance=look))
    return Composition(tuple(panels), caption="1 shape" if len(panels) == 1 else f"{len(panels)} shapes")


def compose_match(
    source: Shape, target: Shape, vertex_map: VertexMap, rotations: Rotations = (None, None), look: Look | None = None
) -> Composition:
    """The source colored by position and the target in the colors that the map transfers to it; grey: unmatched.

    Raises
    ------
    InputError
        The map does not belong to these shapes.
    """
    turns = _same_side(source, target, vertex_map, look, rotations)
    here = position_colors(source, turns[0])
    there = matched_colors(here, vertex_map, invert_map(vertex_map, source, target), source)
    panels = Panel(source, here, source.name), Panel(target, there, target.name)
    return Composition(panels, caption="matched places in one colour").rotated(turns)


def matched_colors(
    colors: Float[Floats, "V 3"], forward: VertexMap, back: VertexMap, source: Shape
) -> Float[Floats, "V_target 3"]:
    """Colors of the target from those of the source's vertices; grey where nothing was matched nearby."""
    matched = back.confidence > _MATCHED * forward.confidence[back.index]
    return np.where(matched[:, None], pull_values(back, colors), UNKNOWN)


def compose_confidence(source: Shape, target: Shape, vertex_map: VertexMap, look: Look | None = None) -> Composition:
    """Source and target colored by the confidence of the map: low is dark."""
    back = invert_map(vertex_map, source, target)
    scale = Scale(0.0, 1.0, "confidence of the map", reverse=True)
    panels = (
        Panel(source, scale.colors(vertex_map.confidence), source.name),
        Panel(target, scale.colors(back.confidence), target.name),
    )
    record = {"confidence_mean": float(vertex_map.confidence.mean())}
    shown = Composition(panels, scale, "the confidence of the map", record)
    return shown.rotated(_same_side(source, target, vertex_map, look))


def compose_errors(
    source: Shape,
    target: Shape,
    vertex_map: VertexMap,
    known: tuple[Int[Ints, " N"], Int[Ints, " N"]],
    errors: Errors,
    unit: ErrorUnit = "cm",
    limits: tuple[float, float] | None = None,
    look: Look | None = None,
) -> Composition:
    """Source and target colored by the errors at ``known`` points, given as vertices of source and target."""
    factor, title = _ERROR_UNITS[unit]
    values = np.asarray(errors.values, np.float64) * factor
    scale = Scale.of(values, title, limits)
    panels = [_painted_points(shape, at, values, scale) for shape, at in zip((source, target), known, strict=True)]
    gaps = any((np.asarray(panel.colors) == UNKNOWN).all(axis=1).any() for panel in panels)
    record = {"points": int(values.size), "mean_cm": errors.mean_cm, "mean_x100": 100 * errors.mean}
    shown = Composition(tuple(panels), replace(scale, unknown=gaps), "the errors of the map", record)
    return shown.rotated(_same_side(source, target, vertex_map, look))


def _painted_points(shape: Shape, vertices: Int[Ints, " N"], values: Float[Floats, " N"], scale: Scale) -> Panel:
    """A shape with numbers at some of its vertices: interpolated where these lie close together, else drawn as balls.

    In between, a vertex takes the weighted mean of its nearest known ones; one far from all has no value.
    """
    sums = np.bincount(vertices, values, shape.V)
    count = np.bincount(vertices, minlength=shape.V)
    own = np.flatnonzero(count)
    means = sums[own] / count[own]
    unit = float(np.sqrt(shape.area)) or 1.0
    tree = cKDTree(shape.verts[own])
    spacing = float(np.median(tree.query(shape.verts[own], 2)[0][:, 1])) if len(own) > 3 else np.inf
    if spacing >= _CLOSE * unit:
        return _with_points(shape, shape.verts[own], scale.colors(means), 0.016 * unit)
    distance, place = tree.query(shape.verts, 4)
    weight = 1.0 / (distance + 1e-3 * unit) ** 2
    painted = (weight * means[place]).sum(axis=1) / weight.sum(axis=1)
    painted[own] = means
    colors = scale.colors(np.where(distance[:, 0] < 2 * spacing, painted, np.nan))
    return Panel(shape, colors, shape.name)


def compose_fit(
    shape: Shape, fitted: Shape, rotation: Float[Floats, "3 3"] | None = None, limits: tuple[float, float] | None = None
) -> Composition:
    """A fitted template (same frame and unit) as blue glass over the shape, and the shape colored by its distance."""
    distance = distances(shape, fitted)
    scale = Scale.of(distance, "distance to the template (unit of the file)", limits)
    record = {"distance_mean": float(np.nanmean(distance)), "distance_max": float(np.nanmax(distance))}
    panels = (
        Panel(shape, label=f"{shape.name} and the template", over=fitted),
        Panel(shape, scale.colors(distance), "how far apart they are"),
    )
    turn = None if rotation is None else upright(rotation)
    return Composition(panels, scale, "the template over the shape", record).rotated((turn, turn))


def distances(shape: Shape, fitted: Shape) -> Float[Floats, " V"]:
    """Distance of each vertex of a shape to the surface of another; nan where it has no position."""
    found = MappedMesh.of(fitted).query(shape.verts).distance
    return found if shape.invalid is None else np.where(shape.invalid, np.nan, found)


def compose_values(
    shapes: Sequence[Shape],
    values: Sequence[Float[Floats, V * C]],
    title: str = "",
    limits: tuple[float, float] | None = None,
) -> Composition:
    """Shapes colored by a number per vertex on one scale, or in given colors: three or four numbers in 0..1 per vertex.

    Raises
    ------
    InputError
        Neither of these.
    OptionError
        ``title`` or ``limits`` with colors.
    """
    tables = [table[:, 0] if table.ndim == 2 and table.shape[1] == 1 else table for table in values]
    if all(table.ndim == 1 for table in tables):
        scale = Scale.of(np.concatenate(tables), title, limits)
        panels = [Panel(shape, scale.colors(table), shape.name) for shape, table in zip(shapes, tables, strict=True)]
        caption = f"numbers from {scale.low:g} to {scale.high:g}"
        return Composition(tuple(panels), scale, caption, {"range": [scale.low, scale.high]})
    for shape, table in zip(shapes, tables, strict=True):
        colors = table.ndim == 2 and table.shape[1] in (3, 4)
        if not colors or not ((table >= 0) & (table <= 1)).all():
            columns = 1 if table.ndim == 1 else table.shape[1]
            raise InputError(
                f"{shape.name}: {columns} numbers per vertex are neither a scale nor colors",
                "give one number per vertex, or red, green and blue in 0..1",
            )
    if title or limits is not None:
        raise OptionError("colors have no scale", "leave out the title and the range")
    panels = [Panel(shape, table, shape.name) for shape, table in zip(shapes, tables, strict=True)]
    return Composition(tuple(panels), caption="the colors of a file")


def compose_light(shapes: Sequence[Shape], light: Sequence[Float[Floats, "V C"]]) -> Composition:
    """Shapes in linear colors of their vertices, three or four columns; alpha is ignored, nan is black."""
    colors = [to_srgb(np.nan_to_num(table[:, :3])) for table in light]
    return Composition(tuple(Panel(s, c, s.name) for s, c in zip(shapes, colors, strict=True)))


def compose_labels(
    shapes: Sequence[Shape],
    codes: Sequence[Int[Ints, " N"]],
    names: Sequence[str],
    on_faces: Sequence[bool] | None = None,
) -> Composition:
    """Shapes with one color per label.

    Parameters
    ----------
    codes
        For each vertex, or face where ``on_faces``, of each shape its index in ``names``; negative: no label.
    """
    panels = []
    for shape, own, faces in zip(shapes, codes, on_faces or [False] * len(shapes), strict=True):
        colors = label_colors(own)
        painted = Panel(shape, face_colors=colors) if faces else Panel(shape, colors, sharp=True)
        panels.append(replace(painted, label=shape.name))
    legend = label_swatches(np.concatenate(codes), names)
    return Composition(tuple(panels), legend, f"{len(names)} labels", {"labels": list(names)})


def merge_labels(labels: Sequence[Labels]) -> tuple[list[Int[Ints, " N"]], list[str]]:
    """Labels of several shapes by one list of names, sorted, so that a name has one color: codes of each, and names."""
    names = sorted({str(name) for own in labels for name in own.names}, key=_by_number)
    number = {name: k for k, name in enumerate(names)}
    return [np.array([*(number[str(name)] for name in own.names), -1])[own.codes] for own in labels], names


def _by_number(name: str) -> tuple[int, int, str]:
    return (0, int(name), "") if name.removeprefix("-").isdecimal() else (1, 0, name)


def compose_points(shapes: Sequence[Shape], points: Sequence[Float[Floats, "N 3"]]) -> Composition:
    """Points on each shape as balls, in the frame of its file; those of one index have one color."""
    panels = [
        _with_points(shape, own, label_colors(np.arange(len(own))), 0.02 * float(np.sqrt(shape.area)) or None)
        for shape, own in zip(shapes, points, strict=True)
    ]
    return Composition(tuple(panels))


def _with_points(
    shape: Shape, points: Float[Floats, "N 3"], colors: Float[Floats, "N 3"], radius: float | None
) -> Panel:
    plain = np.tile(PALE, (shape.V, 1))
    return Panel(shape, plain, shape.name, points=points, point_colors=colors, point_radius=radius)


def _same_side(
    source: Shape, target: Shape, vertex_map: VertexMap, look: Look | None, rotations: Rotations = (None, None)
) -> Rotations:
    axes = (None, None) if look is None else (look.up, look.front)
    return same_side(source, target, vertex_map, rotations, *axes)
