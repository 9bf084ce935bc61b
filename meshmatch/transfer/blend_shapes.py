"""Blendshapes carried along a map: how the source's vertices move, at the target's.

The moves turn with the surface from source to target and grow with it, within bounds. Vertices that the map does not
reach follow those around them; so do those that face another way than their places on the source, such as a vertex of an
upper lip that the map took for one of the lower lip. Separate parts without a counterpart, such as eyes, move as a
whole with what surrounds them. Vertices that touch across a slit, such as lips, stay together where the source's do.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array, eye_array
from scipy.sparse.csgraph import connected_components

from meshmatch.arrays import Bool, Bools, Float, Floats, Floats32, Int, Ints
from meshmatch.geometry.trees import cKDTree
from meshmatch.geometry.triangles import dot, triangle_vectors, unit
from meshmatch.maps.mapped_mesh import length_of
from meshmatch.maps.named_places import corners_of
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.faces import seams
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.clean_weights import same_at
from meshmatch.transfer.local_frames import local_frames
from meshmatch.transfer.low_confidence import diffuse, vertex_graph

# All set by hand; lengths in units of sqrt(area).
# A move grows and shrinks with the surface, but not beyond this factor from what the whole shape does.
_GROWTH = 2.0
# Below this confidence a vertex has no answer of its own, nor one that faces another way than its place on the source:
# the cosine between them. A part of which fewer vertices than this share have an answer has no counterpart; it moves with
# surroundings that are not further away than this.
_SURE, _FACING, _SHARE, _NEAR = 0.1, 0.3, 0.5, 0.1
# A part below this size is an eye or a tooth if the sum of its normals, as a share of its area, and its thinness are below
# and above these.
_SMALL, _OPEN, _THIN = 0.1, 0.6, 0.2
# Vertices touch below this distance if the cosine between their normals is below this; those of a pair are taken for one
# place of the source below this distance. They stay together where they would part by less than the first of these shares of
# their move, and go their own ways above the second.
_TOUCH, _OPPOSED, _ACROSS, _TOGETHER, _APART = 0.004, -0.3, 0.03, 0.15, 0.4
# Moves below this share of the largest are none.
_NOTHING = 1e-3
_NEIGHBOURS, _AROUND = 12, 4


def carry_moves(
    moves: Float[Floats32, "K V_source 3"], forward: VertexMap, backward: VertexMap, source: Shape, target: Shape
) -> Float[Floats32, "K V_target 3"]:
    """How the target's vertices move, in its frame and unit."""
    turns, scale = local_frames(forward, source, target)
    usual = float(np.median(scale[source.valid]))
    frames = turns * np.clip(scale, usual / _GROWTH, usual * _GROWTH)[:, None, None]
    matrix = backward.sparse()
    found = np.stack([(matrix @ np.einsum("vij,vj->vi", frames, move)).astype(np.float32) for move in moves])
    graph = vertex_graph(target)
    known = target.valid & (backward.assumed_confidence >= _SURE)
    facing = unit(backward.apply(np.einsum("vij,vj->vi", turns, source.vertex_normals)))
    known &= dot(facing, target.vertex_normals) > _FACING
    part = _parts(graph)
    held = np.bincount(part, known) >= _SHARE * np.bincount(part)
    known &= held[part]
    solid = _solid(target, part)
    theirs = _parts(vertex_graph(source))
    twin = np.bincount(part, _solid(source, theirs)[theirs[backward.index]]) >= _SHARE * np.bincount(part)
    for k, move in enumerate(found):
        found[k] = diffuse(graph, known, np.where(known[:, None], move, 0.0))[0]
    _move_whole(found, target, part, solid & held & twin, (solid & ~twin) | ~held, known)
    _close(found, backward, source, target)
    welded = same_at(seams(target.verts, target.faces), eye_array(target.V, format="csr"))
    found = np.stack([(welded @ move).astype(np.float32) for move in found])
    size = np.linalg.norm(found, axis=2)
    found[size <= _NOTHING * size.max(axis=1, keepdims=True)] = 0.0
    found[:, ~target.valid] = 0.0
    return found


def _parts(graph: csr_array) -> Int[Ints, " V"]:
    """The number of the connected part of each vertex."""
    return connected_components(graph, directed=False)[1].astype(np.int64)


