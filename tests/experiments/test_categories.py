"""What the benchmarks of categories compute, by hand; hearts and keypoints through their own doors."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from meshmatch.errors import InputError, OptionError
from meshmatch.experiments import animals, category, collection, hearts, keypoint_parts, segments
from meshmatch.experiments.category import RIGID, nearest_maps, ordered_pairs
from meshmatch.experiments.sets import load_folder
from meshmatch.fitting.viscous import ViscousConfig
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.normalise import sqrt_area_frame
from meshmatch.shapes.shape import Shape
from meshmatch.templates.make import NodeConfig, make_template
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


def test_maps_through_registered_vertices(cube: Shape) -> None:
    other = Shape(cube.verts[::-1] + 5, 7 - cube.faces)
    maps = hearts.through({"a": cube.verts, "b": cube.verts + 5}, {"a": cube, "b": other})
    assert np.array_equal(maps["a", "b"].index, np.arange(8)[::-1])


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
    sure = np.array([0.9, 0.8, 0.7, 0.1, 0, 0, 0, 0])
    found = segments.keypoint_errors(shapes, points, {("a", "b"): VertexMap("a", "b", index, confidence=sure)})
    assert found["mean"] == pytest.approx(1 / np.sqrt(3) / 4, abs=1e-3)
    assert (found["median"], found["arrived"], found["confidence_auc"]) == (0.0, 0.75, 1.0)
    assert (found["confidence_right"], found["confidence_wrong"]) == pytest.approx((0.8, 0.1))
    perfect = segments.keypoint_errors(shapes, points, mapped({("a", "b"): np.arange(8)}))
    assert perfect["confidence_auc"] is None and perfect["confidence_wrong"] is None


def test_overlap_of_parts_by_hand() -> None:
    truth, found = np.array([0, 0, 1, 1]), np.array([0, 1, 1, 1])
    area = np.array([1.0, 1.0, 2.0, 0.0])
    assert keypoint_parts.mean_overlap(found, truth, area) == pytest.approx((1 / 2 + 2 / 3) / 2)
    ball = icosphere(1)
    at = np.array([ball.verts[:, 2].argmin(), ball.verts[:, 2].argmax()])
    parts = keypoint_parts.keypoint_parts(ball, at)
    assert parts[at[0]] == 0 and parts[at[1]] == 1
    assert (parts[ball.verts[:, 2] > 0.01] == 1).all()


def test_overlap_of_all_parts_of_a_category_by_hand() -> None:
    """ShapeNet's: 1 for what is neither there nor found, 0 for what is found and not there."""
    truth, found = np.array([0, 0, 1, 1]), np.array([0, 1, 1, 1])
    assert keypoint_parts.category_overlap(found, truth, 2) == pytest.approx((1 / 2 + 2 / 3) / 2)
    assert keypoint_parts.category_overlap(found, truth, 3) == pytest.approx((1 / 2 + 2 / 3 + 1) / 3)
    assert keypoint_parts.category_overlap(np.array([0, 2, 1, 1]), truth, 3) == pytest.approx((1 / 2 + 1 + 0) / 3)


def legged(count: int) -> tuple[Shape, np.ndarray]:
    """A plate of vertices at height 0 with strips of 22 vertices down to -1; its keypoints as a table's."""
    parts = [np.array([[x, y, 0.0] for x in range(4) for y in range(4)])]
    faces = [np.array([[0, 1, 4]])]
    for leg in range(count):
        heights = np.linspace(-0.05, -1, 11)
        strip = np.array([[leg + 0.1 * side, 0, z] for z in heights for side in (0, 1)])
        first = 16 + 22 * leg
        steps = [[first + k, first + k + 1, first + k + 2] for k in range(20)]
        parts.append(strip)
        faces.append(np.array(steps))
    shape = Shape(np.concatenate(parts), np.concatenate(faces))
    keys = np.zeros(18, int)
    for n, (top, foot) in enumerate(((4, 5), (6, 7), (8, 9), (10, 11))):
        keys[top], keys[foot] = 16 + 22 * (n % count), 16 + 22 * (n % count) + 21
    return shape, keys


def test_legs_are_counted_and_their_confidence_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(keypoint_parts, "_SMALLEST", 9)
    legs = {name: keypoint_parts.table_legs(*legged(count)) for name, count in (("a", 3), ("b", 3), ("c", 5))}
    assert [legs[name].max() + 1 for name in "abc"] == [3, 3, 5]
    assert (legs["a"][:16] == -1).all() and legs["a"][-1] == 2
    maps = {}
    for source, target in (("a", "b"), ("b", "a"), ("a", "c")):
        sure = np.full(len(legs[source]), 0.9 if target != "c" else 0.2)
        maps[source, target] = VertexMap(source, target, np.zeros(len(sure), int), confidence=sure)
    found = keypoint_parts.leg_confidence(legs, maps)
    assert found == pytest.approx({"legs_auc": 1.0, "legs_alike": 0.9, "legs_unlike": 0.2})
    alone = keypoint_parts.leg_confidence(legs, {("a", "b"): maps["a", "b"]})
    assert alone["legs_auc"] is None and alone["legs_unlike"] is None


