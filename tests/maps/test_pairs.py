"""Lists of known points from files."""

from pathlib import Path

import numpy as np
import pytest

from meshmatch.errors import InputError
from meshmatch.shapes.vertex_lists import load_pairs, load_points


@pytest.mark.parametrize(
    "text",
    [
        "1 20\n3 40\n",
        "1,20\n3,40",
        "1;20\r\n3;40\r\n",
        "\n# nose, then toe\n1\t20  # nose\n\n3   40\n",
        "source,target\n1,20\n3,40\n",
        "\ufeff1 20\n3 40\n",
    ],
    ids=["spaces", "commas", "semicolons", "comments", "header", "byte order mark"],
)
def test_pairs_from_text(tmp_path: Path, text: str) -> None:
    (tmp_path / "pairs.txt").write_text(text, encoding="utf-8")
    source, target = load_pairs(tmp_path / "pairs.txt")
    assert (source.tolist(), target.tolist()) == ([1, 3], [20, 40])
    assert source.dtype == np.int64


def test_pairs_and_points_from_npy(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.array([[1, 20], [3, 40]], np.int32))
    np.save(tmp_path / "b.npy", np.array([7, 8], np.uint16))
    assert [side.tolist() for side in load_pairs(tmp_path / "a.npy")] == [[1, 3], [20, 40]]
    assert load_points(tmp_path / "b.npy").tolist() == [7, 8]


def test_points_from_text(tmp_path: Path) -> None:
    (tmp_path / "points.txt").write_text("7\n8\n")
    assert load_points(tmp_path / "points.txt").tolist() == [7, 8]


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "is empty"),
        ("# nothing\n", "holds no vertex"),
        ("1\n2\n", "not 2 a line"),
        ("1 2 3\n", "not 2 a line"),
        ("1 2\n3\n", "line 2"),
        ("1 2\n3 x\n", "line 2"),
        ("1.5 2\n2.5 3\n", "1.5 is not a whole number"),
        ("nose toe\nhand foot\n", "line 2"),
        ("1 -2\n", "-2"),
        ("1 99999999999999999999\n", "too large"),
    ],
)
def test_what_is_no_list_of_pairs(tmp_path: Path, text: str, told: str) -> None:
    (tmp_path / "pairs.txt").write_text(text)
    with pytest.raises(InputError) as caught:
        load_pairs(tmp_path / "pairs.txt")
    assert told in caught.value.message
    assert "pairs.txt" in caught.value.message
    assert "counted from 0" in caught.value.hint


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    (tmp_path / "cut.npy").write_bytes(b"\x93NUMPY\x01")
    np.save(tmp_path / "floats.npy", np.array([[0.5, 1.0]]))
    np.save(tmp_path / "objects.npy", np.array([{}], dtype=object), allow_pickle=True)
    (tmp_path / "bytes.txt").write_bytes(b"\xff\xfe\x00\x01")
    for name in ("missing.txt", "cut.npy", "floats.npy", "objects.npy", "bytes.txt"):
        with pytest.raises(InputError, match=name):
            load_pairs(tmp_path / name)
