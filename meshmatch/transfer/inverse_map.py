"""Which way a map runs, and turning it round."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from meshmatch.arrays import Floats, Ints
from meshmatch.errors import InputError
from meshmatch.geometry.topology import edges_of
from meshmatch.geometry.triangles import interpolate
from meshmatch.maps.template_footpoints import small_islands, surrounding_values
from meshmatch.maps.vertex_map import DIRECTION, UNKNOWN, VertexMap
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.mapped_mesh import MappedFootpoints, MappedMesh, on_vertex

_ROUNDS = 2

_OTHER = "match these two again, or keep the map as .npy or .csv, which go by the count of vertices alone"


def check_map(found: VertexMap, source: Shape, target: Shape, label: str = "the map") -> VertexMap:
    """The map, if it is one from `source` to `target`, with what it did not know about them filled in.

    Goes by the hashes of both shapes where the map has them, else by their counts of vertices.

    Raises
    ------
    InputError
        The map was made for another mesh, runs from target to source, or names a vertex or a face that the
        target does not have.
    """
    a, b = source.name or "the source", target.name or "the target"
    hashes, counts = (found.source_hash, found.target_hash), (found.source_vertices, found.target_vertices)
    forward = _agrees(hashes, counts, source, target)
    if not forward and _agrees(hashes, counts, target, source) and found.index.max() < source.V:
        raise InputError(
            f"{label} runs the wrong way: from {b} to {a}, where one from {a} to {b} is needed",
            f"swap the two shapes, or match {a} to {b} ({DIRECTION})",
        )
    for side, shape, name in (("source", source, a), ("target", target, b)):
        digest, count = getattr(found, f"{side}_hash"), getattr(found, f"{side}_vertices")
        made_for = getattr(found, side)
        if count not in (UNKNOWN, shape.V):
            other = f"{made_for or 'another mesh'} of {count} vertices"
            raise InputError(
                f"{label} was made for another {side}: {other}, but {name} has {shape.V}",
                "one entry is needed for each vertex of the source, in the order of its file"
                if side == "source"
                else _OTHER,
            )
        if digest not in ("", shape.hash):
            other = f"{made_for or 'a mesh'} ({digest})"
            raise InputError(
                f"{label} was made for another {side}: {other}, but {name} is {shape.hash}: its vertices or "
                "faces differ",
                _OTHER,
            )
    try:
        made = replace(
            found,
            source=found.source or source.name,
            target=found.target or target.name,
            source_vertices=source.V,
            target_vertices=target.V,
            source_hash=source.hash,
            target_hash=target.hash,
        )
        made.check_faces(target)
    except InputError as error:
        raise InputError(f"{label}: {error.message}", error.hint) from error
    return made


def _agrees(hashes: tuple[str, str], counts: tuple[int, int], source: Shape, target: Shape) -> bool:
    named = all(digest in ("", shape.hash) for digest, shape in zip(hashes, (source, target), strict=True))
    return named and counts[0] == source.V and counts[1] in (UNKNOWN, target.V)


def invert_map(source_to_target: VertexMap, source: Shape, target: Shape, workers: int = 1) -> VertexMap:
    """A map from target to source, from one from source to target.

    The source's vertices at their matched points, with the source's faces, are an image of the source on the
    target; each target vertex takes the closest point of it (see `meshmatch.transfer.mapped_mesh`). Confidence falls
    with the distance: it is low where nothing of the source was mapped to.

    Raises
    ------
    InputError
        As `check_map`.
    """
    checked = check_map(source_to_target, source, target)
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
    rows = np.flatnonzero(on_vertex(found))
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
