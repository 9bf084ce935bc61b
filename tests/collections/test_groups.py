"""Where groups differ: the statistics against textbooks, the levels by chance."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from scipy.stats import ttest_ind

from meshmatch.collections.atlas import Atlas
from meshmatch.collections.groups import compare_groups
from meshmatch.errors import InputError, OptionError
from tests.collections.ellipsoids import ellipsoids

RANDOM = np.random.default_rng(0)
NORMALS = np.tile([0.0, 0.6, 0.8], (7, 1))
EVEN = np.full(7, 1 / 7)


def hotelling(one: np.ndarray, other: np.ndarray) -> float:
    """T squared of two samples (N, 3) by the formula."""
    n, m = len(one), len(other)
    pooled = ((n - 1) * np.cov(one.T) + (m - 1) * np.cov(other.T)) / (n + m - 2)
    apart = other.mean(axis=0) - one.mean(axis=0)
    return float(n * m / (n + m) * apart @ np.linalg.inv(pooled) @ apart)


def test_statistics_are_the_textbooks() -> None:
    offsets = RANDOM.standard_normal((9, 7, 3)) + 5
    second = np.array([0, 1, 0, 1, 1, 0, 0, 0, 1], bool)
    found = compare_groups(offsets, second, NORMALS, EVEN, permutations=50)
    along = np.einsum("svi,vi->sv", offsets, NORMALS)
    assert found.statistic == pytest.approx(ttest_ind(along[second], along[~second]).statistic ** 2)
    assert found.along_normal == pytest.approx(along[second].mean(axis=0) - along[~second].mean(axis=0))
    assert found.difference == pytest.approx(offsets[second].mean(axis=0) - offsets[~second].mean(axis=0))
    found = compare_groups(offsets, second, NORMALS, EVEN, kind="hotelling", permutations=50)
    assert found.statistic == pytest.approx([hotelling(*(offsets[k, v] for k in (~second, second))) for v in range(7)])


@pytest.mark.parametrize("kind", ["normal", "hotelling"])
def test_every_labelling_is_tried(kind) -> None:
    """Slowly: the statistic of each of 20 labellings."""
    offsets = RANDOM.standard_normal((6, 7, 3))
    second = np.array([0, 0, 0, 1, 1, 1], bool)
    offsets[second] += 0.8
    along = np.einsum("svi,vi->sv", offsets, NORMALS)
    rows, apart = [], []
    for chosen in combinations(range(6), 3):
        into = np.isin(np.arange(6), chosen)
        if kind == "normal":
            rows.append(ttest_ind(along[into], along[~into]).statistic ** 2)
        else:
            rows.append([hotelling(offsets[~into, v], offsets[into, v]) for v in range(7)])
        apart.append(np.square(offsets[into].mean(axis=0) - offsets[~into].mean(axis=0)).sum(axis=1).mean())
    table, own = np.array(rows), np.array(rows)[-1]
    found = compare_groups(offsets, second, NORMALS, EVEN, kind=kind)
    assert found.exact
    assert found.labellings == 20
    assert found.p == pytest.approx((table >= own * (1 - 1e-9)).mean(axis=0))
    assert found.p_corrected == pytest.approx((table.max(axis=1)[:, None] >= own * (1 - 1e-9)).mean(axis=0))
    assert found.p_overall == pytest.approx(np.mean(np.array(apart) >= apart[-1] * (1 - 1e-9)))
    assert (found.p_corrected >= found.p).all()
    assert (found.p_fdr >= found.p).all()


def test_chance_is_taken_for_chance() -> None:
    """Of 200 comparisons of equal groups about one in twenty finds something at 0.05, whatever the vertices."""
    random = np.random.default_rng(5)
    second = np.arange(8) % 2 == 0
    hits = {"corrected": 0, "overall": 0, "plain": 0}
    for _ in range(200):
        offsets = random.standard_normal((8, 7, 3))
        found = compare_groups(offsets, second, NORMALS, EVEN)
        hits["corrected"] += found.p_corrected.min() <= 0.05
        hits["overall"] += found.p_overall <= 0.05
        hits["plain"] += found.p.min() <= 0.05
    assert hits["corrected"] <= 20
    assert hits["overall"] <= 20
    assert hits["plain"] > 20  # which is why there is a correction


def test_a_bump_is_found_where_it_is() -> None:
    given = ellipsoids(30, splits=2)
    points = given.points + 0.01 * np.random.default_rng(2).standard_normal(given.points.shape)
    bump = np.exp(-10 * np.square(given.points[0] / given.axes[0] - [1, 0, 0]).sum(axis=1))
    points[15:, :, 0] += 0.2 * bump
    atlas = Atlas.of(points, given.faces)
    for kind in ("normal", "hotelling"):
        found = atlas.compare(atlas.names[:15], atlas.names[15:], kind=kind, permutations=2000, seed=3)
        assert not found.exact
        assert found.labellings == 2001
        assert found.counts == (15, 15)
        assert found.p_corrected[bump.argmax()] == 1 / 2001
        assert found.along_normal[bump.argmax()] == pytest.approx(0.2, rel=0.1)
        assert (found.p_corrected[bump < 0.01] > 0.05).mean() > 0.9  # laying them over one another spreads it a little
        assert np.count_nonzero(found.p_fdr <= 0.05) >= np.count_nonzero(found.p_corrected <= 0.05)
        again = atlas.compare(atlas.names[:15], atlas.names[15:], kind=kind, permutations=2000, seed=3)
        assert np.array_equal(found.p, again.p)
    other = atlas.compare(atlas.names[15:], atlas.names[:15], permutations=100)
    assert np.allclose(other.along_normal, -found.along_normal)


def test_what_cannot_be_compared() -> None:
    given = ellipsoids(5)
    atlas = Atlas.of(given.points, given.faces)
    names = atlas.names
    with pytest.raises(InputError, match="both groups"):
        atlas.compare(names[:3], names[2:])
    with pytest.raises(InputError, match="no shape called") as caught:
        atlas.compare(["nobody", "none"], names[2:])
    assert caught.value.hint == f"there are 5: {', '.join(names)}"
    with pytest.raises(OptionError, match="two shapes"):
        atlas.compare(names[:1], names[1:])
    with pytest.raises(OptionError, match="two shapes"):
        atlas.compare(names[0], names[1:])
    with pytest.raises(InputError, match=f"'{names[0]}' is in both groups"):
        atlas.compare(names[0], names)
    assert atlas.rows(names[3]).tolist() == [3]
    with pytest.raises(OptionError, match="too few"):
        atlas.compare(names[:2], names[2:], kind="hotelling")
    with pytest.raises(OptionError, match="statistic"):
        atlas.compare(names[:2], names[2:], kind="welch")  # type: ignore[arg-type]
    for count, words in ((0, "at least one permutation"), (2.5, "must be a whole number, not 2.5")):
        with pytest.raises(OptionError, match=words):
            atlas.compare(names[:2], names[2:], permutations=count)  # type: ignore[arg-type]
