"""Which triangle lies on which texel."""

import numpy as np
import pytest
from scipy.spatial import Delaunay

from meshmatch.transfer import texels
from meshmatch.transfer.texels import borders_another, count_rows, covered_texels, draw_triangles, grow

SQUARE = np.array([[[0, 0], [4, 0], [4, 4]], [[0, 0], [4, 4], [0, 4]]], float)


def inside(corners: np.ndarray, x: float, y: float) -> bool:
    """Whether a point lies in a triangle, the slow way."""
    signs = []
    for k in range(3):
        (ax, ay), (bx, by) = corners[k], corners[(k + 1) % 3]
        signs.append((bx - ax) * (y - ay) - (by - ay) * (x - ax))
    return min(signs) > 0 or max(signs) < 0


def test_a_square_of_two_triangles_by_hand() -> None:
    found, twice = draw_triangles(SQUARE, 5)
    # centers on the diagonal go to one of the two, and the texels beyond the square to none
    want = [[1, 0, 0, 0, -1], [1, 1, 0, 0, -1], [1, 1, 1, 0, -1], [1, 1, 1, 1, -1], [-1] * 5]
    on_diagonal = np.eye(5, dtype=bool)
    assert twice == 0
    np.testing.assert_array_equal(found[~on_diagonal], np.array(want)[~on_diagonal])
    assert (found[on_diagonal][:4] >= 0).all() and found[4, 4] == -1


def test_random_triangles_against_the_slow_way() -> None:
    rng = np.random.default_rng(0)
    corners = rng.uniform(-3, 15, (40, 3, 2))
    for triangle in corners:
        found, _ = draw_triangles(triangle[None], 12)
        want = [[inside(triangle, x + 0.5, y + 0.5) for x in range(12)] for y in range(12)]
        np.testing.assert_array_equal(found >= 0, want)


def test_every_texel_of_a_triangulation_is_held_once() -> None:
    rng = np.random.default_rng(1)
    points = np.concatenate([rng.uniform(0, 32, (200, 2)), [[0, 0], [32, 0], [0, 32], [32, 32]]])
    points[:100] = np.round(points[:100] * 2) / 2  # many corners and edges on centers
    corners = points[Delaunay(points).simplices]
    found, twice = draw_triangles(corners, 32)
    assert twice == 0
    assert (found >= 0).all()
    assert sum(len(face) for face, _, _ in covered_texels(corners)) == 32 * 32


def test_texels_that_are_held_twice_are_counted() -> None:
    found, twice = draw_triangles(np.concatenate([SQUARE, SQUARE[:1]]), 4)
    assert twice == (draw_triangles(SQUARE[:1], 4)[0] >= 0).sum()
    assert (found >= 0).all()


def test_parts_give_the_same_as_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    corners = np.random.default_rng(2).uniform(0, 20, (30, 3, 2))
    whole = draw_triangles(corners, 20)
    monkeypatch.setattr(texels, "_CHUNK", 7)
    parts = draw_triangles(corners, 20)
    np.testing.assert_array_equal(whole[0], parts[0])
    assert whole[1] == parts[1]


def test_triangles_without_area_hold_nothing() -> None:
    flat = np.array([[[1, 1], [3, 3], [5, 5]], [[2, 2], [2, 2], [2, 2]], [[0, 2.5], [4, 2.5], [2, 2.5]]], float)
    assert not list(covered_texels(flat))
    np.testing.assert_array_equal(count_rows(SQUARE), [4, 4])


def test_growing_takes_straight_neighbours_before_slanting_ones() -> None:
    start = np.full((5, 5), -1, np.int32)
    start[1, 1], start[2, 3] = 7, 9
    same, once, all_over = start.copy(), start.copy(), start.copy()
    grow(same, 0)
    grow(once, 1)
    grow(all_over, 4)
    np.testing.assert_array_equal(same, start)
    assert once[1, 2] == 7 and once[1, 3] == 9 and once[0, 0] == 7 and once[4, 4] == -1
    assert (all_over >= 0).all()


def test_neighbours_that_differ() -> None:
    values = np.array([[1, 1, 2], [1, -1, 2], [1, 1, 1]], np.int32)
    want = [[False, True, True], [False, False, True], [False, False, True]]
    np.testing.assert_array_equal(borders_another(values), want)
