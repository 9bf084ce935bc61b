"""Large systems of graphs against their residual, and against a direct solution."""

import tracemalloc

import numpy as np
import pytest
from scipy.sparse import csc_array, diags_array
from scipy.sparse.linalg import spsolve

from meshmatch.geometry.smoothing import laplacian, smooth_values, solve_positive_definite


def strip(width: int, length: int) -> np.ndarray:
    """Edges of a grid."""
    at = np.arange(width * length).reshape(length, width)
    pairs = [(at[1:], at[:-1]), (at[:, 1:], at[:, :-1]), (at[1:, 1:], at[:-1, :-1])]
    return np.concatenate([np.stack([a.ravel(), b.ravel()], axis=1) for a, b in pairs])


def test_large_systems_are_solved() -> None:
    """The diagonal alone would need more than a thousand steps, and ended there."""
    edges, V = strip(16, 1500), 16 * 1500
    matrix = (laplacian(edges, np.full(len(edges), 1e5), V) + diags_array(np.ones(V))).tocsr()
    right = np.random.default_rng(0).normal(size=(V, 1)) + (np.arange(V) > V / 2)[:, None]
    found = solve_positive_definite(matrix, right, right)
    assert np.linalg.norm(matrix @ found - right) <= 1.01e-6 * np.linalg.norm(right)
    assert np.allclose(found[:, 0], spsolve(csc_array(matrix), right[:, 0]), atol=1e-3)


@pytest.mark.parametrize("hubs", [1, 50])
def test_vertices_with_many_neighbours_take_little_memory(hubs: int) -> None:
    V = 40_000
    rest = np.arange(hubs, V)
    edges = np.concatenate([np.stack([rest, rest % hubs], axis=1), np.stack([rest[1:], rest[:-1]], axis=1)])
    matrix = (laplacian(edges, np.ones(len(edges)), V) + diags_array(np.ones(V))).tocsr()
    right = np.random.default_rng(0).normal(size=(V, 1))
    tracemalloc.start()
    found = solve_positive_definite(matrix, right, right)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 100e6
    assert np.linalg.norm(matrix @ found - right) <= 1.01e-6 * np.linalg.norm(right)


def test_separate_vertices_keep_their_values() -> None:
    values = np.random.default_rng(0).normal(size=(30_000, 2))
    edges = np.zeros((0, 2), dtype=np.int64)
    assert np.allclose(smooth_values(values, np.ones(30_000), edges, np.zeros(0), 1.0), values)
