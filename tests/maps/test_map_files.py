"""Every format: write then read is the same value; damaged or wrong files are told apart in words."""

import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat, savemat

from meshmatch.errors import InputError, OptionError, OutputError
from meshmatch.maps import MAP_SUFFIXES, files
from meshmatch.maps.files import load_map, save_map
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes import input_files
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.shape import Shape
from tests.maps.test_vertex_map import A, B, C, random_map

CARRIES = {".npy": ("index",), ".txt": ("index",), ".csv": ("index", "face", "barycentric", "confidence")}
EVERYTHING = (
    *("index", "face", "barycentric", "confidence", "source", "target", "verdict", "reasons"),
    *("source_vertices", "target_vertices", "source_hash", "target_hash", "source_up", "target_up"),
)


def same(a: VertexMap, b: VertexMap, names: tuple[str, ...]) -> None:
    for name in names:
        one, other = getattr(a, name), getattr(b, name)
        assert type(one) is type(other), name
        if isinstance(one, np.ndarray):
            assert one.dtype == other.dtype, name
            assert np.array_equal(one, other, equal_nan=name == "confidence"), name
        else:
            assert one == other, name


@pytest.mark.parametrize("suffix", MAP_SUFFIXES)
@pytest.mark.parametrize("kind", ["rich", "bare", "identity", "one vertex"])
def test_write_then_read(tmp_path: Path, suffix: str, kind: str) -> None:
    m = {
        "rich": random_map(A, B, 5),
        "bare": VertexMap("", "", np.array([4, 0, 4])),
        "identity": VertexMap.identity(C),
        "one vertex": VertexMap("a", "b", np.array([3]), reasons=("just one",), verdict="poor"),
    }[kind]
    path = tmp_path / f"map{suffix}"
    save_map(path, m)
    same(load_map(path), m, CARRIES.get(suffix, EVERYTHING))
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_axes_may_be_missing_and_are_checked(tmp_path: Path) -> None:
    """Files of older versions have none."""
    m, path = random_map(A, B, 5), tmp_path / "map.npz"
    save_map(path, m)
    with np.load(path) as file:
        known = dict(file)
    np.savez(path, **{name: array for name, array in known.items() if not name.endswith("_up")})
    found = load_map(path)
    assert (found.source_up, found.target_up) == ("", "")
    same(found, m, EVERYTHING[:-2])
    for odd in ("up", "+w", "z", "+y" * 100_000):
        np.savez(path, **known | {"target_up": np.array(odd)})
        with pytest.raises(InputError, match=r"up is one of \+x, -x") as caught:
            load_map(path)
        assert len(str(caught.value)) < 200


@pytest.mark.parametrize("suffix", MAP_SUFFIXES)
def test_the_shapes_fill_in_what_the_file_leaves_out(tmp_path: Path, suffix: str) -> None:
    m = random_map(A, B, 6)
    save_map(tmp_path / f"map{suffix}", m)
    found = load_map(tmp_path / f"map{suffix}", A, B)
    same(found, m, ("index", "source", "target", "source_vertices", "target_vertices", "source_hash", "target_hash"))


@pytest.mark.parametrize("suffix", MAP_SUFFIXES)
def test_the_same_map_gives_the_same_bytes(tmp_path: Path, suffix: str) -> None:
    for name in ("one", "two"):
        save_map(tmp_path / f"{name}{suffix}", random_map(A, B, 7))
    assert (tmp_path / f"one{suffix}").read_bytes() == (tmp_path / f"two{suffix}").read_bytes()


def test_npy_is_what_the_documents_say(tmp_path: Path) -> None:
    save_map(tmp_path / "map.NPY", random_map(A, B, 1))
    index = np.load(tmp_path / "map.NPY")
    assert index.dtype == np.int64
    assert index.shape == (A.V,)


def test_mat_counts_from_one_too(tmp_path: Path) -> None:
    m = random_map(A, B, 1)
    save_map(tmp_path / "map.mat", m)
    content = loadmat(tmp_path / "map.mat")
    assert np.array_equal(content["matlab_index"].ravel(), m.index + 1)
    assert np.array_equal(content["index"].ravel(), m.index)


def test_a_map_saved_by_matlab_may_count_from_one(tmp_path: Path) -> None:
    """`matlab_index` is what is edited there; the other array must not win without a word."""
    path = tmp_path / "map.mat"
    savemat(path, {"matlab_index": np.array([[3], [1], [2]], dtype=float)})
    np.testing.assert_array_equal(load_map(path).index, [2, 0, 1])
    savemat(path, {"matlab_index": np.array([3, 1, 2]), "index": np.array([2, 0, 0])})
    with pytest.raises(InputError, match="its matlab_index is not index \\+ 1"):
        load_map(path)


