"""The part of the fitted template that the samples of a partial shape show."""

from __future__ import annotations

import numpy as np

from meshmatch.arrays import Bool, Bools, Float, Floats
from meshmatch.fitting.solve.system import NodeSystem
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.shapes.shape import Shape

# A template vertex is visible if a sample is within the first distance, and if the template point of the nearest sample is
# within the second distance of the vertex on the rest template (units of sqrt(area)). Set by hand.
_MAX_GAP, _MAX_REST_DISTANCE = 0.06, 0.06


def visible_vertices(system: NodeSystem, local: OrientedPoints, vectors: Float[Floats, "K 3"]) -> Bool[Bools, " V"]:
    """Whether samples (core frame) show each vertex (V,) of the fitted template.

    Vertices beyond a cut have the border of the samples nearby, but the border corresponds to another place of the
    template.
    """
    surface = system.surface(vectors)
    local = local.facing(surface)
    distance, nearest = local.tree.query(surface.features)
    nearest_vertex = surface.tree.query(local.features)[1]
    rest_distance = np.linalg.norm(system.verts[nearest_vertex[nearest]] - system.verts, axis=1)
    return np.asarray((distance < _MAX_GAP) & (rest_distance < _MAX_REST_DISTANCE))


def area_share(system: NodeSystem, vertices: Bool[Bools, " V"]) -> float:
    """Share (0..1) of the rest template's area around some vertices."""
    area = Shape(system.verts, system.faces).vertex_areas
    return float(area[vertices].sum() / area.sum())
