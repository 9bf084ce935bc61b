"""The same surface in other triangles, so that its vertices are not those that a model was trained on.

Splitting triangles and thinning them out again does not do that: a quadric collapse returns to the corners it began with.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_matrix, diags, vstack

from meshmatch.arrays import Int, Ints


def other_triangles(faces: Int[Ints, "F 3"], V: int) -> tuple[csr_matrix, Int[Ints, "N 3"]]:
    """Weights (V + F, V) of new vertices, and the triangles between them.

    The new vertices are the middle of each face, and, in place of each vertex, the mean of the middles around it; those of
    a border stay. An edge becomes two triangles, each from one of its ends to the middles on both of its sides; an open
    edge becomes one.
    """
    F = len(faces)
    at = csr_matrix((np.ones(3 * F), faces.ravel(), np.arange(0, 3 * F + 1, 3)), shape=(F, V))
    start, end = faces.T.ravel(), faces[:, [1, 2, 0]].T.ravel()
    own = V + np.tile(np.arange(F), 3)
    key, back = start * V + end, end * V + start
    order = np.argsort(key)
    twin = order[np.searchsorted(key, back, sorter=order).clip(max=3 * F - 1)]
    open_edge = key[twin] != back
    stays = np.zeros(V)
    stays[start[open_edge]] = stays[end[open_edge]] = 1.0
    middles = at / 3
    around = np.maximum(np.asarray(at.sum(0)).ravel(), 1)
    weights = vstack([diags((1 - stays) / around) @ at.T @ middles + diags(stays), middles]).tocsr()
    return weights, np.stack([start, np.where(open_edge, end, own[twin]), own], 1)
