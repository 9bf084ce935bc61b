"""symmetry through the program's only door; what lies across is made up."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from meshmatch.api.symmetry import Symmetry
from meshmatch.maps.files import load_map
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.value_files import load_values
from tests.cli.conftest import Run, refused, well


@pytest.fixture
def called(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, sphere: Shape) -> dict[str, Any]:
    """A folder with a ball, and what the search was called with."""
    monkeypatch.chdir(tmp_path)
    save_shape("ball.ply", sphere)
    heard: dict[str, Any] = {"verdict": "good"}

    def find(shape: Shape, **options: Any) -> Symmetry:
        heard.update(options)
        number = np.arange(shape.V)
        reasons = () if heard["verdict"] == "good" else ("it is not symmetric",)
        across = VertexMap.between(shape, shape, number[::-1], verdict=heard["verdict"], reasons=reasons)
        apart = np.where(number == 0, 0.5, -0.25)
        return Symmetry(across, np.array([1.0, 0, 0]), 0.125, apart[:, None] * [1.0, 2, 3], apart, 0.1, ("mended",))

    monkeypatch.setattr("meshmatch.find_symmetry", find)
    return heard


NAMES = ("asymmetry", "displacement_x", "displacement_y", "displacement_z")


def test_map_and_asymmetry_are_written(run: Run, called: dict[str, Any], sphere: Shape) -> None:
    words = ("--values", "apart.csv", "--seed", "3", "--threads", "1", "--json")
    answer = well(run("symmetry", "ball.ply", "-o", "across.npz", *words))
    assert called["config"].seed == 3 and called["threads"] == 1
    assert load_map(Path("across.npz")).index.tolist() == list(range(sphere.V))[::-1]
    values = load_values(Path("apart.csv"), sphere)
    assert values.names == NAMES
    assert values.numbers[0].tolist() == [0.5, 0.5, 1.0, 1.5]
    record = answer.record
    assert (record["normal"], record["offset"], record["verdict"]) == ([1.0, 0.0, 0.0], 0.125, "good")
    assert record["asymmetry"]["mean"] == pytest.approx(0.25, abs=0.01) and record["notes"] == ["mended"]
    assert "x . (1 0 0) = 0.125" in answer.err
    well(run("symmetry", "ball.ply", "-o", "across.npz", "--values", "apart.vtp"))
    written = Path("apart.vtp").read_text("utf-8")
    assert [f'Name="{name}"' in written for name in NAMES] == [True] * 4 and load_shape("apart.vtp").V == sphere.V


def test_what_cannot_be_is_refused(run: Run, called: dict[str, Any], tmp_path: Path) -> None:
    before = {"ball.ply"}
    refused(run("symmetry", "ball.ply", "-o", "a.xyz"), "a.xyz", tmp_path, before)
    refused(run("symmetry", "ball.ply", "-o", "a.npz", "--values", "a.glb"), ".glb", tmp_path, before)
    refused(run("symmetry", "ball.ply", "-o", "a.npz", "--values", "ball.ply"), "is an input", tmp_path, before)
    refused(run("symmetry", "gone.ply", "-o", "a.npz"), "gone.ply", tmp_path, before)
    called["verdict"] = "poor"
    refused(run("symmetry", "ball.ply", "-o", "a.npz", "--strict"), "it is not symmetric", tmp_path, before)
