"""Errors of maps of any shapes: the best of a class's symmetries, from its file or from its keypoints."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from PIL import Image

from meshmatch.errors import InputError
from meshmatch.experiments.bench import any_shapes
from meshmatch.experiments.bench.any_shapes import error_of, keypoints_of, row_of, symmetries
from meshmatch.experiments.bench.methods import EarlierVersion
from meshmatch.experiments.pages import results_file
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.shape import Shape

CORNERS = 8


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Boxes of three lengths: corners are keypoints."""
    for number in range(1, 5):
        box = trimesh.creation.box((1.0 + 0.1 * number, 0.6, 0.3)).subdivide()
        save_shape(tmp_path / f"{number}.ply", Shape(np.asarray(box.vertices), np.asarray(box.faces)))
        np.save(tmp_path / f"{number}.keypoints.npy", np.arange(CORNERS))
    return tmp_path


def test_symmetries_of_a_box_are_its_turns_and_reflections(folder: Path) -> None:
    found = symmetries(folder)
    assert len(found) == 8 and np.array_equal(found[0], np.arange(CORNERS))
    assert len({tuple(each) for each in found}) == 8
    exact = keypoints_of(folder, "2")
    for each in found:
        assert error_of(folder, ("1", "2"), exact[each]) == 0


def test_a_pair_has_the_symmetries_of_either_shape_too(folder: Path) -> None:
    box = trimesh.creation.box((0.6, 0.6, 0.3)).subdivide()
    save_shape(folder / "5.ply", Shape(np.asarray(box.vertices), np.asarray(box.faces)))
    np.save(folder / "5.keypoints.npy", np.arange(CORNERS))
    assert len(symmetries(folder)) == len(symmetries(folder, "1", "2")) == 8
    for pair in (("5", "1"), ("1", "5")):
        found = symmetries(folder, *pair)
        assert len(found) == 16 and np.array_equal(found[0], np.arange(CORNERS))
        exact = keypoints_of(folder, pair[1])
        assert max(error_of(folder, pair, exact[each]) for each in found) == 0


def test_pairs_of_a_file_are_swapped_together_and_rings_turn_together(folder: Path) -> None:
    (folder / "symmetry.txt").write_text("0 1\n2 3\n")
    plain, swapped = symmetries(folder)
    assert swapped.tolist() == [1, 0, 3, 2, 4, 5, 6, 7] and plain.tolist() == list(range(8))
    (folder / "symmetry.txt").write_text("0 1 2\n5 6 7\n")
    rings = {tuple(each.tolist()) for each in symmetries(folder)}
    assert len(rings) == 6 and (1, 2, 0, 3, 4, 6, 7, 5) in rings and (0, 2, 1, 3, 4, 5, 7, 6) in rings


def test_the_error_is_along_the_surface_in_units_of_its_size(folder: Path) -> None:
    (folder / "symmetry.txt").write_text("")
    wrong = keypoints_of(folder, "1").copy()
    lengths = any_shapes.distances(folder, "1")
    wrong[0] = int(lengths[0].argmax())
    assert error_of(folder, ("2", "1"), wrong) == pytest.approx(100 * lengths[0].max() / CORNERS)


def test_another_method_that_fails_is_counted_as_a_map_to_one_vertex(folder: Path) -> None:
    class Nearest:
        def fit(self, shape: Shape) -> Shape:
            return shape

        def map(self, source: Shape, source_fit: Shape, target: Shape, target_fit: Shape) -> VertexMap:
            return VertexMap.between(source, target, np.arange(source.V))

    class Fails(Nearest):
        def map(self, *_: object) -> VertexMap:
            raise InputError("it gave up")

    right, wrong = (any_shapes.measure_by(method, folder, ("1", "2")) for method in (Nearest(), Fails()))
    assert (right["error"], right["failed"]) == (0.0, False)
    assert wrong["failed"] and wrong["error"] > 20


@pytest.mark.parametrize("name", ["any-shapes", "any-turning"])
def test_saved_tables_have_the_headings_of_new_ones(name: str) -> None:
    first, *others = results_file(name)["tables"]
    assert first["columns"] == list(any_shapes._COLUMNS) and "over 20 and flagged" in first["columns"]
    assert [table["title"] for table in others][:1] in ([], ["Other methods, 12 pairs of each class"])


