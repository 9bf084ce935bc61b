"""Skin weights: written and read, from glb skins, and what files get wrong."""

import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.sparse import csr_array

from meshmatch.errors import InputError, OptionError
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.tables import write_json
from meshmatch.transfer.attributes import largest_weights
from meshmatch.transfer.weight_files import SkinWeights, load_weights, save_weights, weights_of
from tests.conftest import icosphere
from tests.transfer.skinned import write_skinned_glb

SHAPE = icosphere(1)
NAMES = tuple(f"Knochen {k} ü" for k in range(7))


def some_weights() -> SkinWeights:
    rng = np.random.default_rng(0)
    dense = rng.random((SHAPE.V, 7)) * (rng.random((SHAPE.V, 7)) < 0.5)
    dense[:, 2] += 0.1
    return SkinWeights(largest_weights(csr_array(dense), 4), NAMES)


@pytest.mark.parametrize("suffix", [".npz", ".json", ".NPZ"])
def test_write_then_read(tmp_path: Path, suffix: str) -> None:
    given, path = some_weights(), tmp_path / f"w{suffix}"
    save_weights(path, given)
    found = load_weights(path, SHAPE)
    assert found.names == NAMES
    assert abs(found.matrix - given.matrix).max() < 1e-7
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_the_npz_is_what_the_page_says(tmp_path: Path) -> None:
    save_weights(tmp_path / "w.npz", some_weights())
    with np.load(tmp_path / "w.npz", allow_pickle=False) as archive:
        assert set(archive.files) == {"format", "names", "joints", "weights"}
        joints, weights = archive["joints"], archive["weights"]
        assert str(archive["format"]) == "meshmatch skin weights 1"
        assert tuple(archive["names"]) == NAMES
    assert (joints.dtype, weights.dtype) == (np.int32, np.float32)
    assert joints.shape == weights.shape == (SHAPE.V, 4)
    assert np.allclose(weights.sum(axis=1), 1)
    assert (np.diff(weights, axis=1) <= 0).all()  # the heaviest first
    dense = np.zeros((SHAPE.V, 7))
    np.add.at(dense, (np.arange(SHAPE.V)[:, None], joints), weights)
    assert np.allclose(dense, some_weights().matrix.toarray(), atol=1e-7)


def test_a_dense_table_is_read_too(tmp_path: Path) -> None:
    table = some_weights().matrix.toarray() * 3  # of any scale
    np.savez(tmp_path / "w.npz", weights=table, names=np.array(NAMES))
    found = load_weights(tmp_path / "w.npz", SHAPE)
    assert np.allclose(found.matrix.toarray(), table / 3)
    np.savez(tmp_path / "n.npz", weights=table)
    assert load_weights(tmp_path / "n.npz", SHAPE).names[:2] == ("joint 0", "joint 1")


def test_without_names_joints_are_counted(tmp_path: Path) -> None:
    joints = np.tile([5, 2], (SHAPE.V, 1))
    np.savez(tmp_path / "w.npz", weights=np.full((SHAPE.V, 2), 0.5), joints=joints)
    found = load_weights(tmp_path / "w.npz", SHAPE)
    assert found.names == tuple(f"joint {k}" for k in range(6))
    assert found.matrix.toarray()[0].tolist() == [0, 0, 0.5, 0, 0, 0.5]


def test_a_skin_of_a_glb(tmp_path: Path) -> None:
    write_skinned_glb(tmp_path / "s.glb")
    shape = load_shape(tmp_path / "s.glb")
    found = load_weights(tmp_path / "s.glb", shape)
    assert found.names == ("hip", "knee")
    expected = [*[[0, 1]] * 3, [0, 1], [0, 1], [0.5, 0.5], [1, 0], *[[0, 0]] * 3]
    assert np.allclose(found.matrix.toarray(), expected)


def test_a_skin_of_more_than_four_joints(tmp_path: Path) -> None:
    write_skinned_glb(tmp_path / "s.glb", wide=True)
    found = load_weights(tmp_path / "s.glb", load_shape(tmp_path / "s.glb"))
    share = 64 / 255
    assert np.allclose(found.matrix.toarray()[3], [share / (share + 0.75), 0.75 / (share + 0.75)])


@pytest.mark.slow
def test_characters_of_the_bench(bench: Path) -> None:
    for file in sorted((bench / "textured").glob("*.glb")):
        shape = load_shape(file)
        found = load_weights(file, shape)
        total = np.asarray(found.matrix.sum(axis=1)).ravel()
        assert np.allclose(total, 1)
        assert len(set(found.names)) == len(found.names) > 10


def glb_without_skin(path: Path) -> None:
    save_shape(path, SHAPE)


def promising(path: Path) -> None:
    """A header that promises a million million rows."""
    with zipfile.ZipFile(path, "w") as archive, archive.open("weights.npy", "w") as member:
        text = str({"descr": "<f8", "fortran_order": False, "shape": (10**12, 4)}).ljust(117) + "\n"
        member.write(b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode() + b"\0" * 64)


def objects(path: Path) -> None:
    np.savez(path, weights=np.array([{}, None], dtype=object))


def table(**arrays: np.ndarray) -> Callable[[Path], None]:
    return lambda path: np.savez(path, **arrays)


