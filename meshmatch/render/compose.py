"""Composition of pictures: panels with a legend, from shapes, maps, numbers, labels, points, textures and fits.

Colors are sRGB in 0..1 unless called linear. Maps go from the source, the first shape, to the target.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.errors import InputError, OptionError
from meshmatch.geometry.trees import cKDTree
from meshmatch.maps.evaluate import CM, Errors, ErrorUnit
from meshmatch.maps.mapped_mesh import MappedMesh, invert_map
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.render.facing import Rotations, rotations_to_same_side, snap_upright
from meshmatch.render.figures import Panel
from meshmatch.render.picture import Look, render_shapes
from meshmatch.render.scales import CLAY, Legend, Scale, label_swatches, position_colors
from meshmatch.shapes.appearance import Appearance
from meshmatch.shapes.colors import UNKNOWN, label_colors
from meshmatch.shapes.shape import Shape
from meshmatch.templates.template import Template
from meshmatch.transfer.attributes import pull_values
from meshmatch.transfer.label_files import Labels

# A target vertex is unmatched if its confidence is a smaller share of its match's confidence than this.
_MIN_RELATIVE_CONFIDENCE = 0.05
# Known points at most this far apart (units of sqrt(area)) are interpolated over the surface between them.
_MAX_SPACING = 0.06
_MAX_DOTS = 5000  # dots that a line is drawn with
PALE = (0.88, 0.88, 0.89)
"""Color of a shape on which only points matter."""


@dataclass(frozen=True, eq=False)
class Composition:
    """Panels side by side and the legend of their colors, ready to be rendered; ``caption`` says what is shown, and
    ``record`` has numbers about it for JSON.
    """

    panels: tuple[Panel, ...]
    legend: Legend | None = None
    caption: str = ""
    record: dict[str, Any] = field(default_factory=dict)

    def named(self, names: Sequence[str]) -> Composition:
        """A copy with these labels of the panels."""
        panels = [replace(panel, label=name) for panel, name in zip(self.panels, names, strict=True)]
        return replace(self, panels=tuple(panels))

    def rotated(self, rotations: Sequence[Float[Floats, "3 3"] | None]) -> Composition:
        """A copy with these rotations of the panels, into y up and z to the viewer."""
        panels = [replace(panel, rotation=turn) for panel, turn in zip(self.panels, rotations, strict=True)]
        return replace(self, panels=tuple(panels))

    def render(self, path: str | Path, look: Look = Look()) -> tuple[int, int]:
        """Draw the picture as a PNG; return width and height in pixels. See `render_shapes` for errors."""
        return render_shapes(self.panels, path, replace(look, legend=self.legend))


def compose_shapes(
    subjects: Sequence[tuple[Shape | Template, Appearance | None]], *, plain: bool = False
) -> Composition:
    """Shapes with their textures or colors, and templates as glass around their nodes; with ``plain`` all in clay."""
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
    source: Shape, target: Shape, vertex_map: VertexMap, rotations: Rotations = (None, None), look: Look = Look()
) -> Composition:
    """The source colored by position, and the target with these colors transferred by the map; unmatched parts are grey.

    What fits ignore (weight 0), such as a floor, is not drawn. `InputError` for a map that is not of these shapes.
    """
    drawn = _without_ignored(source), _without_ignored(target)
    turns = rotations_to_same_side(*drawn, vertex_map, rotations, look.up, look.front)
    here, back = position_colors(drawn[0], turns[0]), invert_map(vertex_map, source, target)
    panels = _colored_panels(drawn, (here, matched_colors(here, vertex_map, back, source)))
    caption = "corresponding points in the same color"
    caption += "" if drawn == (source, target) else ", without what was left out"
    return Composition(panels, caption=caption).rotated(turns)


def _without_ignored(shape: Shape) -> Shape:
    """The shape without vertices of weight 0, and their faces; vertices keep their numbers."""
    if shape.weights is None or shape.weights.all() or not shape.weights.any():
        return shape
    return replace(shape, invalid=~shape.valid | (shape.weights == 0))


def _colored_panels(shapes: Sequence[Shape], colors: Iterable[Float[Floats, "V C"]]) -> tuple[Panel, ...]:
    return tuple(Panel(shape, own, shape.name) for shape, own in zip(shapes, colors, strict=True))


def matched_colors(
    colors: Float[Floats, "V 3"], forward: VertexMap, back: VertexMap, source: Shape
) -> Float[Floats, "V_target 3"]:
    """Colors (V_source, 3) of the source's vertices transferred to the target; grey where nothing was matched nearby."""
    matched = back.assumed_confidence > _MIN_RELATIVE_CONFIDENCE * forward.assumed_confidence[back.index]
    return np.where(matched[:, None], pull_values(back, colors), UNKNOWN)


