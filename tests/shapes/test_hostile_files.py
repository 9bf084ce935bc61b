"""Files that are damaged on purpose: one line of error each, no warning, no crash, no memory."""

import base64
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from meshmatch.cli import main
from meshmatch.errors import InputError
from meshmatch.shapes import formats, input_files
from meshmatch.shapes.files import list_meshes, load_shape, save_shape
from meshmatch.shapes.formats import gltf, ply_rows
from meshmatch.shapes.formats.gltf_attributes import read_skin
from meshmatch.shapes.input_files import read_npy
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.textured_files import find_appearance
from tests.transfer.skinned import write_skinned_glb


def refused(path: Path, content: bytes, words: str) -> None:
    path.write_bytes(content)
    with pytest.raises(InputError, match=words) as told:
        load_shape(path)
    assert "\n" not in told.value.message


def ply(*lines: str, body: str = "0 0 0\n1 0 0\n0 1 0\n") -> bytes:
    return "\n".join(["ply", "format ascii 1.0", *lines, "end_header", body]).encode()


XYZ = [f"property float {axis}" for axis in "xyz"]


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_ply_comments_may_name_the_end_of_the_header(tmp_path: Path, end: str) -> None:
    content = ply("comment end_header", "comment made by end_header tool", "element vertex 3", *XYZ)
    (tmp_path / "a.ply").write_bytes(content.replace(b"\n", end.encode()))
    assert load_shape(tmp_path / "a.ply").V == 3


def test_ply_other_elements_may_be_anything(tmp_path: Path) -> None:
    """Only what is read has to be as it is read."""
    lines = ["element vertex 3", *XYZ, "element edge 1", "property int a", "element face 1"]
    content = ply(*lines, "property list uchar int vertex_indices", body="0 0 0 1 0 0 0 1 0\n7\n3 0 1 2\n")
    (tmp_path / "a.ply").write_bytes(content)
    assert load_shape(tmp_path / "a.ply").faces.tolist() == [[0, 1, 2]]


def test_obj_with_texture_coordinates_that_are_no_numbers(tmp_path: Path) -> None:
    path = tmp_path / "a.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nf 1/1 2/99999999999999999999 3/1\n")
    with pytest.raises(InputError, match="texture coordinate"):
        find_appearance(path, load_shape(path))


