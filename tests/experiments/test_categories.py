"""What the benchmarks of categories compute, by hand; hearts and keypoints through their own doors."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from meshmatch.errors import InputError
from meshmatch.experiments import animals, hearts, segments
from meshmatch.experiments.category import area_under_curve, load_category, nearest_all
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.shape import Shape
from tests.conftest import icosphere


def test_the_area_under_the_curve() -> None:
    assert area_under_curve([1, 2, 3, 4], [False, False, True, True]) == 1.0
    assert area_under_curve([4, 3, 2, 1], [False, False, True, True]) == 0.0
    assert area_under_curve([1, 1, 1, 1], [False, True, False, True]) == 0.5
    assert np.isnan(area_under_curve([1, 2], [True, True]))
    rng = np.random.default_rng(0)
    score, right = rng.integers(0, 9, 60), rng.random(60) < 0.4
    pairs = [(a > b) + 0.5 * (a == b) for a in score[right] for b in score[~right]]
    assert area_under_curve(score, right) == pytest.approx(np.mean(pairs))


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
    found = hearts.heart_errors(shapes, truth, {("a", "b"): right})
    assert (found["mean_x100"], found["right_chamber"]) == (0.0, 1.0)
    wrong = right.copy()
    wrong[0] = right[4]  # from x = 0 to x = 1: one edge, and the other chamber
    wrong[7] = 0  # does not count
    found = hearts.heart_errors(shapes, truth, {("a", "b"): wrong})
    assert found["mean_x100"] == pytest.approx(100 / 7 / np.sqrt(6), abs=1e-3)
    assert found["right_chamber"] == pytest.approx(6 / 7, abs=1e-3)
    assert found["worst_pair"] == ["a", "b"]


def test_maps_through_registered_vertices(cube: Shape) -> None:
    other = Shape(cube.verts[::-1] + 5, 7 - cube.faces)
    maps = hearts.through({"a": cube.verts, "b": cube.verts + 5}, {"a": cube, "b": other})
    assert np.array_equal(maps["a", "b"], np.arange(8)[::-1])


def test_errors_of_keypoints_by_hand(cube: Shape) -> None:
    shapes, points = {"a": cube, "b": cube}, {"a": np.arange(4), "b": np.arange(4)}
    index = np.arange(8)
    index[3] = 2  # an edge away: 1 / sqrt(3) of the diagonal
    sure = np.array([0.9, 0.8, 0.7, 0.1, 0, 0, 0, 0])
    found = segments.keypoint_errors(shapes, points, {("a", "b"): (index, sure)})
    assert found["mean"] == pytest.approx(1 / np.sqrt(3) / 4, abs=1e-3)
    assert (found["median"], found["arrived"], found["confidence_auc"]) == (0.0, 0.75, 1.0)
    assert (found["confidence_right"], found["confidence_wrong"]) == (0.8, 0.1)
    perfect = segments.keypoint_errors(shapes, points, {("a", "b"): (np.arange(8), sure)})
    assert perfect["confidence_auc"] is None and perfect["confidence_wrong"] is None


def test_overlap_of_parts_by_hand() -> None:
    truth, found = np.array([0, 0, 1, 1]), np.array([0, 1, 1, 1])
    area = np.array([1.0, 1.0, 2.0, 0.0])
    assert segments.mean_overlap(found, truth, area) == pytest.approx((1 / 2 + 2 / 3) / 2)
    ball = icosphere(1)
    at = np.array([ball.verts[:, 2].argmin(), ball.verts[:, 2].argmax()])
    parts = segments.keypoint_parts(ball, at)
    assert parts[at[0]] == 0 and parts[at[1]] == 1
    assert (parts[ball.verts[:, 2] > 0.01] == 1).all()


def test_shapes_are_stood_alike() -> None:
    ball = icosphere(1)
    verts = ball.verts * [1, 2, 3]
    points = np.array([verts[:, k].argmax() for k in range(3)])
    turn = Rotation.create_group("O").as_matrix()[7]
    shapes = {"a": Shape(verts, ball.faces), "b": Shape(verts @ turn.T, ball.faces)}
    stood = segments.stood_alike(shapes, {"a": points, "b": points})
    assert np.allclose(stood["b"].verts, verts)


def test_nearest_after_alignment() -> None:
    ball = icosphere(2)
    shapes = {
        "a": Shape(ball.verts * [1, 2, 3], ball.faces),
        "b": Shape(7 * ball.verts[::-1] * [1, 2, 3] + 4, len(ball.verts) - 1 - ball.faces[:, ::-1]),
    }
    index, sure = nearest_all(shapes, "none", "area", lambda what: None)["a", "b"]
    assert np.array_equal(index, np.arange(ball.V)[::-1])
    assert sure.min() > 0.99


def test_a_missing_folder_or_truth_is_told(tmp_path: Path, cube: Shape) -> None:
    with pytest.raises(InputError, match="no shapes in"):
        load_category(tmp_path, ".truth.npy")
    save_shape(tmp_path / "a.ply", cube)
    with pytest.raises(InputError, match=r"has no \.truth\.npy"):
        load_category(tmp_path, ".truth.npy")


@pytest.mark.parametrize(
    ("main", "words"),
    [
        (hearts.main, ["--data", "nowhere"]),
        (segments.main, ["--data", "nowhere"]),
        (segments.main, ["--classes", "lamp"]),
        (animals.main, ["--data", "nowhere"]),
    ],
)
def test_what_cannot_be_is_told(main, words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words) == 1
    assert "error:" in capsys.readouterr().err


def balls(folder: Path, ending: str) -> None:
    """Two stretched balls with the same vertices, and what is true of them."""
    ball = icosphere(2)
    folder.mkdir(parents=True)
    for n in range(2):
        save_shape(folder / f"{n}.ply", Shape(ball.verts * [1, 1.2 + 0.1 * n, 1.5], ball.faces))
        truth = (
            np.arange(0, 160, 20) if "key" in ending else np.stack([np.arange(162), np.arange(162) % 2], 1)
        )
        np.save(folder / f"{n}{ending}", truth)


def test_hearts_from_end_to_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    balls(tmp_path / "heart", ".truth.npy")
    words = ["--data", tmp_path, "--steps", "2", "--threads", "1", "--work", tmp_path / "work"]
    words += ["--nodes", "60", "--radius", "0.35", "--minutes", "1", "--seed", "0"]
    assert hearts.main([str(word) for word in words]) == 0
    record = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert record["training"]["steps"] == 2
    assert record["results"]["rigid alignment, nearest vertex"]["mean_x100"] < 10
    assert record["results"]["network, nodes refined"]["pairs"] == 2
    assert {"date", "commit", "machine"} <= record.keys()


def test_segments_from_end_to_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    balls(tmp_path / "plane", ".keypoints.npy")
    words = ["--data", tmp_path, "--classes", "plane", "--steps", "2", "--threads", "1", "--minutes", "1"]
    words += ["--nodes", "60", "--radius", "0.35"]
    assert segments.main([*map(str, words), "--work", str(tmp_path / "work"), "--turns", "given"]) == 0
    record = json.loads(capsys.readouterr().out.splitlines()[-1])
    results = record["classes"]["plane"]["results"]
    assert results["rigid alignment, nearest vertex"]["arrived"] == 1.0
    assert 0.9 < results["rigid alignment, nearest vertex"]["iou"] <= 1.0
    assert results["200 steps on the code"]["pairs"] == 2


def test_kinds_of_animals_and_their_errors_by_hand(cube: Shape) -> None:
    assert [animals.kind_of(name) for name in ("fox-05", "Davis_cow_00000", "timthumb")] == [
        "dog",
        "cow",
        "other",
    ]
    shapes = {"wolf": cube, "dog": cube, "x": cube}
    truth = {name: np.arange(8) for name in shapes}
    right, wrong = np.arange(8), np.arange(8)
    wrong[0] = 4  # an edge away, of 1; the area is 6
    maps = {("wolf", "dog"): wrong, ("dog", "x"): right, ("x", "dog"): right}
    found = animals.animal_errors(shapes, truth, maps)
    assert found["kinds"] == {"across": 0.0, "dog to dog": pytest.approx(100 / 8 / np.sqrt(6), abs=1e-3)}
    assert found["lost"] == pytest.approx(1 / 24, abs=1e-3)
    assert (found["pairs"], found["median_pair_x100"]) == (3, 0.0)


@pytest.mark.parametrize("points", [0, 6])
def test_animals_from_end_to_end(points: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    balls(tmp_path / "animal", ".landmarks.npy")
    for file in (tmp_path / "animal").glob("*.npy"):
        np.save(file, np.arange(162))
    words = ["--data", tmp_path, "--template", "1", "--points", points, "--steps", "2", "--threads", "1"]
    words += [
        "--work",
        tmp_path / "work",
        "--minutes",
        "1",
        "--seed",
        "0",
        "--nodes",
        "60",
        "--radius",
        "0.35",
    ]
    assert animals.main([str(word) for word in words]) == 0
    record = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (record["training"]["template"], record["points"]) == ("1", points)
    assert record["results"]["rigid alignment, nearest vertex"]["mean_x100"] < 12
    assert record["results"]["nodes refined"]["pairs"] == 2
    assert animals.main(["--data", str(tmp_path), "--template", "9"]) == 1
    assert "no animal" in capsys.readouterr().err
