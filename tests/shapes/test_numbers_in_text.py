"""Numbers as people's programs write them in text: headers, counts, quotes, empty cells, decimal commas."""

from pathlib import Path

import numpy as np
import pytest

from meshmatch.errors import InputError, MeshmatchWarning
from meshmatch.shapes.files import load_shape

POINTS = np.array([[0.46183, -1.04, 12.5], [3.25, 0.007, -0.5], [-7.125, 2.5, 100.0]])
TRIANGLE = [[0, 1, 2]]


def table(split: str, point: str = ".", more: str = "") -> str:
    return "".join(split.join(repr(x).replace(".", point) for x in row) + more + "\n" for row in POINTS.tolist())


def lines(head: str, point: str) -> str:
    return "".join(head + " ".join(repr(x).replace(".", point) for x in row) + "\n" for row in POINTS.tolist())


def read(folder: Path, name: str, text: str) -> np.ndarray:
    (folder / name).write_text(text)
    return load_shape(folder / name).verts


@pytest.mark.parametrize(
    "text",
    [
        "//X Y Z\n3\n" + table(" "),
        "3\n//X Y Z\n" + table(" "),
        "//\n//X Y Z\n" + table(" "),
        "% written by MATLAB\n! and another\n" + table(" "),
        "X Y Z\n" + table(" "),
        "x,y,z\n" + table(","),
        '"x","y","z"\n' + table('","').replace("\n", '"\n'),
        "x;y;z;red\n" + table(";", more=";255"),
        "x\ty\tz\n" + table("\t"),
        "// made by a scanner\n// of some kind\nX Y Z R G B\n" + table(" ", more=" 1 2 3"),
        "Points:0,Points:1,Points:2\n" + table(","),
        table(", "),
        table(" , "),
        table(",", more=","),
        table(" ", more=" 255,128,0"),
        table(" ", ","),
        table("\t", ","),
        table(";", ","),
        table("; ", ",", more=";0"),
        "3\n" + table(" ", ","),
        "X;Y;Z\n" + table(";", ","),
    ],
)
def test_points_are_read(tmp_path: Path, text: str) -> None:
    np.testing.assert_array_equal(read(tmp_path, "a.xyz", text), POINTS)


def test_a_header_says_where_the_coordinates_are(tmp_path: Path) -> None:
    rows = "".join(f"{k},{z!r},{x!r},{y!r}\n" for k, (x, y, z) in enumerate(POINTS.tolist()))
    np.testing.assert_array_equal(read(tmp_path, "a.xyz", "id,Z,X,Y\n" + rows), POINTS)
    text = "a cloud with x y z\n" + table(" ")  # a sentence, no names of columns
    np.testing.assert_array_equal(read(tmp_path, "b.xyz", text), POINTS)


def test_an_empty_cell_is_not_a_number_and_moves_no_other(tmp_path: Path) -> None:
    (tmp_path / "a.xyz").write_text("1.5,2,3,9\n1,,3.5,9\n,2,3,9\n")
    shape = load_shape(tmp_path / "a.xyz")
    np.testing.assert_array_equal(shape.valid, [True, False, False])
    np.testing.assert_array_equal(shape.verts[0], [1.5, 2, 3])


@pytest.mark.parametrize("promised", [0, 2, 70])
def test_a_wrong_number_of_points_is_said(tmp_path: Path, promised: int) -> None:
    with pytest.warns(MeshmatchWarning, match=f"promises {promised} points, but holds 3"):
        np.testing.assert_array_equal(read(tmp_path, "a.xyz", f"{promised}\n" + table(" ")), POINTS)


@pytest.mark.parametrize(
    "text",
    [
        table(",", ","),  # comma as both
        "1,5 2.5 3\n2,5 3.5 4\n",
        "1.234,5 2.345,6 3.456,7\n",
        "1,234.5 2,345.6 3,456.7\n",
        "0,5, 0,25, 1,5\n",
    ],
)
def test_commas_that_may_mean_anything_are_refused(tmp_path: Path, text: str) -> None:
    with pytest.raises(InputError) as caught:
        read(tmp_path, "a.xyz", text)
    assert "comma" in caught.value.message + caught.value.hint


def test_whole_numbers_between_commas_stay_columns(tmp_path: Path) -> None:
    np.testing.assert_array_equal(read(tmp_path, "a.xyz", "1,2,3,255,0,10\n4,5,6,7,8,9\n"), [[1, 2, 3], [4, 5, 6]])


PLY = "ply\nformat ascii 1.0\nelement vertex 3\nproperty double x\nproperty double y\nproperty double z\n"
PCD = "FIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nPOINTS 3\nDATA ascii\n"
TEXTS = {
    "a.ply": lambda point: PLY + "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    f"{table(' ', point)}3 0 1 2\n",
    "a.obj": lambda point: lines("v ", point) + "f 1 2 3\n",
    "a.off": lambda point: f"OFF\n3 1 0\n{table(' ', point)}3 0 1 2\n",
    "a.stl": lambda point: f"solid a\nfacet normal 0 0 1\nouter loop\n{lines('vertex ', point)}endloop\nendfacet\n"
    "endsolid a\n",
    "a.pcd": lambda point: PCD + table(" ", point),
}  # fmt: skip


@pytest.mark.parametrize("name", list(TEXTS))
def test_decimal_commas_in_every_text(tmp_path: Path, name: str) -> None:
    np.testing.assert_array_equal(read(tmp_path, name, TEXTS[name](".")), POINTS)
    np.testing.assert_array_equal(read(tmp_path, name, TEXTS[name](",")), POINTS)


@pytest.mark.parametrize("name", list(TEXTS))
@pytest.mark.parametrize(("old", "new"), [("3,25", "3.25"), ("3,25", "3,2,5"), ("3,25", "1.003,25"), ("12,5", "12,")])
def test_other_commas_are_refused_in_every_text(tmp_path: Path, name: str, old: str, new: str) -> None:
    with pytest.raises(InputError) as caught:
        read(tmp_path, name, TEXTS[name](",").replace(old, new))
    assert "comma" in caught.value.message + caught.value.hint
