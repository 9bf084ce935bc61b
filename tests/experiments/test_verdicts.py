"""Honest verdicts: cases whose truth is known, and what is counted of them."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from meshmatch.errors import InputError
from meshmatch.experiments.bench import verdicts
from meshmatch.experiments.bench.verdict_cases import FAMILIES, KEPT, OF_PEOPLE, TUNED, Cases, box_union, furniture
from meshmatch.fitting.judge.calibration import Calibration
from meshmatch.geometry.triangles import face_parts, is_watertight
from meshmatch.shapes.shape import Shape

pytest.importorskip("anny")


SLOW = ("two million", "melted", "animal")


@pytest.fixture(scope="module")
def cases() -> Cases:
    return Cases("human", 5)


@pytest.mark.parametrize(
    "family", [pytest.param(name, marks=pytest.mark.slow if name in SLOW else ()) for name in FAMILIES]
)
def test_a_case_is_drawn_again_alike_with_its_truth(cases: Cases, family: str) -> None:
    case, again = cases.draw(family, 0), cases.draw(family, 0)
    assert np.array_equal(case.shape.verts, again.shape.verts) and np.array_equal(case.truth, again.truth)
    assert len(case.truth) == case.shape.V and case.truth.max() < cases.template.shape.V
    assert (case.truth < 0).all() == (family in ("animal", "furniture", "solid", "kit"))
    assert not np.array_equal(case.shape.verts, cases.draw(family, 2).shape.verts)


def test_furniture_is_watertight_and_of_one_piece() -> None:
    for number in range(3):
        corners = furniture(number, np.random.default_rng(number))
        whole = box_union(corners)
        assert is_watertight(whole.faces) and face_parts(whole.faces, whole.V).max() == 0
        low, high = np.min(corners, axis=(0, 1)), np.max(corners, axis=(0, 1))
        assert np.abs(whole.bounds - [low, high]).max() < 0.05 * np.ptp(whole.bounds, axis=0).max()


def test_families_that_tune_measure_nothing() -> None:
    assert not set(TUNED) & set(KEPT) and set(FAMILIES) == {*TUNED, *KEPT}


def test_a_group_has_only_the_families_of_its_kind() -> None:
    assert set(verdicts.families_of("human", "tuned")) - set(verdicts.families_of("hand", "tuned")) == set(OF_PEOPLE)
    assert verdicts.families_of("hand", "cut, sound") == ["cut", "sound"]


def test_a_truth_is_where_the_body_has_it(cases: Cases) -> None:
    """Of a body with other triangles; and of its mirror image, left and right of which have changed."""
    rng = np.random.default_rng(0)
    shape, truth = cases.body(1, rng)
    body = min(cases.bodies, key=lambda verts: float(cKDTree(verts).query(shape.verts[:50])[0].mean()))
    assert np.linalg.norm(body[truth] - shape.verts, axis=1).max() < 0.06
    case = cases.draw("mirrored", 0)
    resting = cases.template.shape.verts[case.truth]
    edges = case.shape.faces[:, :2]
    lengths = np.linalg.norm(resting[edges[:, 0]] - resting[edges[:, 1]], axis=1)
    assert lengths.mean() < 0.05


def test_a_target_in_pieces_is_cut_again(cases: Cases) -> None:
    """Every fourth target is cut; a cut whose parts lie far apart cannot be fitted."""
    seen: list[int] = []

    class Refusing:
        def fit(self, shape: Shape) -> str:
            seen.append(shape.F)
            if len(seen) == 4:
                raise InputError("2 large parts far apart")
            return "fit"

    targets = [verdicts.target_of(cases, Refusing(), number) for number in range(8)]  # type: ignore[arg-type]
    whole = len(cases.template.shape.faces)
    assert len(seen) == 9
    assert [target.shape.F < whole for target in targets] == 2 * [False, False, False, True]
    assert seen[3] != seen[4] == targets[3].shape.F and targets[3].has.sum() < cases.template.shape.V


def test_a_target_whose_cuts_all_fail_ends_with_the_error(cases: Cases) -> None:
    seen: list[int] = []

    class Refusing:
        def fit(self, shape: Shape) -> str:
            seen.append(shape.F)
            if len(seen) > 1000:
                raise RuntimeError("no end")
            raise InputError("2 large parts far apart")

    with pytest.raises(InputError, match="far apart"):
        verdicts.target_of(cases, Refusing(), 3)  # type: ignore[arg-type]
    assert 1 < len(set(seen)) == len(seen) < 100
    seen.clear()
    with pytest.raises(InputError, match="far apart"):
        verdicts.target_of(cases, Refusing(), 0)  # type: ignore[arg-type]
    assert len(seen) == 1


def case_of(family: str, verdict: str, error: float) -> dict[str, object]:
    return {"family": family, "verdict": verdict, "error": error, "seconds": 2.0}


def test_what_is_counted() -> None:
    found = [
        case_of("a", "good", 1.0),
        case_of("a", "good", 9.0),
        case_of("a", "poor", 4.0),
        case_of("b", "fair", 6.0),
        case_of("c", "fair", 2.0),
        case_of("b", verdicts.REFUSED, math.inf),
        case_of("b", "poor", math.inf),
    ]
    bars = verdicts.bars_of(found)
    assert bars.pop("at_most") == pytest.approx(0.987, abs=0.001)  # one of two
    assert bars == {"good": 2, "good_and_wrong": 1, "right": 3, "right_and_believed": 2}
    first, second = verdicts.rows_of(found, "family", ["a", "b"])
    assert (first["maps"], first["good"], first["right"], first["wrong"], first["worst_cm"]) == (3, 2, 2, 1, 9.0)
    assert first["seconds"] == 2.0
    assert (second["refused"], second["right"], second["wrong"], second["mean_cm"]) == (1, 0, 1, 6.0)


def test_confidence_that_says_what_is_so() -> None:
    rng = np.random.default_rng(0)
    confidence = rng.random(100_000).astype(np.float32)
    found = [{"bins": verdicts.fine_bins(confidence, rng.random(100_000) < confidence)}]
    rows, auc = verdicts.calibration(found)
    assert sum(row["vertices"] for row in rows) == 100_000
    assert all(abs(row["near"] - row["confidence"]) < 0.02 for row in rows)
    assert auc == pytest.approx(5 / 6, abs=0.01)  # of such numbers
    many = [{"bins": verdicts.fine_bins(np.full(10, 0.55, np.float32), np.ones(10, bool))}, *found]
    (row,) = [row for row in verdicts.calibration(many)[0] if row["of"] == "0.5 to 0.6"]
    assert row["near"] > 0.9  # ten vertices of one map weigh as much as a tenth of a hundred thousand of another
    boast = [{"bins": verdicts.fine_bins(confidence, rng.random(100_000) < 0.5 * confidence)}]
    assert max(row["confidence"] - row["near"] for row in verdicts.calibration(boast)[0]) > 0.4


def test_weights_are_found() -> None:
    rng = np.random.default_rng(0)
    signs = rng.normal(size=(400, 2))
    wrong = signs[:, 0] > 0.3
    found = [
        {"verdict": "good", "fit": "good", "signs": list(sign), "error": 20.0 if bad else 1.0}
        for sign, bad in zip(signs, wrong, strict=True)
    ]
    weights, offset = verdicts.fit_weights(found)
    assert weights[0] > 10 * abs(weights[1]) and -offset / weights[0] == pytest.approx(0.3, abs=0.1)
    astray = {"verdict": "poor", "fit": "good", "signs": [-3.0, 0.0], "error": 30.0}  # by the target's fit
    again, same = verdicts.fit_weights([*found, *[astray] * 50])
    assert (again.tolist(), same) == (weights.tolist(), offset)


def test_weights_of_few_cases_stay_near_those_given() -> None:
    given = Calibration(weights=(2.0, 3.0), offset=-1.0, data="", seeds=(), date="")
    few = [{"verdict": "good", "fit": "good", "signs": [0.1 * k, 0.0], "error": 1.0} for k in range(5)]
    weights, offset = verdicts.fit_weights(few, given)
    assert weights == pytest.approx(given.weights, abs=0.5) and offset < given.offset
    alone, _ = verdicts.fit_weights(few)
    assert abs(alone).max() < 1.0


@pytest.mark.slow
def test_the_command_measures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Of two seeds: sound bodies are right, and good; boxes and balls run together are not called good."""
    words = ["--families", "sound,solid", "--count", "1", "--seed", "3", "--seeds", "2", "--output", str(tmp_path)]
    assert verdicts.main(words) == 0
    record = json.loads(capsys.readouterr().out.splitlines()[-1])
    rows = {row["of"]: row for row in record["families"]}
    assert rows["sound"]["maps"] == rows["sound"]["right"] == 2 and rows["sound"]["good"] >= 1
    assert rows["solid"]["good"] == 0 and rows["solid"]["wrong"] + rows["solid"]["refused"] == 2
    assert (tmp_path / "human.png").stat().st_size > 1000
    assert record["good_and_wrong"] == 0