def test_the_ends_of_legs_are_measured_in_the_best_of_a_squares_numberings() -> None:
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
    verts = np.concatenate([np.column_stack([corners, np.full(4, z)]) for z in (0.0, 1.0)])
    table = Shape(verts, np.zeros((0, 3), int))
    keypoints = np.array([0, 1, 2, 3, 4, 0, 5, 1, 6, 2, 7, 3])  # corners, then each leg's top and foot

    def measured(order: list[int]) -> dict[str, float]:
        index = np.array([*order, *(4 + k for k in order)])
        maps = mapped({("a", "b"): index})
        return keypoint_parts.leg_errors({"a": table, "b": table}, {"a": keypoints, "b": keypoints}, maps, 0.1)

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
    table, keypoints = Shape(places, np.zeros((0, 3), int)), np.arange(18)

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
        return keypoint_parts.renumbered_errors(both, dict.fromkeys(both, keypoints), mapped({("a", "b"): index}), 0.1)

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
    stood = segments.stood_alike(shapes, {"a": points, "b": points})
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
    monkeypatch.setattr(hearts, "find_spec", lambda name: None)
    small = ViscousConfig(nodes=60, radius=0.35, steps=2, samples=500)
    monkeypatch.setattr(hearts, "ViscousConfig", lambda seed: small)
    drawn = []
    monkeypatch.setattr(category, "render_shapes", lambda panels, path, look: drawn.append(len(panels)))
    words = [
        "--data",
        str(tmp_path),
        *QUICK,
        "--work",
        str(tmp_path / "work"),
        "--coded-steps",
        "2",
        "--rival-pairs",
        "2",
    ]
    assert hearts.main([*words, "--unseen", "1", "--picture", str(tmp_path / "hearts.png")]) == 0
    record, rows = rows_of(capsys.readouterr().out)
    assert record["training"]["registered"]["steps"] == record["training"]["unregistered"]["steps"] == 2
    assert rows[RIGID]["mean_x100"] < 10
    assert rows["unregistered, nodes refined"]["pairs"] == 6
    assert rows["registered, nodes refined"]["unseen_x100"] is None
    assert "meshmonk" not in rows and "ZoomOut" not in rows  # where they are not installed
    assert rows["3D-CODED"]["pairs"] == 2 and rows["collection, no training"]["pairs"] == 6
    assert len(record["unseen"]) == 1 and record["template"] not in record["unseen"]
    learned = json.loads((tmp_path / "work" / "registered" / "prepared" / "prepared.json").read_text())
    assert learned["registered"] and len(learned["names"]) == 2
    assert drawn == [3]
    alone = ["--unseen", "2", "--measure", "unseen", "--ways", "unregistered"]
    assert hearts.main([*words, *alone]) == 0
    row = rows_of(capsys.readouterr().out)[1]["unregistered, nodes refined"]
    assert (row["unseen_pairs"], row["pairs"]) == (2, 2)


def test_registrations_of_meshmonk_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    balls(tmp_path, ".truth.npy")
    shapes, _ = load_folder(tmp_path, ".truth.npy")
    template = make_template(shapes["0"], "ball", NodeConfig("uniform", 60, 0.35))
    frames = {name: sqrt_area_frame(shape) for name, shape in shapes.items()}
    asked = []

    def register(floating, target):
        asked.append(len(target[0]))
        return floating[0]

    monkeypatch.setattr(hearts, "viscoelastic", register)
    for _ in range(2):
        places = hearts.meshmonk_places(template, shapes, frames, tmp_path / "kept")
        assert np.array_equal(hearts.through(places, shapes)["0", "1"].index, np.arange(162))
    assert asked == [162, 162]


