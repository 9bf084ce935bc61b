"""`view` writes one page, of shapes that it matches or whose map is given, and all or nothing."""

import json
import re
from collections.abc import Callable
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
from tests.cli.conftest import Answer, FakeMatching, Run, fake_fit, refused, well

TURN = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
Show = Callable[[str], tuple[dict[str, Any], Answer]]


def nearest(a: Shape, b: Shape, **words: Any) -> VertexMap:
    return VertexMap.between(a, b, np.linalg.norm(a.verts[:, None] - b.verts[None], axis=2).argmin(axis=1), **words)


@pytest.fixture
def folder(two: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch) -> Path:
    """Two shapes, and a map from the first to the second."""
    monkeypatch.chdir(two[0].parent)
    save_map("map.npz", nearest(load_shape("a.ply"), load_shape("b.ply"), verdict="fair", reasons=("so so",)))
    return two[0].parent


@pytest.fixture
def show(run: Run, folder: Path) -> Show:
    """Write a page; what it says of itself, and what was told."""

    def call(words: str) -> tuple[dict[str, Any], Answer]:
        answer = well(run("view", *words.split(), "-o", "page.html"))
        text = Path("page.html").read_text("utf-8")
        found = re.search(r'<script type="application/json" id="words">(.*?)</script>', text)
        assert found is not None
        return dict(json.loads(found[1])), answer

    return call


@pytest.fixture(autouse=True)
def maps_and_fits(stub: FakeMatching) -> None:
    """A fake match maps to the nearest vertices, and its fits are turned."""
    stub.reasons = ("an arm is missing",)
    stub.make_map = nearest
    stub.make_fit = lambda shape, verdict, reasons=(): fake_fit(
        shape, verdict, frame=Frame(2.0, TURN, np.zeros(3)), front="+z"
    )


@pytest.mark.parametrize("suffix", MAP_SUFFIXES)
def test_a_map_of_any_format(show: Show, suffix: str) -> None:
    save_map(f"m{suffix}", nearest(load_shape("a.ply"), load_shape("b.ply")))
    words, answer = show(f"a.ply b.ply --map m{suffix}")
    assert answer.out == "" and "wrote page.html" in answer.err
    assert (words["source"]["name"], words["target"]["name"]) == ("a.ply", "b.ply")
    assert (words["source"]["vertices"], words["target"]["vertices"]) == (642, 1600)


def test_json(show: Show) -> None:
    words, answer = show("a.ply b.ply --map map.npz --json --quiet")
    assert answer.err == ""
    record = answer.record
    assert (record["output"], record["map"]) == ("page.html", "map.npz")
    assert (record["source"], record["target"]) == ("a.ply", "b.ply")
    assert (record["verdict"], record["reasons"]) == ("fair", ["so so"])
    assert record["drawn_vertices"] == [642, 1600]
    assert record["bytes"] == Path("page.html").stat().st_size
    assert words["verdict"] == "fair"


def test_without_a_map_the_two_are_matched(show: Show, stub: FakeMatching) -> None:
    words, answer = show("a.ply b.ply --json --refine latent --seed 7 --up z --front -y --threads 1")
    config = FitConfig(refine="latent", seed=7, up="z", front="-y")
    assert (stub.called["config"], stub.called["threads"]) == ((config, config), 1)
    assert "3 faces dropped" in answer.err
    record = answer.record
    assert (record["refine"], record["seed"], record["seconds"]) == ("latent", 7, 2.5)
    # it stands as it was fitted
    extent = np.ptp(load_shape("b.ply").verts @ TURN.T, axis=0)
    assert words["target"]["extent"] == pytest.approx(extent / extent.max() * words["target"]["size"], rel=1e-3)


def test_a_poor_fit_is_shown_unless_strict(run: Run, folder: Path, show: Show, stub: FakeMatching) -> None:
    stub.verdict = "poor"
    before = {path.name for path in folder.iterdir()}
    refused(run("view", "a.ply", "b.ply", "-o", "page.html", "--strict"), "an arm is missing", folder, before)
    words, answer = show("b.ply a.ply --quiet")
    assert answer.err == "warning: the map is poor: an arm is missing\n"
    assert words["verdict"] == "poor"
    # nor is its orientation believed: a torus around z is flat to the front
    extent = words["source"]["extent"]
    assert extent[0] == pytest.approx(extent[1], rel=0.02)


