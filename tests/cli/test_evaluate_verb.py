"""`evaluate` measures what a map file says against shapes and truth."""

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import meshmatch
from meshmatch.errors import OptionError
from meshmatch.maps.files import save_map
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.render import compose
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.shape import Shape
from tests.cli.conftest import Answer, Run, refused, well

V = 642
SAMPLES = Path(__file__).parents[2] / "templates" / "samples"


@pytest.fixture
def folder(tmp_path: Path, sphere: Shape, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A map of the sphere a.ply to itself, b.ply, with 64 vertices thrown to vertex 0; and the truth in every form."""
    monkeypatch.chdir(tmp_path)
    for name in ("a.ply", "b.ply"):
        save_shape(name, sphere)
    index = np.arange(V)
    index[-64:] = 0
    save_map("map.npy", VertexMap.between(load_shape("a.ply"), load_shape("b.ply"), index))
    ids = np.arange(V)
    Path("column.txt").write_text("\n".join(map(str, ids)))
    Path("pairs.csv").write_text("source,target\n" + "\n".join(f"{i},{i}" for i in ids))
    np.save("column.npy", ids)
    np.save("pairs.npy", np.stack([ids, ids], 1))
    return tmp_path


@pytest.fixture
def evaluate(run: Run, folder: Path) -> Callable[[str], Answer]:
    return lambda words: well(run("evaluate", "map.npy", "a.ply", "b.ply", *words.split()))


def test_without_truth_it_says_coverage_and_distortion(evaluate: Callable[[str], Answer]) -> None:
    answer = evaluate("")
    assert answer.err == ""
    assert answer.out.split()[:3] == ["coverage", f"{100 * (V - 64) / V:.1f}", "%"]
    assert "distortion" in answer.out
    assert "mean error" not in answer.out


def test_with_the_map_back_it_says_where_both_lead(evaluate: Callable[[str], Answer], folder: Path) -> None:
    shown = evaluate("--backward map.npy").out
    assert "bijectivity" in shown and "dirichlet" in shown
    record = evaluate("--backward map.npy --json").record
    assert 0.0 < record["bijectivity"] < 0.2 and record["dirichlet"] > 1.0
    assert evaluate("--json").record["bijectivity"] is None


@pytest.mark.parametrize(
    "truth",
    [
        *("--truth column.txt", "--truth column.npy", "--truth pairs.csv", "--truth pairs.npy"),
        "--points column.npy column.npy",
    ],
)
def test_every_form_of_the_truth_gives_the_same_errors(evaluate: Callable[[str], Answer], truth: str) -> None:
    record = evaluate(f"{truth} --json").record
    assert (record["points"], record["unit"], record["median"], record["median_cm"]) == (V, "file", 0.0, 0.0)
    assert record["mean_cm"] > 1.0  # a tenth of the vertices, thrown across the sphere
    assert 0.05 < record["share_over_threshold"] <= 64 / V


@pytest.mark.parametrize("nothing", ["-1", "nan", "NA"])
def test_vertices_without_a_counterpart_are_left_out(run: Run, folder: Path, nothing: str) -> None:
    Path("column.txt").write_text("\n".join(nothing if i % 2 else str(i) for i in range(V)))
    answer = well(run("evaluate", "map.npy", "a.ply", "b.ply", "--truth", "column.txt", "--json"))
    assert answer.record["points"] == V // 2
    assert f"column.txt: {V // 2} of {V} vertices have no counterpart: left out" in answer.err


def fcsv(*names: str) -> str:
    """Landmarks of 3D Slicer at the first vertices of the sphere."""
    at = load_shape("a.ply").verts
    rows = (f"{k},{x},{y},{z},0,0,0,1,1,1,0,{names[k]},," for k, (x, y, z) in enumerate(at[: len(names)]))
    return "# CoordinateSystem = LPS\n" + "\n".join(rows)


def test_landmarks_of_both_shapes_are_a_truth(run: Run, folder: Path) -> None:
    """By their names, in whatever order, as files of 3D Slicer or as tables that meshmatch wrote."""
    rows = zip(("groove", "notch", "spur"), load_shape("b.ply").verts[[2, 0, 1]], strict=True)
    Path("a.fcsv").write_text(fcsv("notch", "condyle", "groove"))
    Path("b.csv").write_text("name,x,y,z\n" + "\n".join(f"{name},{x},{y},{z}" for name, (x, y, z) in rows))
    answer = well(run("evaluate", "map.npy", "a.ply", "b.ply", "--points", "a.fcsv", "b.csv", "--json"))
    record = answer.record
    assert (record["points"], record["mean"]) == (2, 0.0)
    assert "a.fcsv: b.csv has no condyle: left out" in answer.err and "b.csv: a.fcsv has no spur" in answer.err
    Path("other.csv").write_text("name,vertex\nA,0\nB,1\nC,2")
    answer = well(run("evaluate", "map.npy", "a.ply", "b.ply", "--points", "a.fcsv", "other.csv", "--json"))
    assert answer.record["mean"] == 0.0 and "no name in common: their landmarks are paired in order" in answer.err


def test_pairs_are_a_truth_in_python_too(folder: Path) -> None:
    pairs = np.array([[0, 0], [641, 641]])
    found = meshmatch.evaluate("map.npy", "a.ply", "b.ply", pairs)
    assert found.errors is not None and found.errors.values.shape == (2,) and found.errors.values[0] == 0


@pytest.mark.parametrize(("pairs", "right"), [("0 0\n5 5\n577 577\n", True), ("641 641\n", False)])
def test_truth_about_good_vertices_alone_is_0(evaluate: Callable[[str], Answer], pairs: str, right: bool) -> None:
    Path("t.txt").write_text(pairs)
    assert ("mean error    0 (unit of the file)" in evaluate("--truth t.txt").out) == right


def test_errors_are_in_the_unit_of_the_file_unless_it_is_a_person(evaluate: Callable[[str], Answer]) -> None:
    record = evaluate("--truth column.txt --json").record
    size = float(np.sqrt(load_shape("b.ply").area))
    assert record["mean"] == pytest.approx(record["mean_x100"] / 100 * size) and record["mean"] > 0
    assert record["threshold"] == pytest.approx(0.1 * size)
    assert f"over {0.1 * size:.3g} (unit of the file)" in evaluate("--truth column.txt").out
    shown = evaluate("--truth column.txt --unit x100 --threshold 1234.5").out
    assert "over 1234.5 x 0.01 sqrt(area)" in shown and shown.splitlines()[0].count("sqrt(area)") == 1
    asked = evaluate("--truth column.txt --unit cm --json").record
    assert (asked["unit"], asked["threshold"], asked["mean"]) == ("cm", 15.0, record["mean_cm"])


def test_of_a_person_they_are_in_centimetres(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    climber = load_shape(SAMPLES / "climber.ply")
    index = np.arange(climber.V)
    index[0] = index[1]
    save_map("map.npz", VertexMap.between(climber, climber, index))
    Path("t.txt").write_text("0 0\n5 5\n")
    answer = run("evaluate", "map.npz", *2 * [str(SAMPLES / "climber.ply")], "--truth", "t.txt")
    assert "cm" in well(answer).out.splitlines()[0] and "over 15 cm" in answer.out


def test_unit_counts_without_truth(folder: Path) -> None:
    assert meshmatch.evaluate("map.npy", "a.ply", "b.ply", unit="x100").unit.name == "x100"
    with pytest.raises(OptionError, match="invalid unit 'mm'"):
        meshmatch.evaluate("map.npy", "a.ply", "b.ply", unit="mm")  # type: ignore[arg-type]


def test_threshold(evaluate: Callable[[str], Answer]) -> None:
    all_wrong, none = (
        evaluate(f"--truth column.txt --threshold {limit} --json").record["share_over_threshold"] for limit in (0, 1000)
    )
    # vertex 0 itself may be among those thrown to it, and is right
    assert 63 / V <= all_wrong <= 64 / V and none == 0.0


@pytest.mark.parametrize("unit", ["cm", "file", "x100"])
def test_a_huge_threshold_does_not_overflow(evaluate: Callable[[str], Answer], unit: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        assert (
            evaluate(f"--truth column.txt --unit {unit} --threshold 1e308 --json").record["share_over_threshold"] == 0
        )


def test_a_threshold_is_a_length(run: Run, folder: Path) -> None:
    answer = run("evaluate", "map.npy", "a.ply", "b.ply", "--threshold", "inf")
    refused(answer, "not inf", folder, {path.name for path in folder.iterdir()})
    answer = run("evaluate", "map.npy", "a.ply", "b.ply", "--threshold", "5")
    refused(answer, "a threshold of errors needs ground truth", folder, {path.name for path in folder.iterdir()})


def test_seed_chooses_the_pairs_of_the_distortion(evaluate: Callable[[str], Answer]) -> None:
    values = [evaluate(f"--seed {seed} --json").record["distortion"] for seed in "010"]
    assert values[0] == values[2] != values[1]


def test_units_draw_different_curves(evaluate: Callable[[str], Answer]) -> None:
    for unit in ("cm", "x100", "file"):
        evaluate(f"--truth column.txt --curve {unit}.png --unit {unit}")
    assert len({Path(f"{unit}.png").read_bytes() for unit in ("cm", "x100", "file")}) == 3


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("--truth short.txt", "3 entries"),
        ("--truth none.txt", "none.txt"),
        ("--truth wide.txt", "not 1 or 2 a line"),
        ("--truth outside.txt", "names vertex 642 of the target, which has 642"),
        ("--truth outside.txt", "subtract 1"),
        ("--truth none.mat", "it is not text"),
        ("--points a.fcsv b.fcsv", "no landmark is in both files"),
        ("--truth short.txt --points short.txt short.txt", "choose one"),
        ("--curve c.png", "needs ground truth"),
        ("--truth pairs.csv --curve c.jpg", "c.jpg"),
        ("--truth pairs.csv --curve nowhere/c.png", "there is no folder"),
        ("--picture e.png", "needs ground truth"),
        ("--truth pairs.csv --picture e.jpg", "is a PNG"),
        ("--truth pairs.csv --picture no/e.png", "there is no folder"),
        ("--truth pairs.csv --picture e.png --curve e.png", "an output of this command"),
    ],
)
def test_what_cannot_be_is_told_before_the_work(run: Run, folder: Path, words: str, told: str) -> None:
    Path("short.txt").write_text("0\n1\n2\n")
    Path("wide.txt").write_text("0 1 2\n")
    Path("outside.txt").write_text("0 642\n")
    Path("none.mat").write_bytes(bytes(range(256)))
    Path("a.fcsv").write_text(fcsv("a", "b"))
    Path("b.fcsv").write_text(fcsv("c"))
    answer = run("evaluate", "map.npy", "a.ply", "b.ply", *words.split())
    refused(answer, told, folder, {path.name for path in folder.iterdir()})


def test_a_map_of_other_shapes_is_refused(run: Run, folder: Path, torus: Shape) -> None:
    save_shape("t.ply", torus)
    before = {path.name for path in folder.iterdir()}
    refused(run("evaluate", "map.npy", "t.ply", "b.ply"), "runs the wrong way", folder, before)


@pytest.mark.parametrize(("unit", "title"), [("cm", "cm"), ("x100", "sqrt(area)"), ("file", "unit of the file")])
def test_the_errors_as_heat_on_both_shapes(
    evaluate: Callable[[str], Answer], monkeypatch: pytest.MonkeyPatch, unit: str, title: str
) -> None:
    real, legends = compose.render_shapes, []

    def watched(panels: Any, path: Path, look: compose.Look) -> None:
        legends.append(look.legend)
        real(panels, path, look)

    monkeypatch.setattr(compose, "render_shapes", watched)
    assert "mean error" in evaluate(f"--truth column.txt --picture errors.png --unit {unit}").out
    with Image.open("errors.png") as image:
        pixels = np.asarray(image, dtype=int)
    red = (pixels[..., 0] > pixels[..., 2] + 60) & (pixels[..., 1] < 120)
    assert red.mean() > 0.005  # the vertices that were thrown to another place
    assert title in legends[0].title
