"""Figure 14: chambers of one heart on others, as three methods carry them."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from meshmatch.experiments.paper import hearts
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.render.picture import Look
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.shape import Shape
from tests.conftest import icosphere


@dataclass(frozen=True)
class SameNumber:
    """A method that maps each vertex to that of its number, or ``turned`` to the last but so many."""

    turned: bool

    def fit(self, shape: Shape) -> None:
        """Nothing."""

    def map(self, source: Shape, source_fit: None, target: Shape, target_fit: None) -> VertexMap:
        return VertexMap.between(source, target, np.arange(source.V)[:: -1 if self.turned else 1])


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten balls of a few sizes as hearts of two chambers."""
    folder = tmp_path_factory.mktemp("bench")
    (folder / "heart").mkdir()
    ball = icosphere(3)
    chambers = (ball.verts[:, 2] > 0).astype(np.int64)
    for k in range(1, 11):
        heart = Shape(ball.verts * [1.0, 0.8, 0.7 + 0.02 * k], ball.faces)
        save_shape(folder / "heart" / f"heart{k:02d}.ply", heart)
        np.save(folder / "heart" / f"heart{k:02d}.truth.npy", np.column_stack([np.arange(ball.V), chambers]))
    return folder


def test_chambers_are_shown_and_counted(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(hearts, "learn_coded", lambda *_: tmp_path)
    methods = {"DirectMethod": False, "ZoomOut": True, "coded": False}
    for name, turned in methods.items():
        monkeypatch.setattr(hearts, name, lambda *_, turned=turned: SameNumber(turned=turned))
    monkeypatch.setattr(hearts, "Look", lambda size: Look(size=(size[0] // 2, size[1] // 2)))
    picture = tmp_path / "figure.png"
    assert hearts.main(["--data", str(data), "--picture", str(picture)]) == 0
    rows = json.loads(capsys.readouterr().out.splitlines()[-1])["rows"]
    assert [row["method"] for row in rows] == ["without a model", "ZoomOut", "3D-CODED"]
    assert [row["right_chamber"] > 0.99 for row in rows] == [True, False, True]
    assert [row["mean_x100"] < 1e-6 for row in rows] == [True, False, True] and rows[0]["pairs"] == 3
    with Image.open(picture) as drawn:
        rows_of = np.split(np.asarray(drawn), 4)
    assert np.array_equal(rows_of[0][:150], rows_of[1][:150]) and not np.array_equal(rows_of[0][:150], rows_of[2][:150])


@pytest.mark.slow
def test_coded_learns_from_six_hearts(data: Path, tmp_path: Path) -> None:
    folder = hearts.learn_coded(data, tmp_path, 1)
    card = json.loads((folder / "card.json").read_text(encoding="utf-8"))
    assert card["network"]["field"] == "pointwise" and not card["correspondence"]
    assert len(list((tmp_path / "learned").iterdir())) == 6
    assert hearts.learn_coded(data, tmp_path, 1) == folder
