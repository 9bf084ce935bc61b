"""`prepare` makes a template of one shape, and of a folder shapes to learn from."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from meshmatch.api.prepare import PrepareConfig
from meshmatch.errors import InputError
from meshmatch.render import compose
from meshmatch.render.picture import Panel
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.shape import Shape
from meshmatch.templates.make import NodeConfig
from meshmatch.templates.template import load_template
from tests.cli.conftest import Answer, Run

# A sphere of area 1 has a radius of 0.28: a few nodes with a wide reach support it.
FEW = ("--nodes", "60", "--radius", "0.3")


@pytest.fixture(autouse=True)
def pictures(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Sequence[Panel], Path]]:
    """What was to be drawn; one test alone waits for a real picture."""
    asked: list[tuple[Sequence[Panel], Path]] = []
    monkeypatch.setattr(compose, "render_shapes", lambda panels, path, look: asked.append((panels, path)))
    return asked


def made(answer: Answer) -> dict[str, object]:
    record = answer.record
    return record


@pytest.fixture
def folder(tmp_path: Path, sphere: Shape) -> Path:
    """Three registered shapes: a sphere, stretched in three ways."""
    shapes = tmp_path / "eggs"
    shapes.mkdir()
    for n in range(3):
        save_shape(shapes / f"egg{n}.ply", Shape(sphere.verts * [1, 1 + 0.2 * n, 1], sphere.faces))
    return shapes


@pytest.mark.parametrize("name", ["eggs", "eggs/.", "link"])
def test_a_folder_is_not_prepared_into_itself(run: Run, folder: Path, tmp_path: Path, name: str) -> None:
    (tmp_path / "link").symlink_to("eggs")
    before = sorted(folder.iterdir())
    answer = run("prepare", folder, "-o", tmp_path / name, *FEW)
    assert answer.status == 1
    assert "into itself" in answer.err
    assert sorted(folder.iterdir()) == before


@pytest.mark.parametrize("count", ["3", "10001"])
def test_too_few_and_too_many_nodes_are_refused(run: Run, folder: Path, tmp_path: Path, count: str) -> None:
    answer = run("prepare", folder, "-o", tmp_path / "out", "--nodes", count)
    assert answer.status == 2
    assert "--nodes" in answer.err
    assert not (tmp_path / "out").exists()


def test_one_shape_becomes_a_template(
    run: Run, two: tuple[Path, Path], tmp_path: Path, pictures: list[tuple[Sequence[Panel], Path]]
) -> None:
    record = made(run("prepare", two[0], "-o", tmp_path / "out", *FEW, "--json"))
    template = load_template(tmp_path / "out" / "template.safetensors")
    assert record["template_hash"] == template.hash
    assert record["nodes"] == template.K >= 60
    assert (record["vertices"], template.radius) == (642, 0.3)
    [([panel], path)] = pictures
    assert path == tmp_path / "out" / "nodes.png"
    assert np.array_equal(panel.points, template.nodes)


def test_radii_grow_instead_of_nodes(run: Run, two: tuple[Path, Path], tmp_path: Path) -> None:
    words = ("prepare", two[0], "--strategy", "uniform", "--nodes", "40", "--radius", "0.15", "--json", "-o")
    assert made(run(*words, tmp_path / "more"))["nodes"] > 40
    assert made(run(*words, tmp_path / "grown", "--grow-radii"))["nodes"] == 40
    template = load_template(tmp_path / "grown" / "template.safetensors")
    assert isinstance(template.radius, np.ndarray) and template.radius.min() >= 0.15
    record = made(run("info", tmp_path / "grown" / "template.safetensors", "--json"))
    assert record["radius"] == template.reach > record["smallest_radius"] >= 0.15


def test_the_nodes_are_drawn(run: Run, two: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    monkeypatch.setattr("meshmatch.render.picture.HEIGHT", 240)
    made(run("prepare", two[0], "-o", tmp_path / "out", *FEW, "--json"))
    with Image.open(tmp_path / "out" / "nodes.png") as drawn:
        assert min(drawn.size) > 100


def test_parts_need_labels_and_use_them(run: Run, two: tuple[Path, Path], sphere: Shape, tmp_path: Path) -> None:
    np.save(tmp_path / "labels.npy", (sphere.verts[:, 2] > 0).astype(int))
    words = ("prepare", two[0], "-o", tmp_path / "out", "--strategy", "parts", *FEW)
    assert run(*words).status == 1
    made(run(*words, "--labels", tmp_path / "labels.npy", "--json"))
    assert set(load_template(tmp_path / "out" / "template.safetensors").labels) == {0, 1}
    np.save(tmp_path / "labels.npy", np.zeros(5, int))
    answer = run(*words, "--labels", tmp_path / "labels.npy")
    assert answer.status == 1
    assert "5 labels" in answer.err


def test_labels_follow_their_vertices_through_repair(run: Run, sphere: Shape, tmp_path: Path) -> None:
    verts = np.concatenate([[[0.0, 0.0, 0.5]], sphere.verts])  # a vertex that no face uses comes first
    save_shape(tmp_path / "a.ply", Shape(verts, sphere.faces + 1))
    np.save(tmp_path / "labels.npy", np.concatenate([[0], (sphere.verts[:, 2] > 0).astype(int)]))
    words = ("--strategy", "parts", "--labels", tmp_path / "labels.npy")
    made(run("prepare", tmp_path / "a.ply", "-o", tmp_path / "out", *words, *FEW, "--json"))
    template = load_template(tmp_path / "out" / "template.safetensors")
    height = template.shape.verts[:, 2]
    clear = np.abs(height) > 1e-9  # not on the equator, where rounding decides
    assert np.array_equal(template.labels[clear], height[clear] > 0)


def test_options_reach_the_config(run: Run, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    heard: list[PrepareConfig] = []

    def stop(shapes: Path, output: Path, config: PrepareConfig, progress: object) -> None:
        heard.append(config)
        raise InputError("far enough")

    monkeypatch.setattr("meshmatch.api.prepare.prepare", stop)
    words = "--strategy uniform --nodes 70 --radius 0.35 --grow-radii --seed 1 --faces 600 --decimate meshlab"
    words += " --template egg1 --align near --scale sphere --mirror no --landmarks .tip.npy"
    assert run("prepare", folder, "-o", tmp_path / "out").status == 1
    assert run("prepare", folder, "-o", tmp_path / "out", *words.split()).status == 1
    nodes = NodeConfig("uniform", 70, 0.35, seed=1, grow=True)
    assert heard == [PrepareConfig(), PrepareConfig(nodes, 600, "meshlab", "egg1", "near", "sphere", "no", ".tip.npy")]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["nothing.ply"], "nothing.ply"),
        (["a.ply", "--radius", "0.01", "--nodes", "60", "--strategy", "uniform"], "vert"),
        (["a.ply", "--template", "b.ply"], "folder"),
        (["empty"], "no shapes"),
    ],
)
def test_what_cannot_be_is_told(
    run: Run, two: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], told: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("empty").mkdir()
    answer = run("prepare", *words, "-o", "out")
    assert answer.status == 1
    assert told in answer.err
    assert not Path("out/template.safetensors").exists()


def test_an_output_folder_that_cannot_be(run: Run, two: tuple[Path, Path]) -> None:
    for verb in (("prepare", two[0]), ("train",)):
        answer = run(*verb, "-o", two[1])
        assert answer.status == 1
        assert "cannot make the folder" in answer.err


def test_quiet(run: Run, two: tuple[Path, Path], tmp_path: Path) -> None:
    answer = run("prepare", two[0], "-o", tmp_path / "out", *FEW, "--quiet")
    assert (answer.status, answer.out, answer.err) == (0, "", "")