def test_maps_of_other_programs(tmp_path: Path) -> None:
    expected = [2, 0, 1]
    np.save(tmp_path / "column.npy", np.array(expected, dtype=np.uint16)[:, None])
    np.save(tmp_path / "half.npy", np.array(expected, dtype=np.float16))
    savemat(tmp_path / "double.mat", {"index": np.array(expected, dtype=float)})
    (tmp_path / "spaces.txt").write_text("# from somewhere\n2\n0\n\n1\n")
    (tmp_path / "excel.csv").write_text("﻿source_vertex, target_vertex\r\n0,2\r\n1,0\r\n2,1\r\n", encoding="utf-8")
    (tmp_path / "list.json").write_text("[2, 0, 1]")
    np.savez(tmp_path / "short.npz", index=np.array(expected))
    for path in sorted(tmp_path.iterdir()):
        assert load_map(path).index.tolist() == expected, path.name


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.npy", b"", "is empty"),
        ("a.npy", b"not an array", "not an npy file"),
        ("a.npz", b"PK\x03\x04 cut", "can be read"),
        ("a.mat", b"MATLAB 5.0 MAT-file" + b" " * 200, "not a MAT-file of version 5"),
        ("a.mat", b"short", "not a MAT-file of version 5"),
        ("a.mat", b"MATLAB 7.3 MAT-file" + b" " * 200, r"version 7\.3"),
        ("a.json", b"{", "can be read"),
        ("a.json", b'{"map": [1]}', "no 'index'"),
        ("a.json", b'{"index": ["a"]}', "whole numbers"),
        ("a.json", b'"index"', "no 'index'"),
        ("a.json", b'{"index": [1], "target": ' + b"[" * 500 + b"]" * 500 + b"}", "'target' is not text"),
        ("a.json", b'{"index": [1], "reasons": [["it lies far"]]}', "'reasons' is not text"),
        ("a.json", b'{"index": [1e300]}', "whole numbers"),
        ("a.csv", b"target_vertex,confidence\n0,1e300\n", "0..1"),
        ("a.csv", b"target_vertex\n", "index must be a list"),
        ("a.txt", b"# nothing\n", "index must be a list"),
        ("a.txt", b"1\ntwo\n", "two"),
        ("a.txt", b"1.5\n", "1.5"),
        ("a.csv", b"x,y\n1,2\n", "target_vertex"),
        ("a.csv", b"source_vertex,target_vertex\n1,2\n0,3\n", "in order"),
        ("a.csv", b"source_vertex,target_vertex\n0,2\n1\n", "line 3 has 1 cell, the first 2"),
        ("a.csv", b"source_vertex,target_vertex,confidence\n0,2,nan\n1,2,0.5\n", "0..1"),
    ],
)
def test_damaged_files(tmp_path: Path, name: str, content: bytes, message: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        load_map(tmp_path / name)
    assert name in caught.value.message
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("suffix", [".npy", ".npz"])
def test_a_map_that_promises_more_than_it_holds(tmp_path: Path, suffix: str) -> None:
    """Two hundred gigabytes in a header: told before anything is allocated."""
    header = str({"descr": "<i8", "fortran_order": False, "shape": (25 * 10**9,)}).ljust(117) + "\n"
    array = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header.encode() + b"\0" * 64
    path = tmp_path / f"a{suffix}"
    if suffix == ".npz":
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("index.npy", array)
    else:
        path.write_bytes(array)
    with pytest.raises(InputError, match=r"^a\.np[yz] .* promises 200000000000 bytes"):
        load_map(path)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.json", b"[0" + b",0" * 2000 + b"]"),
        ("a.json", b'{"index": [' + b"[]," * 2000 + b"[]]}"),
        ("a.json", b"[" + b'{"":0},' * 2000 + b"0]"),
        ("a.txt", b"0\n" * 2000),
        ("a.csv", b"target_vertex\n" + b"0\n" * 2000),
    ],
)
def test_text_that_would_take_too_much_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, content: bytes
) -> None:
    monkeypatch.setattr(input_files, "MEMORY_ALLOWANCE", 100_000)
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=rf"^{name} promises too much"):
        load_map(tmp_path / name)


@pytest.mark.parametrize("suffix", [".npy", ".npz", ".mat"])
def test_arrays_that_would_take_too_much_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str) -> None:
    """Of one byte each, where a map has eight; or deflated."""
    path, index = tmp_path / f"a{suffix}", np.zeros(5000, np.int8)
    if suffix == ".npy":
        np.save(path, index)
    elif suffix == ".npz":
        np.savez_compressed(path, index=index)
    else:
        savemat(path, {"index": index})
    load_map(path)
    monkeypatch.setattr(input_files, "MEMORY_ALLOWANCE", 60_000)
    with pytest.raises(InputError, match="promises too much"):
        load_map(path)


def test_a_signalling_nan_prints_no_warning(tmp_path: Path) -> None:
    """Warnings are errors here. NumPy's own nan is quiet; a damaged file may hold the other kind."""
    np.save(tmp_path / "a.npy", np.full(4, 0x7D01, np.uint16).view(np.float16))
    with pytest.raises(InputError, match="whole numbers"):
        load_map(tmp_path / "a.npy")