@pytest.mark.parametrize(("axes", "flat"), [("--up z --front y", 1), ("--up x --front z", 2)])
def test_with_a_map_up_and_front_say_how_the_source_stands(show: Show, torus: Shape, axes: str, flat: int) -> None:
    save_map("identity.npz", VertexMap.identity(torus))
    words, _ = show(f"b.ply b.ply --map identity.npz {axes}")
    assert [int(np.argmin(words[side]["extent"])) for side in ("source", "target")] == [flat, flat]


def test_up_and_front_lie_along_two_axes(run: Run, folder: Path) -> None:
    words = "a.ply b.ply --map map.npz --up z --front -z -o page.html"
    refused(run("view", *words.split()), "along one axis", folder, {path.name for path in folder.iterdir()})


def test_a_gltf_says_itself_which_way_is_up(show: Show, torus: Shape) -> None:
    save_shape("t.glb", Shape(torus.verts[:, [2, 0, 1]], torus.faces))  # around x: its width is least
    save_map("m.npy", VertexMap.identity(load_shape("t.glb")))
    assert int(np.argmin(show("t.glb t.glb --map m.npy")[0]["source"]["extent"])) == 0


@pytest.mark.parametrize(("source", "target"), [("a.ply", "cloud.npy"), ("cloud.npy", "a.ply")])
def test_clouds(show: Show, source: str, target: str) -> None:
    np.save("cloud.npy", load_shape("b.ply").verts)
    save_map("m.csv", nearest(load_shape(source), load_shape(target)))
    words, _ = show(f"{source} {target} --map m.csv")
    assert [words[side]["cloud"] for side in ("source", "target")] == [source == "cloud.npy", target == "cloud.npy"]


@pytest.fixture
def painted(folder: Path, sphere: Shape) -> None:
    """The sphere of a.ply with an image on it, as painted.obj, skin.mtl and skin.png."""
    Image.new("RGB", (8, 8), (200, 100, 0)).save("skin.png")
    Path("skin.mtl").write_text("newmtl skin\nmap_Kd skin.png\n")
    lines = ["mtllib skin.mtl", "usemtl skin"]
    lines += [f"v {x} {y} {z}" for x, y, z in sphere.verts.tolist()]
    lines += ["vt 0 0", "vt 1 0", "vt 0 1"]
    lines += [f"f {a}/1 {b}/2 {c}/3" for a, b, c in (sphere.faces + 1).tolist()]
    Path("painted.obj").write_text("\n".join(lines) + "\n")


def test_a_texture_is_worn_by_both(show: Show, painted: None, sphere: Shape, torus: Shape) -> None:
    save_map("m.npy", nearest(sphere, torus))
    words, _ = show("painted.obj b.ply --map m.npy")
    assert words["look"] == {"kind": "texture", "side": "source"}
    assert words["source"]["look"]["images"] == ["image/png"]
    save_map("m.npy", nearest(torus, sphere))
    assert show("b.ply painted.obj --map m.npy")[0]["look"] == {"kind": "texture", "side": "target"}


def test_colors_of_both_shapes(show: Show, sphere: Shape) -> None:
    colors = np.concatenate([np.abs(sphere.verts), np.ones((sphere.V, 1))], axis=1)
    save_shape("colored.ply", Shape(sphere.verts, sphere.faces, "colored", colors))
    save_map("map.npz", VertexMap.identity(sphere))
    words, _ = show("colored.ply colored.ply --map map.npz")
    assert (words["look"], words["own"]) == ({"kind": "colors", "side": "source"}, True)


def test_a_texture_that_is_missing_is_said_and_the_rest_shown(show: Show, painted: None) -> None:
    Path("skin.png").unlink()
    words, answer = show("painted.obj b.ply --map map.npz")
    assert "shown without its look: " in answer.err and "skin.png" in answer.err
    assert words["look"] is None


@pytest.mark.parametrize(("line", "missing"), [("map_Kd skin.png", "skin.png"), ("", "")])
def test_vertex_colors_are_shown_where_the_materials_are_missing(show: Show, line: str, missing: str) -> None:
    shape = load_shape("a.ply")
    save_shape("a.obj", Shape(shape.verts, shape.faces, "", np.full((shape.V, 4), 0.5)))
    text = Path("a.obj").read_text().replace("f ", "vt 0 0\nmtllib a.mtl\nusemtl skin\nf ", 1)
    Path("a.obj").write_text(text)
    Path("a.mtl").write_text(f"newmtl skin\n{line}\n")
    words, answer = show("a.obj b.ply --map map.npz")
    assert missing in answer.err
    assert words["look"] == {"kind": "colors", "side": "source"}
