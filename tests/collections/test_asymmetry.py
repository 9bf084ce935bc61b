"""Asymmetry is found where it was put: what all eggs have is directional, what each has is fluctuating."""

from __future__ import annotations

import numpy as np
import pytest

from meshmatch.collections.asymmetry import measure_asymmetry
from meshmatch.collections.atlas import Atlas
from meshmatch.errors import InputError, OptionError
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


N, TIMES = 7, 3


def measured(seed: int, *, own: float = 0.0, common: float = 0.0, error: float = 0.02, splits: int = 1) -> Atlas:
    """Left and right eggs of individuals, each measured several times; a bump is larger on one side."""
    random = np.random.default_rng(seed)
    given = ellipsoids(N, splits=splits, seed=seed)
    ball = given.points[0] / given.axes[0]
    points = np.broadcast_to(given.points[:, None, None], (N, TIMES, 2, *ball.shape)).copy()
    points[..., 0] += common * near(ball, np.array([1.0, 0, 0])) * np.array([1.0, 0.0])[:, None]
    points[..., 1] += own * random.standard_normal((N, 1, 2, 1)) * near(ball, np.array([0.0, 1, 0]))
    points += error * random.standard_normal(points.shape)
    return Atlas.of(points.reshape(-1, *ball.shape), given.faces, NAMES)


NAMES = tuple(f"{who}-{time}-{side}" for who in range(N) for time in range(TIMES) for side in ("right", "left"))
CELLS = [name.split("-") for name in NAMES]
TABLE = {"who": [who for who, _, _ in CELLS], "side": [side for _, _, side in CELLS]}


def plain_table(values: np.ndarray, who: np.ndarray, side: np.ndarray) -> list[tuple[int, float]]:
    """Degrees of freedom and sums of squares of individuals, sides, both together and what is left, by least squares."""
    design = np.ones((len(values), 1))
    rest = values - values.mean(axis=0)
    found, rank = [], 1
    individual = np.eye(who.max() + 1)[who]
    for more in (individual, side[:, None], individual * side[:, None]):
        design = np.hstack([design, more])
        left = values - design @ np.linalg.lstsq(design, values, rcond=1e-9)[0]
        now = int(np.linalg.matrix_rank(design))
        found.append((now - rank, float(np.square(rest).sum() - np.square(left).sum())))
        rest, rank = left, now
    return [*found, (len(values) - rank, float(np.square(rest).sum()))]


def test_measurements_of_left_and_right_ones_are_analysed_as_by_a_plain_reference() -> None:
    atlas = measured(1, own=0.05, common=0.05)
    found = measure_asymmetry(atlas, TABLE, individuals="who", sides="side", permutations=400, seed=3)
    aligned = (atlas.mean + atlas.offsets(atlas.scores)) * np.sqrt(atlas.weights)[:, None]
    values = aligned.reshape(len(NAMES), -1)
    who, right = np.array(TABLE["who"], int), np.array([side == "right" for side in TABLE["side"]], float)
    plain = plain_table(values, who, right)
    told = [(each.df, each.ss) for each in found.table.effects] + [(found.table.residual_df, found.table.residual_ss)]
    assert [df for df, _ in told] == [df for df, _ in plain] == [N - 1, 1, N - 1, 2 * N * (TIMES - 1)]
    assert [ss for _, ss in told] == pytest.approx([ss for _, ss in plain])
    assert found.table.total_ss == pytest.approx(sum(ss for _, ss in plain))
    assert sum(each.r2 for each in found.table.effects) < 1
    individual, side, own = (ss / df for df, ss in plain[:3])
    error = plain[3][1] / plain[3][0]
    assert [each.f for each in found.table.effects] == pytest.approx([individual / own, side / own, own / error])
    assert found.directional.coefficients == ("side: right - left",)
    apart = values[right > 0].reshape(N, TIMES, -1) - values[right == 0].reshape(N, TIMES, -1)
    means = apart.mean(axis=1)
    signs = np.array(np.meshgrid(*[[1, -1]] * N)).reshape(N, -1).T
    flipped = np.square(signs @ means).sum(axis=1)
    assert found.directional.p == pytest.approx(np.mean(flipped >= flipped[0] * (1 - 1e-9)))
    random = np.random.default_rng(0)
    flat = apart.reshape(N * TIMES, -1)
    orders = [np.arange(N * TIMES), *(random.permutation(N * TIMES) for _ in range(400))]
    between = np.array(
        [np.square(flat[order].reshape(N, TIMES, -1).mean(axis=1) - flat.mean(axis=0)).sum() for order in orders]
    )
    assert found.table.effects[2].p == pytest.approx(np.mean(between >= between[0] * (1 - 1e-9)), abs=0.03)


