"""Numbers of vertices, and vertex colors: written and read, and what files get wrong."""

import base64
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from meshmatch.errors import InputError, MeshmatchWarning, OptionError
from meshmatch.shapes.colors import linear_to_srgb_alpha
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.formats.vtk import write_vtp
from meshmatch.shapes.formats.vtk_xml import point_arrays
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.label_files import labels_of, save_labels
from meshmatch.transfer.value_files import (
    Values,
    _make_unique,
    linear_colors,
    load_values,
    parse_blank,
    save_colors,
    save_values,
)
from tests.conftest import icosphere

SHAPE = icosphere(1)
NUMBERS = np.random.default_rng(0).normal(size=(SHAPE.V, 3)) * 10.0 ** np.arange(-20, 40, 20)


@pytest.mark.parametrize("suffix", [".npy", ".csv", ".NPY"])
@pytest.mark.parametrize("columns", [0, 1, 3])
def test_write_then_read(tmp_path: Path, suffix: str, columns: int) -> None:
    given = NUMBERS[:, 0].copy() if columns == 0 else NUMBERS[:, :columns].copy()
    given[7] = np.nan
    save_values(tmp_path / f"v{suffix}", Values(given), SHAPE)
    found = load_values(tmp_path / f"v{suffix}", SHAPE)
    if columns == 1 and suffix == ".csv":
        given = given[:, 0]  # a single column is a list
    assert np.array_equal(found.numbers, given, equal_nan=True)


def test_names_of_columns_stay(tmp_path: Path) -> None:
    (tmp_path / "v.csv").write_text("\ufeffheat, loss in %\n" + "1,2\n" * SHAPE.V, encoding="utf-8")
    found = load_values(tmp_path / "v.csv", SHAPE)
    assert found.names == ("heat", "loss in %")
    save_values(tmp_path / "w.csv", found, SHAPE)
    assert (tmp_path / "w.csv").read_text().splitlines()[:2] == ["vertex,heat,loss in %", "0,1.0,2.0"]
    assert load_values(tmp_path / "w.csv", SHAPE).names == found.names


def test_a_ply_has_a_property_for_each_number(tmp_path: Path) -> None:
    import trimesh

    save_values(tmp_path / "v.ply", Values(NUMBERS, ("heat", "x", "loss in %")), SHAPE)
    data = trimesh.load(tmp_path / "v.ply", process=False).metadata["_ply_raw"]["vertex"]["data"]
    for k, name in enumerate(("heat", "x_", "loss_in__")):
        assert data[name].dtype == np.float32
        assert np.array_equal(np.ravel(data[name]), NUMBERS[:, k].astype(np.float32))
    assert np.array_equal(load_shape(tmp_path / "v.ply").verts, SHAPE.verts)


@pytest.mark.parametrize("suffix", [".vtp", ".vtk"])
def test_vtk_has_an_array_for_each_number(tmp_path: Path, suffix: str) -> None:
    save_values(tmp_path / f"v{suffix}", Values(NUMBERS, ("heat", "heat", "loss in %")), SHAPE)
    data = (tmp_path / f"v{suffix}").read_bytes()
    if suffix == ".vtk":
        for k, name in enumerate((b"heat", b"heat_", b"loss_in_%")):
            begin = data.index(name + b" 1 42 double\n") + len(name) + 13
            assert np.array_equal(np.frombuffer(data, ">f8", 42, begin), NUMBERS[:, k])
    else:
        for k, name in enumerate((b"heat", b"heat_", b"loss in %")):
            text = data[data.index(b'Name="' + name + b'"') :]
            held = base64.b64decode(text[text.index(b">") + 1 : text.index(b"<")])
            assert np.array_equal(np.frombuffer(held, "<f8", 42, 8), NUMBERS[:, k])
    assert np.array_equal(load_shape(tmp_path / f"v{suffix}").verts, SHAPE.verts)


def rows(count: int, row: str = "1,2\n") -> Callable[[Path], object]:
    return lambda path: path.write_text(row * count)