@pytest.mark.parametrize("suffix", [".npy", ".txt", ".csv", ".npz", ".mat", ".json"])
def test_confidence_that_is_not_known_stays_so(tmp_path: Path, suffix: str) -> None:
    made = VertexMap("a", "b", np.array([2, 0, 1]))
    path = tmp_path / f"map{suffix}"
    save_map(path, made)
    assert np.isnan(load_map(path).confidence).all() and np.isnan(made.compose(made).confidence).all()
    if suffix == ".json":
        assert json.loads(path.read_text())["confidence"] == [None] * 3


def test_a_truncated_npy_and_a_pickle(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.arange(1000))
    whole = (tmp_path / "a.npy").read_bytes()
    (tmp_path / "a.npy").write_bytes(whole[:2000])
    with pytest.raises(InputError, match=r"a\.npy"):
        load_map(tmp_path / "a.npy")
    np.save(tmp_path / "b.npy", np.array([{}], dtype=object), allow_pickle=True)
    with pytest.raises(InputError, match="Python objects"):
        load_map(tmp_path / "b.npy")
    np.savez(tmp_path / "c.npz", index=np.array([0]), face=np.array([{}], dtype=object))
    with pytest.raises(InputError, match="Python objects"):
        load_map(tmp_path / "c.npz")


def test_missing_files_folders_and_suffixes(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is no file"):
        load_map(tmp_path / "none.npy")
    (tmp_path / "folder.npy").mkdir()
    with pytest.raises(InputError, match="not a file"):
        load_map(tmp_path / "folder.npy")
    for call in (lambda: load_map(tmp_path / "a.xls"), lambda: save_map(tmp_path / "a", VertexMap.identity(A))):
        with pytest.raises(OptionError, match="not a format for maps") as caught:
            call()
        assert ".npz" in caught.value.hint
    with pytest.raises(OutputError, match="no folder"):
        save_map(tmp_path / "deeper" / "a.npy", VertexMap.identity(A))


def test_a_map_of_another_source_or_target(tmp_path: Path) -> None:
    path = tmp_path / "map.npy"
    np.save(path, np.zeros(7, dtype=int))
    with pytest.raises(InputError, match=r"map\.npy was made for another source: a mesh of 7 vertices, but a has 12"):
        load_map(path, A, B)
    np.save(path, np.full(A.V, B.V + 5))
    with pytest.raises(InputError, match=r"map\.npy: .* only 16"):
        load_map(path, A, B)
    np.save(path, np.arange(A.V) + B.V - A.V + 1)
    with pytest.raises(InputError, match="has only 16") as caught:
        load_map(path, A, B)
    assert "1-based" in caught.value.hint
    save_map(tmp_path / "map.json", random_map(A, C, 0))
    with pytest.raises(InputError, match=rf"another target: c of {C.V} vertices, but b has 16"):
        load_map(tmp_path / "map.json", A, B)
    record = json.loads((tmp_path / "map.json").read_text())
    record |= {"target_vertices": -1, "target_hash": ""}
    record["face"][0] = 10_000
    record["index"] = [0] * A.V
    (tmp_path / "map.json").write_text(json.dumps(record))
    with pytest.raises(InputError, match="names face 10000"):
        load_map(tmp_path / "map.json", A, B)


@pytest.mark.parametrize("suffix", MAP_SUFFIXES)
def test_the_wrong_direction_is_named(tmp_path: Path, suffix: str) -> None:
    save_map(tmp_path / f"map{suffix}", random_map(B, A, 0))
    with pytest.raises(InputError, match=rf"map\{suffix} runs the wrong way: from b to a") as caught:
        load_map(tmp_path / f"map{suffix}", A, B)
    assert "swap" in caught.value.hint


def test_a_shape_that_has_changed_is_refused(tmp_path: Path) -> None:
    save_map(tmp_path / "map.npz", random_map(A, B, 0))
    moved = type(A)(A.verts * 2, A.faces, "a")
    with pytest.raises(InputError, match=rf"another source: a \({A.hash}\), but a is {moved.hash}"):
        load_map(tmp_path / "map.npz", moved, B)
    save_map(tmp_path / "map.npy", random_map(A, B, 0))
    assert load_map(tmp_path / "map.npy", moved, B).source_hash == moved.hash


def test_the_list_of_suffixes_is_that_of_the_formats() -> None:
    assert tuple(files._FORMATS) == MAP_SUFFIXES


def test_shapes_to_check_may_be_files_or_arrays(tmp_path: Path, cube: Shape) -> None:
    save_map(tmp_path / "m.npz", VertexMap.identity(cube))
    save_shape(tmp_path / "cube.ply", cube)
    found = load_map(tmp_path / "m.npz", tmp_path / "cube.ply", (cube.verts, cube.faces))
    assert found.target_faces is not None
    with pytest.raises(InputError):
        load_map(tmp_path / "m.npz", cube.verts[:5])
