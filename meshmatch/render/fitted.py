"""A template laid on a shape, and a template's nodes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from meshmatch.render.facing import upright
from meshmatch.render.figures import Panel
from meshmatch.render.picture import Look, render_shapes
from meshmatch.render.scales import Scale
from meshmatch.shapes.shape import Shape
from meshmatch.templates.template import Template
from meshmatch.transfer.mapped_mesh import MappedMesh

FloatArray = NDArray[np.float64]


def render_fit(shape: Shape, fitted: Shape, path: str | Path, *, rotation: FloatArray | None = None) -> None:
    """Draw `fit_panels` with their scale."""
    panels, scale = fit_panels(shape, fitted, rotation)
    render_shapes(panels, path, Look(legend=scale))


def fit_panels(
    shape: Shape,
    fitted: Shape,
    rotation: FloatArray | None = None,
    label: str | None = None,
    limits: tuple[float, float] | None = None,
) -> tuple[list[Panel], Scale]:
    """The fitted template as coloured glass over the shape, and the shape in the heat of its distance to it.

    Parameters
    ----------
    fitted
        The template in the shape's frame and unit, as `meshmatch register` writes it.
    """
    distance = distances(shape, fitted)
    scale = Scale.of(distance, "distance to the template (unit of the file)", limits)
    name = shape.name if label is None else label
    rotation = None if rotation is None else upright(rotation)
    return [
        Panel(shape, label=f"{name} and the template", rotation=rotation, over=fitted),
        Panel(shape, scale.colors(distance), "how far apart they are", rotation=rotation),
    ], scale


def distances(shape: Shape, fitted: Shape) -> FloatArray:
    """Distance (V,) of each vertex of a shape to the surface of another; nan where it has no position."""
    found = MappedMesh.of(fitted).query(shape.verts).distance
    return found if shape.invalid is None else np.where(shape.invalid, np.nan, found)


def nodes_panel(template: Template, label: str | None = None) -> Panel:
    """A template as glass, with its nodes in it."""
    name = f"{template.name}: {template.K} nodes" if label is None else label
    return Panel(template.shape, label=name, points=template.nodes, glass=True)
