"""`match` and `register` hand everything on, and write all or nothing."""

import signal
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

import meshmatch
from meshmatch.api import matcher, matching
from meshmatch.errors import OutputError
from meshmatch.fitting.fit import Fit
from meshmatch.maps.files import load_map
from meshmatch.models.trained import TrainedModel
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.formats.gltf import Document
from meshmatch.shapes.repair import repair
from meshmatch.shapes.shape import Shape
from meshmatch.templates.template import Template
from tests.cli.conftest import FakeMatching, Run, fake_fit
from tests.models.small_model import small_card

FACES = np.array([[0, 1, 2], [0, 2, 3]])
CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])


@pytest.mark.parametrize("suffix", [".npy", ".npz", ".csv", ".txt", ".mat", ".json"])
def test_match_writes_the_map(run: Run, two: tuple[Path, Path], stub: FakeMatching, suffix: str) -> None:
    output = two[0].with_name(f"map{suffix}")
    answer = run("match", *two, "-o", output)
    assert answer.status == 0
    assert answer.out == ""
    found = load_map(output, load_shape(two[0]), load_shape(two[1]))
    assert found.index.tolist() == [i % 1600 for i in range(642)]
    assert sorted(path.name for path in output.parent.iterdir()) == sorted(["a.ply", "b.ply", output.name])


def test_match_says_what_it_did(run: Run, two: tuple[Path, Path], stub: FakeMatching) -> None:
    said = run("match", *two, "-o", two[0].with_name("map.npy")).err
    for words in (
        "3 faces dropped",
        "a.ply: good fit, up +y, front -z",
        "for each of the 642 vertices of a.ply its vertex of b.ply (2.5 s)",
    ):
        assert words in said


def test_match_json_is_one_line_of_data(run: Run, two: tuple[Path, Path], stub: FakeMatching) -> None:
    stub.verdict, stub.reasons = "fair", ("a hand is far",)
    output = two[0].with_name("map.npy")
    answer = run("match", *two, "-o", output, "--json", "--refine", "latent", "--seed", "3")
    assert answer.out.count("\n") == 1
    record = answer.record
    assert record["output"] == str(output)
    assert (record["source"], record["target"]) == ("a.ply", "b.ply")
    assert (record["source_vertices"], record["target_vertices"]) == (642, 1600)
    assert (record["verdict"], record["reasons"]) == ("fair", ["a hand is far"])
    assert (record["refine"], record["seed"], record["model"]) == ("latent", 3, "human")
    assert record["seconds"] == 2.5
    assert record["notes"] == ["a.ply: 3 faces dropped"]
    assert [each["shape"] for each in record["fits"]] == ["a.ply", "b.ply"]
    assert record["fits"][0]["residual"] == 0.0123
    assert record["fits"][0]["regularity"] == {"inverted": 0.001, "volume": 0.25}


def test_match_draws_a_picture(run: Run, two: tuple[Path, Path], stub: FakeMatching) -> None:
    picture, output = two[0].with_name("both.png"), two[0].with_name("map.npy")
    answer = run("match", *two, "-o", output, "--picture", picture, "--json")
    assert f"drew {picture}" in answer.err
    assert answer.record["picture"] == str(picture)
    with Image.open(picture) as image:
        pixels = np.asarray(image)
        assert image.size[0] > 1.3 * image.size[1]  # side by side
    assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > 1000  # and in colors
    assert output.exists()


def test_the_picture_lacks_what_a_fit_left_out(run: Run, two: tuple[Path, Path], stub: FakeMatching) -> None:
    def fit_of_upper_half(shape: Shape, *args: Any) -> Fit:
        upper = replace(shape, weights=shape.verts[:, 1] > np.median(shape.verts[:, 1]))
        return replace(fake_fit(shape, *args), repaired=repair(upper))

    stub.make_fit = fit_of_upper_half
    picture = two[0].with_name("both.png")
    answer = run("match", *two, "-o", two[0].with_name("map.npy"), "--picture", picture)
    assert f"drew {picture}: corresponding points in the same color, without what was left out" in answer.err


