"""Remesh a surface, so that its vertices are not those that a model was trained on.

Subdivision and decimation would not do: quadric edge collapse returns to the original vertices.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_matrix, diags, vstack

from meshmatch.arrays import Int, Ints


def other_triangles(faces: Int[Ints, "F 3"], V: int) -> tuple[csr_matrix, Int[Ints, "N 3"]]:
    """Sqrt(3)-like subdivision: (V + F, V) weights of new vertices, and the triangles between them.

    The new vertices are the centroid of each face, and for each old vertex the mean of the centroids around it; boundary
    vertices are kept. An edge becomes two triangles, each from one of its ends to the centroids on both sides; a boundary
    edge becomes one.
    """
    F = len(faces)
    incidence = csr_matrix((np.ones(3 * F), faces.ravel(), np.arange(0, 3 * F + 1, 3)), shape=(F, V))
    start, end = faces.T.ravel(), faces[:, [1, 2, 0]].T.ravel()
    face_vertex = V + np.tile(np.arange(F), 3)
    key, reverse_key = start * V + end, end * V + start
    order = np.argsort(key)
    twin = order[np.searchsorted(key, reverse_key, sorter=order).clip(max=3 * F - 1)]
    open_edge = key[twin] != reverse_key
    is_fixed = np.zeros(V)
    is_fixed[start[open_edge]] = is_fixed[end[open_edge]] = 1.0
    centroids = incidence / 3
    n_faces = np.maximum(np.asarray(incidence.sum(0)).ravel(), 1)
    weights = vstack([diags((1 - is_fixed) / n_faces) @ incidence.T @ centroids + diags(is_fixed), centroids]).tocsr()
    return weights, np.stack([start, np.where(open_edge, end, face_vertex[twin]), face_vertex], 1)
