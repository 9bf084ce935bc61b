"""A template from one shape: two resolutions, nodes, labels."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from meshmatch.arrays import Int, Ints
from meshmatch.errors import TemplateError
from meshmatch.shapes.decimate import Quality, decimate
from meshmatch.shapes.normalise import sqrt_area_frame
from meshmatch.shapes.sampling import triangulate_cloud
from meshmatch.shapes.shape import Shape
from meshmatch.templates.nodes import NodeConfig, choose_nodes
from meshmatch.templates.template import Template

LOW_FACES = 10_000


def low_resolution(
    shape: Shape, faces: int = LOW_FACES, quality: Quality = "fast"
) -> tuple[Int[Ints, " V"], Int[Ints, "F 3"]]:
    """Decimate onto a subset of the shape's own vertices: kept indices, faces.

    Whatever belongs to a vertex (weights, labels, positions on registered shapes) is then kept by indexing.
    """
    if shape.F <= faces:
        return np.arange(shape.V), np.asarray(shape.faces)
    small = decimate(shape, faces, quality)
    nearest = cKDTree(shape.verts).query(small.verts)[1]
    keep, renumbered = np.unique(nearest, return_inverse=True)
    corners = renumbered.reshape(-1)[small.faces]
    a, b, c = corners.T
    return keep, corners[(a != b) & (b != c) & (c != a)]


def low_mesh(
    shape: Shape, faces: int = LOW_FACES, quality: Quality = "fast"
) -> tuple[Int[Ints, " V"], Int[Ints, "F 3"]]:
    """`low_resolution` of a mesh, or a triangulation of a cloud: kept indices, faces."""
    return triangulate_cloud(shape, faces) if shape.is_cloud else low_resolution(shape, faces, quality)


def make_template(
    shape: Shape,
    name: str,
    config: NodeConfig,
    *,
    labels: Int[Ints, " V"] | None = None,
    label_names: Sequence[str] = (),
    core: Int[Ints, " C"] | None = None,
    low: tuple[Int[Ints, " V_low"], Int[Ints, "F_low 3"]] | None = None,
) -> Template:
    """Template bundle of a mesh.

    Parameters
    ----------
    shape
        Of the resting category, any unit; a mesh becomes the dense mesh, a cloud is triangulated.
    labels
        Part of every vertex of ``shape``; a single part where not given.
    core
        Vertices of ``shape`` that fix the category's frame; all where not given.
    low
        A low resolution made before (see :func:`low_resolution`).

    Raises
    ------
    TemplateError
        If nodes cannot support every vertex.
    InputError
        If a cloud's points lie on no surface.
    """
    keep, faces = low_mesh(shape) if low is None else low
    small = Shape(shape.verts[keep], faces, name)
    frame = sqrt_area_frame(small)
    small = Shape(frame.apply(small.verts), faces, name)
    parts = np.zeros(shape.V, np.int64) if labels is None else np.asarray(labels, np.int64)
    if parts.shape != (shape.V,):
        raise TemplateError(f"{len(parts)} labels for {shape.V} vertices of {shape.name}", "one label a vertex, from 0")
    if parts.min() < 0:
        raise TemplateError(f"{shape.name} has a label below 0: {parts.min()}", "count parts from 0")
    names = tuple(label_names) or tuple(f"part {n}" for n in range(int(parts.max()) + 1))
    in_core = np.ones(shape.V, bool) if core is None else np.isin(np.arange(shape.V), core)
    return Template(
        name=name,
        shape=small,
        dense=small if shape.is_cloud else Shape(frame.apply(shape.verts), shape.faces, name),
        nodes=choose_nodes(small, config, None if labels is None else parts[keep], noisy=shape.is_cloud),
        radius=config.radius,
        labels=parts[keep],
        label_names=names,
        core=np.flatnonzero(in_core[keep]),
    )
