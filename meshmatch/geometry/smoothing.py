"""Values on a graph, such as the edges of a mesh, that are averaged with those around: linear systems of its Laplacian."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.sparse import csc_array, csr_array, diags_array
from scipy.sparse.csgraph import dijkstra
from scipy.sparse.linalg import LinearOperator, SuperLU, cg, splu

from meshmatch.arrays import Float, Floats, Int, Ints

_LARGE = 20_000  # vertices; below, the diagonal alone takes few steps
_COARSEST = 3_000  # its matrix may be dense
_CLUSTER = 10  # vertices of the next finer level
_DAMPING = 0.6
_MOST_WORK = 10  # products for each entry of a matrix: on a surface 2 to 6, with neighbours by the thousands far more


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
    V = matrix.shape[0]
    near = diags_array(1.0 / matrix.diagonal()) if V < _LARGE else LinearOperator((V, V), _levels(matrix), dtype=float)
    columns = [cg(matrix, b, x, rtol=1e-6, maxiter=1000, M=near)[0] for b, x in zip(right.T, start.T, strict=True)]
    return np.stack(columns, axis=1)


def _levels(matrix: csr_array) -> Callable[[Floats], Floats]:
    """About the inverse of a matrix: by its diagonal, plus the same for clusters of neighbours, and so on. With it the steps
    that are needed hardly grow with the mesh (an additive multigrid method, with smoothed aggregation)."""
    V, inverse = matrix.shape[0], 1.0 / matrix.diagonal()
    if V <= _COARSEST:
        firm = matrix + diags_array(1e-6 * matrix.diagonal())  # clusters that became alike
        return factors(csc_array(firm)).solve
    seeds = np.sort(np.random.default_rng(0).choice(V, V // _CLUSTER, replace=False))
    steps = csr_array((np.ones(matrix.nnz), matrix.indices, matrix.indptr), shape=matrix.shape)
    nearest = dijkstra(steps, indices=seeds, unweighted=True, return_predecessors=True, min_only=True)[2]
    rows = np.flatnonzero(nearest >= 0)  # others are connected to no seed
    members = csr_array((np.ones(len(rows)), (rows, np.searchsorted(seeds, nearest[rows]))), shape=(V, len(seeds)))
    spread = csr_array(members - diags_array(_DAMPING * inverse) @ (matrix @ members))
    if not (_is_cheap(matrix, spread) and _is_cheap(spread.T.tocsr(), csr_array(matrix @ spread), matrix.nnz)):
        spread = members
    gather = spread.T.tocsr()
    coarser = _levels(csr_array(gather @ matrix @ spread))
    return lambda rest: inverse * rest + spread @ coarser(gather @ rest)


def _is_cheap(first: csr_array, second: csr_array, entries: int = 0) -> bool:
    """Whether a product of sparse matrices takes few multiplications for each of some entries (default: the first's)."""
    return int(np.diff(second.indptr)[first.indices].sum(dtype=np.int64)) <= _MOST_WORK * (entries or first.nnz)


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
