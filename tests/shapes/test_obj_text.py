"""An obj whose vertices moved is the same text with other numbers, and takes its materials along."""

import warnings
from pathlib import Path

import numpy as np
import pytest

from meshmatch.errors import InputError, MeshmatchWarning, OptionError
from meshmatch.shapes.deformed_files import save_moved
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.formats.obj_text import with_positions
from meshmatch.shapes.shape import Shape

TEXT = b"""# a leaf; v 1 2 3 is no vertex here
mtllib leaf.mtl
o leaf
v  0 0 0 1 0 0
\tv 1 0 0 # the second
v 1 1 0
v 0 1 0
vt 0 0
vt 1 1
vn 0 0 1
vn 0 0 1
g half
usemtl green
s 1
f 1/1/1 2/2/1 3/2/1 4//1
"""
MOVED = np.array([[0.5, 0.25, 3.0], [1e-9, 2.0, 0.0], [np.nan, 0, 0], [1 / 3, 0.0, -7.0]])
UPRIGHT = np.tile([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]], (4, 1, 1))


@pytest.mark.parametrize("ends", [b"\n", b"\r\n"])
def test_only_the_numbers_change(ends: bytes) -> None:
    given = TEXT.replace(b"\n", ends)
    lines, before = with_positions("leaf.obj", given, MOVED, UPRIGHT).split(ends), given.split(ends)
    assert lines[3:7] == [b"v  0.5 0.25 3 1 0 0", b"\tv 1e-09 2 0 # the second", b"v 1 1 0", b"v 0.333333333333 0 -7"]
    assert lines[9:11] == [b"vn 0 -1 0", b"vn 0 0 1"]  # no face has the second normal
    assert [*lines[:3], *lines[7:9], *lines[11:]] == [*before[:3], *before[7:9], *before[11:]]


def test_written_then_read_gives_the_positions(tmp_path: Path) -> None:
    verts = np.random.default_rng(0).normal(size=(4, 3))
    for k, text in enumerate((TEXT, TEXT.replace(b"v 1 1 0", b"v 1 \\\n1 0"), TEXT.replace(b"\n", b"\r"))):
        path = tmp_path / f"{k}.obj"
        path.write_bytes(with_positions("leaf.obj", text, verts, UPRIGHT))
        found = load_shape(path)
        assert np.allclose(found.verts, verts, rtol=1e-11)
        assert found.F == 2


def test_another_number_of_vertices_is_refused() -> None:
    with pytest.raises(InputError, match=r"vertices of leaf\.obj"):
        with_positions("leaf.obj", TEXT, MOVED[:3])


@pytest.fixture
def leaf(tmp_path: Path) -> Path:
    """An obj with an mtl and an image in a folder below."""
    folder = tmp_path / "given"
    (folder / "maps").mkdir(parents=True)
    (folder / "leaf.obj").write_bytes(TEXT)
    (folder / "leaf.mtl").write_text("newmtl green\nmap_Kd -s 1 1 maps\\Leaf.png\nmap_Bump -bm 0.5 gone.png\n")
    (folder / "maps" / "leaf.png").write_bytes(b"not looked into")
    return folder / "leaf.obj"


def test_materials_come_along(leaf: Path, tmp_path: Path) -> None:
    shape = load_shape(leaf)
    out = tmp_path / "out"
    out.mkdir()
    with pytest.warns(MeshmatchWarning, match=r"gone\.png, which is not there"):
        save_moved(out / "new.obj", leaf, shape, UPRIGHT)
    assert sorted(path.name for path in out.rglob("*")) == ["leaf.mtl", "leaf.png", "maps", "new.obj"]
    assert (out / "maps" / "leaf.png").read_bytes() == b"not looked into"
    assert (out / "leaf.mtl").read_bytes() == leaf.with_name("leaf.mtl").read_bytes()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        save_moved(leaf.with_name("beside.obj"), leaf, shape, UPRIGHT)  # nothing to copy
    (out / "leaf.mtl").write_text("newmtl mine\n")
    with pytest.warns(MeshmatchWarning), pytest.raises(OptionError, match=r"another .*leaf\.mtl is there"):
        save_moved(out / "second.obj", leaf, shape, UPRIGHT)
    assert not (out / "second.obj").exists()
    assert (out / "leaf.mtl").read_text() == "newmtl mine\n"


def test_what_a_format_does_not_hold_is_told(leaf: Path, tmp_path: Path) -> None:
    shape = load_shape(leaf)
    told = r"new\.ply does not have .*the groups, the texture coordinates and the normals of leaf\.obj"
    with pytest.warns(MeshmatchWarning, match=told):
        save_moved(tmp_path / "new.ply", leaf, shape, UPRIGHT)
    assert np.array_equal(load_shape(tmp_path / "new.ply").verts, shape.verts)
    plain = Shape(shape.verts, shape.faces, "plain")
    save_shape(tmp_path / "plain.ply", plain)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        save_moved(tmp_path / "again.obj", tmp_path / "plain.ply", plain, UPRIGHT)
        save_moved(tmp_path / "mine.obj", None, plain, UPRIGHT)


def test_a_glb_keeps_its_texture(tmp_path: Path) -> None:
    original = Path("templates/samples/dancer-textured.glb").resolve()
    shape = load_shape(original)
    turns = np.tile(np.eye(3), (shape.V, 1, 1))
    save_moved(tmp_path / "new.glb", original, shape, turns)
    from meshmatch.shapes.textured_files import load_appearance

    again = load_shape(tmp_path / "new.glb")
    assert np.allclose(again.verts[: shape.V], shape.verts, atol=1e-5)
    before, after = load_appearance(original, shape), load_appearance(tmp_path / "new.glb", again)
    assert np.allclose(after.uv, before.uv, atol=1e-6)
    assert np.array_equal(after.materials[0].image, before.materials[0].image)