def archive(path: Path) -> None:
    with path.open("wb") as file:
        np.savez(file, a=np.ones(42))


BAD: dict[str, tuple[str, Callable[[Path], object], str]] = {
    "not there": ("a.npy", lambda path: None, "there is no file"),
    "empty": ("a.csv", lambda path: path.touch(), "is empty"),
    "nothing but lines": ("a.csv", rows(9, "\n"), "is empty"),
    "too few": ("a.csv", rows(41), "41 rows, but sphere1 has 42 vertices"),
    "too many": ("a.npy", lambda path: np.save(path, np.ones((43, 2))), "43 rows"),
    "no columns": ("a.npy", lambda path: np.save(path, np.ones((42, 0))), "no columns"),
    "a cube": ("a.npy", lambda path: np.save(path, np.ones((42, 2, 2))), r"array of \(42, 2, 2\)"),
    "words": ("a.npy", lambda path: np.save(path, np.array(["a"] * 42)), "not numbers"),
    "ragged": ("a.csv", lambda path: path.write_text("1,2\n" * 41 + "1\n"), "line 42 has 1 cell, the first 2"),
    "a word": ("a.csv", lambda path: path.write_text("1\n" * 41 + "many\n"), "many"),
    "unsorted": ("a.csv", lambda path: path.write_text("vertex,v\n1,1\n0,1\n"), "in order"),
    "a header alone": ("a.csv", lambda path: path.write_text("vertex,v\n"), "has 0 rows"),
    "not text": ("a.csv", lambda path: path.write_bytes(b"\xff\xfe\x00"), "can be read"),
    "damaged": ("a.npy", lambda path: path.write_bytes(b"nonsense"), "is not an npy file"),
    "an archive": ("a.npy", archive, "several arrays"),
    "a suffix": ("a.mat", lambda path: path.write_text("x"), "not read from '.mat'"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_values_are_told_in_words(tmp_path: Path, case: str) -> None:
    name, make, words = BAD[case]
    make(tmp_path / name)
    with pytest.raises(InputError, match=words):
        load_values(tmp_path / name, SHAPE)


@pytest.mark.parametrize(
    ("text", "columns", "expected"),
    [
        ("nan", 2, [np.nan, np.nan]),
        ("0.5", 4, [0.5] * 4),
        ("1,0,0", 3, [1, 0, 0]),
        ("1 0 0", 4, [1, 0, 0, 1]),
        ("#ff0080", 3, [1, 0, 128 / 255]),
        ("#FF0080", 4, [1, 0, 128 / 255, 1]),
    ],
)
def test_what_stands_for_nothing(text: str, columns: int, expected: list[float]) -> None:
    assert np.allclose(parse_blank(text, columns), expected, equal_nan=True)


@pytest.mark.parametrize("text", ["red", "#ff00", "#gg0000", "#٣٣٣٣٣٣", "#+f+f+f", "1,2", "", "٣", "1_0"])
def test_what_cannot_stand_for_nothing(text: str) -> None:
    for columns, given in ((3, text), (1, text if "," not in text else "#ff0000")):
        with pytest.raises(OptionError, match="needed"):
            parse_blank(given, columns)


def test_arrays_of_vtk_are_values_and_stay(tmp_path: Path) -> None:
    """Of a file that ParaView shows: read as values, and kept beside those that are transferred to its shape."""
    own = tmp_path / "own.vtp"
    thick, normals = NUMBERS[:, 0], SHAPE.vertex_normals
    write_vtp(own, painted(), {"thickness": thick, "Normals": normals, "site": np.arange(SHAPE.V)})
    found = load_values(own, SHAPE)
    assert found.names == ("thickness", "Normals_0", "Normals_1", "Normals_2", "site")
    assert np.array_equal(found.numbers, np.column_stack([thick, normals, np.arange(SHAPE.V)]))
    save_values(tmp_path / "out.vtp", Values(NUMBERS[:, :2], ("site", "age")), SHAPE, own)
    arrays = point_arrays(tmp_path / "out.vtp")
    assert list(arrays) == ["thickness", "Normals", "site", "site_", "age"]
    assert np.array_equal(arrays["site_"], NUMBERS[:, 0]) and np.array_equal(arrays["Normals"], normals)
    save_labels(tmp_path / "labels.vtp", labels_of(["a"] * SHAPE.V, SHAPE), SHAPE, own)
    assert {"thickness", "site", "label"} < set(point_arrays(tmp_path / "labels.vtp"))
    write_vtp(own, painted())
    with pytest.raises(InputError, match=r"own\.vtp has no numbers at its points"):
        load_values(own, SHAPE)


@pytest.mark.parametrize("name", ["v.obj", "v"])
def test_values_have_their_suffixes(tmp_path: Path, name: str) -> None:
    with pytest.raises(OptionError, match="not a format for values"):
        save_values(tmp_path / name, Values(NUMBERS), SHAPE)


def painted() -> Shape:
    shade = np.random.default_rng(1).integers(0, 256, (SHAPE.V, 4)) / 255
    return Shape(SHAPE.verts, SHAPE.faces, "painted", shade)


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".off", ".vtp", ".vtk", ".npy", ".csv"])
def test_colors_are_written_as_they_were(tmp_path: Path, suffix: str) -> None:
    shape = painted()
    path = tmp_path / f"c{suffix}"
    save_colors(path, shape, linear_to_srgb_alpha(linear_colors(shape)))
    assert shape.colors is not None
    table = suffix in (".npy", ".csv")
    found = load_values(path, shape).numbers if table else load_shape(path).colors
    assert found is not None
    channels = 3 if suffix == ".obj" else 4
    assert np.abs(found[:, :channels] - shape.colors[:, :channels]).max() < 1e-9


