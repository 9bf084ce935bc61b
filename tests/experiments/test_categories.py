"""What the benchmarks of categories compute, by hand; hearts and keypoints through their own doors."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from meshmatch.experiments.bench import category, hearts, keypoints, kinds
from meshmatch.experiments.bench.category import RIGID, nearest_maps, ordered_pairs
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.shape import Shape
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
    assert (found["mean_x100"], found["right_chamber"], found["unseen_x100"]) == (0.0, 1.0, None)
    wrong = right.copy()
    wrong[0] = right[4]  # from x = 0 to x = 1: one edge, and the other chamber
    wrong[7] = 0  # does not count
    assert found["across_x100"] == 0.0
    found = hearts.heart_errors(shapes, truth, mapped({("a", "b"): wrong, ("b", "a"): right}), ["a"])
    assert found["unseen_pairs"] == 0  # of two shapes that are both unseen
    found = hearts.heart_errors(shapes, truth, mapped({("a", "b"): wrong}), ["b", "a"])
    assert found["unseen_x100"] == found["mean_x100"]
    assert found["mean_x100"] == pytest.approx(100 / 7 / np.sqrt(6), abs=1e-3)
    assert found["right_chamber"] == pytest.approx(6 / 7, abs=1e-3)
    assert found["worst_pair"] == ["a", "b"]
    # the normal of a corner, whatever its triangles weigh, looks away from the middle
    assert 0.2 * found["mean_x100"] < found["across_x100"] < 0.9 * found["mean_x100"]


def test_hearts_are_registered_by_what_both_kept() -> None:
    """A ball, and the same stretched, moved and of other triangles: every second vertex is known of both."""
    ball, other = icosphere(2), icosphere(3)

    def bent(verts: np.ndarray) -> np.ndarray:
        return 50 * (verts * [1, 1.3, 0.8] + 0.2 * verts[:, [1, 2, 0]] ** 2) + 7

    ids = np.arange(ball.V)
    theirs = 1000 + np.arange(other.V)
    theirs[: ball.V : 2] = ids[::2]  # subdivision keeps the vertices and adds others behind them
    assert np.allclose(other.verts[: ball.V], ball.verts)
    found = hearts.registered(ball, ids, Shape(bent(other.verts), other.faces), theirs)
    apart = np.linalg.norm(found - bent(ball.verts), axis=1)
    assert apart[::2].max() < 1e-6
    assert apart.max() < 1.0  # of a ball of diameter 100


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


def test_overlap_of_all_parts_of_a_category_by_hand() -> None:
    """ShapeNet's: 1 for what is neither there nor found, 0 for what is found and not there."""
    truth, found = np.array([0, 0, 1, 1]), np.array([0, 1, 1, 1])
    assert keypoints.category_overlap(found, truth, 2) == pytest.approx((1 / 2 + 2 / 3) / 2)
    assert keypoints.category_overlap(found, truth, 3) == pytest.approx((1 / 2 + 2 / 3 + 1) / 3)
    assert keypoints.category_overlap(np.array([0, 2, 1, 1]), truth, 3) == pytest.approx((1 / 2 + 1 + 0) / 3)


def test_the_ends_of_legs_are_measured_in_the_best_of_a_squares_numberings() -> None:
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
    verts = np.concatenate([np.column_stack([corners, np.full(4, z)]) for z in (0.0, 1.0)])
    table = Shape(verts, np.zeros((0, 3), int))
    points = np.array([0, 1, 2, 3, 4, 0, 5, 1, 6, 2, 7, 3])  # corners, then each leg's top and foot

    def measured(order: list[int]) -> dict[str, float]:
        index = np.array([*order, *(4 + k for k in order)])
        maps = mapped({("a", "b"): index})
        return keypoints.leg_errors({"a": table, "b": table}, {"a": points, "b": points}, maps, 0.1)

    for order in ([0, 1, 2, 3], [1, 2, 3, 0], [3, 2, 1, 0], [0, 3, 2, 1]):
        assert measured(order) == {"legs_mean": 0, "legs_arrived": 1}, order
    # Two neighbours are exchanged: no numbering of a square suits more than two of the four legs.
    assert measured([1, 0, 2, 3]) == {"legs_mean": pytest.approx(0.5 / np.sqrt(3), abs=1e-4), "legs_arrived": 0.5}


