"""Shapes in coordinates of a country: what is written and drawn keeps its shape, however few digits a format has."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from meshmatch.api.pictures import picture
from meshmatch.api.texture import transfer_texture
from meshmatch.errors import MeshmatchWarning, OutputError
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.render.picture import Look
from meshmatch.shapes.dressed_files import save_textured
from meshmatch.shapes.files import load_shape, save_shape, save_upright
from meshmatch.shapes.formats import TexturedMesh, gltf_write
from meshmatch.shapes.formats.gltf import Document
from meshmatch.shapes.formats.gltf_edit import Editor
from meshmatch.shapes.formats.gltf_write import choose_origin, write_morphs
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.textured_files import load_appearance
from meshmatch.transfer.bake import BakeOptions
from tests.render.pairs import Pair, bump, shuffled_pair
from tests.render.test_page import page_of

PLACES = {"UTM": (512345.678, 4612345.678, 120.25), "millimetres": (5e6, -7e6, 10.0), "one axis": (0.0, 0.0, 1e8)}


def placed(shape: Shape, place: str) -> Shape:
    return Shape(shape.verts + PLACES[place], shape.faces, shape.name, shape.colors)


@pytest.mark.parametrize("place", list(PLACES))
@pytest.mark.parametrize("cloud", [False, True])
def test_a_glb_keeps_every_vertex_in_place(tmp_path: Path, sphere: Shape, place: str, cloud: bool) -> None:
    shape = placed(sphere, place)
    shape = Shape(shape.verts, []) if cloud else shape
    save_shape(tmp_path / "a.glb", shape)
    np.testing.assert_allclose(load_shape(tmp_path / "a.glb").verts, shape.verts, rtol=0, atol=2e-7)
    scene = trimesh.load_scene(tmp_path / "a.glb")  # an independent reader that knows nodes
    np.testing.assert_allclose(scene.bounds.mean(axis=0), shape.bounds.mean(axis=0), rtol=0, atol=2e-7)
    turn = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    assert save_upright(tmp_path / "b.glb", shape, turn)
    np.testing.assert_allclose(load_shape(tmp_path / "b.glb").verts, shape.verts @ turn.T, rtol=0, atol=2e-7)
    assert not save_upright(tmp_path / "b.ply", shape, turn)
    np.testing.assert_array_equal(load_shape(tmp_path / "b.ply").verts, shape.verts)


def test_positions_that_were_single_stay_what_they_were(tmp_path: Path, sphere: Shape) -> None:
    verts = (sphere.verts * 40 + PLACES["UTM"]).astype(np.float32)
    save_shape(tmp_path / "a.glb", Shape(verts, sphere.faces))
    np.testing.assert_array_equal(load_shape(tmp_path / "a.glb").verts, verts)


@pytest.mark.parametrize("middle", [(0, 0, 0), (0, 0.9, 0), (3, -2, 1)])
def test_a_shape_near_the_origin_is_written_as_it_is(sphere: Shape, middle: tuple[float, ...]) -> None:
    assert not choose_origin(sphere.verts + middle).any()


@pytest.mark.parametrize("stray", [(0, 0, 0), (1e7, 0, 0)])
def test_a_stray_vertex_costs_the_others_nothing(tmp_path: Path, sphere: Shape, stray: tuple[float, ...]) -> None:
    verts = np.concatenate([sphere.verts + PLACES["UTM"], [stray]])
    save_shape(tmp_path / "a.glb", Shape(verts, sphere.faces))
    np.testing.assert_allclose(load_shape(tmp_path / "a.glb").verts[:-1], verts[:-1], rtol=0, atol=2e-7)
    near = np.concatenate([sphere.verts, [[1e7, 0, 0]]])
    save_shape(tmp_path / "b.glb", Shape(near, sphere.faces))
    np.testing.assert_allclose(load_shape(tmp_path / "b.glb").verts, near, rtol=0, atol=2e-7)


def test_all_vertices_at_one_place(tmp_path: Path) -> None:
    verts = np.tile(PLACES["UTM"], (3, 1))
    save_shape(tmp_path / "a.glb", Shape(verts, [[0, 1, 2]]))
    np.testing.assert_array_equal(load_shape(tmp_path / "a.glb").verts, verts)


def test_textured_and_morphing_files(tmp_path: Path, sphere: Shape) -> None:
    far = placed(sphere, "UTM")
    uv = np.zeros((sphere.F, 3, 2))
    image = np.full((2, 2, 4), 255, np.uint8)
    for name in ("a.glb", "a.obj"):
        save_textured(tmp_path / name, TexturedMesh(far.verts, far.faces, uv), image)
        back = load_shape(tmp_path / name).verts[: sphere.V]
        np.testing.assert_allclose(back, far.verts, rtol=0, atol=2e-7 if name == "a.glb" else 0)
    write_morphs(tmp_path / "m.glb", far, {"larger": far.verts + 0.1 * sphere.verts})
    np.testing.assert_allclose(load_shape(tmp_path / "m.glb").verts, far.verts, rtol=0, atol=2e-7)


def test_an_stl_says_that_it_cannot(tmp_path: Path, sphere: Shape) -> None:
    save_shape(tmp_path / "near.stl", sphere)  # any warning is an error here
    with pytest.warns(MeshmatchWarning, match=r"move by up to 0\.2"):
        save_shape(tmp_path / "far.stl", placed(sphere, "UTM"))


@pytest.mark.parametrize("place", ["UTM", "one axis"])
def test_a_picture_does_not_depend_on_the_place(tmp_path: Path, make_sphere, place: str) -> None:
    ball = make_sphere(2)
    shape = Shape(ball.verts * [1, 0.6, 1.7], ball.faces)
    look = Look(size=(60, 60), up="z", front="y")
    for name, one in (("near", shape), ("far", placed(shape, place))):
        picture([one], tmp_path / f"{name}.png", look=look)
    near, far = (np.asarray(Image.open(tmp_path / f"{name}.png")).astype(int) for name in ("near", "far"))
    assert np.abs(near - far).max() <= 3


@pytest.mark.parametrize("place", ["millimetres"])
def test_a_baked_texture_shows_the_colors_that_were_there(tmp_path: Path, make_sphere, place: str) -> None:
    ball = make_sphere(3)
    colors = np.concatenate([ball.verts / 3 + 0.5, np.ones((ball.V, 1))], axis=1)
    path = tmp_path / "a.ply"
    save_shape(path, Shape(ball.verts + PLACES[place], ball.faces, "ball", colors))
    shape = load_shape(path)
    made = transfer_texture(
        path, path, VertexMap.between(shape, shape, np.arange(shape.V)), options=BakeOptions(size=128)
    )
    made.save(tmp_path / "a.glb")
    back = load_shape(tmp_path / "a.glb")
    np.testing.assert_allclose(back.verts[: shape.V], shape.verts, rtol=0, atol=2e-7)
    look = load_appearance(tmp_path / "a.glb", back)
    column, row = np.floor(look.uv.mean(axis=1) * 128).astype(int).T
    shown = look.materials[0].image[row, column, :3] / 255
    expected = ball.verts[ball.faces].mean(axis=1) / 3 + 0.5
    assert np.abs(shown - expected).max() < 0.04


@pytest.mark.parametrize("place", list(PLACES))
def test_a_page_does_not_depend_on_the_place(tmp_path: Path, make_sphere, place: str) -> None:
    near = shuffled_pair(bump(make_sphere(2)))
    shapes = [placed(shape, place) for shape in (near.source, near.target)]
    far = Pair(
        *shapes,
        VertexMap.between(*shapes, near.there.index, verdict="good"),
        VertexMap.between(*shapes[::-1], near.back.index, verdict="good"),
    )
    turns = np.eye(3), np.eye(3)
    pages = [page_of(tmp_path / "a.html", pair, rotations=turns).arrays for pair in (near, far)]
    for name in ("source.position", "target.position", "source.normal", "target.normal", "source.place"):
        one, other = (page[name].astype(int) for page in pages)
        assert np.abs(one - other).max() <= 1, name


@pytest.mark.parametrize("suffix", [".glb", ".stl"])
def test_what_32_bits_cannot_hold_is_refused(sphere: Shape, tmp_path: Path, suffix: str) -> None:
    """Infinite numbers make no file that others can read."""
    huge = Shape(sphere.verts * 1e39, sphere.faces)
    with pytest.raises(OutputError, match=f"beyond 3.4e\\+38, the largest number of a {suffix} file"):
        save_shape(tmp_path / f"huge{suffix}", huge)
    assert list(tmp_path.iterdir()) == []
    save_shape(tmp_path / "huge.ply", huge)
    assert np.array_equal(load_shape(tmp_path / "huge.ply").verts, huge.verts)


def test_a_glb_that_would_be_larger_than_one_can_be_is_refused(
    sphere: Shape, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A sequence of hundreds of shapes reaches 4 GiB, and so may a file that gets a rig."""
    path = tmp_path / "sequence.glb"
    targets = {f"{k}": sphere.verts * (1 + k) for k in range(20)}
    write_morphs(path, sphere, targets)
    held = path.read_bytes()
    assert Editor(Document(path, held)).to_bytes() == held
    path.unlink()
    monkeypatch.setattr(gltf_write, "_MAX_BYTES", len(held) - 1)
    with pytest.raises(OutputError, match="becomes larger than a glb can be"):
        write_morphs(path, sphere, targets)
    with pytest.raises(OutputError, match=r"sequence\.glb becomes larger than a glb can be"):
        Editor(Document(path, held)).to_bytes()
    assert not path.exists()
