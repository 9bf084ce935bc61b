"""How well measurements repeat, on numbers whose spread is known."""

import numpy as np
import pytest

from meshmatch.experiments.bench.measurements import _row, people_of


def test_scans_are_those_of_people() -> None:
    assert people_of("faust", ["tr_reg_080", "tr_reg_089", "tr_reg_090"]) == {
        "faust 8": ["tr_reg_080", "tr_reg_089"],
        "faust 9": ["tr_reg_090"],
    }
    assert people_of("scape", ["mesh000", "mesh001"]) == {"scape": ["mesh000", "mesh001"]}


def test_a_spread_is_within_people_and_what_is_missing_counts_nowhere() -> None:
    nan = np.nan
    left, right = [[60.0, 60.0], [62.0, 62.0], [64.0, 64.0]], [[nan, 50.0], [nan, 50.0], [nan, 50.0]]
    one = np.moveaxis(np.array([left, right]), 0, 2)  # scans, ours and true, sides
    row = _row("girth", [one, one + 20])
    assert (row["people"], row["scans"], row["missing"]) == (2, 6, 6)
    assert (row["mean"], row["spread"], row["worst"]) == pytest.approx((72.0, 2.0, 2.0))
    assert row["true"] == pytest.approx(2.0 / np.sqrt(2))
    once = _row("girth", [np.where(np.arange(3)[:, None, None] == 0, one, nan)])
    assert np.isnan(once["spread"]) and once["missing"] == 5
