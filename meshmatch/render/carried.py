"""What was carried from one shape to another, on both of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from meshmatch.maps.vertex_map import VertexMap
from meshmatch.render.figures import Panel
from meshmatch.render.legend import Legend
from meshmatch.render.matched import PALE, Rotations, same_side
from meshmatch.render.picture import Look, render_shapes
from meshmatch.render.scales import Scale, label_colors, label_swatches
from meshmatch.shapes.appearance import Appearance
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.srgb import to_srgb

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Scene:
    """Two panels, source and target, and what their colours mean."""

    panels: tuple[Panel, Panel]
    legend: Legend | None = None


def light_on_both(source: Shape, target: Shape, here: FloatArray, there: FloatArray) -> Scene:
    """Colours as light (V_src, 3 or 4) and (V_tgt, 3 or 4); alpha is ignored, nan is black."""
    one, other = (to_srgb(np.nan_to_num(light[:, :3])) for light in (here, there))
    return Scene((Panel(source, one), Panel(target, other)))


def values_on_both(source: Shape, target: Shape, here: FloatArray, there: FloatArray, title: str) -> Scene:
    """Numbers (V_src,) and (V_tgt,) as heat on one scale; of rows of numbers the first is drawn."""
    one, other = (table if table.ndim == 1 else table[:, 0] for table in (here, there))
    scale = Scale.of(np.concatenate([one, other]), title)
    return Scene((Panel(source, scale.colors(one)), Panel(target, scale.colors(other))), scale)


def labels_on_both(
    source: Shape,
    target: Shape,
    here: IntArray,
    there: IntArray,
    names: Sequence[str],
    on_faces: tuple[bool, bool] = (False, False),
) -> Scene:
    """Numbers of labels, places in ``names``, of vertices or faces; negative where there is none."""
    panels = labelled(source, here, on_faces[0]), labelled(target, there, on_faces[1])
    return Scene(panels, label_swatches(np.concatenate([here, there]), names))


def labelled(shape: Shape, labels: IntArray, on_faces: bool) -> Panel:
    """A shape with a colour for each label of its vertices (V,) or faces (F,)."""
    colors = label_colors(labels)
    return Panel(shape, face_colors=colors) if on_faces else Panel(shape, colors, sharp=True)


def points_on_both(source: Shape, target: Shape, here: FloatArray, there: FloatArray) -> Scene:
    """Points (N, 3) and (N, 3) as balls, those that belong together in one colour."""
    panels = []
    for shape, points in ((source, here), (target, there)):
        radius = 0.02 * float(np.sqrt(shape.area))
        colors = label_colors(np.arange(len(points)))
        plain = np.tile(PALE, (shape.V, 1))
        panels.append(Panel(shape, plain, points=points, point_colors=colors, point_radius=radius or None))
    return Scene((panels[0], panels[1]))


def looks_on_both(source: Shape, target: Shape, here: Appearance | None, there: Appearance | None) -> Scene:
    """Textures, or else the shapes' own colours."""
    return Scene((Panel(source, appearance=here), Panel(target, appearance=there)))


def render_carried(
    scene: Scene,
    vertex_map: VertexMap,
    ends: tuple[Shape, Shape],
    path: str | Path,
    *,
    rotations: Rotations = (None, None),
    labels: tuple[str, str] | None = None,
) -> None:
    """Draw both panels, seen from the same side.

    Parameters
    ----------
    vertex_map, ends
        The map from source to target, and the shapes that it is of.
    """
    turns = same_side(*ends, vertex_map, rotations, Look())
    names = labels or (ends[0].name, ends[1].name)
    panels = [
        replace(panel, rotation=turn, label=name)
        for panel, turn, name in zip(scene.panels, turns, names, strict=True)
    ]
    render_shapes(panels, path, Look(legend=scene.legend))