def _solid(shape: Shape, part: Int[Ints, " V"]) -> Bool[Bools, " P"]:
    """Parts that are small and solid, as eyes and teeth are, and lashes, which bend with the skin, are not."""
    many = int(part.max()) + 1
    low, high, outwards = np.full((many, 3), np.inf), np.full((many, 3), -np.inf), np.zeros((many, 3))
    np.minimum.at(low, part, shape.verts)
    np.maximum.at(high, part, shape.verts)
    vectors, of_face = triangle_vectors(shape.verts, shape.faces), part[shape.faces[:, 0]]
    np.add.at(outwards, of_face, vectors)
    area = np.bincount(of_face, np.linalg.norm(vectors, axis=1), many)
    closed = np.linalg.norm(outwards, axis=1) < _OPEN * area
    counts = np.bincount(part, minlength=many)
    mean = np.stack([np.bincount(part, column, many) for column in shape.verts.T], axis=1) / counts[:, None]
    off, spread = shape.verts - mean[part], np.zeros((many, 3, 3))
    np.add.at(spread, part, off[:, :, None] * off[:, None, :])
    widths = np.sqrt(np.maximum(np.linalg.eigvalsh(spread), 0.0))
    thick = widths[:, 0] > _THIN * widths[:, 2]
    return np.asarray(closed & thick & ((high - low).max(axis=1) < _SMALL * length_of(shape)))


def _move_whole(
    found: Float[Floats32, "K V 3"],
    target: Shape,
    part: Int[Ints, " V"],
    own: Bool[Bools, " P"],
    lost: Bool[Bools, " P"],
    known: Bool[Bools, " V"],
) -> None:
    """Let parts move as a whole: as their ``own`` answers say, or, if these are ``lost``, with what surrounds them."""
    rows = np.flatnonzero(known & ~(own | lost)[part])
    tree = cKDTree(target.verts[rows]) if len(rows) else None
    members, counts = np.argsort(part, kind="stable"), np.bincount(part)
    starts = np.cumsum(counts) - counts
    for number in np.flatnonzero(own | lost).tolist():
        inside = members[starts[number] : starts[number] + counts[number]]
        around = inside[known[inside]]
        if lost[number] and tree is not None:
            distance, near = (np.asarray(each) for each in tree.query(target.verts[inside], min(_AROUND, len(rows))))
            around = rows[np.unique(near[distance <= _NEAR * length_of(target)])]
        if len(around):
            found[:, inside] = _rigidly(target.verts[inside], target.verts[around], found[:, around])


def _rigidly(points: Float[Floats, "N 3"], around: Float[Floats, "M 3"], moves: Float[Floats32, "K M 3"]) -> Floats32:
    """(K, N, 3) how points move with those around: by the rotation and shift that most of these agree on."""
    weight = np.ones(moves.shape[:2])
    for _ in range(5):
        share = weight / weight.sum(axis=1, keepdims=True)
        center, shift = share @ around, np.einsum("km,kmd->kd", share, moves)
        here = around[None] - center[:, None]
        there = here + moves - shift[:, None]
        left, _, right = np.linalg.svd(np.einsum("km,kmi,kmj->kij", share, there, here))
        sign = np.ones((len(moves), 3))
        sign[:, 2] = np.sign(np.linalg.det(left @ right))
        turn = (left * sign[:, None, :]) @ right
        off = np.linalg.norm(np.einsum("kij,kmj->kmi", turn, here) - there, axis=2)
        usual = np.median(off, axis=1, keepdims=True)
        weight = 1.0 / (1.0 + (off / np.maximum(2.0 * usual, 1e-12)) ** 2)
    own = points[None] - center[:, None]
    return np.asarray(np.einsum("kij,knj->kni", turn, own) - own + shift[:, None], np.float32)


def _close(found: Float[Floats32, "K V 3"], backward: VertexMap, source: Shape, target: Shape) -> None:
    """Keep vertices together that touch across a slit, in those shapes in which the source's stay together."""
    other, theirs = _touched(target), _touched(source)
    at, places = corners_of(source.faces, backward.face, backward.index), backward.points(source)
    rows = np.flatnonzero((other >= 0) & (theirs[at] >= 0).any(axis=1))
    rows = rows[(theirs[at[other[rows]]] >= 0).any(axis=1)]
    near = np.linalg.norm(places[rows] - places[other[rows]], axis=1) < _ACROSS * length_of(source)
    rows = rows[near]
    for move in found:
        a, b = move[rows], move[other[rows]]
        largest = np.maximum(np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1))
        ratio = np.linalg.norm(a - b, axis=1) / np.maximum(largest, 1e-30)
        share = np.clip((_APART - ratio) / (_APART - _TOGETHER), 0.0, 1.0)[:, None]
        move[rows] = a + 0.5 * share * (b - a)


def _touched(shape: Shape) -> Int[Ints, " V"]:
    """The nearest vertex that each touches: one that faces it; -1 where there is none."""
    reach = _TOUCH * length_of(shape)
    found = cKDTree(shape.verts).query(shape.verts, min(_NEIGHBOURS, shape.V), distance_upper_bound=reach)
    distance, near = (np.asarray(each).reshape(shape.V, -1) for each in found)
    row, column = np.nonzero(np.isfinite(distance))
    opposed = dot(shape.vertex_normals[row], shape.vertex_normals[near[row, column]]) < _OPPOSED
    row, column = row[opposed][::-1], column[opposed][::-1]  # the nearest is the last
    touched = np.full(shape.V, -1)
    touched[row] = near[row, column]
    return touched
