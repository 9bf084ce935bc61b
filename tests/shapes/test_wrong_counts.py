"""STL, PCD and NumPy files that hold more or less than they promise: all that is whole is read, and it is said."""

import struct
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from meshmatch.errors import InputError, MeshmatchWarning
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.shape import Shape

BOM = b"\xef\xbb\xbf"


@pytest.fixture(scope="module")
def ball(make_sphere: Callable[[int], Shape]) -> np.ndarray:
    """Corners (F, 3, 3) of triangles, as single floats."""
    shape = make_sphere(1)
    return shape.verts[shape.faces].astype(np.float32) + np.float32(3)


def binary(corners: np.ndarray, count: int | None = None, head: bytes = b"made by hand", tail: bytes = b"") -> bytes:
    rows = np.zeros(len(corners), [("n", "<f4", 3), ("v", "<f4", (3, 3)), ("a", "<u2")])
    rows["v"] = corners
    return head.ljust(80, b"\0") + struct.pack("<I", len(corners) if count is None else count) + rows.tobytes() + tail


def text(corners: np.ndarray, name: str = "ball", end: str = "endsolid ball\n", line: str = "\n") -> bytes:
    facets = [
        "facet normal 0 0 0\n outer loop\n"
        + "".join(f"  vertex {x!r} {y!r} {z!r}\n" for x, y, z in facet.tolist())
        + " endloop\nendfacet\n"
        for facet in corners.astype(float)
    ]
    return f"solid {name}\n{''.join(facets)}{end}".replace("\n", line).encode("latin-1")


def corners_in(folder: Path, data: bytes) -> np.ndarray:
    (folder / "a.stl").write_bytes(data)
    return load_shape(folder / "a.stl").verts.reshape(-1, 3, 3)


@pytest.mark.parametrize("count", [0, 0xFFFFFFFF, 1, 79, 81, 10**6])
@pytest.mark.parametrize("head", [b"solid as some programs write it", b"COLOR=\xff\xff\xff\xff", b""])
def test_a_wrong_count_in_a_binary_stl(tmp_path: Path, ball: np.ndarray, count: int, head: bytes) -> None:
    assert len(ball) == 80
    with pytest.warns(MeshmatchWarning, match=f"promises {count} triangles, but holds 80"):
        np.testing.assert_array_equal(corners_in(tmp_path, binary(ball, count, head)), ball)


@pytest.mark.parametrize("tail", [b"\0", bytes(50), bytes(64), bytes(1000), b"made by a program " * 20, b"\xff" * 150])
def test_bytes_behind_the_triangles(tmp_path: Path, ball: np.ndarray, tail: bytes) -> None:
    with pytest.warns(MeshmatchWarning, match=f"holds {len(tail)} bytes behind its 80 triangles"):
        np.testing.assert_array_equal(corners_in(tmp_path, binary(ball, tail=tail)), ball)


def test_a_binary_stl_that_is_cut_short(tmp_path: Path, ball: np.ndarray) -> None:
    with pytest.warns(MeshmatchWarning, match="promises 80 triangles, but holds 79"):
        np.testing.assert_array_equal(corners_in(tmp_path, binary(ball)[:-20]), ball[:-1])


@pytest.mark.parametrize("head", [b"solid ball", b"facet", b"solid vertex"])
def test_a_right_count_says_nothing(tmp_path: Path, ball: np.ndarray, head: bytes) -> None:
    np.testing.assert_array_equal(corners_in(tmp_path, binary(ball, head=head)), ball)
    np.testing.assert_array_equal(corners_in(tmp_path, BOM + binary(ball, head=head)), ball)


@pytest.mark.parametrize(
    "changed",
    [
        lambda ball: text(ball, name="K\xf6rper vertex 1 2"),
        lambda ball: text(ball, line="\r\n"),
        lambda ball: text(ball, line="\r"),
        lambda ball: BOM + text(ball),
        lambda ball: text(ball).upper(),
        lambda ball: b"\n\n  " + text(ball),
        lambda ball: text(ball, line=" ").replace(b" ball ", b" ball\n", 1),  # but for the name, all in one line
        lambda ball: text(ball, line=" "),
        lambda ball: text(ball[:30], end="endsolid\n") + text(ball[30:], "other"),
        lambda ball: text(ball, end="endsolid"),
    ],
)
def test_texts_of_every_kind(tmp_path: Path, ball: np.ndarray, changed: Callable[[np.ndarray], bytes]) -> None:
    np.testing.assert_allclose(corners_in(tmp_path, changed(ball)), ball)