def test_a_row_counts_every_pair_and_names_the_worst() -> None:
    found = [
        {"pair": "a to b", "error": 4.0, "verdict": "good", "ambiguous": False, "cpu": 1.0},
        {"pair": "b to a", "error": 20.0, "verdict": "good", "ambiguous": False, "cpu": 3.0},
        {"pair": "a to c", "error": 6.0, "verdict": "fair", "ambiguous": True, "cpu": 2.0},
    ]
    row = row_of("box", found)
    assert (row["pairs"], row["mean"], row["median"], row["worst"]) == (3, 10.0, 6.0, "b to a")
    assert row["under"] == pytest.approx(2 / 3) and (row["good"], row["good_over"]) == (2, 1)
    lost = [{**found[0], "error": 21.0}, {**found[1], "error": 30.0, "verdict": "poor"}, {**found[2], "error": 40.0}]
    assert (row["far_off"], row["told"]) == (0, 0)
    assert [row_of("cup", lost)[name] for name in ("far_off", "told")] == [3, 2]


def test_the_calibration_of_direct_maps_tells_right_from_wrong() -> None:
    rng = np.random.default_rng(0)
    found = [
        {"error": 3.0 if right else 30.0, "energy": rng.normal(0.03 if right else 0.05, 0.008), "leads": leads}
        for right in [True] * 60 + [False] * 40
        for leads in [(rng.uniform(0.002, 0.02), 0.03) if right else (rng.uniform(0, 0.004),)]
    ]
    fitted = any_shapes.fit_calibration(found)
    assert fitted.energy > 0 and fitted.lead > 0 and "100 pairs" in fitted.data
    told = [fitted.logit(each["energy"], each["leads"]) > 0 for each in found]
    assert np.mean([a == (each["error"] < 10) for a, each in zip(told, found, strict=True)]) > 0.85
    assert fitted.logit(0.03, [0.004, 0.5]) == fitted.logit(0.03, [0.5, 0.004]) < fitted.logit(0.03, [])


def test_verdicts_are_counted_by_weights_of_other_classes() -> None:
    rng = np.random.default_rng(1)
    pairs = [
        {
            "error": 3.0 if right else 30.0,
            "energy": rng.normal(0.03 if right else 0.06, 0.004),
            "leads": (rng.uniform(0.002, 0.01),),
            "turns": 1,
        }
        for right in [True] * 30 + [False] * 20
    ]
    odd = [{"error": 30.0, "energy": 0.02, "leads": (0.02,), "turns": 1}]  # looks right, and is wrong
    counts = any_shapes.cross_validate({"a": pairs[::2], "b": pairs[1::2], "odd": odd})
    assert (counts["pairs"], counts["right"]) == (51, 30)
    assert counts["good"] > counts["good_over"] == 1 and counts["right_not_poor"] >= 28


def test_the_worst_pair_of_each_class_is_drawn(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(any_shapes, "folder_of", lambda *_: folder)
    asked = []

    class Matcher:
        def match(self, source: Shape, target: Shape) -> SimpleNamespace:
            asked.append((source.name[0], target.name[0]))
            return SimpleNamespace(map=VertexMap.between(source, target, range(source.V)), rotations=(None, None))

    rows = [{"class": f"box{k}", "worst": f"{k} to 4", "worst_error": 3.0} for k in (1, 2, 3, 1)]
    any_shapes.draw_worst(rows, tmp_path / "worst.png", folder, Matcher())  # type: ignore[arg-type]
    assert asked == [("1", "4"), ("2", "4"), ("3", "4"), ("1", "4")]
    with Image.open(tmp_path / "worst.png") as sheet:
        drawn = np.asarray(sheet.convert("RGB"))
    height, width = 340, 480
    assert drawn.shape == (2 * height, 3 * width, 3)
    cells = [drawn[y : y + height, x : x + width] for y in (0, height) for x in (0, width, 2 * width)]
    assert [len(np.unique(cell.reshape(-1, 3), axis=0)) > 50 for cell in cells] == [True] * 4 + [False] * 2


def test_an_earlier_version_maps_by_its_own_commands(tmp_path: Path, folder: Path) -> None:
    """One whose every map is the identity; and one that fails, whose words are told."""
    package = tmp_path / "checkout/meshmatch"
    package.mkdir(parents=True)
    (package / "__init__.py").touch()
    (package / "__main__.py").write_text(
        "import sys, numpy as np, pathlib\n"
        "words = sys.argv[1:]\n"
        "assert words[-1] == '--quiet' and pathlib.Path('source.ply').exists() and pathlib.Path('target.ply').exists()\n"
        "if words[0] == 'map':\n"
        "    pathlib.Path('maps/source').mkdir(parents=True)\n"
        "    np.save('maps/source/target.npy', np.arange(26))\n"
    )
    method = EarlierVersion(package.parent)
    row = any_shapes.measure_by(method, folder, ("1", "2"))
    assert row["error"] == 0 and not row["failed"] and row["cpu"] > 0
    (package / "__main__.py").write_text("raise SystemExit('no model')")
    shape = load_shape(folder / "1.ply")
    with pytest.raises(InputError, match="fit gave up: no model"):
        method.map(shape, None, shape, None)
    assert any_shapes.measure_by(method, folder, ("1", "2"))["failed"]
