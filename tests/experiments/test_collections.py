"""Collections as experiments: fits of whole sets; errors of hearts by hand."""

import json
from pathlib import Path

import numpy as np
import pytest

from meshmatch.experiments.bench import collections as groupwise
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.shape import Shape


def last_row(capsys: pytest.CaptureFixture[str]) -> dict[str, object]:
    return dict(json.loads(capsys.readouterr().out.splitlines()[-1])["rows"][0])


def test_errors_of_hearts_by_hand(cube: Shape) -> None:
    """Of two cubes with shuffled vertices; only ids that both have count."""
    other = Shape(cube.verts[::-1], 7 - cube.faces)
    truth = {
        "a": np.stack([np.arange(8), np.arange(8) // 4], 1),
        "b": np.stack([np.arange(8)[::-1], np.arange(8)[::-1] // 4], 1),
    }
    truth["b"][0, 0] = 99  # vertex 7 of a has no partner
    shapes = {"a": cube, "b": other}
    right = np.arange(8)[::-1]
    found = groupwise.heart_errors(shapes, truth, {("a", "b"): VertexMap("a", "b", right)})
    assert (found["mean_x100"], found["right_chamber"]) == (0.0, 1.0)
    wrong = right.copy()
    wrong[0] = right[4]  # from x = 0 to x = 1: one edge, and the other chamber
    wrong[7] = 0  # does not count
    assert found["across_x100"] == 0.0
    found = groupwise.heart_errors(shapes, truth, {("a", "b"): VertexMap("a", "b", wrong)})
    assert found["mean_x100"] == pytest.approx(100 / 7 / np.sqrt(6), abs=1e-3)
    assert found["right_chamber"] == pytest.approx(6 / 7, abs=1e-3)
    assert found["worst_pair"] == ["a", "b"]
    near = right.copy()
    near[1] = right[2]  # another vertex of its chamber
    assert groupwise.heart_errors(shapes, truth, {("a", "b"): VertexMap("a", "b", near)})["right_chamber"] == 1.0
    # the normal of a corner, whatever its triangles weigh, looks away from the middle
    assert 0.2 * found["mean_x100"] < found["across_x100"] < 0.9 * found["mean_x100"]


@pytest.mark.slow
def test_hearts_without_a_model(bench: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--data", str(bench), "--sets", "heart", "--limit-shapes", "2", "--work", str(tmp_path / "work")]
    assert groupwise.main(words) == 0
    row = last_row(capsys)
    assert (row["shapes"], row["maps"], row["same"]) == (2, 2, True)
    assert isinstance(row["error"], float) and 0.1 < row["error"] < 0.7
    assert isinstance(row["largest_gb"], float) and row["largest_gb"] > 0.05
