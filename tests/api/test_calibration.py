"""What is usual of a model's fits is found, kept on its card, and decides how far a single fit is trusted."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import meshmatch
from meshmatch.api import calibration
from meshmatch.errors import InputError, MeshmatchError, ModelError, OptionError
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import LatentRefineConfig
from meshmatch.fitting.judge.features import FitFeatures
from meshmatch.fitting.judge.reasons import Reason
from meshmatch.fitting.reference_statistics import MIN_FAIR_TRUST, Usual
from meshmatch.models.registry import find_model, load_once
from meshmatch.shapes.files import save_shape
from tests.conftest import icosphere, some_fit
from tests.models.small_model import small_card, write_model

BALL = icosphere(1)


def fit_of(stretch: float, residual: float) -> Fit:
    signs = FitFeatures(residual=residual, stretch=stretch)
    return some_fit(BALL.verts, BALL.faces, residual=residual, signs=signs)


@pytest.fixture
def fitted(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Shapes that were asked for; every third cannot be fitted."""
    asked: list[Any] = []

    def fit_all(self: meshmatch.Matcher, shapes: list[Any], errors: str) -> list[Fit | MeshmatchError]:
        assert self.config == meshmatch.FitConfig(latent=LatentRefineConfig(steps=400))  # all else as fits are judged
        asked.extend(shapes)
        fits = [fit_of(0.2 + 0.01 * k, 0.01 + 0.001 * k) for k in range(len(shapes))]
        return [fit if k % 3 else InputError("broken") for k, fit in enumerate(fits)]

    monkeypatch.setattr(calibration.Matcher, "fit_all", fit_all)
    return asked


def test_medians_of_some_shapes_go_on_the_card(tmp_path: Path, fitted: list[Any]) -> None:
    write_model(tmp_path / "mine", correspondence=False)
    (tmp_path / "prepared" / "normalised").mkdir(parents=True)
    for number in range(20):
        save_shape(tmp_path / "prepared" / "normalised" / f"s{number:02d}.ply", BALL)
    before = load_once(tmp_path / "mine")
    card = meshmatch.calibrate(tmp_path / "mine", tmp_path / "prepared", count=9)
    assert [path.stem for path in fitted] == ["s00", "s02", "s05", "s07", "s10", "s12", "s14", "s17", "s19"]
    assert card.metrics["usual"] == {"fits": 6, "residual": 0.0145, "stretch": 0.245}
    assert card.metrics["validation"] == {"distance": 0.5}
    assert find_model(tmp_path / "mine")[1] == card
    assert load_once(tmp_path / "mine").card == card != before.card


def test_what_cannot_be_calibrated(tmp_path: Path, fitted: list[Any]) -> None:
    write_model(tmp_path / "mine", correspondence=False)
    card = (tmp_path / "mine" / "card.json").read_bytes()
    with pytest.raises(InputError, match=r"4 shapes .* too few"):
        meshmatch.calibrate(tmp_path / "mine", [BALL] * 4)
    assert fitted == []
    with pytest.raises(InputError, match=r"4 shapes .* too few"):
        meshmatch.calibrate(tmp_path / "mine", [BALL] * 6)
    with pytest.raises(OptionError, match="4 shapes are too few"):
        meshmatch.calibrate(tmp_path / "mine", [BALL] * 9, count=4)
    with pytest.raises(InputError, match="no shapes"):
        meshmatch.calibrate(tmp_path / "mine", tmp_path)
    assert (tmp_path / "mine" / "card.json").read_bytes() == card
    write_model(tmp_path / "other")
    with pytest.raises(ModelError, match="learned correspondence"):
        meshmatch.calibrate(tmp_path / "other", [BALL] * 9)


def test_a_fit_is_judged_beside_what_its_model_learned_from() -> None:
    usual = Usual.of_card(small_card(metrics={"usual": {"fits": 9, "stretch": 0.2, "residual": 0.01}}))
    assert usual is not None
    fit = replace(fit_of(0.2, 0.01), verdict="fair", reasons=(Reason("doubt", "97 %"),))
    sound, torn, far = (usual.judged(fit, 0.99, *each) for each in ((0.2, 0.01), (0.35, 0.01), (0.9, 0.02)))
    assert (sound.verdict, sound.reasons) == ("good", ())
    assert (torn.verdict, far.verdict) == ("fair", "poor")
    assert "stands out of what blob learned from" in torn.reasons[0]
    assert sound.trust > 0.9 > torn.trust > MIN_FAIR_TRUST > far.trust > 0


@pytest.mark.parametrize(
    "numbers", [{}, {"stretch": 0.2}, {"stretch": 0, "residual": 1}, {"stretch": np.inf, "residual": 1}]
)
def test_a_card_that_says_nothing_of_use(numbers: dict[str, float]) -> None:
    card = small_card()
    assert Usual.of_card(card) is None
    if np.isfinite(list(numbers.values())).all():
        assert Usual.of_card(replace(card, metrics={"usual": numbers})) is None
