"""The table of what `--model auto` makes of every shape: counts, and the readings that decide."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from meshmatch.api.inputs import as_model, validated
from meshmatch.api.kinds import Installed
from meshmatch.experiments.bench import chosen_models
from meshmatch.shapes.shape import Shape
from tests.conftest import icosphere


@pytest.fixture(autouse=True)
def readings(monkeypatch: pytest.MonkeyPatch) -> None:
    """Read off a shape's name, in hundredths: by the human model, by the other."""

    def read(models: list[Any], shapes: list[Shape], configs: Any, sure: float) -> np.ndarray:
        return np.array([[float(word) / 100] for word in shapes[0].name.split()[1:]])

    monkeypatch.setattr(chosen_models, "category_residuals", read)
    monkeypatch.setattr(
        chosen_models, "installed_models", lambda: [Installed.loaded(as_model(name)) for name in ("human", "quadruped")]
    )


def named(*names: str) -> list[Shape]:
    ball = icosphere(2)
    return [Shape(ball.verts, ball.faces if name[0] != "c" else np.empty((0, 3), np.int64), name) for name in names]


def test_bodies_are_counted() -> None:
    row = chosen_models.row_of("scape", named("a 3 6", "b 4 5", "c 5.5 6", "d 6 7", "e 6 4"))
    assert (row["shapes"], row["right"], row["unsure"], row["wrong"]) == (5, 2, 1, 2)
    assert (row["kind"], row["own"], row["others"]) == ("human", 0.06, 0.04)
    assert row["which"] == ["d 6 7: none", "e 6 4: quadruped"]


def test_what_has_no_model_must_be_refused() -> None:
    row = chosen_models.row_of("chair", named("a 6 6", "b 6 4"))
    assert (row["kind"], row["right"], row["which"], row["own"]) == ("none", 1, ["b 6 4: quadruped"], None)


def test_solids_can_be_fitted_and_are_closed() -> None:
    solids = list(chosen_models.shapes_of("solids", Path()))
    assert len({solid.name for solid in solids}) == 5
    for solid in solids:
        clean = validated(solid).shape
        assert not len(clean.edges.open)
