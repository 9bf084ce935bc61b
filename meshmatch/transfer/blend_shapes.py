"""Transfer of blendshapes along a map: displacements of the source's vertices, applied to the target's.

Displacements rotate with the surface from source to target and scale with it, within limits. Vertices that the map does
not reach follow those around them; so do vertices whose normal disagrees with that of their place on the source, such as one
of the upper lip that is mapped to the lower lip. Separate parts without a counterpart, such as eyes, move rigidly with their
surroundings. Vertices that touch across a slit, such as lips, stay together where the source's do.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array, eye_array
from scipy.sparse.csgraph import connected_components

from meshmatch.arrays import Bool, Bools, Float, Floats, Floats32, Int, Ints
from meshmatch.geometry.trees import cKDTree
from meshmatch.geometry.triangles import dot, normalized, triangle_vectors
from meshmatch.maps.indices import corners_of
from meshmatch.maps.mapped_mesh import length_of
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.progress import Progress
from meshmatch.shapes.faces import seam_representatives
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.clean_weights import same_at
from meshmatch.transfer.local_frames import local_frames
from meshmatch.transfer.low_confidence import diffuse, vertex_graph

# All set by hand; lengths in units of sqrt(area).
# Displacements scale with the surface, within this factor of the median scale.
_MAX_GROWTH = 2.0
# Minimum confidence, and minimum cosine between a vertex's normal and that of its place, for a vertex to be known. A part
# with a smaller share of known vertices has no counterpart, and moves with surroundings up to the last distance away.
_MIN_CONFIDENCE, _MIN_COSINE, _MIN_KNOWN, _NEAR = 0.1, 0.3, 0.5, 0.1
# A part is solid, as eyes and teeth are: largest size; largest sum of its normals as a share of its area; smallest thickness
# as a share of its length.
_MAX_SOLID, _MAX_OPEN, _MIN_THICKNESS = 0.1, 0.6, 0.2
# Vertices touch below the first distance if the cosine between their normals is below the second number. They are a pair if
# their places on the source are closer than the third. A pair stays together where it would part by less than the fourth
# share of its displacement, and moves freely above the fifth.
_TOUCH, _OPPOSED, _SAME_PLACE, _TOGETHER, _APART = 0.004, -0.3, 0.03, 0.15, 0.4
# Displacements below this share of the largest one become 0.
_NEGLIGIBLE = 1e-3
_N_NEIGHBOURS, _N_AROUND = 12, 4


def carry_moves(
    moves: Float[Floats32, "K V_source 3"],
    forward: VertexMap,
    backward: VertexMap,
    source: Shape,
    target: Shape,
    progress: Progress = Progress(),
) -> Float[Floats32, "K V_target 3"]:
    """Displacements (K, V_target, 3) of the target's vertices, in its frame and unit."""
    rotations, scale = local_frames(forward, source, target)
    typical = float(np.median(scale[source.valid]))
    frames = rotations * np.clip(scale, typical / _MAX_GROWTH, typical * _MAX_GROWTH)[:, None, None]
    matrix = backward.sparse()
    moved = np.stack([(matrix @ np.einsum("vij,vj->vi", frames, move)).astype(np.float32) for move in moves])
    graph = vertex_graph(target)
    known = target.valid & (backward.assumed_confidence >= _MIN_CONFIDENCE)
    facing = normalized(backward.apply(np.einsum("vij,vj->vi", rotations, source.vertex_normals)))
    known &= dot(facing, target.vertex_normals) > _MIN_COSINE
    part = _connected_parts(graph)
    has_counterpart = np.bincount(part, known) >= _MIN_KNOWN * np.bincount(part)
    known &= has_counterpart[part]
    is_solid = _solid_parts(target, part)
    source_part = _connected_parts(vertex_graph(source))
    twin_is_solid = np.bincount(
        part, _solid_parts(source, source_part)[source_part[backward.index]]
    ) >= _MIN_KNOWN * np.bincount(part)
    for k, move in enumerate(moved):
        moved[k] = diffuse(graph, known, np.where(known[:, None], move, 0.0))[0]
        progress((k + 1) / len(moved))
    _move_rigidly(
        moved,
        target,
        part,
        is_solid & has_counterpart & twin_is_solid,
        (is_solid & ~twin_is_solid) | ~has_counterpart,
        known,
    )
    _close_slits(moved, backward, source, target)
    welded = same_at(seam_representatives(target.verts, target.faces), eye_array(target.V, format="csr"))
    moved = np.stack([(welded @ move).astype(np.float32) for move in moved])
    size = np.linalg.norm(moved, axis=2)
    moved[size <= _NEGLIGIBLE * size.max(axis=1, keepdims=True)] = 0.0
    moved[:, ~target.valid] = 0.0
    return moved


def _connected_parts(graph: csr_array) -> Int[Ints, " V"]:
    """(V,) the connected part of each vertex."""
    return connected_components(graph, directed=False)[1].astype(np.int64)