def test_a_real_ctrl_c_in_the_long_work(run: Run, two: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    def slow(*_: object, **__: object) -> None:
        signal.raise_signal(signal.SIGINT)
        pytest.fail("the signal was swallowed")

    monkeypatch.setattr(matching, "match", slow)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background ignores it
    try:
        answer = run("match", *two, "-o", two[0].with_name("map.npy"), "--picture", two[0].with_name("p.png"))
    finally:
        signal.signal(signal.SIGINT, before)
    assert answer.status == 130
    assert answer.err.splitlines() == ["interrupted: no file is half-written"]
    assert sorted(path.name for path in two[0].parent.iterdir()) == ["a.ply", "b.ply"]


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".off", ".stl", ".glb"])
def test_register_writes_the_template_in_the_frame_of_the_file(
    run: Run, two: tuple[Path, Path], stub: FakeMatching, suffix: str
) -> None:
    output = two[0].with_name(f"fitted{suffix}")
    answer = run("register", two[0], "-o", output)
    assert answer.status == 0
    assert answer.out == ""
    fitted, made = load_shape(output), fake_fit(load_shape(two[0]))
    wanted = 2.0 * made.points + [10.0, 0, 0]
    assert np.allclose(fitted.verts[fitted.faces], wanted[made.faces])
    assert "good fit, up +y, front -z" in answer.err
    assert f"{meshmatch.measure_distance(two[0], output)}\n" in answer.err