def test_damaged_stl_says_nothing_else(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n"
    text = f"solid x\n{lines}{lines}endsolid x\n"
    for old in ("normal 0 0 1", "normal 0 0 1\nouter", "vertex 1 0 0"):
        (tmp_path / "a.stl").write_text(text.replace(old, old.replace("0", "?", 1)))
        code = main(["info", str(tmp_path / "a.stl")])
        assert capsys.readouterr().err.count("\n") == (2 if code else 0)


SIGNALLING = np.array([0x7F800001, 0x3F800000, 0x80000000], np.uint32).view(np.float32)


@pytest.mark.parametrize("order", ["<", ">"])
def test_npy_with_nans_that_signal(tmp_path: Path, order: str) -> None:
    """Warnings are errors here; a zero keeps its sign."""
    np.save(tmp_path / "a.npy", SIGNALLING.astype(SIGNALLING.dtype.newbyteorder(order), copy=False))
    found = read_npy(tmp_path / "a.npy").astype(np.float64)
    assert np.isnan(found[0]) and found[1] == 1 and np.signbit(found[2])


def test_gltf_with_nans_that_signal(tmp_path: Path) -> None:
    path = broken(tmp_path)
    words = json.loads(path.read_text())
    view = words["bufferViews"][words["accessors"][3]["bufferView"]]
    data = bytearray(base64.b64decode(words["buffers"][0]["uri"].partition("base64,")[2]))
    data[view.get("byteOffset", 0) : view.get("byteOffset", 0) + 4] = SIGNALLING[:1].tobytes()
    words["buffers"][0]["uri"] = f"data:;base64,{base64.b64encode(data).decode()}"
    path.write_text(json.dumps(words))
    assert np.isfinite(read_skin(path, path.read_bytes())[0].data).all()


@pytest.mark.parametrize("code", [0x110000, 0xD800])
def test_npy_with_characters_that_do_not_exist(tmp_path: Path, code: int) -> None:
    np.save(tmp_path / "a.npy", np.array(["ab", "cd"]))
    content = bytearray((tmp_path / "a.npy").read_bytes())
    content[-4:] = code.to_bytes(4, "little")
    (tmp_path / "a.npy").write_bytes(content)
    with pytest.raises(InputError, match="characters"):
        read_npy(tmp_path / "a.npy")


def broken(tmp_path: Path, *changes: tuple[tuple[str | int, ...], object]) -> Path:
    """The skinned glb of the tests as a gltf, with other values at places of its description."""
    write_skinned_glb(tmp_path / "whole.glb")
    data = (tmp_path / "whole.glb").read_bytes()
    size = int.from_bytes(data[12:16], "little")
    words = json.loads(data[20 : 20 + size])
    body = base64.b64encode(data[28 + size :]).decode()
    words["buffers"][0]["uri"] = f"data:application/octet-stream;base64,{body}"
    for place, value in changes:
        inner = words
        for key in place[:-1]:
            inner = inner[key]
        inner[place[-1]] = value
    path = tmp_path / "a.gltf"
    path.write_text(json.dumps(words))
    return path


def test_gltf_counts_that_are_no_numbers(tmp_path: Path) -> None:
    path = broken(tmp_path, (("accessors", 0, "count"), float("inf")))
    with pytest.raises(InputError, match="makes no sense"):
        load_shape(path)
    with pytest.raises(InputError, match="makes no sense"):
        read_skin(path, path.read_bytes())


@pytest.mark.parametrize("key", ["translation", "rotation", "scale"])
@pytest.mark.parametrize("value", [float("nan"), 1e308])
def test_gltf_nodes_that_stand_nowhere(tmp_path: Path, key: str, value: float) -> None:
    """Warnings are errors here: none is told, whoever reads the file."""
    four = 4 if key == "rotation" else 3
    path = broken(tmp_path, (("nodes", 0, key), [value] * four), (("nodes", 4, key), [value] * four))
    shape = load_shape(path)
    assert shape.V == 10
    assert sum(count for _, count in list_meshes(path)) == 10
    find_appearance(path, shape)
    read_skin(path, path.read_bytes())


def test_a_skin_that_names_a_joint_it_does_not_have(tmp_path: Path) -> None:
    """Joints as floats, of which one is below 0: counted from the end it would be another joint."""
    path = broken(tmp_path, (("accessors", 2, "componentType"), 5122))
    assert len(read_skin(path, path.read_bytes())[0].data) == 8
    path = broken(tmp_path, (("skins", 0, "joints"), [1]))
    with pytest.raises(InputError, match="not among the 1"):
        read_skin(path, path.read_bytes())


def test_gltf_with_a_buffer_that_claims_a_terabyte(tmp_path: Path) -> None:
    """An accessor without a view is all zeros, of as many as it says: bounded by what is there."""
    path = broken(
        tmp_path,
        (("buffers", 0, "byteLength"), 10**12),
        (("accessors", 4), {"componentType": 5126, "type": "VEC3", "count": 10**7}),
    )
    with pytest.raises(InputError, match="makes 13,333,333 vertices"):
        load_shape(path)
    path = broken(tmp_path, (("accessors", 4), {"componentType": 5126, "type": "VEC3", "count": 10**6}))
    with pytest.raises(InputError, match="promises 1000000 values"):
        load_shape(path)


def test_gltf_of_one_mesh_many_times(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    copies = [{"mesh": 0}] * 100
    path = broken(tmp_path, (("nodes",), copies), (("scenes", 0, "nodes"), list(range(100))))
    assert load_shape(path).V == 400
    monkeypatch.setattr(formats, "BASE_ELEMENTS", 300)
    with pytest.raises(InputError, match=r"makes [0-9,]+ vertices and faces"):
        load_shape(path)
    monkeypatch.undo()
    monkeypatch.setattr(gltf, "MAX_NODES", 90)
    with pytest.raises(InputError, match="over 90 nodes"):
        load_shape(path)


@pytest.mark.filterwarnings("ignore::meshmatch.errors.MeshmatchWarning")
@pytest.mark.parametrize("case", ["points", "faces", "a polygon", "rows of unequal length"])
def test_ply_of_more_than_its_bytes_can_mean(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, case: str) -> None:
    """Numbers of one byte become eight, and a polygon of a thousand corners a thousand faces."""
    axes = [f"property char {axis}" for axis in "xyz"]
    some = ["element vertex 3", *axes, "element face {n}", "property list {size} uchar vertex_indices"]
    lines, body = {
        "points": (["element vertex 5000", *axes], bytes(15_000)),
        "faces": ([line.format(n=4000, size="uchar") for line in some], bytes(9) + bytes([3, 0, 1, 2]) * 4000),
        "a polygon": (
            [line.format(n=1, size="int") for line in some],
            bytes(9) + (9000).to_bytes(4, "little") + bytes(9000),
        ),
        "rows of unequal length": (
            [line.format(n=2500, size="uchar") for line in some],
            bytes(9) + bytes([1, 0, 2, 0, 0]) * 1250,
        ),
    }[case]
    content = "\n".join(["ply", "format binary_little_endian 1.0", *lines, "end_header", ""]).encode() + body
    (tmp_path / "a.ply").write_bytes(content)
    load_shape(tmp_path / "a.ply")
    monkeypatch.setattr(formats, "BASE_ELEMENTS", 100)
    monkeypatch.setattr(ply_rows, "BASE_ELEMENTS", 100)
    refused(tmp_path / "a.ply", content, r"makes [0-9,]+ vertices and faces|has lists of [0-9,]+ numbers")


@pytest.mark.parametrize("suffix", [".obj", ".off", ".xyz", ".stl", ".npy"])
def test_more_than_the_bytes_of_a_file_can_mean(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str) -> None:
    corners = "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n"
    content = {
        ".obj": "v 0 0 0\nv 1 0 0\nv 0 1 0\n" + "f 1 2 3\n" * 1000,
        ".off": "OFF\n3 1000 0\n0 0 0\n1 0 0\n0 1 0\n" + "3 0 1 2\n" * 1000,
        ".xyz": "0 0 0\n1 0 0\n0 1 0\n" * 333,
        ".stl": f"solid x\n{corners * 1000}endsolid x\n",
    }.get(suffix, "")
    path = tmp_path / f"a{suffix}"
    if suffix == ".npy":
        np.save(path, np.zeros((1000, 3), np.float16))
    else:
        path.write_text(content)
    assert load_shape(path).V > 2
    monkeypatch.setattr(formats, "BASE_ELEMENTS", 100)
    refused(path, path.read_bytes(), "vertices and faces")


def test_text_of_more_lines_than_it_may_have(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(input_files, "MEMORY_ALLOWANCE", 10_000)
    for name, content in (("a.obj", b"v 0 0 0\n"), ("a.xyz", b"0 0 0\n"), ("a.off", b"OFF 1 0 0\n0 0 0\n")):
        refused(tmp_path / name, content + b"\n" * 1000, "promises too much")
    monkeypatch.setattr(input_files, "LARGEST_TEXT", 900)
    refused(tmp_path / "a.ply", ply("element vertex 300", *XYZ, body="0 0 0\n" * 300), "too large for a file of text")


# 100,000 points that stand two thousand times in a scene; an index of fifty million zeros, deflated.
BOMBS = r"""
import json, resource, struct, zipfile
from meshmatch.errors import InputError
from meshmatch.maps.files import load_map
from meshmatch.shapes.files import load_shape

body = bytes(1_200_000)
words = json.dumps({
    "asset": {"version": "2.0"}, "nodes": [{"mesh": 0}] * 2000,
    "meshes": [{"primitives": [{"mode": 0, "attributes": {"POSITION": 0}}]}],
    "accessors": [{"bufferView": 0, "componentType": 5126, "count": 100_000, "type": "VEC3"}],
    "bufferViews": [{"buffer": 0, "byteLength": len(body)}], "buffers": [{"byteLength": len(body)}],
}).encode()
words += b" " * (-len(words) % 4)
head = struct.pack("<4sIII4s", b"glTF", 2, 28 + len(words) + len(body), len(words), b"JSON")
open("a.glb", "wb").write(head + words + struct.pack("<I4s", len(body), b"BIN\0") + body)
with zipfile.ZipFile("a.npz", "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
    with archive.open("index.npy", "w") as file:
        header = "{'descr': '|i1', 'fortran_order': False, 'shape': (50331648,), }".ljust(117) + "\n"
        file.write(b"\x93NUMPY\1\0" + len(header).to_bytes(2, "little") + header.encode())
        for _ in range(48):
            file.write(bytes(1 << 20))
resource.setrlimit(resource.RLIMIT_AS, (3 << 29, 3 << 29))
for read, name in ((load_shape, "a.glb"), (load_map, "a.npz")):
    try:
        read(name)
    except InputError as error:
        print(error)
"""


def test_small_files_that_promise_gigabytes(tmp_path: Path) -> None:
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).resolve().parents[2])}
    command = [sys.executable, "-c", BOMBS]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
    errors = done.stdout.splitlines()
    assert "a.glb makes" in errors[0] and "index.npy promises" in errors[1]