def test_what_each_has_of_its_own_is_told_from_errors() -> None:
    true = measure_asymmetry(
        measured(2, own=0.3, common=0.3, splits=2), TABLE, individuals="who", sides="side", permutations=199
    )
    own = true.table.effects[2]
    assert (own.name, own.p, own.p_anywhere) == ("individual:side", 1 / 200, 1 / 200)
    ball = ellipsoids(1, splits=2, spread=np.zeros(3)).points[0] / AXES
    places = own.places
    assert places is not None
    assert np.linalg.norm(ball[places.statistic.argmax()] - [0, 1, 0]) < 0.3
    assert true.error is not None
    assert np.sqrt(np.square(true.error).mean()) == pytest.approx(0.02 * np.sqrt(6), rel=0.1)
    assert true.directional.p_anywhere <= 0.05
    assert np.linalg.norm(ball[true.directional.along_normal[0].argmax()] - [1, 0, 0]) < 0.3


def test_errors_are_taken_for_errors() -> None:
    """Of 60 collections without fluctuating asymmetry about three have some at 0.05."""
    found = []
    for seed in range(60):
        atlas = measured(seed, splits=0, error=0.01)
        about = measure_asymmetry(atlas, TABLE, individuals="who", sides="side", permutations=99, seed=seed)
        found.append([about.table.effects[2].p, about.table.effects[2].p_anywhere])
    assert (np.array(found) <= 0.05).sum(axis=0).max() <= 8
    assert np.mean(found, axis=0) == pytest.approx([0.5, 0.5], abs=0.1)


def test_measurements_of_symmetric_shapes(eggs: Ellipsoids) -> None:
    """Whose asymmetry is each one's own, and not the error; also where some were measured once."""
    ball = ellipsoids(1, splits=3, spread=np.zeros(3)).points[0] / AXES
    random = np.random.default_rng(4)
    whose = np.repeat(np.arange(S), 2)[: 2 * S - 3]
    points = eggs.points[whose]
    points[:, :, 0] += 0.08 * random.standard_normal(S)[whose, None] * near(ball, OWN)
    points += 0.005 * random.standard_normal(points.shape)
    atlas = Atlas.of(moved(points), eggs.faces)
    found = measure_asymmetry(atlas, {"egg": [f"egg {k}" for k in whose]}, individuals="egg", permutations=199)
    assert found.names == tuple(f"egg {k}" for k in range(S - 1))
    own = found.table.effects[2]
    assert (own.df, found.table.residual_df) == (S - 2, 2 * (len(whose) - S + 1))
    assert own.p == own.p_anywhere == 1 / 200
    assert found.directional.p > 0.01
    one = measure_asymmetry(atlas, {"egg": [str(k) for k in range(len(whose))]}, individuals="egg", permutations=99)
    assert [each.name for each in one.table.effects] == ["individual", "side"]
    assert one.error is None


def test_columns_that_make_no_pairs_are_refused() -> None:
    atlas = measured(0)
    other = {**TABLE, "odd": ["left", *TABLE["side"][1:]], "many": list("abcdef") * N}
    other["empty"] = ["", *TABLE["side"][1:]]
    for column, words in {"odd": "not as many right as left", "many": "6 values", "empty": "is missing"}.items():
        with pytest.raises(InputError, match=words):
            measure_asymmetry(atlas, other, individuals="who", sides=column)
    with pytest.raises(OptionError, match="sides are of individuals"):
        measure_asymmetry(atlas, other, sides="side")
    few = {**TABLE, "who": ["a"] * 18 + ["b"] * 24}
    with pytest.raises(InputError, match="2 individuals are too few"):
        measure_asymmetry(atlas, few, individuals="who", sides="side")