def test_register_stands_upright_in_a_glb(run: Run, two: tuple[Path, Path], stub: FakeMatching) -> None:
    """By a node, where the shape's file has no axes; its vertices are in the frame of the file."""
    stub.make_fit = partial(fake_fit, up="+z")
    output = two[0].with_name("fitted.glb")
    answer = run("register", two[0], "-o", output)
    assert "a node turns the template upright, along y" in answer.err
    wanted = 2.0 * fake_fit(load_shape(two[0])).points + [10.0, 0, 0]
    np.testing.assert_allclose(load_shape(output).verts, wanted @ [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-5)
    np.testing.assert_allclose(Document(output, output.read_bytes()).accessor(0), wanted, atol=1e-5)
    save_shape(two[0].with_suffix(".glb"), load_shape(two[0]))
    answer = run("register", two[0].with_suffix(".glb"), "-o", output)
    assert answer.status == 0 and "a node turns" not in answer.err
    np.testing.assert_allclose(load_shape(output).verts, wanted, atol=1e-5)
    answer = run("register", two[0], "--onto", two[1], "-o", output)
    assert f"a node turns {two[0].name} upright, along y" in answer.err


def test_register_keeps_the_file_of_a_mesh_of_your_own(run: Run, two: tuple[Path, Path], stub: FakeMatching) -> None:
    """All but positions, as wrap does; --template says the same from the other side."""
    base = two[0].with_name("base.obj")
    save_shape(base, load_shape(two[0]))
    words = base.read_text().splitlines()
    first = next(k for k, line in enumerate(words) if line.startswith("f"))
    words[first:first] = ["vt 0.5 0.5", "g mine"]
    base.write_text("\n".join(["# made by hand", *words, "f 1/1 2/1 3/1 4/1", ""]))
    onto, template = (two[0].with_name(name) for name in ("onto.obj", "template.obj"))
    assert (answer := run("register", base, "--onto", two[1], "-o", onto)).status == 0, answer.err
    assert (answer := run("register", two[1], "--template", base, "-o", template)).status == 0, answer.err
    assert template.read_text() == onto.read_text()
    assert {"# made by hand", "g mine", "vt 0.5 0.5", "f 1/1 2/1 3/1 4/1"} <= set(onto.read_text().splitlines())
    answer = run("register", two[1], "--template", base, "--onto", two[0], "-o", onto)
    assert answer.status == 1 and "--onto does not go with --template" in answer.err


def test_register_draws_the_template_over_the_shape(
    run: Run, two: tuple[Path, Path], stub: FakeMatching, monkeypatch: pytest.MonkeyPatch
) -> None:
    picture = two[0].with_name("p.png")
    answer = run("register", two[0], "-o", two[0].with_name("fitted.ply"), "--picture", picture, "--json")
    assert answer.record["picture"] == str(picture)
    assert f"drew {picture}" in answer.err
    with Image.open(picture) as image:
        assert len(np.unique(np.asarray(image).reshape(-1, 3), axis=0)) > 1000

    def failing(*_: object, **__: object) -> None:
        raise OutputError("the disk is full")

    monkeypatch.setattr("meshmatch.render.compose.compose_fit", failing)
    words = ("register", two[0], "-o", two[0].with_name("second.ply"), "--picture", picture)
    assert run(*words).status == 1
    assert two[0].with_name("second.ply").exists()


def test_register_json(run: Run, two: tuple[Path, Path], stub: FakeMatching) -> None:
    answer = run("register", two[0], "-o", two[0].with_name("fitted.ply"), "--json", "--quiet")
    record = answer.record
    assert answer.err == ""
    assert (record["shape"], record["verdict"], record["up"]) == ("a.ply", "good", "+y")
    wanted = meshmatch.measure_distance(two[0], two[0].with_name("fitted.ply"))
    assert record["distance"] == pytest.approx({"mean": wanted.mean, "most": wanted.most, "unit": "file"})
    assert record["output"] == str(two[0].with_name("fitted.ply"))


def test_register_says_what_repair_did(run: Run, two: tuple[Path, Path], stub: FakeMatching, sphere: Shape) -> None:
    faces = np.concatenate([sphere.faces, sphere.faces[:3]])
    save_shape(two[0], Shape(sphere.verts, faces))
    output = two[0].with_name("fitted.ply")
    answer = run("register", two[0], "-o", output, "--json")
    (note,) = answer.record["notes"]
    assert note.startswith("a.ply: 3 ")
    assert note in " ".join(answer.err.split())
    whole = run("register", two[1], "-o", output, "--json")
    assert whole.record["notes"] == []
    assert "b.ply: 3" not in whole.err


def test_register_in_full_resolution(
    run: Run, two: tuple[Path, Path], stub: FakeMatching, sphere: Shape, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A translation of all nodes moves the dense template by as much, then out of the core frame."""
    nodes = sphere.verts[:42]
    template = Template("ball", Shape(CORNERS, FACES), sphere, nodes, 1.2, np.zeros(4, int), ("all",), np.arange(4))
    moved = replace(fake_fit(sphere), template_hash=template.hash, vectors=np.tile([0.0, 0.0, 5.0], (42, 1)))
    stub.make_fit = lambda *_, **__: moved
    network = SimpleNamespace(config=SimpleNamespace(field="mls"))
    model = TrainedModel(small_card(), template, network)  # type: ignore[arg-type]
    monkeypatch.setattr(matcher, "as_model", lambda name: model)
    output = two[0].with_name("fitted.ply")
    answer = run("register", two[0], "-o", output, "--dense", "--json", "--model", "human")
    assert (answer.status, answer.record["vertices"]) == (0, 642)
    fitted = load_shape(output)
    assert np.allclose(fitted.verts, 2.0 * (sphere.verts + np.array([0, 0, 5])) + np.array([10, 0, 0]), atol=1e-5)
    assert np.array_equal(fitted.faces, sphere.faces)


def test_full_resolution_needs_the_template_of_the_fit(run: Run, two: tuple[Path, Path], stub: FakeMatching) -> None:
    answer = run("register", two[0], "-o", two[0].with_name("fitted.ply"), "--dense")
    assert answer.status == 1
    assert "another template" in answer.err
    assert not two[0].with_name("fitted.ply").exists()
