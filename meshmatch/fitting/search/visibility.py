"""Which of the fitted template the samples of a shape show: what matters of a part, which does not show all of it."""

from __future__ import annotations

import numpy as np

from meshmatch.arrays import Bool, Bools, Float, Floats
from meshmatch.fitting.solve.system import NodeSystem
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.shapes.shape import Shape

# A template vertex is visible if a sample is this near, and if the nearest sample belongs this near to the vertex on the
# resting template (units of sqrt(area)). Set by hand.
_NEAR, _HOME = 0.06, 0.06


def visible_vertices(system: NodeSystem, local: OrientedPoints, vectors: Float[Floats, "K 3"]) -> Bool[Bools, " V"]:
    """Whether samples (core frame) show each vertex of the template as fitted.

    Vertices beyond a cut have the edge of the samples near by, but the edge belongs elsewhere on the template.
    """
    surface = system.surface(vectors)
    local = local.facing(surface)
    distance, nearest = local.tree.query(surface.features)
    home = surface.tree.query(local.features)[1]
    away = np.linalg.norm(system.verts[home[nearest]] - system.verts, axis=1)
    return np.asarray((distance < _NEAR) & (away < _HOME))


def area_share(system: NodeSystem, vertices: Bool[Bools, " V"]) -> float:
    """Share (0..1) of the resting template's area around some vertices."""
    area = Shape(system.verts, system.faces).vertex_areas
    return float(area[vertices].sum() / area.sum())
