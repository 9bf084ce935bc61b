"""Samples of a part, completed by what a fit takes the rest to be.

The network was mostly shown complete shapes. Where samples show a part, the template's fitted surface stands in for
what is missing, and the network is asked again about both together. The refinement then holds what is not visible where
the network wants it, and nothing beyond a cut is pulled onto its edge.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from meshmatch.arrays import Bool, Bools, Float, Floats
from meshmatch.fitting.system import NodeSystem
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape

# A template vertex is visible if a sample is this near, and if the nearest sample belongs this near to the vertex on the
# resting template (units of sqrt(area)). Set by hand.
_NEAR, _HOME = 0.06, 0.06
_MAX_ADDED = 3  # points that are added for each sample, at most


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


def completed(
    system: NodeSystem,
    local: OrientedPoints,
    vectors: Float[Floats, "K 3"],
    share: float,
    rng: np.random.Generator,
    visible: Bool[Bools, " V"] | None = None,
) -> OrientedPoints:
    """Samples (core frame) of a ``share`` of the surface, with points of the fitted template where they show nothing.

    ``visible`` says where they do, if that is known: `visible_vertices` of as many samples as are asked.
    """
    surface = system.surface(vectors)
    if visible is None:
        visible = visible_vertices(system, local, vectors)
    faces = system.faces[~visible[system.faces].any(axis=1)]
    if not len(faces):
        return local
    missing = Shape(surface.points, faces)
    if not missing.area > 0:
        return local
    P = len(local.points)
    count = min(round(P * missing.area / share), _MAX_ADDED * P)
    added = sample_surface(missing, count, rng)
    local = local.facing(surface)
    order = rng.permutation(P + count)
    return replace(
        local,
        points=np.concatenate([local.points, added.points])[order],
        normals=np.concatenate([local.normals, added.normals])[order],
        weights=None if local.weights is None else np.append(local.weights, np.ones(count))[order],
    )


def area_share(system: NodeSystem, vertices: Bool[Bools, " V"]) -> float:
    """Share (0..1) of the resting template's area around some vertices."""
    area = Shape(system.verts, system.faces).vertex_areas
    return float(area[vertices].sum() / area.sum())
