"""The inverse of a map: from one that takes the source to the target, one that takes the target to the source."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from meshmatch.arrays import Int, Ints
from meshmatch.maps.islands import reassign_islands
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.mapped_mesh import MappedFootpoints, MappedMesh, known_normals

_ROUNDS = 2
# Of the source vertices that meet on a target vertex, those with this share of the highest confidence count.
_TRUSTED = 0.5


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
    normals = known_normals(target)
    found = image.query(target.verts, normals, workers)
    central = _central_vertices(checked, source, target.V)
    several = np.flatnonzero(central >= 0)
    vertex = central[several]
    found = found.updated(
        several,
        MappedFootpoints(
            vertex,
            np.full(len(several), -1),
            np.tile([1.0, 0.0, 0.0], (len(several), 1)),
            found.distance[several],
            checked.confidence[vertex].astype(np.float64),
        ),
    )
    if not target.is_cloud:
        length, source_length = (float(np.sqrt(shape.area)) or 1.0 for shape in (target, source))
        found, _ = reassign_islands(
            target.verts / length,
            target.faces,
            target.vertex_areas,
            found,
            lambda places: places.values(source.faces, source.verts) / source_length,
            lambda rows, near: image.query(target.verts[rows], normals[rows], workers, near * source_length),
            _ROUNDS,
        )
    confidence = np.clip(found.confidence, 0.0, 1.0).astype(np.float32)
    if target.invalid is not None:
        confidence[target.invalid] = 0.0
    return VertexMap.between(
        target,
        source,
        index=found.vertex,
        face=found.face,
        barycentric=found.barycentric,
        confidence=confidence,
        verdict=checked.verdict,
        reasons=checked.reasons,
    )


def _is_identity(found: VertexMap) -> bool:
    return bool((found.index == np.arange(found.source_vertices)).all() and (found.face < 0).all())


def _central_vertices(found: VertexMap, source: Shape, V: int) -> Int[Ints, " V"]:
    """Where several source vertices meet on a target vertex, the one nearest to their mean; -1 elsewhere.

    A map of vertex numbers to a coarser target puts a patch of the source on each vertex, and any of it would be
    closest.
    """
    highest = np.zeros(V)
    rows = np.flatnonzero(found.on_vertex)
    at = found.index[rows]
    np.maximum.at(highest, at, found.confidence[rows])
    trusted = found.confidence[rows] >= _TRUSTED * highest[at]
    if source.invalid is not None:
        trusted &= ~source.invalid[rows]
    rows, at = rows[trusted], at[trusted]
    count = np.bincount(at, minlength=V)
    sums = np.stack([np.bincount(at, source.verts[rows, k], V) for k in range(3)], axis=1)
    mean = sums / np.maximum(count, 1)[:, None]
    distance = np.linalg.norm(source.verts[rows] - mean[at], axis=1)
    order = np.lexsort((rows, distance, at))
    vertex, first = np.unique(at[order], return_index=True)
    chosen = np.full(V, -1, np.int64)
    chosen[vertex] = rows[order[first]]
    chosen[count < 2] = -1
    return chosen