@pytest.mark.parametrize("lost", [0, len("endfacet\n"), 30, 60, 90])
def test_a_text_without_an_end(tmp_path: Path, ball: np.ndarray, lost: int) -> None:
    data = text(ball, end="")
    with pytest.warns(MeshmatchWarning, match="has no end"):
        found = corners_in(tmp_path, data[: len(data) - lost])
    assert len(found) == (80 if lost < 20 else 79)
    np.testing.assert_allclose(found, ball[: len(found)])


def test_a_loop_of_four_corners_is_two_triangles(tmp_path: Path) -> None:
    corners = np.array([[[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]], float)
    found = corners_in(tmp_path, text(corners))
    np.testing.assert_array_equal(found, corners[0][[[0, 1, 2], [0, 2, 3]]])


@pytest.mark.parametrize("data", [bytes(5000), b"PK\3\4" + bytes(range(256)) * 20, b"not a mesh at all\n" * 40])
def test_other_files_are_no_stl(tmp_path: Path, data: bytes) -> None:
    with pytest.raises(InputError, match=r"not an stl file|triangles"):
        corners_in(tmp_path, data)


# --- points

POINTS = np.arange(30, dtype=float).reshape(10, 3)


def pcd(count: str, how: str, fields: str = "x y z", rows: int = 10, tail: bytes = b"") -> bytes:
    head = f"# .PCD v0.7\nVERSION 0.7\nFIELDS {fields}\nSIZE 4 4 4\nTYPE F F F\n{count}DATA {how}\n".encode()
    table = POINTS[:rows]
    plain = "".join(f"{x} {y} {z}\n" for x, y, z in table.tolist()).encode()
    return head + (plain if how == "ascii" else table.astype("<f4").tobytes()) + tail


@pytest.mark.parametrize("how", ["ascii", "binary"])
@pytest.mark.parametrize("count", ["WIDTH 10\nHEIGHT 1\nPOINTS 10\n", "WIDTH 5\nHEIGHT 2\n", "POINTS 10\n"])
@pytest.mark.parametrize("fields", ["x y z", "X Y Z"])
def test_pcd_counts_as_programs_write_them(tmp_path: Path, how: str, count: str, fields: str) -> None:
    for start in (b"", BOM):
        (tmp_path / "a.pcd").write_bytes(start + pcd(count, how, fields))
        np.testing.assert_array_equal(load_shape(tmp_path / "a.pcd").verts, POINTS)


@pytest.mark.parametrize("how", ["ascii", "binary"])
@pytest.mark.parametrize("count", ["POINTS 0\n", "POINTS 12\n", "WIDTH 10\nHEIGHT 1\nPOINTS 3\n"])
def test_a_wrong_count_in_a_pcd(tmp_path: Path, how: str, count: str) -> None:
    (tmp_path / "a.pcd").write_bytes(pcd(count, how))
    with pytest.warns(MeshmatchWarning, match="but holds 10"):
        np.testing.assert_array_equal(load_shape(tmp_path / "a.pcd").verts, POINTS)


def test_bytes_behind_the_points(tmp_path: Path) -> None:
    (tmp_path / "a.pcd").write_bytes(pcd("POINTS 10\n", "binary", tail=bytes(100)))
    with pytest.warns(MeshmatchWarning, match="more than its 10 points"):
        np.testing.assert_array_equal(load_shape(tmp_path / "a.pcd").verts, POINTS)


def test_numpy_arrays_with_more_behind_them_or_with_fields(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", POINTS)
    with (tmp_path / "a.npy").open("ab") as file:
        file.write(bytes(99))
    np.testing.assert_array_equal(load_shape(tmp_path / "a.npy").verts, POINTS)
    rows = np.zeros(10, [("intensity", "u1"), ("z", "f4"), ("x", "f8"), ("y", "i4")])
    for axis, column in zip("xyz", POINTS.T, strict=True):
        rows[axis] = column
    np.save(tmp_path / "b.npy", rows)
    np.testing.assert_array_equal(load_shape(tmp_path / "b.npy").verts, POINTS)


def test_a_pcd_with_millions_of_numbers_for_each_point(tmp_path: Path) -> None:
    """The memory that a header asks for is no more than its bytes can mean, field by field and together."""
    fields = 20
    head = f"FIELDS {'x ' * fields}\nSIZE {'4 ' * fields}\nTYPE {'F ' * fields}\nCOUNT {'9000000 ' * fields}\n"
    (tmp_path / "a.pcd").write_bytes(f"{head}POINTS 1\nDATA binary\n".encode() + bytes(200_000))
    tracemalloc.start()
    with pytest.raises(InputError, match="over 4096 numbers for each point"):
        load_shape(tmp_path / "a.pcd")
    assert tracemalloc.get_traced_memory()[1] < 4_000_000
    tracemalloc.stop()
