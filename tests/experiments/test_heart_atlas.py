"""Atlases of hearts, on balls that are stretched along one axis."""

import json
from pathlib import Path

import numpy as np
import pytest

from meshmatch import Atlas
from meshmatch.experiments import heart_atlas
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.shape import Shape
from tests.conftest import icosphere


@pytest.fixture(autouse=True)
def small_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("meshmatch.render.picture.HEIGHT", 240)


@pytest.fixture
def data(tmp_path: Path) -> Path:
    ball = icosphere(2)
    (tmp_path / "heart").mkdir()
    for n in range(5):
        save_shape(tmp_path / "heart" / f"{n}.ply", Shape(ball.verts * [1, 1.3 + 0.1 * n, 2], ball.faces))
        np.save(tmp_path / "heart" / f"{n}.truth.npy", np.stack([np.arange(ball.V), np.zeros(ball.V, int)], 1))
    return tmp_path


def test_the_truth_gives_one_mode_and_small_errors(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert heart_atlas.main(["--data", str(data), "--ways", "truth", "--work", str(data / "work")]) == 0
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    (row,) = told["rows"]
    assert row["method"] == "truth"
    assert row["first_three"] > 0.999
    assert row["generalisation_x100"] < 0.1
    assert row["generalisation_surface_x100"] < 0.2
    assert row["specificity_surface_x100"] > 0.05
    atlas = Atlas.load(data / "work" / "truth")
    assert atlas.compactness[0] > 0.99
    assert atlas.names == tuple("01234")


@pytest.mark.parametrize("way", ["nodes", "mean"])
def test_nodes_lie_on_the_surfaces(data: Path, capsys: pytest.CaptureFixture[str], way: str) -> None:
    words = ["--data", str(data), "--ways", way, "--hearts", "4"]
    assert heart_atlas.main(words) == 0
    (row,) = json.loads(capsys.readouterr().out.splitlines()[-1])["rows"]
    assert row["generalisation_surface_x100"] < 1.5


def test_what_is_not_there_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    for words in (["--data", "nowhere"], ["--ways", "guess"]):
        assert heart_atlas.main(words) == 1
        assert "error:" in capsys.readouterr().err