def test_all_keypoints_of_a_table_are_measured_in_the_best_numbering() -> None:
    ring = np.array([[0, 0], [2, 0], [2, 2], [0, 2]], float)
    places = np.zeros((18, 3))
    places[:4, :2], places[[4, 6, 8, 10], :2], places[[5, 7, 9, 11], :2] = ring, ring, ring
    places[[4, 6, 8, 10], 2], places[[5, 7, 9, 11], 2], places[12:14] = 1, 2, [[1, 1, 0], [1, 1, 1]]
    places[[14, 17, 16, 15], :2] = 0.5 * (ring + np.roll(ring, -1, axis=0))
    table, points = Shape(places, np.zeros((0, 3), int)), np.arange(18)

    def arrived(corners: list[int], legs: list[int]) -> dict[str, float]:
        """A map that numbers corners (and the sides between them) and legs in these ways."""
        sides, index = [14, 17, 16, 15], np.arange(18)
        index[:4] = corners
        index[sides] = [
            next(side for side, edge in zip(sides, ({0, 1}, {1, 2}, {2, 3}, {3, 0}), strict=True) if edge == {a, b})
            for a, b in zip(corners, corners[1:] + corners[:1], strict=True)
        ]
        index[[4, 6, 8, 10]], index[[5, 7, 9, 11]] = 4 + 2 * np.array(legs), 5 + 2 * np.array(legs)
        both = {"a": table, "b": table}
        return keypoints.renumbered_errors(both, dict.fromkeys(both, points), mapped({("a", "b"): index}), 0.1)

    assert arrived([1, 2, 3, 0], [3, 2, 1, 0])["renumbered_arrived"] == 1
    assert arrived([2, 1, 0, 3], [0, 1, 2, 3])["renumbered_mean"] == 0
    crossed = arrived([0, 1, 2, 3], [1, 0, 2, 3])
    assert crossed["renumbered_arrived"] == pytest.approx(14 / 18) and crossed["legs_arrived"] == 0.5


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


@pytest.mark.parametrize(
    ("main", "words"), [(hearts.main, ["--data", "nowhere"]), (kinds.main, ["--data", "nowhere", "--sets", "animals"])]
)
def test_what_cannot_be_is_told(main, words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words) == 1
    assert "error:" in capsys.readouterr().err


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


QUICK = ["--steps", "2", "--threads", "1", "--nodes", "60", "--radius", "0.35", "--minutes", "1"]


@pytest.mark.slow
def test_hearts_from_end_to_end(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    balls(tmp_path / "heart", ".truth.npy", 3)
    drawn = []
    monkeypatch.setattr(category, "render_shapes", lambda panels, path, look: drawn.append(len(panels)))
    words = ["--data", str(tmp_path), *QUICK, "--work", str(tmp_path / "work")]
    assert hearts.main([*words, "--unseen", "1", "--picture", str(tmp_path / "hearts.png")]) == 0
    record, rows = rows_of(capsys.readouterr().out)
    assert record["training"]["registered"]["steps"] == record["training"]["unregistered"]["steps"] == 2
    assert rows[RIGID]["mean_x100"] < 10
    assert rows["unregistered, nodes refined"]["pairs"] == 6
    assert rows["registered, nodes refined"]["unseen_x100"] is None
    assert len(record["unseen"]) == 1 and record["template"] not in record["unseen"]
    learned = json.loads((tmp_path / "work" / "registered" / "prepared" / "prepared.json").read_text())
    assert learned["registered"] and len(learned["names"]) == 2
    assert drawn == [3]
    alone = ["--unseen", "2", "--measure", "unseen", "--ways", "unregistered"]
    assert hearts.main([*words, *alone]) == 0
    row = rows_of(capsys.readouterr().out)[1]["unregistered, nodes refined"]
    assert (row["unseen_pairs"], row["pairs"]) == (2, 2)