def test_gltf_holds_light_and_the_others_colors(tmp_path: Path) -> None:
    """Middle grey on a screen, 188 of 255, is half the light of white."""
    grey = np.full((SHAPE.V, 4), 0.5)
    grey[:, 3] = 1
    save_colors(tmp_path / "c.glb", SHAPE, linear_to_srgb_alpha(grey))
    save_colors(tmp_path / "c.ply", SHAPE, linear_to_srgb_alpha(grey))
    for name in ("c.glb", "c.ply"):
        again = load_shape(tmp_path / name)
        assert again.colors is not None
        assert np.abs(again.colors[:, :3] - 188 / 255).max() < 0.003  # read, both are as a screen has them
        assert np.abs(linear_colors(again) - grey).max() < 0.005
    import trimesh

    stored: Any = trimesh.load(tmp_path / "c.glb", force="mesh")  # as the file has them
    assert np.abs(stored.visual.vertex_colors[:, :3] / 255 - 0.5).max() < 0.005


def test_no_colors_is_told_with_what_to_do(tmp_path: Path) -> None:
    save_shape(tmp_path / "a.ply", SHAPE)
    with pytest.raises(InputError, match=r"a\.ply has no vertex colors") as told:
        linear_colors(load_shape(tmp_path / "a.ply"))
    assert "--values" in told.value.hint


def test_colors_have_their_suffixes(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match=r"c\.stl: '\.stl' is not a format for vertex colors"):
        save_colors(tmp_path / "c.stl", SHAPE, np.ones((SHAPE.V, 4)))


def test_columns_of_one_name_are_told_apart() -> None:
    assert _make_unique(["a", "a", "a", "a_", "x"], {"x"}) == ["a", "a_", "a_2", "a__", "x_"]
    assert len(set(_make_unique(["a"] * 20_000, set()))) == 20_000


def test_numbers_that_a_ply_changes_are_told(tmp_path: Path) -> None:
    with pytest.warns(MeshmatchWarning, match="32-bit numbers, which change some"):
        save_values(tmp_path / "v.ply", Values(np.full(SHAPE.V, 20_000_001.0)), SHAPE)