def compose_confidence(source: Shape, target: Shape, vertex_map: VertexMap, look: Look = Look()) -> Composition:
    """Source and target colored by the map's confidence, dark where it is low. `OptionError` if it is unknown."""
    if np.isnan(vertex_map.confidence).any():
        hint = "maps that `meshmatch match` wrote as .npz, .mat, .json or .csv have it"
        raise OptionError("the confidence of this map is not known", hint)
    scale = Scale(0.0, 1.0, "confidence of the map", reverse=True)
    maps = vertex_map, invert_map(vertex_map, source, target)
    panels = _colored_panels((source, target), [scale.colors(each.confidence) for each in maps])
    record = {"confidence_mean": float(vertex_map.confidence.mean())}
    shown = Composition(panels, scale, "the confidence of the map", record)
    return shown.rotated(rotations_to_same_side(source, target, vertex_map, up=look.up, front=look.front))


def compose_errors(
    source: Shape,
    target: Shape,
    vertex_map: VertexMap,
    known: tuple[Int[Ints, " N"], Int[Ints, " N"]],
    errors: Errors,
    unit: ErrorUnit = CM,
    limits: tuple[float, float] | None = None,
    look: Look = Look(),
) -> Composition:
    """Source and target colored by the errors at ``known`` points, given as vertices of source and target."""
    values = np.asarray(errors.values, np.float64) * unit.factor
    scale = Scale.of(values, f"error ({unit.words})", limits)
    panels = [_value_panel(shape, at, values, scale) for shape, at in zip((source, target), known, strict=True)]
    gaps = any((np.asarray(panel.colors) == UNKNOWN).all(axis=1).any() for panel in panels)
    record = {"points": int(values.size), "unit": unit.name, "mean": unit.factor * errors.mean}
    record |= {"mean_cm": errors.mean_cm, "mean_x100": 100 * errors.mean}
    shown = Composition(tuple(panels), replace(scale, unknown=gaps), "the errors of the map", record)
    return shown.rotated(rotations_to_same_side(source, target, vertex_map, up=look.up, front=look.front))


def _value_panel(shape: Shape, vertices: Int[Ints, " N"], values: Float[Floats, " N"], scale: Scale) -> Panel:
    """A shape with values at some of its vertices. Sparse values are drawn as balls; dense ones color the surface, where
    other vertices take a weighted mean of the nearest values, or are grey if they are far from all.
    """
    vertex, row, count = np.unique(vertices, return_inverse=True, return_counts=True)
    means = np.bincount(row, values) / count
    unit = float(np.sqrt(shape.area)) or 1.0
    tree = cKDTree(shape.verts[vertex])
    spacing = float(np.median(tree.query(shape.verts[vertex], 2)[0][:, 1])) if len(vertex) > 3 else np.inf
    if spacing >= _MAX_SPACING * unit:
        return _points_panel(shape, shape.verts[vertex], scale.colors(means), 0.016 * unit)
    distance, place = tree.query(shape.verts, 4)
    weight = 1.0 / (distance + 1e-3 * unit) ** 2
    interpolated = (weight * means[place]).sum(axis=1) / weight.sum(axis=1)
    interpolated[vertex] = means
    return Panel(shape, scale.colors(np.where(distance[:, 0] < 2 * spacing, interpolated, np.nan)), shape.name)


def compose_fit(
    shape: Shape,
    fitted: Shape,
    rotation: Float[Floats, "3 3"] | None = None,
    limits: tuple[float, float] | None = None,
    what: str = "the template",
) -> Composition:
    """A fitted mesh (same frame and unit) as blue glass over the shape, and the shape colored by the distance to it."""
    distance = distances(shape, fitted)
    scale = Scale.of(distance, f"distance to {what} (unit of the file)", limits)
    record = {"distance_mean": float(np.nanmean(distance)), "distance_max": float(np.nanmax(distance))}
    panels = (
        Panel(shape, label=f"{shape.name} and {what}", over=fitted),
        Panel(shape, scale.colors(distance), "how far apart they are"),
    )
    turn = None if rotation is None else snap_upright(rotation)
    return Composition(panels, scale, f"{what} over the shape", record).rotated((turn, turn))


def distances(shape: Shape, fitted: Shape) -> Float[Floats, " V"]:
    """Distance of each vertex of a shape from another shape's surface; nan for vertices without a position."""
    return np.where(shape.valid, MappedMesh.of(fitted).query(shape.verts).distance, np.nan)