def test_files_that_are_too_large_are_not_read(tmp_path: Path) -> None:
    with (tmp_path / "a.ply").open("wb") as file:
        file.truncate(20 << 30)  # sparse
    with pytest.raises(InputError, match=r"a\.ply is too large: 20\.0 GiB"):
        load_shape(tmp_path / "a.ply")


def test_names_that_no_file_can_have(tmp_path: Path) -> None:
    """Too long, or a link that leads to itself: given by the user, or by the file."""
    with pytest.raises(InputError, match="File name too long"):
        load_shape(tmp_path / ("x" * 300 + ".ply"))
    (tmp_path / "loop.bin").symlink_to("loop.bin")
    for name in ("x" * 300, "loop.bin"):
        path = broken(tmp_path, (("buffers", 0, "uri"), name))
        with pytest.raises(InputError, match="needs the file"):
            load_shape(path)
        path = tmp_path / "a.obj"
        path.write_text(f"mtllib {name}\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
        with pytest.raises(InputError, match="which is not there"):
            find_appearance(path, load_shape(path))


def test_huge_coordinates_cause_no_warning(tmp_path: Path) -> None:
    """Warnings are errors here."""
    points = np.random.default_rng(0).normal(size=(300, 3))
    points[0] = 1e59
    save_shape(tmp_path / "a.ply", Shape(points, []))
    shape = load_shape(tmp_path / "a.ply")
    assert shape.V == 300 and np.isfinite(shape.vertex_normals).all() and np.isfinite(shape.area)
