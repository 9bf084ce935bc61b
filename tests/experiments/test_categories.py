"""What the benchmarks of categories compute, by hand; hearts and keypoints through their own doors."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from meshmatch.experiments.bench import category, hearts, keypoints
from meshmatch.experiments.bench.category import RIGID, nearest_maps, ordered_pairs
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.shape import Shape
from meshmatch.templates.make import NodeConfig
from tests.conftest import icosphere


def mapped(maps: dict[tuple[str, str], np.ndarray]) -> dict[tuple[str, str], VertexMap]:
    """Indices as maps of full confidence."""
    return {pair: VertexMap(*pair, index) for pair, index in maps.items()}


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
    found = hearts.heart_errors(shapes, truth, mapped({("a", "b"): right}))
    assert (found["mean_x100"], found["right_chamber"]) == (0.0, 1.0)
    wrong = right.copy()
    wrong[0] = right[4]  # from x = 0 to x = 1: one edge, and the other chamber
    wrong[7] = 0  # does not count
    assert found["across_x100"] == 0.0
    found = hearts.heart_errors(shapes, truth, mapped({("a", "b"): wrong}))
    assert found["mean_x100"] == pytest.approx(100 / 7 / np.sqrt(6), abs=1e-3)
    assert found["right_chamber"] == pytest.approx(6 / 7, abs=1e-3)
    assert found["worst_pair"] == ["a", "b"]
    # the normal of a corner, whatever its triangles weigh, looks away from the middle
    assert 0.2 * found["mean_x100"] < found["across_x100"] < 0.9 * found["mean_x100"]


def test_pairs_are_spread_evenly(cube: Shape) -> None:
    shapes = dict.fromkeys("abcd", cube)
    assert len(ordered_pairs(shapes)) == len(ordered_pairs(shapes, 99)) == 12
    some = ordered_pairs(shapes, 4)
    assert [pair[0] for pair in some] == list("abcd")
    assert all(a != b for a, b in some)


def test_errors_of_keypoints_by_hand(cube: Shape) -> None:
    shapes, points = {"a": cube, "b": cube}, {"a": np.arange(4), "b": np.arange(4)}
    index = np.arange(8)
    index[3] = 2  # an edge away: 1 / sqrt(3) of the diagonal
    found = keypoints.keypoint_errors(shapes, points, mapped({("a", "b"): index}))
    assert found["mean"] == pytest.approx(1 / np.sqrt(3) / 4, abs=1e-3)
    assert (found["median"], found["arrived"], found["pairs"]) == (0.0, 0.75, 1)


def test_overlap_of_parts_by_hand() -> None:
    truth, found = np.array([0, 0, 1, 1]), np.array([0, 1, 1, 1])
    area = np.array([1.0, 1.0, 2.0, 0.0])
    assert keypoints.mean_overlap(found, truth, area) == pytest.approx((1 / 2 + 2 / 3) / 2)
    ball = icosphere(1)
    at = np.array([ball.verts[:, 2].argmin(), ball.verts[:, 2].argmax()])
    parts = keypoints.keypoint_parts(ball, at)
    assert parts[at[0]] == 0 and parts[at[1]] == 1
    assert (parts[ball.verts[:, 2] > 0.01] == 1).all()


def test_shapes_are_stood_alike() -> None:
    ball = icosphere(1)
    verts = ball.verts * [1, 2, 3]
    points = np.array([verts[:, k].argmax() for k in range(3)])
    turn = Rotation.create_group("O").as_matrix()[7]
    shapes = {"a": Shape(verts, ball.faces), "b": Shape(verts @ turn.T, ball.faces)}
    stood = keypoints.stood_alike(shapes, {"a": points, "b": points})
    assert np.allclose(stood["b"].verts, verts)


def test_nearest_after_alignment() -> None:
    ball = icosphere(2)
    shapes = {
        "a": Shape(ball.verts * [1, 2, 3], ball.faces),
        "b": Shape(7 * ball.verts[::-1] * [1, 2, 3] + 4, len(ball.verts) - 1 - ball.faces[:, ::-1]),
    }
    found = nearest_maps(shapes, "none", "area", [("a", "b")])["a", "b"]
    assert np.array_equal(found.index, np.arange(ball.V)[::-1])
    assert found.confidence.min() > 0.99


def balls(folder: Path, ending: str, count: int = 2) -> None:
    """A few stretched balls with the same vertices, and what is true of them."""
    ball = icosphere(2)
    folder.mkdir(parents=True, exist_ok=True)
    for n in range(count):
        save_shape(folder / f"{n}.ply", Shape(ball.verts * [1, 1.2 + 0.1 * n, 1.5], ball.faces))
        truth = np.arange(0, 160, 20) if "key" in ending else np.stack([np.arange(162), np.arange(162) % 2], 1)
        np.save(folder / f"{n}{ending}", truth)


def rows_of(text: str) -> tuple[dict, dict[str, dict]]:
    """The record and its rows by method."""
    record = json.loads(text.splitlines()[-1])
    return record, {row["method"]: row for row in record["rows"]}


@pytest.mark.slow
def test_hearts_from_end_to_end(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    balls(tmp_path / "heart", ".truth.npy", 3)
    drawn = []
    monkeypatch.setattr(category, "render_shapes", lambda panels, path, look: drawn.append(len(panels)))
    monkeypatch.setattr(hearts, "NodeConfig", lambda *_, seed: NodeConfig("uniform", 60, 0.35, seed=seed))
    words = ["--data", str(tmp_path), "--steps", "2", "--threads", "1", "--minutes", "1"]
    assert hearts.main([*words, "--picture", str(tmp_path / "hearts.png")]) == 0
    record, rows = rows_of(capsys.readouterr().out)
    assert record["training"]["steps"] == 2
    assert rows[RIGID]["mean_x100"] < 10
    assert rows["nodes refined"]["pairs"] == 6
    assert drawn == [3]