def _solid_parts(shape: Shape, part: Int[Ints, " V"]) -> Bool[Bools, " P"]:
    """(P,) parts that are small and solid, like eyes and teeth, but unlike lashes, which bend with the skin."""
    count = int(part.max()) + 1
    low, high, outwards = np.full((count, 3), np.inf), np.full((count, 3), -np.inf), np.zeros((count, 3))
    np.minimum.at(low, part, shape.verts)
    np.maximum.at(high, part, shape.verts)
    vectors, of_face = triangle_vectors(shape.verts, shape.faces), part[shape.faces[:, 0]]
    np.add.at(outwards, of_face, vectors)
    area = np.bincount(of_face, np.linalg.norm(vectors, axis=1), count)
    closed = np.linalg.norm(outwards, axis=1) < _MAX_OPEN * area
    counts = np.bincount(part, minlength=count)
    mean = np.stack([np.bincount(part, column, count) for column in shape.verts.T], axis=1) / counts[:, None]
    offset, spread = shape.verts - mean[part], np.zeros((count, 3, 3))
    np.add.at(spread, part, offset[:, :, None] * offset[:, None, :])
    widths = np.sqrt(np.maximum(np.linalg.eigvalsh(spread), 0.0))
    thick = widths[:, 0] > _MIN_THICKNESS * widths[:, 2]
    return np.asarray(closed & thick & ((high - low).max(axis=1) < _MAX_SOLID * length_of(shape)))


def _move_rigidly(
    moved: Float[Floats32, "K V 3"],
    target: Shape,
    part: Int[Ints, " V"],
    own: Bool[Bools, " P"],
    lost: Bool[Bools, " P"],
    known: Bool[Bools, " V"],
) -> None:
    """Move parts rigidly, in place: by their ``own`` known vertices or, if ``lost``, with what surrounds them."""
    rows = np.flatnonzero(known & ~(own | lost)[part])
    tree = cKDTree(target.verts[rows]) if len(rows) else None
    members, counts = np.argsort(part, kind="stable"), np.bincount(part)
    starts = np.cumsum(counts) - counts
    for number in np.flatnonzero(own | lost).tolist():
        inside = members[starts[number] : starts[number] + counts[number]]
        neighbours = inside[known[inside]]
        if lost[number] and tree is not None:
            distance, near = (np.asarray(each) for each in tree.query(target.verts[inside], min(_N_AROUND, len(rows))))
            neighbours = rows[np.unique(near[distance <= _NEAR * length_of(target)])]
        if len(neighbours):
            moved[:, inside] = _rigid_displacements(
                target.verts[inside], target.verts[neighbours], moved[:, neighbours]
            )


def _rigid_displacements(
    points: Float[Floats, "N 3"], neighbours: Float[Floats, "M 3"], moves: Float[Floats32, "K M 3"]
) -> Floats32:
    """(K, N, 3) displacements of points by the rotation and translation that most points around agree on (robust fit)."""
    weight = np.ones(moves.shape[:2])
    for _ in range(5):
        share = weight / weight.sum(axis=1, keepdims=True)
        center, shift = share @ neighbours, np.einsum("km,kmd->kd", share, moves)
        source_points = neighbours[None] - center[:, None]
        moved_points = source_points + moves - shift[:, None]
        left, _, right = np.linalg.svd(np.einsum("km,kmi,kmj->kij", share, moved_points, source_points))
        sign = np.ones((len(moves), 3))
        sign[:, 2] = np.sign(np.linalg.det(left @ right))
        rotation = (left * sign[:, None, :]) @ right
        error = np.linalg.norm(np.einsum("kij,kmj->kmi", rotation, source_points) - moved_points, axis=2)
        typical = np.median(error, axis=1, keepdims=True)
        weight = 1.0 / (1.0 + (error / np.maximum(2.0 * typical, 1e-12)) ** 2)
    centered = points[None] - center[:, None]
    return np.asarray(np.einsum("kij,knj->kni", rotation, centered) - centered + shift[:, None], np.float32)


def _close_slits(moved: Float[Floats32, "K V 3"], backward: VertexMap, source: Shape, target: Shape) -> None:
    """Keep vertices together that touch across a slit, in place, in those shapes where the source's stay together."""
    other, source_other = _touching(target), _touching(source)
    at, places = corners_of(source.faces, backward.face, backward.index), backward.points(source)
    rows = np.flatnonzero((other >= 0) & (source_other[at] >= 0).any(axis=1))
    rows = rows[(source_other[at[other[rows]]] >= 0).any(axis=1)]
    near = np.linalg.norm(places[rows] - places[other[rows]], axis=1) < _SAME_PLACE * length_of(source)
    rows = rows[near]
    for move in moved:
        a, b = move[rows], move[other[rows]]
        largest = np.maximum(np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1))
        ratio = np.linalg.norm(a - b, axis=1) / np.maximum(largest, 1e-30)
        share = np.clip((_APART - ratio) / (_APART - _TOGETHER), 0.0, 1.0)[:, None]
        move[rows] = a + 0.5 * share * (b - a)


def _touching(shape: Shape) -> Int[Ints, " V"]:
    """(V,) the nearest vertex with an opposite normal that each vertex touches; -1 where there is none."""
    reach = _TOUCH * length_of(shape)
    found = cKDTree(shape.verts).query(shape.verts, min(_N_NEIGHBOURS, shape.V), distance_upper_bound=reach)
    distance, nearest = (np.asarray(each).reshape(shape.V, -1) for each in found)
    row, column = np.nonzero(np.isfinite(distance))
    opposed = dot(shape.vertex_normals[row], shape.vertex_normals[nearest[row, column]]) < _OPPOSED
    row, column = row[opposed][::-1], column[opposed][::-1]  # the nearest comes last and counts
    touched = np.full(shape.V, -1)
    touched[row] = nearest[row, column]
    return touched
