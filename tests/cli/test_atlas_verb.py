"""``meshmatch atlas`` on meshes that share their vertices."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from meshmatch import Atlas
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.shape import Shape
from tests.cli.conftest import Run
from tests.collections.ellipsoids import ellipsoids
from tests.conftest import icosphere, vtp_arrays


@pytest.fixture(autouse=True)
def no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is in the folder has tests of its own."""
    monkeypatch.setattr("meshmatch.collections.atlas_pictures.render_shapes", lambda *_: None)


@pytest.fixture
def shapes(tmp_path: Path) -> Path:
    folder = tmp_path / "shapes"
    folder.mkdir()
    given = ellipsoids(8, splits=1)
    for k, points in enumerate(given.points):
        save_shape(folder / f"egg-{k}.ply", Shape(points, given.faces))
    return folder


def group(path: Path, numbers: range) -> Path:
    path.write_text("".join(f"egg-{k}.ply\n" for k in numbers))
    return path


def test_a_folder_of_meshes_becomes_an_atlas(run: Run, shapes: Path, tmp_path: Path) -> None:
    output, names = tmp_path / "atlas", ("thin", "thick")
    groups = [group(tmp_path / f"{name}.txt", range(4 * k, 4 * k + 4)) for k, name in enumerate(names)]
    words = ("atlas", shapes, "-o", output, "--groups", *groups, "--samples", 2, "--modes", 2, "--seed", 3, "--json")
    answer = run(*words)
    told = answer.record
    assert told["output"] == str(output)
    assert sorted(told["files"]) == sorted(path.name for path in output.iterdir())
    assert (told["shapes"], told["modes"], told["seed"]) == (8, 2, 3)
    assert told["groups"]["names"] == list(names)
    assert told["groups"]["labellings"] == 70
    assert told["measures"]["counts"] == [1, 2]
    found = Atlas.load(output)
    plain = Atlas.of(ellipsoids(8, splits=1).points, found.faces, found.names, modes=2)
    assert np.allclose(found.scores, plain.scores)
    assert len(list((output / "samples").iterdir())) == 2
    assert "thin and thick (4 and 4 shapes): p = " in answer.err
    again = run(*words)
    assert again.status == 1
    assert "is not empty" in again.err


def test_what_is_chosen_is_done(run: Run, shapes: Path, tmp_path: Path) -> None:
    output = tmp_path / "atlas"
    answer = run(
        "atlas", shapes, "-o", output, "--no-measures", "--robust", "--scale", "remove", "-q", "--leave-out", "egg-0"
    )
    assert (answer.status, answer.out, answer.err) == (0, "", "")
    found = Atlas.load(output)
    assert found.robust and found.names == tuple(f"egg-{k}" for k in range(1, 8))
    assert found.scale == "remove"
    assert not (output / "measures.csv").exists()


def test_a_model_is_explained(run: Run, shapes: Path, tmp_path: Path) -> None:
    output, table = tmp_path / "atlas", tmp_path / "table.csv"
    rows = [f"egg-{k}.ply,{'ab'[k % 2]},{30 + k if k else 'NA'}" for k in range(8)]
    table.write_text("\n".join(["name,kind,age", *rows]) + "\n")
    words = ("atlas", shapes, "-o", output, "--metadata", table, "--permutations", 99, "--no-measures")
    answer = run(*words, "--model", "shape ~ log(size) + kind")
    assert answer.status == 0
    assert Atlas.load(output).scale == "remove"
    head, size, kind, *others = [line.split() for line in answer.out.splitlines()]
    assert head[:8] == ["term", "df", "SS", "MS", "R2", "F", "Z", "p"]
    assert (size[:2], kind[:2]) == (["log(size)", "1"], ["kind", "1"])
    assert [line[:2] for line in others] == [["residuals", "5"], ["total", "7"]]
    assert "kind: 2 categories (a 4, b 4), compared with a" in answer.err
    shutil.rmtree(output)
    answer = run(*words, "--model", "form ~ age", "--json", "-q")
    assert "egg-0: left out of the model, as its age is missing" in answer.err
    told = answer.record["model"]
    assert (told["formula"], told["shapes"], told["permutations"]) == ("form ~ age", 7, 100)
    assert told["left_out"] == {"egg-0": "age"}
    (age,) = told["terms"]
    assert age["SS"] + told["residuals"]["SS"] == pytest.approx(told["total"]["SS"], rel=1e-4)
    lines = (output / "anova.csv").read_text().splitlines()
    assert lines[1].startswith(f"age,1,{age['SS']}")
    assert len((output / "effects.csv").read_text().splitlines()) == 1 + len(Atlas.load(output).mean)
    assert load_shape(output / "effects.vtp").V == len(Atlas.load(output).mean)
    assert not (output / "allometry.csv").exists()


def test_other_units_are_told(run: Run, shapes: Path, tmp_path: Path) -> None:
    given = ellipsoids(8, splits=1)
    save_shape(shapes / "egg-2.ply", Shape(1000 * given.points[2], given.faces))
    answer = run("atlas", shapes, "-o", tmp_path / "a", "--no-measures", "-q")
    assert "do the files have one unit?" in answer.err
    answer = run("atlas", shapes, "-o", tmp_path / "b", "--no-measures", "-q", "--scale", "remove")
    assert answer.err == ""


