"""Fits are judged by what is usual in their collection; and sides, by what all of them show."""

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from meshmatch.collections import setting
from meshmatch.collections.compare import Compared, opposite_side_names
from meshmatch.collections.setting import Record
from meshmatch.collections.stores import Store
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.judge import calibration
from meshmatch.fitting.judge.reasons import Reason
from meshmatch.fitting.solve.regularity import Regularity
from meshmatch.models.registry import NO_MODEL
from meshmatch.shapes.shape import Shape
from tests.conftest import icosphere, some_fit

UNSURE = Reason("unsupervised", "nothing was learned")


def records(stretches: list[float], sides: list[float] | None = None) -> list[Record]:
    leads = sides or [0.0] * len(stretches)
    return [
        Record(f"s{k}", "", "fair", residual=0.01, stretch=stretch, likely=0.99, side=side)
        for k, (stretch, side) in enumerate(zip(stretches, leads, strict=True))
    ]


def test_what_is_stretched_as_the_others_is_good_and_what_stands_out_is_poor() -> None:
    some = records([0.2, 0.22, 0.18, 0.21, 0.19, 0.5, 1.2])
    usual = Compared.of(some)
    assert usual is not None and usual.usual.stretch == pytest.approx(0.21)
    assert [usual.stands_out(each) for each in some] == [False] * 5 + [True] * 2
    ball = icosphere(1)
    fit = replace(some_fit(ball.verts, ball.faces), verdict="fair", reasons=(UNSURE,))
    judged = [usual.judged(fit, each) for each in some]
    assert [each.verdict for each in judged] == ["good"] * 5 + ["fair", "poor"]
    assert [reason.code for each in judged for reason in each.reasons] == ["outlier"] * 2
    assert "1.6-fold, 1.2-fold is usual" in judged[5].reasons[0]
    trust = [each.trust for each in judged]
    assert trust[0] > 0.9 > trust[5] > 0.5 > trust[6] > 0


def test_what_is_folded_is_not_right_however_usual_that_is() -> None:
    some = records([1.8] * 6)
    usual = Compared.of(some)
    assert usual is not None
    ball = icosphere(1)
    fit = replace(some_fit(ball.verts, ball.faces), verdict="fair", reasons=(UNSURE,))
    verdicts = []
    for inverted in (0.05, 0.07, 0.12, 0.2):
        judged = usual.judged(replace(fit, regularity=Regularity(inverted)), some[0])
        verdicts.append(judged.verdict)
        assert usual.trust(replace(some[0], inverted=inverted)) == judged.trust
    assert verdicts == ["good", "fair", "poor", "poor"]
    assert usual.trust(some[0]) > 0.9  # of a version that did not say


def test_more_of_a_residual_counts_and_what_a_fit_says_of_itself_stays() -> None:
    some = records([0.2] * 6)
    usual = Compared.of(some)
    assert usual is not None
    ball = icosphere(1)
    fit = replace(some_fit(ball.verts, ball.faces), verdict="fair", reasons=(UNSURE,))
    far = usual.judged(fit, replace(some[0], residual=0.03))
    assert far.verdict == "poor" and "3.0 % of sqrt(area) apart" in far.reasons[0]
    torn = replace(fit, reasons=(Reason("ambiguous", "two are as good"), UNSURE))
    assert [reason.code for reason in usual.judged(torn, some[0]).reasons] == ["ambiguous"]
    assert usual.judged(torn, some[0]).verdict == "fair"
    crushed = replace(fit, reasons=(Reason("crushed", "stretched 2.0-fold on average"), Reason("torn", "torn")))
    told = usual.judged(crushed, replace(some[0], stretch=0.7)).reasons
    assert [reason.code for reason in told] == ["outlier", "torn"]  # stretch is told once
    assert usual.judged(replace(fit, verdict="poor"), some[0]).verdict == "poor"
    assert usual.judged(fit, replace(some[0], likely=0.3)).verdict == "poor"


def test_only_a_shape_with_an_edge_may_be_a_part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ball, asked = icosphere(2), []

    def fitted(*_: object, whole: float | None, **__: object) -> Fit:
        asked.append(whole)
        return some_fit(ball.verts, ball.faces)

    monkeypatch.setattr(setting, "fit_without_model", fitted)
    monkeypatch.setattr(setting.Setting, "template", None)
    monkeypatch.setattr(setting.Setting, "_find_start", lambda *_: None)
    how = setting.Setting(Store.of(tmp_path), NO_MODEL, FitConfig())
    for shape in (ball, Shape(ball.verts, ball.faces[ball.verts[ball.faces, 2].min(axis=1) > -0.3])):
        how.fit(shape, whole=3.0)
    assert asked == [None, 3.0]


def test_of_few_and_of_fits_that_do_not_say_nothing_is_usual() -> None:
    assert Compared.of(records([0.2] * 4)) is None
    assert Compared.of(records([np.nan] * 9)) is None


def test_sides_are_taken_where_nearly_all_have_a_clear_one() -> None:
    stretches = [0.2] * 6
    clear = records(stretches, [0.3, 0.12, -0.2, 0.4, 0.25, -0.25])
    assert opposite_side_names(clear) == {"s2", "s5"}
    symmetric = records(stretches, [0.01, 0.02, -0.03, 0.01, -0.12, 0.09])
    assert opposite_side_names(symmetric) == set()
    assert opposite_side_names(clear[:3]) == set()


def test_only_a_side_that_is_worse_is_in_doubt() -> None:
    usual, ball = Compared.of(records([0.2] * 6)), icosphere(1)
    assert usual is not None
    fit = replace(some_fit(ball.verts, ball.faces), verdict="fair", reasons=(UNSURE,))
    judged = [usual.judged(fit, record) for record in records([0.2] * 3, [0.3, -0.03, -0.2])]
    assert [each.verdict for each in judged] == ["good", "good", "fair"]
    assert [reason.code for each in judged for reason in each.reasons] == ["side"]


def test_a_record_of_other_types_is_not_read() -> None:
    kept = asdict(records([1.0])[0])
    assert Record.of({**kept, "stretch": 2}).stretch == 2
    for words in ({**kept, "stretch": "much"}, {**kept, "name": 3}, {**kept, "mirrored": None}, {**kept, "other": 1}):
        with pytest.raises(TypeError):
            Record.of(words)


def test_fits_are_judged_anew_where_the_weights_of_their_category_change(tmp_path: Path) -> None:
    def digests() -> list[str]:
        return [setting.Setting(Store.of(tmp_path), model, FitConfig()).digest() for model in ("head", "human")]

    before = digests()
    with pytest.MonkeyPatch.context() as patch:
        later = replace(calibration.calibration_of("head"), date="2030-01-01")
        patch.setitem(calibration._OF_CATEGORY, "head", later)
        after = digests()
    assert [one == other for one, other in zip(before, after, strict=True)] == [False, True]
