"""Weights of verdicts are found from what is right and what is lost, and rows count what they say."""

from pathlib import Path

import numpy as np

from meshmatch.experiments.bench.own_verdicts import TREATMENTS, fit_weights, make_spoiled, row_of


def test_weights_cost_what_lost_fits_have_more_of() -> None:
    rng = np.random.default_rng(0)
    right = np.arange(80) % 4 > 0
    stretch = np.where(right, rng.uniform(0, 0.3, 80), rng.uniform(0.8, 2.0, 80))
    found = fit_weights(np.stack([stretch, rng.uniform(0, 0.1, 80)], 1), right)
    assert found.stretch > 1 and found.residual >= 0
    assert found.offset - 0.1 * found.stretch > 0 > found.offset - 1.5 * found.stretch


def test_a_row_counts_what_is_right_and_what_is_believed() -> None:
    verdicts, errors = ["good", "fair", "poor", "good", "fair", "poor"], [0.01, 0.02, 0.03, 0.2, None, 0.4]
    rows = [{"verdict": verdict, "error": error} for verdict, error in zip(verdicts, errors, strict=True)]
    row = row_of("x", "w", rows)
    assert (row["right"], row["good"], row["good_lost"], row["believed"], row["lost_not_poor"]) == (3, 2, 1, 2, 2)


def test_a_collection_is_spoiled_as_it_says() -> None:
    made = make_spoiled("molars", Path(), 10, 0)
    assert tuple(made.how.values()) == TREATMENTS
    cut, whole = (made.some.each[f"molars-0{k}"] for k in (4, 0))
    assert cut.cut and cut.shape.edges.open.any() and not whole.shape.edges.open.any()
    assert made.some.each["molars-02"].mirrored and not whole.mirrored
