"""What to do where a map has little confidence: leave blank, or fill in from the neighbours.

`low` (N,) are entries of low confidence. Those without a value count as such too: the source had none there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array, diags_array
from scipy.sparse.csgraph import dijkstra
from scipy.sparse.linalg import cg

from meshmatch.arrays import Bool, Bools, Floats, Int, Ints
from meshmatch.geometry.trees import cKDTree
from meshmatch.geometry.triangles import same_rows
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.attributes import NO_LABEL, largest_weights

_NEIGHBOURS = 8  # of a point of a cloud


@dataclass(frozen=True)
class LowConfidence:
    """How many entries a result has, how many of low confidence, and of all left blank, or filled in; others are kept."""

    total: int
    low: int
    blank: int = 0
    filled: int = 0


def vertex_graph(shape: Shape) -> csr_array:
    """(V, V) sparse, symmetric: lengths of the edges of a mesh, or to the nearest points in a cloud. Vertices at one
    place are joined, so that texture seams do not separate.
    """
    if shape.is_cloud:
        near = cKDTree(shape.verts).query(shape.verts, min(_NEIGHBOURS + 1, shape.V))[1].reshape(shape.V, -1)
        pairs = np.stack([np.repeat(near[:, 0], near.shape[1] - 1), near[:, 1:].ravel()], axis=1)
    else:
        pairs = shape.edges.vertices.astype(np.int64)
    first = same_rows(shape.verts)
    twins = np.flatnonzero(first != np.arange(shape.V))
    return _graph(shape.verts, np.concatenate([pairs, np.stack([first[twins], twins], axis=1)]))


def face_graph(shape: Shape) -> csr_array:
    """(F, F) sparse, symmetric: distances between the centers of faces that share an edge."""
    corners = same_rows(shape.verts)[shape.faces]
    a, b = corners.ravel(), corners[:, [1, 2, 0]].ravel()
    key = np.minimum(a, b) * shape.V + np.maximum(a, b)
    order = np.argsort(key, kind="stable")
    same = np.flatnonzero(key[order][1:] == key[order][:-1])
    pairs = np.stack([order[same], order[same + 1]], axis=1) // 3
    return _graph(shape.verts[shape.faces].mean(axis=1), pairs)


def _graph(points: Floats, pairs: Ints) -> csr_array:
    pairs = np.unique(np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=1), axis=0)
    length = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    # A length of 0 would be no edge at all.
    length = np.maximum(length, max(1e-3 * float(np.median(length)), 1e-30) if len(length) else 1.0)
    places = np.concatenate([pairs, pairs[:, ::-1]]).T
    return csr_array((np.tile(length, 2), tuple(places)), shape=(len(points), len(points)))


def _with_neighbours(graph: csr_array, some: Bools) -> Ints:
    """Numbers of some nodes and of their neighbours: only these matter, however large the rest is."""
    return np.flatnonzero(some | (np.asarray(graph @ some.astype(np.float64)) > 0))


def nearest_known(graph: csr_array, known: Bools) -> Ints:
    """(N,) for each node the nearest known one along the graph; itself if it is known; -1 out of reach."""
    nearest = np.where(known, np.arange(len(known)), -1)
    some = _with_neighbours(graph, ~known)
    if known[some].any():
        part, begin = csr_array(graph[some][:, some]), np.flatnonzero(known[some])
        distance, _, first = dijkstra(part, indices=begin, min_only=True, return_predecessors=True)
        reached = np.isfinite(distance)
        nearest[some[reached]] = some[first[reached]]
    return nearest


def diffuse(graph: csr_array, known: Bools, values: Floats) -> tuple[Floats, Bools]:
    """Values (N, D) with the unknown rows filled in, and (N,) which rows were; those that no known row reaches stay.

    They are the discrete harmonic function with the known values as its boundary, by conjugate gradients: each is the
    mean of its neighbours, weighted by 1 / distance.
    """
    nearest = nearest_known(graph, known)
    ask = ~known & (nearest >= 0)
    out = np.array(values, np.float64)
    rows = np.flatnonzero(ask)
    if not len(rows):
        return out, ask
    out[rows] = out[nearest[rows]]
    near = csr_array(graph[rows])
    near.data = 1.0 / near.data
    total = np.asarray(near.sum(axis=1)).ravel()
    system = csr_array(diags_array(total) - csr_array(near[:, rows]))
    fixed = np.where(known[:, None], out, 0.0)
    right = np.asarray(near @ fixed)
    scale = diags_array(1.0 / total)
    for column in range(out.shape[1]):
        found, _ = cg(system, right[:, column], x0=out[rows, column], rtol=1e-8, maxiter=2000, M=scale)
        # A mean lies between the known values; the solver's last bits may not.
        out[rows, column] = np.clip(found, fixed[known, column].min(), fixed[known, column].max())
    return out, ask


def replace_low_values(
    values: Floats, low: Bool[Bools, " V"], target: Shape, blank: Floats | float | None = None, fill: bool = False
) -> tuple[Floats, LowConfidence]:
    """Values (V,) or (V, D) of the target; those of low confidence, or nan, are left blank, filled in, or kept.

    Columns are told apart: what one lacks says nothing of the others. Vertices count if any of their values do.
    """
    table = values.reshape(len(values), -1)
    wanting = low[:, None] | ~np.isfinite(table)
    count, blanked, filled = int(wanting.any(axis=1).sum()), 0, 0
    if fill:
        graph, done, table = vertex_graph(target), np.zeros(len(low), bool), table.copy()
        masks, groups = np.unique(wanting, axis=1, return_inverse=True)
        for group, mask in enumerate(masks.T):
            columns = np.flatnonzero(groups.ravel() == group)
            table[:, columns], reached = diffuse(graph, ~mask, table[:, columns])
            done |= reached
        filled = int(done.sum())
    elif blank is not None:
        table, blanked = np.where(wanting, blank, table), count
    return table.reshape(values.shape), LowConfidence(len(low), count, blanked, filled)


def replace_low_weights(
    weights: csr_array, low: Bool[Bools, " V"], target: Shape, fill: bool, max_joints: int
) -> tuple[csr_array, LowConfidence]:
    """Skin weights (V, J) of the target; those of low confidence are filled in, or kept. Rows still sum to 1."""
    low = low | (np.diff(weights.indptr) == 0)
    N, count = len(low), int(low.sum())
    if not fill or not count:
        return weights, LowConfidence(N, count)
    graph = vertex_graph(target)
    some = _with_neighbours(graph, low)  # dense numbers only where they are needed
    dense, done = diffuse(csr_array(graph[some][:, some]), ~low[some], weights[some].toarray())
    filled = np.zeros(N, bool)
    filled[some[done]] = True
    kept = csr_array(diags_array((~filled).astype(np.float64)) @ weights)
    row, column = np.nonzero(np.where(done[:, None], dense, 0.0) > 0)
    new = csr_array((dense[row, column], (some[row], column)), shape=weights.shape)
    return largest_weights(csr_array(kept + new), max_joints), LowConfidence(N, count, 0, int(filled.sum()))


def replace_low_labels(
    labels: Int[Ints, " N"], low: Bool[Bools, " N"], target: Shape, blank: bool, fill: bool, on_faces: bool
) -> tuple[Int[Ints, " N"], LowConfidence]:
    """Labels of the target's vertices or faces; those of low confidence are left blank (-1), taken from the nearest
    known ones along the surface, or kept.
    """
    low = low | (labels < 0)
    out, filled = labels.copy(), 0
    if fill:
        nearest = nearest_known(face_graph(target) if on_faces else vertex_graph(target), ~low)
        ask = low & (nearest >= 0)
        out[ask] = labels[nearest[ask]]
        filled = int(ask.sum())
    elif blank:
        out[low] = NO_LABEL
    return out, LowConfidence(len(labels), int(low.sum()), int((out < 0).sum()), filled)
