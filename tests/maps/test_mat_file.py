"""MAT-files: against SciPy, which reads and writes all kinds of them; and damaged in every byte."""

import zlib
from contextlib import suppress
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat, savemat

from meshmatch.errors import InputError
from meshmatch.maps import mat_file
from meshmatch.maps.files import load_map, save_map
from meshmatch.maps.mat_file import read_mat
from tests.maps.test_vertex_map import A, B, random_map

NAMES = ("index", "weights", "word", "lines", "reasons", "none", "wide", "yes")
RECORD = {
    "index": np.arange(7, dtype=np.int64),
    "weights": np.arange(6.0).reshape(2, 3) / 7,
    "word": "größer",
    "reasons": np.array(["one", "", "three, and more"], dtype=object),
    "none": np.empty((0, 3)),
    "wide": np.arange(24, dtype=np.uint8).reshape(2, 3, 4),
    "yes": np.array([True, False]),
    "other": np.arange(3.0),
    "structure": {"a": 1},
}


def written(record: dict, **how: bool) -> bytes:
    out = BytesIO()
    savemat(out, record, oned_as="column", **how)
    return out.getvalue()


@pytest.mark.parametrize("packed", [False, True])
def test_the_same_as_scipy(packed: bool) -> None:
    data = written(RECORD, do_compression=packed)
    found, theirs = read_mat(data, NAMES), loadmat(BytesIO(data))
    assert set(found) == set(NAMES) - {"lines"}
    for name in ("index", "weights", "none", "wide", "yes"):
        assert np.array_equal(found[name], theirs[name]), name
    assert found["word"] == "größer"
    assert found["reasons"] == ["one", "", "three, and more"]


def test_text_of_several_rows() -> None:
    assert read_mat(written({"lines": np.array(["abc", "def"])}), ["lines"]) == {"lines": "abcdef"}


def test_the_other_byte_order() -> None:
    """One array of doubles, byte for byte as the specification has it."""
    matrix = b"".join(
        [
            np.array([6, 8, 6, 0], ">u4").tobytes(),  # flags: a double
            np.array([5, 8, 1, 2], ">i4").tobytes(),  # 1 x 2
            np.array([0x00010001], ">u4").tobytes() + b"x\0\0\0",  # a small element: the name
            np.array([9, 16], ">u4").tobytes() + np.array([1.5, -2.0], ">f8").tobytes(),
        ]
    )
    head = b"MATLAB 5.0 MAT-file".ljust(124) + b"\1\0MI"
    found = read_mat(head + np.array([14, len(matrix)], ">u4").tobytes() + matrix, ["x"])
    assert np.array_equal(found["x"], [[1.5, -2.0]])
    assert found["x"].dtype == np.float64


@pytest.mark.parametrize("packed", [False, True])
def test_damage_is_an_error_or_another_value(packed: bool) -> None:
    """Whatever a byte becomes, nothing but `InputError` comes of it. (SciPy's reader crashes on some of these.)"""
    data = written({"index": np.arange(3), "word": "ab", "reasons": RECORD["reasons"]}, do_compression=packed)
    assert len(read_mat(data, NAMES)) == 3
    refused = 0
    for at in range(124, len(data)):
        for byte in (0, 1, 255, data[at] ^ 16):
            try:
                read_mat(data[:at] + bytes([byte]) + data[at + 1 :], NAMES)
            except InputError:
                refused += 1
    assert refused > 100
    for end in range(len(data)):
        with suppress(InputError):
            assert len(read_mat(data[:end], NAMES)) < 3


def test_nothing_unpacks_beyond_the_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mat_file, "LARGEST", 10_000)
    bomb = zlib.compress(b"\0" * 1_000_000)
    data = b"MATLAB 5.0 MAT-file".ljust(124) + b"\0\1IM" + np.array([15, len(bomb)], "<u4").tobytes() + bomb
    with pytest.raises(InputError, match="unpack to too many bytes"):
        read_mat(data, NAMES)


def test_a_damaged_map_is_told_with_its_name(tmp_path: Path) -> None:
    save_map(tmp_path / "m.mat", random_map(A, B, 3))
    whole = (tmp_path / "m.mat").read_bytes()
    (tmp_path / "m.mat").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match=r"^m\.mat: "):
        load_map(tmp_path / "m.mat")


def test_variables_under_other_names_are_named(tmp_path: Path) -> None:
    path = tmp_path / "maps.mat"
    path.write_bytes(written({"C": np.eye(2), "T": np.arange(1, 4)}))
    with pytest.raises(InputError, match=r"maps\.mat: it has only C, T$") as caught:
        load_map(path)
    assert "'index' if it counts vertices from 0, or 'matlab_index' if from 1" in caught.value.hint
    path.write_bytes(written({"index": {"a": 1}, "T": np.arange(1, 4)}))
    with pytest.raises(InputError, match="its index is of a class that is not read"):
        load_map(path)
    path.write_bytes(written({}))
    with pytest.raises(InputError, match="nothing usable"):
        load_map(path)
