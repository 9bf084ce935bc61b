"""Labels: written and read in every format, what they belong to, and what files get wrong."""

import base64
import json
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from meshmatch.errors import InputError, MeshmatchWarning, OptionError
from meshmatch.shapes.colors import UNKNOWN, label_colors
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.label_files import (
    LABEL_SUFFIXES,
    Label,
    Labels,
    On,
    labels_of,
    load_labels,
    name_labels,
    save_labels,
)
from tests.conftest import icosphere

SHAPE = icosphere(1)  # 42 vertices, 80 faces
SQUARE = Shape(np.eye(4)[:, :3], np.array([[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]), "tetrahedron")


def cells(labels: Labels) -> list[Label]:
    return [labels.names[code] for code in labels.codes.tolist()]


def some(on: On, words: bool) -> Labels:
    size = SHAPE.V if on == "vertices" else SHAPE.F
    codes = np.random.default_rng(4).integers(0, 3, size)
    return Labels(codes, ("left hand", "right, hand", "Fuß") if words else (-4, 0, 17), on)


@pytest.mark.parametrize("suffix", LABEL_SUFFIXES[:-2])
@pytest.mark.parametrize("on", ["vertices", "faces"])
@pytest.mark.parametrize("words", [False, True])
def test_write_then_read(tmp_path: Path, suffix: str, on: On, words: bool) -> None:
    given = some(on, words)
    save_labels(tmp_path / f"l{suffix}", given, SHAPE)
    found = load_labels(tmp_path / f"l{suffix}", SHAPE)
    assert (cells(found), found.on) == (cells(given), on)
    assert found.are_words is words


@pytest.mark.parametrize("on", ["vertices", "faces"])
@pytest.mark.parametrize("words", [False, True])
def test_a_ply_has_labels_and_colors(tmp_path: Path, on: On, words: bool) -> None:
    given = some(on, words)
    save_labels(tmp_path / "l.ply", given, SHAPE)
    with pytest.warns(MeshmatchWarning, match="color for each face") if on == "faces" else nullcontext():
        shape = load_shape(tmp_path / "l.ply")
    assert np.array_equal(shape.verts, SHAPE.verts)
    assert np.array_equal(shape.faces, SHAPE.faces)
    head = (tmp_path / "l.ply").read_bytes().split(b"end_header")[0].decode()
    assert "property int label" in head.split("element face")[1 if on == "faces" else 0]
    assert ("comment label 2 Fuß" in head) is words
    if on == "vertices":
        assert shape.colors is not None
        expected = label_colors([0, 1, 2])[given.codes]
        assert np.abs(shape.colors[:, :3] - expected).max() < 0.5 / 255 + 1e-9


@pytest.mark.parametrize("on", ["vertices", "faces"])
@pytest.mark.parametrize("words", [False, True])
def test_a_vtp_has_labels_and_colors(tmp_path: Path, on: On, words: bool) -> None:
    given = some(on, words)
    save_labels(tmp_path / "l.vtp", given, SHAPE)
    shape = load_shape(tmp_path / "l.vtp")
    assert np.array_equal(shape.verts, SHAPE.verts) and np.array_equal(shape.faces, SHAPE.faces)
    text = (tmp_path / "l.vtp").read_text(encoding="utf-8")
    data = ElementTree.fromstring(text).find(f".//{'PointData' if on == 'vertices' else 'CellData'}")
    assert data is not None
    labels, colors = data
    assert [each.get("Name") for each in data] == ["label", "Colors"]
    assert (labels.get("type"), colors.get("NumberOfComponents")) == ("Int32", "3")
    found = np.frombuffer(base64.b64decode(labels.text or "")[8:], "<i4")
    assert np.array_equal(found, given.codes if words else cells(given))
    assert ("<!-- label 2 Fuß -->" in text) is words
    if on == "vertices":
        assert shape.colors is not None
        expected = label_colors([0, 1, 2])[given.codes]
        assert np.abs(shape.colors[:, :3] - expected).max() < 0.5 / 255 + 1e-9
    odd = Labels(np.arange(SHAPE.V) % 2, ("--> <a/>", "b--"), "vertices")
    save_labels(tmp_path / "odd.vtp", odd, SHAPE)
    assert load_shape(tmp_path / "odd.vtp").V == SHAPE.V
    save_labels(tmp_path / "wide.vtp", Labels(np.zeros(SHAPE.V, int), (2**40,), "vertices"), SHAPE)
    assert 'type="Int64" Name="label"' in (tmp_path / "wide.vtp").read_text(encoding="utf-8")


def test_labels_in_a_ply_are_the_numbers_themselves(tmp_path: Path) -> None:
    import trimesh

    given = some("vertices", False)
    save_labels(tmp_path / "l.ply", given, SHAPE)
    other = trimesh.load(tmp_path / "l.ply", process=False)
    values = other.metadata["_ply_raw"]["vertex"]["data"]["label"]
    assert np.array_equal(np.ravel(values), cells(given))


@pytest.mark.parametrize("names", [("arm", ""), (3, -1)])
def test_no_label_is_grey_in_a_ply_as_in_pictures(tmp_path: Path, names: tuple[Label, ...]) -> None:
    save_labels(tmp_path / "l.ply", Labels(np.arange(SHAPE.V) % 2, names, "vertices"), SHAPE)
    colors = load_shape(tmp_path / "l.ply").colors
    assert colors is not None
    assert np.abs(colors[1::2, :3] - UNKNOWN).max() < 0.5 / 255 + 1e-9
    assert np.abs(colors[::2, :3] - label_colors([0])).max() < 0.5 / 255 + 1e-9


@pytest.mark.parametrize("suffix", LABEL_SUFFIXES)
def test_words_and_names_that_are_no_text(tmp_path: Path, suffix: str) -> None:
    """Half a letter out of JSON, and a file's name that is not UTF-8: written with a stand-in."""
    (tmp_path / "in.json").write_text(json.dumps(["arm", "\ud800"] * (SHAPE.V // 2)))
    given = load_labels(tmp_path / "in.json", SHAPE)
    save_labels(tmp_path / f"l{suffix}", given, SHAPE)
    if suffix not in (".ply", ".vtp"):
        assert cells(load_labels(tmp_path / f"l{suffix}", SHAPE))[:2] == ["arm", "\ufffd"]


READABLE: dict[str, tuple[str, str]] = {
    "bare csv": ("a.csv", "{rows}"),
    "csv with a header of its own": ("a.csv", "part\n{rows}"),
    "numbered csv without a header": ("a.csv", "{numbered}"),
    "csv with more columns": ("a.csv", "Vertex,area,LABEL\n{wide}"),
    "rows numbered from 1, as R does": ("a.csv", '"","label"\n{from_one}'),
    "what Excel is told, in quotes": ("a.csv", '"sep=,"\nvertex,label\n{numbered}'),
    "txt with spaces": ("a.txt", "\ufeff{spaced}\n\n"),
    "bare json": ("a.json", "{list}"),
    "json of labels": ("a.json", '{{"labels": {list}}}'),
}


@pytest.mark.parametrize("case", READABLE)
def test_what_people_have_is_read(tmp_path: Path, case: str) -> None:
    words = [f"part {k % 3}" for k in range(SHAPE.V)]
    name, text = READABLE[case]
    filled = text.format(
        rows="\n".join(words),
        numbered="\n".join(f"{k},{word}" for k, word in enumerate(words)),
        from_one="\n".join(f'"{k}",{word}' for k, word in enumerate(words, 1)),
        wide="\n".join(f"{k},0.5,{word}" for k, word in enumerate(words)),
        spaced="\r\n".join(f"  {word} " for word in words),
        list=json.dumps(words),
    )
    (tmp_path / name).write_text(filled, encoding="utf-8")
    found = load_labels(tmp_path / name, SHAPE)
    assert (cells(found), found.on) == (words, "vertices")


def test_parts_by_their_members(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text('{"head": [0, 1, 2], "neck": [2, 3], "none": []}')
    found = load_labels(tmp_path / "a.json", SHAPE)
    assert found.names == ("head", "neck")
    assert found.codes[:5].tolist() == [0, 0, 0, 1, -1]
    assert found.on == "vertices"
    of_faces = load_labels(tmp_path / "a.json", SHAPE, "faces")
    assert (of_faces.on, len(of_faces.codes)) == ("faces", SHAPE.F)


def test_whole_numbers_written_as_others_are_numbers(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.arange(SHAPE.V) % 2 + 0.0)
    assert load_labels(tmp_path / "a.npy", SHAPE).names == (0, 1)
    np.save(tmp_path / "b.npy", np.arange(SHAPE.V) % 2 == 0)
    assert load_labels(tmp_path / "b.npy", SHAPE).names == (0, 1)
    assert labels_of(np.resize([" 7", "+1"], SHAPE.V), SHAPE).names == (1, 7)
    assert labels_of(np.resize(["٣", "1_0"], SHAPE.V), SHAPE).names == ("1_0", "٣")  # digits for Python, words here


def test_missing_labels_are_none(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(json.dumps([None, *([5] * (SHAPE.V - 1))]))
    found = load_labels(tmp_path / "a.json", SHAPE)
    assert found.codes[:2].tolist() == [-1, 0]
    assert found.names == (5,)


def test_as_many_vertices_as_faces_are_asked_about(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.arange(4))
    with pytest.raises(OptionError, match="as many vertices as faces") as told:
        load_labels(tmp_path / "a.npy", SQUARE)
    assert "--on vertices or --on faces" in told.value.hint
    assert load_labels(tmp_path / "a.npy", SQUARE, "faces").on == "faces"
    save_labels(tmp_path / "b.json", Labels(np.arange(4), (1, 2, 3, 4), "faces"), SQUARE)
    assert load_labels(tmp_path / "b.json", SQUARE).on == "faces"  # the file itself says so
    with pytest.raises(OptionError, match="labels of faces, not of vertices"):
        load_labels(tmp_path / "b.json", SQUARE, "vertices")


def lines(*texts: str) -> Callable[[Path], object]:
    return lambda path: path.write_text("\n".join([*texts, ""]))


BAD: dict[str, tuple[str, Callable[[Path], object], str]] = {
    "not there": ("a.npy", lambda path: None, "there is no file"),
    "a folder": ("a.npy", lambda path: path.mkdir(), "is a folder"),
    "empty": ("a.txt", lambda path: path.touch(), "is empty"),
    "wrong length": ("a.npy", lambda path: np.save(path, np.arange(41)), "41 labels, but sphere1 has 42 vert"),
    "a table": ("a.npy", lambda path: np.save(path, np.eye(42)), r"array of \(42, 42\)"),
    "damaged": ("a.npy", lambda path: path.write_bytes(b"\x93NUMPY"), "does not hold arrays"),
    "objects": ("a.npy", lambda path: np.save(path, np.array([None] * 42), allow_pickle=True), "Python objects"),
    "broken numbers": ("a.npy", lambda path: np.save(path, np.linspace(0, 1, 42)), "is not a label"),
    "no label at all": ("a.json", lambda path: path.write_text(json.dumps([None] * 42)), "no label at all"),
    "no json": ("a.json", lambda path: path.write_text("[1,"), "can be read"),
    "a number": ("a.json", lambda path: path.write_text("7"), "no list of labels"),
    "lists": ("a.json", lambda path: path.write_text(json.dumps([[1]] * 42)), "whole number or a word"),
    "on what": ("a.json", lines('{"on": "hair", "labels": [1, 2]}'), "not on 'hair'"),
    "parts out of range": ("a.json", lambda path: path.write_text('{"arm": [42]}'), "'arm' is not a list"),
    "parts of words": ("a.json", lambda path: path.write_text('{"arm": "left"}'), "'arm' is not a list"),
    "ragged csv": ("a.csv", lambda path: path.write_text("0,a\n1\n"), "not equally long"),
    "unsorted csv": ("a.csv", lines("vertex,label", *[f"{41 - k},a" for k in range(42)]), "in order"),
    "csv that counts from 1": ("a.csv", lines("vertex,label", *[f"{k + 1},a" for k in range(42)]), "in order"),
    "columns split by spaces": ("a.csv", lines("vertex label", *[f"{k} 1" for k in range(42)]), "names two columns"),
    "columns split by bars": ("a.txt", lines("vertex|label", *[f"{k}|1" for k in range(42)]), "names two columns"),
    "nameless csv": ("a.csv", lambda path: path.write_text("1,2,3\n" * 42), "none is called label"),
    "not text": ("a.txt", lambda path: path.write_bytes(b"\xff\xfe\x00"), "can be read"),
    "a suffix": ("a.xlsx", lambda path: path.write_text("x"), "not read from '.xlsx'"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_labels_are_told_in_words(tmp_path: Path, case: str) -> None:
    name, make, words = BAD[case]
    make(tmp_path / name)
    with pytest.raises(InputError, match=words):
        load_labels(tmp_path / name, SHAPE)


def test_the_count_must_be_that_of_what_was_said(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.arange(42))
    with pytest.raises(InputError, match="cannot be of its faces"):
        load_labels(tmp_path / "a.npy", SHAPE, "faces")


def test_blank_has_the_kind_of_the_labels() -> None:
    numbers, words = some("vertices", False), some("vertices", True)
    codes = np.array([0, -1, 2])
    assert cells(name_labels(codes, numbers, "vertices", None)) == [-4, -1, 17]
    assert cells(name_labels(codes, numbers, "vertices", "99")) == [-4, 99, 17]
    assert cells(name_labels(codes, numbers, "vertices", "17")) == [-4, 17, 17]
    assert cells(name_labels(codes, words, "vertices", None)) == ["left hand", "", "Fuß"]
    assert cells(name_labels(codes, words, "vertices", "99")) == ["left hand", "99", "Fuß"]
    for text in ("none", "٣", "1_0"):
        with pytest.raises(OptionError, match=f"--blank {text}: labels are whole numbers"):
            name_labels(codes, numbers, "vertices", text)


def test_a_suffix_that_cannot_hold_labels_is_refused(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match=r"l\.obj: '\.obj' is not a format for labels"):
        save_labels(tmp_path / "l.obj", some("vertices", True), SHAPE)
    wide = Labels(np.zeros(42, int), (2**40,), "vertices")
    with pytest.raises(OptionError, match="32 bits"):
        save_labels(tmp_path / "l.ply", wide, SHAPE)
    save_labels(tmp_path / "l.npy", wide, SHAPE)
    assert load_labels(tmp_path / "l.npy", SHAPE).names == (2**40,)


@pytest.mark.parametrize(
    ("suffix", "fine"), [(".npy", False), (".ply", False), (".vtp", False), (".csv", True), (".json", True)]
)
def test_labels_of_more_than_64_bits(tmp_path: Path, suffix: str, fine: bool) -> None:
    huge = 99999999999999999999999
    (tmp_path / "a.txt").write_text(f"{huge}\n" * SHAPE.V)
    given = load_labels(tmp_path / "a.txt", SHAPE)
    assert given.names == (huge,)
    if fine:
        save_labels(tmp_path / f"l{suffix}", given, SHAPE)
        assert load_labels(tmp_path / f"l{suffix}", SHAPE).names == (huge,)
    else:
        with pytest.raises(OptionError, match="bits"):
            save_labels(tmp_path / f"l{suffix}", given, SHAPE)


def test_labels_from_an_array() -> None:
    assert labels_of(np.arange(SHAPE.V) % 3, SHAPE).names == (0, 1, 2)
    words = labels_of(["arm", "leg"] * (SHAPE.F // 2), SHAPE)
    assert (words.names, words.on) == (("arm", "leg"), "faces")
    assert words.values[:2].tolist() == ["arm", "leg"]
    with pytest.raises(InputError, match=r"not an array of \(2, 2\)"):
        labels_of(np.eye(2), SHAPE)
    with pytest.raises(InputError, match="the array has 3 labels"):
        labels_of([1, 2, 3], SHAPE)
