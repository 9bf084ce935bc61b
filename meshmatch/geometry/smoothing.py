"""Values on a graph, such as the edges of a mesh, that are averaged with those around: linear systems of its Laplacian."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csc_array, csr_array, diags_array
from scipy.sparse.linalg import SuperLU, cg, splu

from meshmatch.arrays import Float, Floats, Int, Ints


def laplacian(edges: Int[Ints, "E 2"], weight: Float[Floats, " E"], V: int) -> csr_array:
    """(V, V) sparse: weighted sums over the edges of differences between their ends."""
    start, end = edges.T
    places = np.concatenate([start, end]), np.concatenate([end, start])
    neighbours = csr_array((np.concatenate([weight, weight]), places), shape=(V, V))
    return csr_array(diags_array(np.asarray(neighbours.sum(axis=1)).ravel()) - neighbours)


def factors(matrix: csc_array) -> SuperLU:
    """Of a matrix without negative eigenvalues, or whose diagonal outweighs the rest of every row: it needs no other pivots,
    and the search for these would take most of the time.
    """
    options = {"SymmetricMode": True}
    return splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)


def solved(matrix: csr_array, right: Float[Floats, "V D"], start: Float[Floats, "V D"]) -> Float[Floats, "V D"]:
    """Columns that solve a positive definite system, by conjugate gradients."""
    scaled = diags_array(1.0 / matrix.diagonal())
    columns = [cg(matrix, b, x, rtol=1e-6, maxiter=1000, M=scaled)[0] for b, x in zip(right.T, start.T, strict=True)]
    return np.stack(columns, axis=1)


def averaged(
    values: Float[Floats, "V D"],
    trust: Float[Floats, " V"],
    edges: Int[Ints, "E 2"],
    length: Float[Floats, " E"],
    radius: float,
) -> Float[Floats, "V D"]:
    """Values averaged over a surface within about a radius (in the unit of the edges' lengths).

    Each counts by its ``trust``, which is positive; where that is small, the values around take its place.
    """
    V = len(values)
    degree = np.maximum(np.bincount(edges.ravel(), minlength=V), 1)
    weight = 4.0 * (radius / np.maximum(length, 0.01 * radius)) ** 2 / degree[edges].mean(axis=1)
    matrix = (laplacian(edges, weight, V) + diags_array(trust)).tocsr()
    return solved(matrix, trust[:, None] * values, values)