def json_of(**values: object) -> Callable[[Path], None]:
    return lambda path: write_json(path, {"weights": [[1]] * SHAPE.V, **values})


BAD: dict[str, tuple[str, Callable[[Path], object], str]] = {
    "not there": ("a.npz", lambda path: None, "there is no file"),
    "empty": ("a.npz", lambda path: path.touch(), "is empty"),
    "no archive": ("a.npz", lambda path: path.write_bytes(b"PK nonsense"), "does not hold arrays"),
    "promising": ("a.npz", promising, "promises"),
    "objects": ("a.npz", objects, "Python objects"),
    "no weights": ("a.npz", table(w=np.eye(3)), "there is no 'weights'"),
    "flat": ("a.npz", table(weights=np.ones(SHAPE.V)), "not a table of numbers"),
    "nan": ("a.npz", table(weights=np.full((SHAPE.V, 2), np.nan)), "not a table of numbers"),
    "negative": ("a.npz", table(weights=np.tile([2.0, -1.0], (SHAPE.V, 1))), "negative"),
    "huge": ("a.npz", table(weights=np.full((SHAPE.V, 2), 1e308)), "a weight is too large"),
    "tiny": ("a.npz", table(weights=np.full((SHAPE.V, 2), 1e-320)), "all weights are 0"),
    "all zero": ("a.npz", table(weights=np.zeros((SHAPE.V, 2))), "all weights are 0"),
    "wrong length": ("a.npz", table(weights=np.ones((9, 2))), "9 vertices, but sphere1 has 42"),
    "unlike": (
        "a.npz",
        table(weights=np.ones((SHAPE.V, 2)), joints=np.ones((SHAPE.V, 3), int)),
        r"\(42, 3\), but 'weights' of \(42, 2\)",
    ),
    "broken joints": ("a.npz", table(weights=np.ones((SHAPE.V, 2)), joints=np.full((SHAPE.V, 2), 0.5)), "not whole"),
    "joint out of range": (
        "a.npz",
        table(weights=np.ones((SHAPE.V, 1)), joints=np.full((SHAPE.V, 1), 3), names=np.array(["a", "b"])),
        "names joint 3, but there are 2",
    ),
    "names": ("a.npz", table(weights=np.ones((SHAPE.V, 3)), names=np.array(["a", "b"])), "3 columns for 2 names"),
    "no json": ("a.json", lambda path: path.write_text("{"), "can be read"),
    "a list": ("a.json", lambda path: path.write_text("[1]"), "there is no 'weights'"),
    "ragged": ("a.json", lambda path: path.write_text('{"weights": [[1], [1, 2]]}'), "not a table of numbers"),
    "joints of a word": ("a.json", json_of(joints="x"), "'joints' is not a table"),
    "joints of words": ("a.json", json_of(joints=[["a"]] * SHAPE.V), "'joints' is not a table"),
    "huge joints": ("a.json", json_of(joints=[[1e300]] * SHAPE.V), "too large"),
    "no joints": ("a.json", json_of(joints=None), "'joints' is not a table"),
    "ragged names": ("a.json", json_of(names=[["a"], ["b", "c"]]), "can be read"),
    "a suffix": ("a.abc", lambda path: path.write_text("x"), "not read from '.abc'"),
    "no skin": ("a.glb", glb_without_skin, "has no skin"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_weights_are_told_in_words(tmp_path: Path, case: str) -> None:
    name, make, words = BAD[case]
    make(tmp_path / name)
    with pytest.raises(InputError, match=words):
        load_weights(tmp_path / name, SHAPE)


def test_a_damaged_skin_is_told_in_words(tmp_path: Path) -> None:
    write_skinned_glb(tmp_path / "s.glb")
    data = (tmp_path / "s.glb").read_bytes()
    (tmp_path / "s.glb").write_bytes(data.replace(b'"joints": [1, 0]', b'"joints": [1, 9]'))
    with pytest.raises(InputError, match="makes no sense"):
        load_weights(tmp_path / "s.glb", Shape(np.eye(3), np.array([[0, 1, 2]])))


def test_joints_of_one_name_are_told_apart(tmp_path: Path) -> None:
    write_skinned_glb(tmp_path / "s.glb")
    data = (tmp_path / "s.glb").read_bytes()
    (tmp_path / "s.glb").write_bytes(data.replace(b'"name": "hip" ', b"").replace(b' "hip"', b'"knee"'))
    assert load_weights(tmp_path / "s.glb", load_shape(tmp_path / "s.glb")).names == ("knee", "knee 2")


def test_weights_from_a_table() -> None:
    table = some_weights().matrix
    for given in (table * 2, table.toarray()):
        found = weights_of(given, SHAPE)
        assert np.allclose(found.matrix.toarray(), table.toarray())
        assert found.names == tuple("0123456")
    with pytest.raises(InputError, match="not a table of numbers"):
        weights_of(np.ones(SHAPE.V), SHAPE)
    with pytest.raises(InputError, match="the array has weights of 3 vertices"):
        weights_of(np.ones((3, 2)), SHAPE)


def test_an_unknown_suffix_is_refused(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match=r"w\.txt: '\.txt' is not a format for skin weights"):
        save_weights(tmp_path / "w.txt", some_weights())
