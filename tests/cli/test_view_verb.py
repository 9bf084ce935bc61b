"""`view` writes one page, of shapes that it matches or whose map is given, and all or nothing."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from meshmatch.fitting.fit_config import FitConfig
from meshmatch.geometry.frames import Frame
from meshmatch.maps import MAP_SUFFIXES
from meshmatch.maps.files import save_map
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.shape import Shape
from tests.cli.conftest import FakeMatching, Run, fake_fit

TURN = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])


def words_of(path: Path) -> dict[str, Any]:
    """What the page says of itself."""
    found = re.search(r'<script type="application/json" id="words">(.*?)</script>', path.read_text("utf-8"))
    assert found is not None
    return dict(json.loads(found[1]))


def nearest(a: Shape, b: Shape, **words: Any) -> VertexMap:
    return VertexMap.between(a, b, np.linalg.norm(a.verts[:, None] - b.verts[None], axis=2).argmin(axis=1), **words)


@pytest.fixture
def known(two: tuple[Path, Path]) -> tuple[Path, Path, Path]:
    """Two shapes, and a map from the first to the second."""
    path = two[0].with_name("map.npz")
    save_map(path, nearest(load_shape(two[0]), load_shape(two[1]), verdict="fair", reasons=("so so",)))
    return *two, path


@pytest.fixture(autouse=True)
def maps_and_fits(stub: FakeMatching) -> None:
    """A fake match maps to the nearest vertices, and its fits are turned."""
    stub.reasons = ("an arm is missing",)
    stub.make_map = nearest
    stub.make_fit = lambda shape, verdict, reasons=(): fake_fit(
        shape, verdict, frame=Frame(2.0, TURN, np.zeros(3)), front="+z"
    )


@pytest.mark.parametrize("suffix", MAP_SUFFIXES)
def test_a_map_of_any_format(run: Run, known: tuple[Path, Path, Path], suffix: str) -> None:
    a, b, _ = known
    path, page = a.with_name(f"m{suffix}"), a.with_name("page.html")
    save_map(path, nearest(load_shape(a), load_shape(b)))
    answer = run("view", a, b, "--map", path, "-o", page)
    assert (answer.status, answer.out) == (0, "")
    words = words_of(page)
    assert (words["source"]["name"], words["target"]["name"]) == ("a.ply", "b.ply")
    assert (words["source"]["vertices"], words["target"]["vertices"]) == (642, 1600)
    assert f"wrote {page}" in answer.err


def test_json(run: Run, known: tuple[Path, Path, Path]) -> None:
    page = known[0].with_name("page.html")
    answer = run("view", *known[:2], "--map", known[2], "-o", page, "--json", "--quiet")
    assert answer.err == ""
    record = json.loads(answer.out)
    assert (record["output"], record["map"]) == (str(page), str(known[2]))
    assert (record["source"], record["target"]) == ("a.ply", "b.ply")
    assert (record["verdict"], record["reasons"]) == ("fair", ["so so"])
    assert record["drawn_vertices"] == [642, 1600]
    assert record["bytes"] == page.stat().st_size
    assert words_of(page)["verdict"] == "fair"


def test_without_a_map_the_two_are_matched(run: Run, two: tuple[Path, Path], stub: FakeMatching) -> None:
    page = two[0].with_name("page.html")
    words = ("--refine", "latent", "--seed", "7", "--up", "z", "--front", "-y", "--threads", "1")
    answer = run("view", *two, "-o", page, "--json", *words)
    assert answer.status == 0
    config = FitConfig(refine="latent", seed=7, up="z", front="-y")
    assert (stub.called["config"], stub.called["threads"]) == ((config, config), 1)
    assert "3 faces dropped" in answer.err
    record = json.loads(answer.out)
    assert (record["refine"], record["seed"], record["seconds"]) == ("latent", 7, 2.5)
    # it stands as it was fitted
    extent = np.ptp(load_shape(two[1]).verts @ TURN.T, axis=0)
    assert words_of(page)["target"]["extent"] == pytest.approx(
        extent / extent.max() * words_of(page)["target"]["size"], rel=1e-3
    )


def test_a_poor_fit_is_shown_unless_strict(run: Run, two: tuple[Path, Path], stub: FakeMatching) -> None:
    stub.verdict = "poor"
    page = two[0].with_name("page.html")
    answer = run("view", *two, "-o", page, "--strict")
    assert answer.status == 1
    assert "an arm is missing" in answer.err
    assert not page.exists()
    answer = run("view", *reversed(two), "-o", page, "--quiet")
    assert (answer.status, answer.err) == (0, "warning: the map is poor: an arm is missing\n")
    assert words_of(page)["verdict"] == "poor"
    # nor is its orientation believed: a torus around z is flat to the front
    extent = words_of(page)["source"]["extent"]
    assert extent[0] == pytest.approx(extent[1], rel=0.02)


@pytest.mark.parametrize(("up", "flat"), [("z", 1), ("x", 2)])
def test_with_a_map_up_and_front_say_how_the_source_stands(
    run: Run, known: tuple[Path, Path, Path], torus: Shape, up: str, flat: int
) -> None:
    twice, page = known[0].with_name("identity.npz"), known[0].with_name("page.html")
    save_map(twice, VertexMap.identity(torus))
    words = ("--map", twice, "--up", up, "--front", {"z": "y", "x": "z"}[up])
    assert run("view", known[1], known[1], "-o", page, *words).status == 0
    for side in ("source", "target"):
        extent = words_of(page)[side]["extent"]
        assert int(np.argmin(extent)) == flat
    answer = run("view", known[1], known[1], "-o", page, "--map", twice, "--up", "z", "--front", "-z")
    assert answer.status == 1
    assert "lie along one axis" in answer.err


def test_a_gltf_says_itself_which_way_is_up(run: Run, torus: Shape, tmp_path: Path) -> None:
    file, page = tmp_path / "t.glb", tmp_path / "page.html"
    save_shape(file, Shape(torus.verts[:, [2, 0, 1]], torus.faces))  # around x: its width is least
    save_map(tmp_path / "m.npy", VertexMap.identity(load_shape(file)))
    assert run("view", file, file, "--map", tmp_path / "m.npy", "-o", page).status == 0
    assert int(np.argmin(words_of(page)["source"]["extent"])) == 0


def test_clouds(run: Run, known: tuple[Path, Path, Path]) -> None:
    cloud, page = known[0].with_name("cloud.npy"), known[0].with_name("page.html")
    np.save(cloud, load_shape(known[1]).verts)
    for source, target in ((known[0], cloud), (cloud, known[0])):
        path = known[0].with_name("m.csv")
        save_map(path, nearest(load_shape(source), load_shape(target)))
        assert run("view", source, target, "--map", path, "-o", page).status == 0
        words = words_of(page)
        assert [words[side]["cloud"] for side in ("source", "target")] == [source == cloud, target == cloud]


def painted(path: Path, shape: Shape) -> Path:
    """The shape with an image on it, as obj, mtl and png."""
    Image.new("RGB", (8, 8), (200, 100, 0)).save(path.with_name("skin.png"))
    path.with_name("skin.mtl").write_text("newmtl skin\nmap_Kd skin.png\n")
    lines = ["mtllib skin.mtl", "usemtl skin"]
    lines += [f"v {x} {y} {z}" for x, y, z in shape.verts.tolist()]
    lines += ["vt 0 0", "vt 1 0", "vt 0 1"]
    lines += [f"f {a}/1 {b}/2 {c}/3" for a, b, c in (shape.faces + 1).tolist()]
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_texture_is_worn_by_both(run: Run, known: tuple[Path, Path, Path], sphere: Shape) -> None:
    source, page = painted(known[0].with_name("painted.obj"), sphere), known[0].with_name("page.html")
    words = ("--map", known[0].with_name("m.npy"), "-o", page)
    save_map(words[1], nearest(sphere, load_shape(known[1])))
    assert run("view", source, known[1], *words).status == 0
    assert words_of(page)["look"] == {"kind": "texture", "side": "source"}
    assert words_of(page)["source"]["look"]["images"] == ["image/png"]
    save_map(words[1], nearest(load_shape(known[1]), sphere))
    assert run("view", known[1], source, *words).status == 0
    assert words_of(page)["look"] == {"kind": "texture", "side": "target"}


def test_colors_of_both_shapes(run: Run, known: tuple[Path, Path, Path], sphere: Shape) -> None:
    colored, page = known[0].with_name("colored.ply"), known[0].with_name("page.html")
    colors = np.concatenate([np.abs(sphere.verts), np.ones((sphere.V, 1))], axis=1)
    save_shape(colored, Shape(sphere.verts, sphere.faces, "colored", colors))
    save_map(known[2], VertexMap.identity(sphere))
    assert run("view", colored, colored, "--map", known[2], "-o", page).status == 0
    words = words_of(page)
    assert (words["look"], words["own"]) == ({"kind": "colors", "side": "source"}, True)


def test_a_texture_that_is_missing_is_said_and_the_rest_shown(
    run: Run, known: tuple[Path, Path, Path], sphere: Shape
) -> None:
    source, page = painted(known[0].with_name("painted.obj"), sphere), known[0].with_name("page.html")
    source.with_name("skin.png").unlink()
    answer = run("view", source, known[1], "--map", known[2], "-o", page)
    assert answer.status == 0
    assert "shown without its look: " in answer.err
    assert "skin.png" in answer.err
    assert words_of(page)["look"] is None


def test_vertex_colors_are_shown_where_the_materials_are_missing(run: Run, known: tuple[Path, Path, Path]) -> None:
    source, page = known[0].with_suffix(".obj"), known[0].with_name("page.html")
    shape = load_shape(known[0])
    save_shape(source, Shape(shape.verts, shape.faces, "", np.full((shape.V, 4), 0.5)))
    source.write_text(source.read_text().replace("f ", "vt 0 0\nmtllib a.mtl\nusemtl skin\nf ", 1))
    for name, missing in (("map_Kd skin.png", "skin.png"), ("", "")):
        source.with_name("a.mtl").write_text(f"newmtl skin\n{name}\n")
        answer = run("view", source, known[1], "--map", known[2], "-o", page)
        assert answer.status == 0 and missing in answer.err
        assert words_of(page)["look"] == {"kind": "colors", "side": "source"}