def compose_values(
    shapes: Sequence[Shape],
    values: Sequence[Float[Floats, V * C]],
    title: str = "",
    limits: tuple[float, float] | None = None,
) -> Composition:
    """Shapes colored by one number per vertex on a common scale, or in given colors: three or four numbers in 0..1.

    `InputError` if the values are neither of these, `OptionError` for ``title`` or ``limits`` with colors.
    """
    tables = [table[:, 0] if table.ndim == 2 and table.shape[1] == 1 else table for table in values]
    if all(table.ndim == 1 for table in tables):
        scale = Scale.of(np.concatenate(tables), title, limits)
        caption = f"numbers from {scale.low:g} to {scale.high:g}"
        panels = _colored_panels(shapes, map(scale.colors, tables))
        return Composition(panels, scale, caption, {"range": [scale.low, scale.high]})
    for shape, table in zip(shapes, tables, strict=True):
        columns = 1 if table.ndim == 1 else table.shape[1]
        if columns not in (3, 4) or not ((table >= 0) & (table <= 1)).all():
            hint = "give one number per vertex, or red, green and blue in 0..1"
            raise InputError(f"{shape.name}: {columns} numbers per vertex are neither a scale nor colors", hint)
    if title or limits is not None:
        raise OptionError("colors have no scale", "leave out the title and the range")
    return Composition(_colored_panels(shapes, tables), caption="the colors of a file")


def compose_labels(
    shapes: Sequence[Shape],
    codes: Sequence[Int[Ints, " N"]],
    names: Sequence[str],
    on_faces: Sequence[bool] | None = None,
) -> Composition:
    """Shapes with one color per label; each vertex, or face, has an index into ``names``, negative for no label."""
    colors = [label_colors(codes_of_shape) for codes_of_shape in codes]
    panels = [
        Panel(
            shape,
            None if faces else codes_of_shape,
            shape.name,
            sharp=True,
            face_colors=codes_of_shape if faces else None,
        )
        for shape, codes_of_shape, faces in zip(shapes, colors, on_faces or [False] * len(shapes), strict=True)
    ]
    legend = label_swatches(np.concatenate(codes), names)
    return Composition(tuple(panels), legend, f"{len(names)} labels", {"labels": list(names)})


def merge_labels(labels: Sequence[Labels]) -> tuple[list[Int[Ints, " N"]], list[str]]:
    """Merge labels of several shapes into one sorted list of names: codes of each shape, and the names."""
    found = {str(name) for own in labels for name in own.names}
    numbers = {name for name in found if name.removeprefix("-").isdecimal()}
    names = [*sorted(sorted(numbers), key=int), *sorted(found - numbers)]
    number = {name: k for k, name in enumerate(names)}
    return [np.array([*(number[str(name)] for name in own.names), -1])[own.codes] for own in labels], names


def compose_points(shapes: Sequence[Shape], points: Sequence[Float[Floats, "N 3"]]) -> Composition:
    """Points on each shape as balls, in the frame of its file; points with the same index have the same color."""
    colors = [label_colors(np.arange(len(own))) for own in points]
    radii = [0.02 * float(np.sqrt(shape.area)) or None for shape in shapes]
    return Composition(tuple(map(_points_panel, shapes, points, colors, radii)))


def compose_lines(shapes: Sequence[Shape], lines: Sequence[Sequence[Float[Floats, "M 3"]]]) -> Composition:
    """Lines on each shape, in the frame of its file; lines with the same index have the same color."""
    panels = []
    for shape, own in zip(shapes, lines, strict=True):
        radius = 0.006 * float(np.sqrt(shape.area) or shape.diagonal)
        dots = [_sample_line(line, radius) for line in own]
        colors = label_colors(np.repeat(np.arange(len(dots)), [len(each) for each in dots]))
        panels.append(_points_panel(shape, np.concatenate([np.empty((0, 3)), *dots]), colors, radius))
    return Composition(tuple(panels))


def _sample_line(line: Float[Floats, "M 3"], step: float) -> Float[Floats, "N 3"]:
    """Points along a line, at most a step apart, unless that takes more than the maximum number of dots."""
    if len(line) < 2:
        return line
    lengths = np.linalg.norm(np.diff(line, axis=0), axis=1)
    at = np.concatenate([[0.0], np.cumsum(lengths)])
    samples = np.linspace(0.0, at[-1], min(int(at[-1] / step) + 2, _MAX_DOTS))
    return np.column_stack([np.interp(samples, at, line[:, axis]) for axis in range(3)])


def compose_garments(bodies: Sequence[Shape], worn: Sequence[Shape]) -> Composition:
    """Each body in grey, with what it wears in the first color of labels."""
    cloth = label_colors(np.zeros(1, np.int64))
    panels = []
    for body, over in zip(bodies, worn, strict=True):
        together = np.concatenate([body.verts, over.verts]), np.concatenate([body.faces, over.faces + body.V])
        colors = np.concatenate([np.tile(PALE, (body.V, 1)), np.tile(cloth, (over.V, 1))])
        panels.append(Panel(Shape(*together, body.name), colors, body.name))
    return Composition(tuple(panels))


def _points_panel(
    shape: Shape, points: Float[Floats, "N 3"], colors: Float[Floats, "N 3"], radius: float | None
) -> Panel:
    plain = np.tile(PALE, (shape.V, 1))
    return Panel(shape, plain, shape.name, points=points, point_colors=colors, point_radius=radius)
