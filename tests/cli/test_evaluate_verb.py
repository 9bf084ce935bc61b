"""`evaluate` measures what a map file says against shapes and truth."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from meshmatch.maps.files import save_map
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.shape import Shape
from tests.cli.conftest import Run, refused

V = 642


@pytest.fixture
def files(tmp_path: Path, sphere: Shape) -> tuple[Path, Path, Path]:
    """A map of the sphere to itself with 64 vertices thrown to vertex 0, and both shapes."""
    save_shape(tmp_path / "a.ply", sphere)
    save_shape(tmp_path / "b.ply", sphere)
    a, b = load_shape(tmp_path / "a.ply"), load_shape(tmp_path / "b.ply")
    index = np.arange(V)
    index[-64:] = 0
    save_map(tmp_path / "map.npy", VertexMap.between(a, b, index))
    return tmp_path / "map.npy", tmp_path / "a.ply", tmp_path / "b.ply"


def test_without_truth_it_says_coverage_and_distortion(run: Run, files: tuple[Path, ...]) -> None:
    answer = run("evaluate", *files)
    assert answer.status == 0
    assert answer.err == ""
    assert answer.out.split()[:3] == ["coverage", f"{100 * (V - 64) / V:.1f}", "%"]
    assert "distortion" in answer.out
    assert "mean error" not in answer.out


def write_truth(folder: Path, form: str) -> list[str | Path]:
    ids = np.arange(V)
    if form == "column":
        (folder / "t.txt").write_text("\n".join(str(i) for i in ids))
        return ["--truth", folder / "t.txt"]
    if form == "column npy":
        np.save(folder / "t.npy", ids)
        return ["--truth", folder / "t.npy"]
    if form == "pairs":
        (folder / "t.csv").write_text("source,target\n" + "\n".join(f"{i},{i}" for i in ids))
        return ["--truth", folder / "t.csv"]
    if form == "pairs npy":
        np.save(folder / "t.npy", np.stack([ids, ids], 1))
        return ["--truth", folder / "t.npy"]
    np.save(folder / "p.npy", ids)
    return ["--points", folder / "p.npy", folder / "p.npy"]


@pytest.mark.parametrize("form", ["column", "column npy", "pairs", "pairs npy", "points"])
def test_every_form_of_the_truth_gives_the_same_errors(
    run: Run, files: tuple[Path, ...], form: str, tmp_path: Path
) -> None:
    answer = run("evaluate", *files, *write_truth(tmp_path, form), "--json")
    record = json.loads(answer.out)
    assert record["points"] == V
    assert record["median_cm"] == 0.0
    assert record["mean_cm"] > 1.0  # a tenth of the vertices, thrown across the sphere
    assert 0.05 < record["share_over_threshold"] <= 64 / V
    assert record["threshold_cm"] == 15.0


def test_truth_about_good_vertices_alone_is_0(run: Run, files: tuple[Path, ...], tmp_path: Path) -> None:
    (tmp_path / "t.txt").write_text("0 0\n5 5\n577 577\n")
    answer = run("evaluate", *files, "--truth", tmp_path / "t.txt")
    assert "mean error    0.00 cm" in answer.out
    (tmp_path / "t.txt").write_text("641 641\n")
    assert "mean error    0.00 cm" not in run("evaluate", *files, "--truth", tmp_path / "t.txt").out


def test_threshold(run: Run, files: tuple[Path, ...], tmp_path: Path) -> None:
    truth = write_truth(tmp_path, "column")
    all_wrong = json.loads(run("evaluate", *files, *truth, "--threshold", "0", "--json").out)
    none = json.loads(run("evaluate", *files, *truth, "--threshold", "1000", "--json").out)
    # vertex 0 itself may be among those thrown to it, and is right
    assert 63 / V <= all_wrong["share_over_threshold"] <= 64 / V
    assert none["share_over_threshold"] == 0.0


def test_seed_chooses_the_pairs_of_the_distortion(run: Run, files: tuple[Path, ...]) -> None:
    values = [json.loads(run("evaluate", *files, "--seed", seed, "--json").out)["distortion"] for seed in "010"]
    assert values[0] == values[2] != values[1]


def test_units_draw_different_curves(run: Run, files: tuple[Path, ...], tmp_path: Path) -> None:
    truth = write_truth(tmp_path, "column")
    for unit in ("cm", "x100"):
        run("evaluate", *files, *truth, "--curve", tmp_path / f"{unit}.png", "--unit", unit)
    assert (tmp_path / "cm.png").read_bytes() != (tmp_path / "x100.png").read_bytes()


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("--truth short.txt", "3 entries"),
        ("--truth none.txt", "none.txt"),
        ("--truth wide.txt", "not 1 a line"),
        ("--truth outside.txt", "not among the 642 vertices"),
        ("--truth short.txt --points short.txt short.txt", "choose one"),
        ("--curve c.png", "needs ground truth"),
        ("--truth t.csv --curve c.jpg", "c.jpg"),
        ("--truth t.csv --curve nowhere/c.png", "there is no folder"),
        ("--picture e.png", "needs ground truth"),
        ("--truth t.csv --picture e.jpg", "is a PNG"),
        ("--truth t.csv --picture no/e.png", "there is no folder"),
        ("--truth t.csv --picture e.png --curve e.png", "an output of this command"),
    ],
)
def test_what_cannot_be_is_told_before_the_work(
    run: Run, files: tuple[Path, ...], tmp_path: Path, words: str, told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("short.txt").write_text("0\n1\n2\n")
    Path("wide.txt").write_text("0 1 2\n")
    Path("outside.txt").write_text("0 642\n")
    write_truth(tmp_path, "pairs")
    refused(run("evaluate", *files, *words.split()), told, tmp_path, {path.name for path in tmp_path.iterdir()})


def test_a_map_of_other_shapes_is_refused(run: Run, files: tuple[Path, ...], tmp_path: Path, torus: Shape) -> None:
    save_shape(tmp_path / "t.ply", torus)
    answer = run("evaluate", files[0], tmp_path / "t.ply", files[2])
    assert answer.status == 1
    assert "runs the wrong way" in answer.err


@pytest.mark.parametrize("unit", ["cm", "x100"])
def test_the_errors_as_heat_on_both_shapes(
    run: Run, files: tuple[Path, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, unit: str
) -> None:
    from meshmatch.render import compose

    real, legends = compose.render_shapes, []

    def watched(panels: object, path: Path, look: compose.Look) -> None:
        legends.append(look.legend)
        real(panels, path, look)  # type: ignore[arg-type]

    monkeypatch.setattr(compose, "render_shapes", watched)
    picture = tmp_path / "errors.png"
    words = ("evaluate", *files, *write_truth(tmp_path, "column"), "--picture", picture, "--unit", unit)
    answer = run(*words)
    assert answer.status == 0, answer.err
    assert "cm" in answer.out
    with Image.open(picture) as image:
        pixels = np.asarray(image, dtype=int)
    red = (pixels[..., 0] > pixels[..., 2] + 60) & (pixels[..., 1] < 120)
    assert red.sum() > 500  # the vertices that were thrown to another place
    assert ("cm" if unit == "cm" else "sqrt(area)") in legends[0].title
