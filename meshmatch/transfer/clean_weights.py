"""Cleaning of transferred skin weights for animation: without strays, holes and tears, four joints per vertex.

Where limbs touch, a map takes some vertices to the wrong one, and a single vertex that follows another limb is a spike.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array, csr_array, diags_array
from scipy.sparse.csgraph import connected_components

from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints
from meshmatch.geometry.trees import cKDTree
from meshmatch.maps.footpoints import Surface
from meshmatch.shapes.faces import seam_representatives
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.attributes import joint_table, largest_weights
from meshmatch.transfer.low_confidence import replace_low_weights, vertex_graph

# All set by hand. Smaller weights do not connect vertices to a region; regions of a joint with less than this share of its
# largest one on the same part of a mesh are strays; a vertex that keeps less than this share of its weight is a hole.
_MIN_CONNECTING, _MIN_REGION, _MIN_KEPT = 0.02, 0.25, 0.5
# Neighbours with less than this share of their weights in common are a tear; steps of smoothing tears.
_MIN_COMMON, _SMOOTHING_STEPS = 0.1, 3
_MIN_WEIGHT = 1e-3  # smaller weights move nothing visibly
# Vertices farther from the source than this, in diagonals of the target's box, have no counterpart; where more than this
# share are, the map is wrong.
_MAX_DISTANCE, _MAX_SHARE = 0.01, 0.25


def clean_weights(
    weights: csr_array, target: Shape, influences: int = 4, unknown: Bool[Bools, " V"] | None = None
) -> csr_array:
    """Clean skin weights (V, J) of the target; every row sums to 1. Vertices at one position along seams get equal weights.

    On every connected part of the mesh each joint keeps its main regions; holes are filled in from their surroundings, and
    neighbours with almost nothing in common are smoothed. Vertices that no joint moves take the weights of the nearest other
    one. Weights of ``unknown`` vertices are ignored and filled in like holes.
    """
    graph = vertex_graph(target)
    twin = np.arange(target.V) if target.is_cloud else seam_representatives(target.verts, target.faces)
    if unknown is not None and not unknown.all():
        weights = csr_array(diags_array((~unknown).astype(np.float64)) @ weights)
    weights = same_at(twin, largest_weights(weights, influences))
    cleaned = _remove_strays(weights, graph)
    sums = np.asarray(cleaned.sum(axis=1)).ravel()
    filled, _ = replace_low_weights(cleaned, sums < _MIN_KEPT, target, True, influences)
    smooth = largest_weights(same_at(twin, _smooth_tears(same_at(twin, filled), graph)), influences)
    smooth.data[smooth.data < _MIN_WEIGHT] = 0.0
    return _fill_empty_rows(largest_weights(smooth, influences), target)


def find_uncovered(
    target: Shape, points: Float[Floats, "V_source 3"], faces: Int[Ints, "F 3"]
) -> Bool[Bools, " V_target"]:
    """(V_target,) vertices far from the mapped surface of the source, such as long hair that the source lacks.

    A map takes these to whatever is nearest: hair that hangs down, to the back. All False where the map places the source
    far from much of the target.
    """
    size = float(np.linalg.norm(np.ptp(target.bounds, axis=0)))
    is_far = Surface(points, faces).query(target.verts).distance > _MAX_DISTANCE * size
    return np.asarray(is_far & (is_far.mean() <= _MAX_SHARE))


def same_at(twin: Int[Ints, " V"], weights: csr_array) -> csr_array:
    """Average the weights of all vertices that have the same twin."""
    V = len(twin)
    together = csr_array((np.ones(V), (np.arange(V), twin)), (V, V))
    share = diags_array(1.0 / np.maximum(np.bincount(twin, minlength=V), 1))
    return csr_array(together @ (share @ (together.T @ weights)))


def _remove_strays(weights: csr_array, graph: csr_array) -> csr_array:
    """Remove regions of a joint that are far smaller than its largest one on the same part of the mesh."""
    joints, shares = joint_table(weights)
    V, N = joints.shape
    part = connected_components(graph, directed=False)[1]
    edges = coo_array(graph)
    rows, columns = edges.row[edges.row < edges.col], edges.col[edges.row < edges.col]
    begins, ends = [], []
    for a in range(N):
        for b in range(N):
            linked = (
                (joints[rows, a] == joints[columns, b])
                & (shares[rows, a] > _MIN_CONNECTING)
                & (shares[columns, b] > _MIN_CONNECTING)
            )
            begins.append(N * rows[linked] + a)
            ends.append(N * columns[linked] + b)
    begin, end = np.concatenate(begins), np.concatenate(ends)
    links = coo_array((np.ones(len(begin), np.int8), (begin, end)), (V * N, V * N))
    region = connected_components(links, directed=False)[1]
    amount = np.bincount(region, shares.ravel())
    where = part.repeat(N) * (int(joints.max(initial=0)) + 1) + joints.ravel()
    _, place = np.unique(where, return_inverse=True)
    largest = np.zeros(int(place.max(initial=0)) + 1)
    np.maximum.at(largest, place, amount[region])
    good = (amount[region] >= _MIN_REGION * largest[place]) & (shares.ravel() > 0)
    at = np.flatnonzero(good)
    return csr_array((shares.ravel()[at].astype(np.float64), (at // N, joints.ravel()[at])), weights.shape)


def _smooth_tears(weights: csr_array, graph: csr_array) -> csr_array:
    """Smooth weights around edges whose ends have almost nothing in common."""
    edges = coo_array(graph)
    differ = 0.5 * np.asarray(abs(weights[edges.row] - weights[edges.col]).sum(axis=1)).ravel() > 1.0 - _MIN_COMMON
    is_torn = np.zeros(weights.shape[0])
    is_torn[edges.row[differ]] = 1.0
    around = (is_torn > 0) | (np.asarray(graph @ is_torn) > 0)
    rows = np.flatnonzero(around)
    if not len(rows):
        return weights
    links = csr_array(graph[rows])
    links.data = np.ones_like(links.data)
    mean = csr_array(diags_array(0.5 / np.maximum(np.diff(links.indptr), 1)) @ links)
    own = csr_array((np.full(len(rows), 0.5), (np.arange(len(rows)), rows)), mean.shape)
    blend = csr_array(own + mean)
    back = csr_array((np.ones(len(rows)), (rows, np.arange(len(rows)))), (weights.shape[0], len(rows)))
    others = diags_array((~around).astype(np.float64))
    for _ in range(_SMOOTHING_STEPS):
        weights = csr_array(others @ weights + back @ (blend @ weights))
    return weights


def _fill_empty_rows(weights: csr_array, target: Shape) -> csr_array:
    """Fill empty rows with those of the nearest vertex that has weights."""
    empty = np.diff(weights.indptr) == 0
    if not empty.any() or empty.all():
        return weights
    full = np.flatnonzero(~empty)
    rows = np.arange(len(empty))
    rows[empty] = full[cKDTree(target.verts[full]).query(target.verts[empty])[1]]
    return csr_array(weights[rows])


def make_rigid(weights: csr_array, groups: list[tuple[Int[Ints, " N"], Int[Ints, " M"]]]) -> csr_array:
    """Move groups of vertices rigidly: each with the joint that has most of the weight of the vertices ``beside`` it, or of
    its own vertices where there are none. ``groups`` are pairs of (own vertices, vertices beside).
    """
    rows = np.arange(weights.shape[0])
    chosen = np.full(len(rows), -1)
    for group, beside in groups:
        deciding = beside if len(beside) else group
        chosen[group] = int(np.asarray(weights[deciding].sum(axis=0)).ravel().argmax())
    stiff = chosen >= 0
    others = csr_array(diags_array((~stiff).astype(np.float64)) @ weights)
    one = csr_array((np.ones(int(stiff.sum())), (rows[stiff], chosen[stiff])), weights.shape)
    return csr_array(others + one)
