"""Where vertices belong on the template: pieces cut out by tears, and clouds that ask their neighbours."""

import numpy as np
import pytest

from meshmatch.fitting.fit import Fit
from meshmatch.maps.footpoints import (
    neighbour_medians,
    neighbours,
    small_islands,
    surrounding_values,
    template_footpoints,
)
from meshmatch.shapes.shape import Shape
from tests.conftest import some_fit
from tests.maps.solids import grid

# A chain of ten vertices, one apart; where they belong is where they are.
CHAIN = np.stack([np.arange(9), np.arange(1, 10)], 1)
ALONG = np.stack([np.arange(10.0), np.zeros(10), np.zeros(10)], 1)


def test_a_small_piece_between_tears_is_doubted() -> None:
    area, length = np.full(10, 0.1), np.full(9, 0.01)
    resting = 0.01 * ALONG
    assert not small_islands(CHAIN, length, resting, area).any()
    astray = resting.copy()
    astray[4] += 1.0
    assert small_islands(CHAIN, length, astray, 0.05 * area / area.sum() + (np.arange(10) != 4)).tolist() == [
        k == 4 for k in range(10)
    ]
    # a piece as large as a tenth of the surface is believed
    assert not small_islands(CHAIN, length, astray, area).any()


def test_surroundings_fill_from_the_rim() -> None:
    doubted = np.zeros(10, bool)
    doubted[3:6] = True
    around = surrounding_values(CHAIN, ALONG, doubted)
    assert np.allclose(around[~doubted], ALONG[~doubted])
    assert np.allclose(around[4, 0], 4.0, atol=0.2)
    alone = surrounding_values(CHAIN, ALONG, np.ones(10, bool))
    assert np.isnan(alone).all()


def test_medians_by_hand() -> None:
    values = np.array([[0.0, 5], [1, 5], [9, 5], [2, 5]])
    near = np.array([[0, 1, 2], [1, 0, 3], [2, 3, 1], [3, 1, 0]])
    assert neighbour_medians(values, near)[:, 0].tolist() == [1, 1, 2, 1]
    assert (neighbour_medians(values, near)[:, 1] == 5).all()


@pytest.mark.parametrize(("roughness", "count"), [(0.0, 9), (0.5, 9), (1.0, 15)])
def test_noise_asks_more_neighbours(roughness: float, count: int) -> None:
    points = np.random.default_rng(0).random((3000, 3))
    near = neighbours(points, roughness)
    assert near.shape == (3000, count)
    assert np.array_equal(near[:, 0], np.arange(3000))
    assert neighbours(points[:5], 1.0).shape == (5, 5)


def plates(gap: float) -> Fit:
    """Two square plates, one above the other, that belong far apart on the resting template."""
    sheet = grid(12, 12, 0.05)
    low, half = sheet.verts, sheet.faces
    points = np.concatenate([low, low + np.array([0, 0, gap])])
    resting = np.concatenate([low, low + np.array([0, 0, 1.0])])
    faces = np.concatenate([half, half + len(low)])
    return some_fit(points, faces, resting=resting)


def test_points_that_noise_carries_across_return() -> None:
    """A sheet of points below the upper plate; a few of them have sunk to the lower one."""
    fit = plates(0.1)
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.random((400, 2)) * 0.6, np.full((400, 1), 0.09)], 1)
    sunk = rng.choice(400, 25, replace=False)
    points[sunk, 2] = 0.04
    shape = Shape(points, np.empty((0, 3), np.int64), "sheet")
    foot, belongs = template_footpoints(shape, fit)
    assert (belongs[:, 2] > 0.9).all()
    assert np.allclose(fit.points[fit.faces[foot.face]].mean(1)[:, 2], 0.1)
