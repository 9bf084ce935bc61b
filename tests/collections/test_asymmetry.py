"""Asymmetry is found where it was put: what all eggs have is directional, what each has is fluctuating."""

from __future__ import annotations

import numpy as np
import pytest

from meshmatch.collections.asymmetry import measure_asymmetry
from meshmatch.collections.atlas import Atlas
from meshmatch.errors import InputError
from tests.collections.ellipsoids import AXES, Ellipsoids, ellipsoids, moved

S = 14
COMMON, OWN = np.array([0.8, 0.6, 0.0]), np.array([-0.8, 0.0, 0.6])
FLIP = np.array([-1.0, 1.0, 1.0])


def near(ball: np.ndarray, place: np.ndarray) -> np.ndarray:
    """A bump on the unit sphere."""
    return np.exp(-25 * np.square(ball - place).sum(axis=1))


@pytest.fixture(scope="module")
def eggs() -> Ellipsoids:
    """Eggs with one plane of symmetry, x = 0."""
    given = ellipsoids(S, splits=3, spread=np.array([0.03, 0.05, 0.1]))
    points = given.points + 0.005 * np.random.default_rng(1).standard_normal(given.points.shape)
    points[:, :, 1] += 0.08 * points[:, :, 2] ** 2
    points[:, :, 2] += 0.2 * points[:, :, 1] ** 2
    return Ellipsoids(points, given.faces, given.axes)


def test_both_kinds_are_found_where_they_are(eggs: Ellipsoids) -> None:
    ball = ellipsoids(1, splits=3, spread=np.zeros(3)).points[0] / AXES
    points = eggs.points.copy()
    points[:, :, 0] += 0.1 * near(ball, COMMON)
    own = 0.08 * np.random.default_rng(2).standard_normal(S)
    points[:, :, 0] += own[:, None] * near(ball, OWN)
    atlas = Atlas.of(moved(points), eggs.faces)
    found = measure_asymmetry(atlas, permutations=199)
    side = found.directional
    assert (side.df, found.table.residual_df, found.table.total_df) == (1, S - 1, 2 * S - 1)
    assert side.p_anywhere <= 0.01
    along = side.along_normal[0]
    for values, place in ((along, COMMON), (-along, COMMON * FLIP)):
        assert np.linalg.norm(ball[values.argmax()] - place) < 0.15
        assert values.max() == pytest.approx(0.08, abs=0.02)  # 0.1 along x, which is not quite outwards
    places = side.places
    assert places is not None
    far = np.linalg.norm(np.abs(ball) - np.abs(COMMON), axis=1) > 0.5
    assert (places.p_corrected[far] > 0.05).mean() > 0.95
    highest = ball[found.fluctuating.argmax()]
    assert min(np.linalg.norm(highest - OWN), np.linalg.norm(highest - OWN * FLIP)) < 0.2
    assert np.corrcoef(found.fluctuating_of, np.abs(own - own.mean()))[0, 1] > 0.95
    assert (found.total_of > 0.9 * found.of_mean).all()


def test_there_is_none_where_there_is_none(eggs: Ellipsoids) -> None:
    found = measure_asymmetry(Atlas.of(eggs.points, eggs.faces), permutations=99, kind="hotelling", seed=2)
    assert found.directional.p > 0.05
    assert found.directional.p_anywhere > 0.05
    assert found.of_mean < 0.005
    (individual, side) = found.table.effects
    assert individual.r2 > 0.9
    assert np.isnan(individual.p)
    assert side.name == "side"


def test_what_is_not_symmetric_is_refused(eggs: Ellipsoids) -> None:
    points = eggs.points.copy()
    points[:, :, 0] += 0.4 * points[:, :, 1] * points[:, :, 2]
    points[:, :, 1] += 0.3 * points[:, :, 0] ** 2 * np.sign(points[:, :, 0])
    with pytest.raises(InputError, match="no mirror image of itself"):
        measure_asymmetry(Atlas.of(points, eggs.faces))
