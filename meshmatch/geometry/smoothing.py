"""Smoothing of values on a graph, such as a mesh's edges, by linear systems with its Laplacian."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.sparse import csc_array, csr_array, diags_array
from scipy.sparse.csgraph import dijkstra
from scipy.sparse.linalg import LinearOperator, SuperLU, cg, splu

from meshmatch.arrays import Float, Floats, Int, Ints

_MIN_MULTIGRID = 20_000  # vertices; for smaller systems a diagonal preconditioner takes few steps
_MAX_COARSEST = 3_000  # vertices of the coarsest level, whose matrix is factorized
_CLUSTER_SIZE = 10  # vertices per cluster, from one level to the next
_DAMPING = 0.6
_MAX_WORK = 10  # multiplications for each entry of a matrix: 2 to 6 on a surface, far more with thousands of neighbours


def laplacian(edges: Int[Ints, "E 2"], weight: Float[Floats, " E"], V: int) -> csr_array:
    """(V, V) sparse weighted graph Laplacian: row sums on the diagonal, minus the weights of the edges."""
    start, end = edges.T
    places = np.concatenate([start, end]), np.concatenate([end, start])
    neighbours = csr_array((np.concatenate([weight, weight]), places), shape=(V, V))
    return csr_array(diags_array(np.asarray(neighbours.sum(axis=1)).ravel()) - neighbours)


def factorize(matrix: csc_array) -> SuperLU:
    """Sparse LU factorization without pivoting.

    For matrices that are positive semidefinite or diagonally dominant: these need no pivoting, and the search for
    pivots would take most of the time.
    """
    options = {"SymmetricMode": True}
    return splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)


def solve_positive_definite(
    matrix: csr_array, right: Float[Floats, "V D"], start: Float[Floats, "V D"]
) -> Float[Floats, "V D"]:
    """Solve a sparse positive definite system for each column of ``right`` by conjugate gradients, from ``start``."""
    V = matrix.shape[0]
    preconditioner = (
        diags_array(1.0 / matrix.diagonal())
        if V < _MIN_MULTIGRID
        else LinearOperator((V, V), _multigrid(matrix), dtype=float)
    )
    columns = [
        cg(matrix, b, x, rtol=1e-6, maxiter=1000, M=preconditioner)[0] for b, x in zip(right.T, start.T, strict=True)
    ]
    return np.stack(columns, axis=1)


def _multigrid(matrix: csr_array) -> Callable[[Floats], Floats]:
    """Approximate inverse of a matrix: an additive multigrid preconditioner with smoothed aggregation.

    Each level adds its inverse diagonal to the correction from clusters of neighbours. With it the number of conjugate
    gradient steps hardly grows with the mesh.
    """
    V, inverse = matrix.shape[0], 1.0 / matrix.diagonal()
    if V <= _MAX_COARSEST:
        regularized = matrix + diags_array(1e-6 * matrix.diagonal())  # regularised: clusters may coincide
        return factorize(csc_array(regularized)).solve
    seeds = np.sort(np.random.default_rng(0).choice(V, V // _CLUSTER_SIZE, replace=False))
    graph = csr_array((np.ones(matrix.nnz), matrix.indices, matrix.indptr), shape=matrix.shape)
    nearest = dijkstra(graph, indices=seeds, unweighted=True, return_predecessors=True, min_only=True)[2]
    rows = np.flatnonzero(nearest >= 0)  # the others are connected to no seed
    members = csr_array((np.ones(len(rows)), (rows, np.searchsorted(seeds, nearest[rows]))), shape=(V, len(seeds)))
    prolongation = csr_array(members - diags_array(_DAMPING * inverse) @ (matrix @ members))
    if not (
        _is_cheap(matrix, prolongation)
        and _is_cheap(prolongation.T.tocsr(), csr_array(matrix @ prolongation), matrix.nnz)
    ):
        prolongation = members
    restriction = prolongation.T.tocsr()
    coarser = _multigrid(csr_array(restriction @ matrix @ prolongation))
    return lambda vector: inverse * vector + prolongation @ coarser(restriction @ vector)


def _is_cheap(first: csr_array, second: csr_array, entries: int = 0) -> bool:
    """Whether a sparse product takes at most `_MAX_WORK` multiplications per entry (by default entries of ``first``)."""
    return int(np.diff(second.indptr)[first.indices].sum(dtype=np.int64)) <= _MAX_WORK * (entries or first.nnz)


def smooth_values(
    values: Float[Floats, "V D"],
    trust: Float[Floats, " V"],
    edges: Int[Ints, "E 2"],
    length: Float[Floats, " E"],
    radius: float,
) -> Float[Floats, "V D"]:
    """Average values over a surface within about ``radius`` (in the unit of the edge lengths).

    Each value counts by its positive ``trust``; where that is small, the surrounding values replace it.
    """
    V = len(values)
    degree = np.maximum(np.bincount(edges.ravel(), minlength=V), 1)
    weight = 4.0 * (radius / np.maximum(length, 0.01 * radius)) ** 2 / degree[edges].mean(axis=1)
    matrix = (laplacian(edges, weight, V) + diags_array(trust)).tocsr()
    return solve_positive_definite(matrix, trust[:, None] * values, values)
