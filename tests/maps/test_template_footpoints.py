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
from tests.conftest import icosphere, some_fit
from tests.maps.solids import grid

# A chain of ten vertices, one apart; where they belong is where they are.
CHAIN = np.stack([np.arange(9), np.arange(1, 10)], 1)
ALONG = np.stack([np.arange(10.0), np.zeros(10), np.zeros(10)], 1)


def test_a_small_piece_between_tears_is_doubted() -> None:
    area, length = np.full(10, 0.1), np.full(9, 0.01)
    resting = 0.01 * ALONG
    assert (small_islands(CHAIN, length, resting, area) == -1).all()
    astray = resting.copy()
    astray[4] += 1.0
    found = small_islands(CHAIN, length, astray, 0.05 * area / area.sum() + (np.arange(10) != 4))
    assert (found >= 0).tolist() == [k == 4 for k in range(10)]
    # a piece as large as a tenth of the surface is believed
    assert (small_islands(CHAIN, length, astray, area) == -1).all()


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


def plate_with(other: Shape) -> Fit:
    """A plate of area 1 around the origin, and something on it that belongs far above."""
    sheet = grid(60, 60, 1 / 60)
    verts = sheet.verts - np.array([0.5, 0.5, 0.0])
    points = np.concatenate([verts, other.verts])
    resting = np.concatenate([verts, other.verts + np.array([0, 0, 1.0])])
    return some_fit(points, np.concatenate([sheet.faces, other.faces + sheet.V]), resting=resting)


def test_a_limb_that_is_fused_with_what_it_lies_on_stays_a_limb() -> None:
    """A ball that is sunk into a plate, as a scan has it: one surface, turned about the ball's axis."""
    ball, radius, up = icosphere(3), 0.05, 0.02
    fit = plate_with(Shape(radius * ball.verts + np.array([0, 0, up]), ball.faces))
    angle = np.linspace(0.05, np.arccos(-up / radius), 20)
    away = np.concatenate([radius * np.sin(angle), np.linspace(0.055, 0.45, 40)])
    height = np.concatenate([up + radius * np.cos(angle), np.zeros(40)])
    turns = np.linspace(0, 2 * np.pi, 48, endpoint=False)[:, None]
    verts = np.stack([away * np.cos(turns), away * np.sin(turns), np.tile(height, (48, 1))], -1).reshape(-1, 3)
    a, b = (np.arange(60) + 60 * np.array([[k], [(k + 1) % 48]]) for k in range(48)), np.arange(59)
    faces = np.concatenate([np.stack([one[b], one[b + 1], two[b + 1]], 1) for one, two in a])
    back = np.concatenate([faces, np.stack([faces[:, 0], faces[:, 2], faces[:, 2] - 1], 1)])
    _, belongs = template_footpoints(Shape(verts, back, "scan"), fit)
    limb = np.tile(np.arange(60) < 18, 48)
    assert (belongs[limb, 2] > 0.9).all() and (belongs[np.tile(np.arange(60) > 22, 48), 2] < 0.1).all()


def test_a_piece_of_a_plate_below_a_sheet_returns_to_the_plate() -> None:
    sheet = grid(12, 12, 1 / 60)
    fit = plate_with(Shape(sheet.verts + np.array([-0.1, -0.1, 0.01]), sheet.faces))
    scan = grid(60, 60, 1 / 60)
    _, belongs = template_footpoints(Shape(scan.verts + np.array([-0.5, -0.5, 0.006]), scan.faces, "scan"), fit)
    assert (belongs[:, 2] < 0.1).all()
