"""Values, labels and skin weights of the source, pulled back to the vertices of the target.

Smooth things are interpolated between the corners of the source's face; labels are voted on and never averaged.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.shape import Shape

NO_LABEL = -1


def pull_values(back: VertexMap, values: Floats) -> Floats:
    """Numbers (V_source,) or (V_source, D) on the target: (V_target,) or (V_target, D).

    As `VertexMap.apply`, except that a value that is not finite takes no part, unless it has more than half of the
    weight: then the result is nan.

    Parameters
    ----------
    back : VertexMap
        From target to source.
    """
    values = np.asarray(values, np.float64)
    matrix = back.sparse()
    finite = np.isfinite(values)
    if finite.all():
        return np.asarray(matrix @ values)
    share = np.asarray(matrix @ finite.astype(np.float64))
    sums = np.asarray(matrix @ np.where(finite, values, 0.0))
    return np.where(share >= 0.5, sums / np.maximum(share, 0.5), np.nan)


def pull_labels(
    back: VertexMap, source: Shape, labels: Int[Ints, " N"], on_faces: bool = False
) -> Int[Ints, " V_target"]:
    """Labels of the target's vertices: those with most weight around their places on the source.

    Parameters
    ----------
    labels : (V_source,) or, ``on_faces``, (F_source,) int64
        A number for each label from 0; `NO_LABEL` for none.

    Returns
    -------
    (V_target,) int64
        `NO_LABEL` where nothing around has a label.
    """
    return most_votes(vertex_votes(back, source, labels, on_faces))


def vertex_votes(back: VertexMap, source: Shape, labels: Ints, on_faces: bool = False) -> csr_array:
    """(V_target, labels) sparse: the weight of each label at each target vertex."""
    places = face_weights(back, source) if on_faces else back.sparse()
    return csr_array(places @ one_hot(labels))


def face_weights(back: VertexMap, source: Shape) -> csr_array:
    """(V_target, F_source) sparse: the source's face at each place; at a vertex all faces around, by their area."""
    V = back.source_vertices
    within = (back.face >= 0) & (back.barycentric.max(axis=1) < 1.0 - 1e-9)
    rows = np.flatnonzero(within)
    direct = csr_array((np.ones(len(rows)), (rows, back.face[rows])), shape=(V, source.F))
    rows = np.flatnonzero(~within)
    at = csr_array((np.ones(len(rows)), (rows, back.index[rows])), shape=(V, source.V))
    area = source.face_areas / max(float(source.face_areas.max()), 1e-300) + 1e-12
    return csr_array(direct + at @ faces_at_vertices(source, area))


def faces_at_vertices(shape: Shape, weight: Float[Floats, " F"]) -> csr_array:
    """(V, F) sparse: `weight` (F,) of each face at each of its corners."""
    entries = np.repeat(weight, 3), (shape.faces.ravel(), np.repeat(np.arange(shape.F), 3))
    return csr_array(entries, shape=(shape.V, shape.F))


def one_hot(labels: Int[Ints, " N"]) -> csr_array:
    """(N, labels) sparse: 1 at the label of each; rows without a label are empty."""
    rows = np.flatnonzero(labels >= 0)
    width = int(labels.max(initial=-1)) + 1
    return csr_array((np.ones(len(rows)), (rows, labels[rows])), shape=(len(labels), max(width, 1)))


def most_votes(votes: csr_array) -> Int[Ints, " N"]:
    """The label with most votes in each row, the lowest of equal ones; `NO_LABEL` in an empty row."""
    votes = csr_array(votes)
    rows = np.repeat(np.arange(votes.shape[0]), np.diff(votes.indptr))
    # Sums of thirds differ in the last bits: equal votes should count as equal.
    order = np.lexsort((votes.indices, -np.round(votes.data, 9), rows))
    order = order[votes.data[order] > 0]
    winner, first = np.unique(rows[order], return_index=True)
    result = np.full(votes.shape[0], NO_LABEL, np.int64)
    result[winner] = votes.indices[order[first]]
    return result


def pull_weights(back: VertexMap, weights: csr_array, max_joints: int = 4) -> csr_array:
    """Skin weights (V_source, J) on the target (V_target, J), interpolated; rows have at most `max_joints`, and sum to 1.

    A vertex stays without weights where the source has none.
    """
    return largest_weights(csr_array(back.sparse() @ weights), max_joints)


def largest_weights(weights: csr_array, limit: int) -> csr_array:
    """The `limit` largest weights of each row, scaled to sum to 1; those that are not positive are dropped."""
    weights = csr_array(weights)
    rows = np.repeat(np.arange(weights.shape[0]), np.diff(weights.indptr))
    order = np.lexsort((weights.indices, -weights.data, rows))
    rank = np.arange(len(order)) - weights.indptr[rows[order]]
    order = order[(rank < limit) & (weights.data[order] > 0)]
    kept = csr_array((weights.data[order], (rows[order], weights.indices[order])), shape=weights.shape)
    total = np.bincount(rows[order], weights.data[order], weights.shape[0])
    kept.data /= total[np.repeat(np.arange(kept.shape[0]), np.diff(kept.indptr))]
    return kept