def test_maps_of_zoomout_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One pair is mapped to itself, on the other the library gives up."""
    balls(tmp_path, ".truth.npy")
    shapes, _ = load_folder(tmp_path, ".truth.npy")
    asked = []

    class Known:
        def fit(self, shape):
            return shape.name

        def map(self, source, first, target, second, start=None):
            asked.append((first, second))
            if start is not None:
                return start
            if first.startswith("1"):
                raise InputError("gave up")
            return VertexMap.between(source, target, np.arange(162))

    monkeypatch.setattr(hearts, "ZoomOut", Known)
    for _ in range(2):
        maps = hearts.by_zoomout(shapes, [("0", "1"), ("1", "0")], tmp_path / "kept")
        assert np.array_equal(maps["0", "1"].index, np.arange(162))
        assert not maps["1", "0"].index.any()
    assert len(asked) == 2
    turned = VertexMap.between(shapes["0"], shapes["1"], np.arange(162)[::-1])
    again = hearts.by_zoomout(shapes, [("0", "1")], tmp_path / "aligned", {("0", "1"): turned})
    assert np.array_equal(again["0", "1"].index, turned.index)


def test_a_collection_is_registered_without_training(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Three bent balls that share their vertices; a second run reads what the first one kept."""
    ball = icosphere(3)
    shapes = {}
    for n in range(3):
        bent = ball.verts * [1, 1.2 + 0.1 * n, 1.5] + 0.1 * n * ball.verts[:, [1, 2, 0]] ** 2
        shapes[str(n)] = Shape((10 + n) * bent + n, ball.faces, str(n))
    config = ViscousConfig(nodes=120, radius=0.3, samples=4000, steps=6)
    nearest = nearest_maps(shapes, "near", "area", [("0", "2")])["0", "2"]
    for _ in range(2):
        maps = collection.collection_maps(shapes, "0", config, tmp_path)
        apart = shapes["2"].verts[maps["0", "2"].index] - shapes["2"].verts
        rigid = shapes["2"].verts[nearest.index] - shapes["2"].verts
        assert np.linalg.norm(apart, axis=1).mean() < 0.85 * np.linalg.norm(rigid, axis=1).mean()
        assert len(maps) == 6
        monkeypatch.setattr(collection, "viscous_vectors", None)  # it is not asked again
    with pytest.raises(OptionError, match="other choices"):
        collection.collection_maps(shapes, "0", replace(config, steps=7), tmp_path)


def test_segments_from_end_to_end(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn = []
    monkeypatch.setattr(category, "render_shapes", lambda panels, path, look: drawn.append((panels, path)))
    balls(tmp_path / "plane", ".keypoints.npy")
    words = ["--data", str(tmp_path), "--classes", "plane", *QUICK, "--pictures", str(tmp_path)]
    assert segments.main([*words, "--work", str(tmp_path / "work")]) == 0
    _, rows = rows_of(capsys.readouterr().out)
    assert rows[RIGID]["arrived"] == 1.0
    assert 0.9 < rows[RIGID]["iou"] <= 1.0
    assert rows["200 steps on the code"]["pairs"] == 2
    assert "legs_auc" not in rows["200 steps on the code"]
    [(panels, path)] = drawn
    assert len(panels) == 2 and path == tmp_path / "segments-plane.png"


def test_kinds_of_animals_and_their_errors_by_hand(cube: Shape) -> None:
    assert [animals.kind_of(name) for name in ("fox-05", "Davis_cow_00000", "timthumb")] == ["dog", "cow", "other"]
    shapes = {"wolf": cube, "dog": cube, "x": cube}
    truth = {name: np.arange(8) for name in shapes}
    right, wrong = np.arange(8), np.arange(8)
    wrong[0] = 4  # an edge away, of 1; the area is 6
    maps = {("wolf", "dog"): wrong, ("dog", "x"): right, ("x", "dog"): right}
    found = animals.animal_errors(shapes, truth, mapped(maps))
    assert found["across"] == 0.0
    assert found["dog to dog"] == pytest.approx(100 / 8 / np.sqrt(6), abs=1e-3)
    assert found["lost"] == pytest.approx(1 / 24, abs=1e-3)
    assert (found["pairs"], found["median_pair_x100"]) == (3, 0.0)


@pytest.mark.parametrize("points", [0, 6])
def test_animals_from_end_to_end(points: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    balls(tmp_path / "animal", ".landmarks.npy", 3)
    for file in (tmp_path / "animal").glob("*.npy"):
        np.save(file, np.arange(162))
    words = ["--data", str(tmp_path), "--template", "1", "--points", str(points), *QUICK]
    words += ["--limit-pairs", "1", "--limit-shapes", "2"]
    assert animals.main(words) == 0
    record, rows = rows_of(capsys.readouterr().out)
    assert record["training"]["template"] == "1"
    assert rows[RIGID]["mean_x100"] < 12
    assert rows["nodes refined"]["pairs"] == 1
    assert list(rows["nodes refined"]["verdicts"]) == ["0", "2"]  # evenly spread; all are learned
    assert animals.main(["--data", str(tmp_path), "--template", "9"]) == 1
    assert "no animal" in capsys.readouterr().err
