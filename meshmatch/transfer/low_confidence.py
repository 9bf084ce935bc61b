"""Treatment of results where the map has low confidence: leave them blank, or fill them in from their neighbours.

`low` (N,) marks entries of low confidence. Entries without a value, because the source has none there, are treated alike.
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

_N_NEIGHBOURS = 8  # nearest neighbours of a point of a cloud


@dataclass(frozen=True)
class LowConfidence:
    """Number of entries of a result; of those of low confidence; and of those left blank, or filled in. Others are kept."""

    total: int
    low: int
    blank: int = 0
    filled: int = 0


def vertex_graph(shape: Shape) -> csr_array:
    """(V, V) sparse and symmetric: lengths of a mesh's edges, or distances to the nearest points in a cloud. Vertices at one
    position are connected, so that texture seams do not separate.
    """
    if shape.is_cloud:
        near = cKDTree(shape.verts).query(shape.verts, min(_N_NEIGHBOURS + 1, shape.V))[1].reshape(shape.V, -1)
        pairs = np.stack([np.repeat(near[:, 0], near.shape[1] - 1), near[:, 1:].ravel()], axis=1)
    else:
        pairs = shape.edges.vertices.astype(np.int64)
    first = same_rows(shape.verts)
    twins = np.flatnonzero(first != np.arange(shape.V))
    return _graph(shape.verts, np.concatenate([pairs, np.stack([first[twins], twins], axis=1)]))


def face_graph(shape: Shape) -> csr_array:
    """(F, F) sparse and symmetric: distances between the centers of faces that share an edge."""
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
    # A length of 0 would not be an edge in a sparse matrix.
    length = np.maximum(length, max(1e-3 * float(np.median(length)), 1e-30) if len(length) else 1.0)
    places = np.concatenate([pairs, pairs[:, ::-1]]).T
    return csr_array((np.tile(length, 2), tuple(places)), shape=(len(points), len(points)))


def _with_neighbours(graph: csr_array, some: Bools) -> Ints:
    """Indices of some nodes and their neighbours; working on these keeps the cost independent of the rest."""
    return np.flatnonzero(some | (np.asarray(graph @ some.astype(np.float64)) > 0))


def nearest_known(graph: csr_array, known: Bools) -> Ints:
    """(N,) the nearest known node of each node along the graph: itself if it is known, -1 if none can be reached."""
    nearest = np.where(known, np.arange(len(known)), -1)
    some = _with_neighbours(graph, ~known)
    if known[some].any():
        part, begin = csr_array(graph[some][:, some]), np.flatnonzero(known[some])
        distance, _, first = dijkstra(part, indices=begin, min_only=True, return_predecessors=True)
        reached = np.isfinite(distance)
        nearest[some[reached]] = some[first[reached]]
    return nearest


def diffuse(graph: csr_array, known: Bools, values: Floats) -> tuple[Floats, Bools]:
    """Fill in unknown rows of values (N, D); return the values, and (N,) which rows were filled. Rows that no known row
    reaches are kept.

    The result is the discrete harmonic function with the known values as its boundary, solved by conjugate gradients: each
    row is the mean of its neighbours, weighted by 1 / distance.
    """
    nearest = nearest_known(graph, known)
    fillable = ~known & (nearest >= 0)
    out = np.array(values, np.float64)
    rows = np.flatnonzero(fillable)
    if not len(rows):
        return out, fillable
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
        # A harmonic function stays between its boundary values; the solver's last bits may not.
        out[rows, column] = np.clip(found, fixed[known, column].min(), fixed[known, column].max())
    return out, fillable


def replace_low_values(
    values: Floats, low: Bool[Bools, " V"], target: Shape, blank: Floats | float | None = None, fill: bool = False
) -> tuple[Floats, LowConfidence]:
    """Leave low-confidence or nan values (V,) or (V, D) of the target blank, fill them in, or keep them.

    Columns are independent: a nan in one does not affect the others. Counts are of vertices where any column is affected.
    """
    table = values.reshape(len(values), -1)
    missing = low[:, None] | ~np.isfinite(table)
    count, blanked, filled = int(missing.any(axis=1).sum()), 0, 0
    if fill:
        graph, done, table = vertex_graph(target), np.zeros(len(low), bool), table.copy()
        masks, groups = np.unique(missing, axis=1, return_inverse=True)
        for group, mask in enumerate(masks.T):
            columns = np.flatnonzero(groups.ravel() == group)
            table[:, columns], reached = diffuse(graph, ~mask, table[:, columns])
            done |= reached
        filled = int(done.sum())
    elif blank is not None:
        table, blanked = np.where(missing, blank, table), count
    return table.reshape(values.shape), LowConfidence(len(low), count, blanked, filled)


def replace_low_weights(
    weights: csr_array, low: Bool[Bools, " V"], target: Shape, fill: bool, max_joints: int
) -> tuple[csr_array, LowConfidence]:
    """Fill in low-confidence skin weights (V, J) of the target, or keep them. Rows still sum to 1."""
    low = low | (np.diff(weights.indptr) == 0)
    N, count = len(low), int(low.sum())
    if not fill or not count:
        return weights, LowConfidence(N, count)
    graph = vertex_graph(target)
    some = _with_neighbours(graph, low)  # dense rows only where they are needed
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
    """Leave low-confidence labels of the target's vertices or faces blank (-1), replace them by the nearest known ones along
    the surface, or keep them.
    """
    low = low | (labels < 0)
    out, filled = labels.copy(), 0
    if fill:
        nearest = nearest_known(face_graph(target) if on_faces else vertex_graph(target), ~low)
        fillable = low & (nearest >= 0)
        out[fillable] = labels[nearest[fillable]]
        filled = int(fillable.sum())
    elif blank:
        out[low] = NO_LABEL
    return out, LowConfidence(len(labels), int(low.sum()), int((out < 0).sum()), filled)
