"""The inverse of a map: from one that takes the source to the target, one that takes the target to the source."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from meshmatch.arrays import Floats, Ints
from meshmatch.geometry.topology import edges_of
from meshmatch.geometry.triangles import interpolate
from meshmatch.maps.template_footpoints import small_islands, surrounding_values
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.mapped_mesh import MappedFootpoints, MappedMesh

_ROUNDS = 2


def invert_map(source_to_target: VertexMap, source: Shape, target: Shape, workers: int = 1) -> VertexMap:
    """A map from target to source, from one from source to target.

    The source's vertices at their matched points, with the source's faces, are an image of the source on the
    target; each target vertex takes the closest point of it (see `meshmatch.transfer.mapped_mesh`). Confidence falls
    with the distance: it is low where nothing of the source was mapped to.

    Raises
    ------
    InputError
        As `VertexMap.for_shapes`.
    """
    checked = source_to_target.for_shapes(source, target)
    if source.hash == target.hash and target.invalid is None and _is_identity(checked):
        return replace(checked, source=target.name, target=source.name)
    image = MappedMesh(checked, source, target)
    normals = target_normals(target)
    found = image.query(target.verts, normals, workers)
    chosen = _middles(checked, source, target.V)
    several = np.flatnonzero(chosen >= 0)
    found.vertex[several], found.face[several] = chosen[several], -1
    found.barycentric[several] = (1.0, 0.0, 0.0)
    found.confidence[several] = checked.confidence[chosen[several]]
    _ask_neighbours(image, found, source, target, normals, workers)
    confidence = found.confidence
    if target.invalid is not None:
        confidence[target.invalid] = 0.0
    return VertexMap.between(
        target,
        source,
        index=found.vertex,
        face=found.face,
        barycentric=found.barycentric,
        confidence=np.clip(confidence, 0.0, 1.0).astype(np.float32),
        verdict=checked.verdict,
        reasons=checked.reasons,
    )


def _ask_neighbours(
    image: MappedMesh, found: MappedFootpoints, source: Shape, target: Shape, normals: Floats, workers: int
) -> None:
    """Correct small pieces of the target that lie elsewhere on the source than all around them.

    Where two sheets of the target touch, the closest point can be one of the other sheet. Such pieces ask again,
    knowing where their neighbours lie. `found` is changed in place.
    """
    if target.is_cloud:
        return
    edges = edges_of(target.faces).vertices
    unit, source_unit = (float(np.sqrt(shape.area)) or 1.0 for shape in (target, source))
    length = np.linalg.norm(target.verts[edges[:, 0]] - target.verts[edges[:, 1]], axis=1) / unit
    at = points_on(source, found) / source_unit
    for _ in range(_ROUNDS):
        doubted = small_islands(edges, length, at, target.vertex_areas / unit**2)
        if not doubted.any():
            return
        around = surrounding_values(edges, at, doubted)
        ask = np.flatnonzero(doubted & np.isfinite(around).all(axis=1))
        if not len(ask):
            return
        near = around[ask] * source_unit
        again = image.query(target.verts[ask], normals[ask], workers, near)
        for name in ("vertex", "face", "barycentric", "confidence", "distance"):
            getattr(found, name)[ask] = getattr(again, name)
        at[ask] = points_on(source, again) / source_unit


def points_on(source: Shape, places: MappedFootpoints) -> Floats:
    """(N, 3) the points themselves, in the source's frame."""
    points = source.verts[places.vertex]
    inside = places.face >= 0
    corners = source.faces[places.face[inside]]
    points[inside] = interpolate(source.verts, corners, places.barycentric[inside])
    return points


def target_normals(target: Shape) -> np.ndarray:
    """(V, 3) unit normals of a mesh; zeros for a cloud, whose signs are unsure."""
    return np.zeros_like(target.verts) if target.is_cloud else target.vertex_normals


def _is_identity(found: VertexMap) -> bool:
    return bool((found.index == np.arange(found.source_vertices)).all() and (found.face < 0).all())


def _middles(found: VertexMap, source: Shape, V: int) -> Ints:
    """(V_tgt,) the middle one of the several source vertices that meet on a target vertex; -1 elsewhere.

    A map of vertex numbers to a coarser target puts a patch of the source on each vertex, and any of them is
    closest.
    """
    best = np.zeros(V)
    rows = np.flatnonzero(found.on_vertex)
    at = found.index[rows]
    np.maximum.at(best, at, found.confidence[rows])
    sure = found.confidence[rows] >= 0.5 * best[at]
    if source.invalid is not None:
        sure &= ~source.invalid[rows]
    rows, at = rows[sure], at[sure]
    many = np.bincount(at, minlength=V)
    sums = np.stack([np.bincount(at, source.verts[rows, k], V) for k in range(3)], axis=1)
    middle = sums / np.maximum(many, 1)[:, None]
    away = np.linalg.norm(source.verts[rows] - middle[at], axis=1)
    order = np.lexsort((rows, away, at))
    vertex, first = np.unique(at[order], return_index=True)
    chosen = np.full(V, -1, np.int64)
    chosen[vertex] = rows[order[first]]
    chosen[many < 2] = -1
    return chosen