def test_a_shape_unlike_the_others_is_told(run: Run, shapes: Path, tmp_path: Path) -> None:
    given = ellipsoids(8, splits=1)
    save_shape(shapes / "egg-2.ply", Shape(given.points[2] * [1, 1, 0.2], given.faces))
    words = ("atlas", shapes, "--no-measures", "--permutations", 9, "--model", "form ~ size", "--format", "svg")
    answer = run(*words, "-o", tmp_path / "a", "--json", "-q")
    assert "warning: egg-2: unlike the others, and 86 % of mode 1" in answer.err
    told = answer.record
    assert told["outliers"] == ["egg-2"]
    charts = {"allometry.svg", "components.svg", "histogram.svg", "scree.svg"}
    assert charts <= set(told["files"])
    assert not any(name.endswith(".png") for name in told["files"])


def test_shapes_of_parts_are_superimposed_by_one(run: Run, tmp_path: Path) -> None:
    folder, rng, ball = tmp_path / "shapes", np.random.default_rng(0), icosphere(1)
    folder.mkdir()
    for k in range(6):
        verts = np.concatenate([ball.verts * [1, 1.3, 2], 0.5 * ball.verts + [0, 2 * rng.standard_normal(), 4]])
        save_shape(folder / f"{k}.ply", Shape(verts, np.concatenate([ball.faces, ball.faces + ball.V])))
    answer = run("atlas", folder, "-o", tmp_path / "a", "--align-by", "1", "--no-measures", "--json")
    assert answer.record["align_by"] == "1"
    found = Atlas.load(tmp_path / "a")
    assert len(found.modes) == 1 and np.abs(found.modes[0, : ball.V]).max() < 1e-6
    assert np.ptp(found.modes[0, ball.V :], axis=0) == pytest.approx(0, abs=1e-6)  # the other one moves as a whole


def test_mirror_images_are_compared(run: Run, shapes: Path, tmp_path: Path) -> None:
    output = tmp_path / "a"
    answer = run("atlas", shapes, "-o", output, "--no-measures", "--permutations", 20, "--symmetry")
    assert answer.status == 0
    assert "from its mirror image" in answer.err
    assert [line.split()[0] for line in answer.out.splitlines()] == [
        "term",
        "individual",
        "side",
        "fluctuating",
        "total",
    ]
    assert len((output / "asymmetry.csv").read_text().splitlines()) == 9
    told = json.loads((output / "atlas.json").read_text())["asymmetry"]
    assert told["of_mean"] < 0.01
    assert (output / "asymmetry.vtp").exists()


def test_left_and_right_ones_of_a_table(run: Run, shapes: Path, tmp_path: Path) -> None:
    """Each measured twice."""
    table, output, given = tmp_path / "table.csv", tmp_path / "atlas", ellipsoids(12, splits=1)
    for k in range(8, 12):
        save_shape(shapes / f"egg-{k}.ply", Shape(given.points[k], given.faces))
    rows = [f"egg-{k},{k // 4},{'left' if k % 2 else 'right'}" for k in range(12)]
    table.write_text("\n".join(["name,who,side", *rows]) + "\n")
    words = ("--symmetry", "--metadata", table, "--individuals", "who", "--sides", "side", "--permutations", 20)
    answer = run("atlas", shapes, "-o", output, "--no-measures", *words)
    assert answer.status == 0, answer.err
    assert "the sides differ by" in answer.err
    assert [line.split()[0] for line in answer.out.splitlines()] == [
        *("term", "individual", "side", "individual:side", "error", "total")
    ]
    assert len((output / "asymmetry.csv").read_text().splitlines()) == 4
    arrays = vtp_arrays(output / "asymmetry.vtp")
    assert {"side: right - left", "individual:side, p corrected", "fluctuating", "error"} <= set(arrays)


@pytest.mark.parametrize(
    "wrong",
    [
        *("nowhere", "file", "input", "both", "unknown", "statistic", "table", "space", "row", "part", "parts"),
        *("sides", "individuals", "no table"),
    ],
)
def test_what_is_refused_leaves_nothing(run: Run, shapes: Path, tmp_path: Path, wrong: str) -> None:
    output, one = tmp_path / "atlas", group(tmp_path / "one.txt", range(4))
    other = group(tmp_path / "other.txt", range(3, 7) if wrong == "both" else range(7, 12))
    table = tmp_path / "table.csv"
    table.write_text("name,x\negg-0,1\n")
    where = {"nowhere": tmp_path / "gone", "file": one}.get(wrong, shapes)
    more = {
        "both": ("--groups", one, other),
        "unknown": ("--groups", one, other),
        "statistic": ("--statistic", "hotelling"),
        "table": ("--metadata", one),
        "space": ("--model", "shape ~ size", "--space", "form"),
        "row": ("--model", "shape ~ x", "--metadata", table),
        "part": ("--align-by", "femur"),
        "parts": ("--align-by", "1", "--symmetry"),
        "sides": ("--symmetry", "--metadata", table, "--sides", "x"),
        "individuals": ("--individuals", "x", "--metadata", table),
        "no table": ("--symmetry", "--individuals", "x"),
    }
    before = sorted(tmp_path.rglob("*"))
    answer = run("atlas", where, "-o", shapes if wrong == "input" else output, *more.get(wrong, ()))
    assert answer.status == 1
    assert answer.err.startswith("error: ")
    assert answer.err.count("\n") == 2
    assert sorted(tmp_path.rglob("*")) == before
