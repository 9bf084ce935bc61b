"""PLY files that get other numbers keep all else: polygons, properties, elements, comments, text or the order of bytes."""

from pathlib import Path

import numpy as np
import pytest

from meshmatch.errors import MeshmatchWarning
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.formats import ply
from meshmatch.shapes.formats.ply import parsed
from meshmatch.shapes.formats.ply_edit import PlyFile
from meshmatch.shapes.shape import Shape

HEAD = """ply
format {} 1.0
comment TextureFile skin.png
obj_info kept too
element camera 1
property float view
element vertex 5
property float x
property float y
property float z
property float nx
property float ny
property float nz
property double quality
property uchar diffuse_red
property uchar diffuse_green
property uchar diffuse_blue
element face 2
property list uchar int vertex_indices
property list uchar float texcoord
property uchar flags
element edge 1
property int vertex1
property int vertex2
end_header
"""
PLACES = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0.5, 0]], np.float32)
POLYGONS = ([0, 1, 2, 3], [1, 4, 2])


def example(kind: str) -> bytes:
    """A quad and a triangle, in text or in bytes of an order."""
    if kind == "ascii":
        vertices = [f"{x} {y} {z} 0 0 1 {k / 3!r} 9 8 7" for k, (x, y, z) in enumerate(PLACES)]
        faces = [" ".join(map(str, [len(p), *p, 2 * len(p), *[0.5] * 2 * len(p), 3])) for p in POLYGONS]
        return "\n".join([HEAD.format(kind).rstrip(), "0.5", *vertices, *faces, "0 4", ""]).encode()
    order = {"binary_little_endian": "<", "binary_big_endian": ">"}[kind]
    out = np.array(0.5, order + "f4").tobytes()
    for k, place in enumerate(PLACES):
        out += np.array([*place, 0, 0, 1], order + "f4").tobytes() + np.array(k / 3, order + "f8").tobytes()
        out += bytes([9, 8, 7])
    for polygon in POLYGONS:
        out += bytes([len(polygon)]) + np.array(polygon, order + "i4").tobytes()
        out += bytes([2 * len(polygon)]) + np.array([0.5] * 2 * len(polygon), order + "f4").tobytes() + bytes([3])
    return HEAD.format(kind).encode() + out + np.array([0, 4], order + "i4").tobytes()


def table(data: bytes, name: str) -> dict[str, np.ndarray]:
    return next(each for each in parsed("a.ply", data).elements if each.name == name).table


def edge(kind: str) -> bytes:
    return b"\n0 4\n" if kind == "ascii" else example(kind)[-8:]


KINDS = ["ascii", "binary_little_endian", "binary_big_endian"]


@pytest.mark.parametrize("kind", KINDS)
def test_numbers_of_vertices_are_added_and_all_else_stays(kind: str) -> None:
    before = example(kind)
    colors = ply.color_columns(np.tile([1.0, 0.0, 0.5, 1.0], (5, 1)))
    label = np.arange(5, dtype=np.int32)
    after = PlyFile.parsed("a.ply", before).with_columns({"label": label, **colors}, {}, ["label 0 head"])
    head = after.split(b"end_header")[0]
    for line in HEAD.format(kind).replace("end_header\n", "").splitlines():
        assert (line.encode() in head) != ("diffuse" in line)  # earlier colors make room
    assert head.index(b"comment label 0 head") < head.index(b"element")
    was, now = table(before, "vertex"), table(after, "vertex")
    for each in ("x", "y", "z", "nx", "nz", "quality"):
        np.testing.assert_array_equal(now[each], was[each])
    np.testing.assert_array_equal(now["label"], label)
    np.testing.assert_array_equal(now["blue"], 128)
    for each in ("vertex_indices", "texcoord"):
        for first, second in zip(table(before, "face")[each], table(after, "face")[each], strict=True):
            np.testing.assert_array_equal(first, second)
    assert after.endswith(edge(kind))


@pytest.mark.parametrize("kind", KINDS)
def test_a_polygon_has_what_most_of_its_triangles_have(kind: str) -> None:
    after = PlyFile.parsed("a.ply", example(kind)).with_columns({}, {"label": np.array([4, 4, 7], np.int32)})
    faces = table(after, "face")
    np.testing.assert_array_equal(faces["label"], [4, 7])
    np.testing.assert_array_equal(faces["vertex_indices"][1], [4, 3])
    np.testing.assert_array_equal(faces["flags"], 3)
    np.testing.assert_array_equal(table(after, "vertex")["quality"], np.arange(5) / 3)
    assert after.endswith(edge(kind))


@pytest.mark.parametrize("kind", KINDS)
def test_vertices_move_and_normals_turn_with_them(kind: str, tmp_path: Path) -> None:
    tipped = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    after = PlyFile.parsed("a.ply", example(kind)).with_positions(PLACES @ tipped.T, np.tile(tipped, (5, 1, 1)))
    now = table(after, "vertex")
    np.testing.assert_allclose(np.stack([now[f"n{axis}"] for axis in "xyz"], 1), [[0, -1, 0]] * 5)
    (tmp_path / "a.ply").write_bytes(after)
    np.testing.assert_allclose(load_shape(tmp_path / "a.ply").verts, PLACES @ tipped.T)
    head = after.split(b"end_header")[0]
    assert head == example(kind).split(b"end_header")[0]  # kinds of numbers too


def test_what_is_replaced_is_said() -> None:
    with pytest.warns(MeshmatchWarning, match="a.ply has quality of each vertex already, which is replaced"):
        after = PlyFile.parsed("a.ply", example("ascii")).with_columns({"quality": np.ones(5, np.float32)}, {})
    np.testing.assert_array_equal(table(after, "vertex")["quality"], 1.0)
    assert after.count(b"quality") == 1


def test_only_the_file_of_a_shape_is_edited(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(example("ascii"))
    shape = load_shape(path)
    same = PlyFile.of(path, shape)
    assert same is not None
    assert same.data == example("ascii")
    assert PlyFile.of(path, shape, faces=True) is not None
    assert PlyFile.of(path, Shape(shape.verts[:4], shape.faces[:2])) is None
    assert PlyFile.of(None, shape) is None
    strips = example("ascii").replace(b"element face", b"element tristrips")
    path.write_bytes(strips)
    assert PlyFile.of(path, shape, faces=True) is None
    assert PlyFile.of(path, shape) is not None


@pytest.mark.parametrize("text", [" ", "\n"])
def test_a_text_whose_rows_are_not_one_to_a_line_is_not_edited(tmp_path: Path, text: str) -> None:
    path = tmp_path / "a.ply"
    head, _, body = example("ascii").partition(b"end_header\n")
    lines = body.split(b"\n")
    lines[1:3] = [text.join(lines[1].decode().split(" ", 1)).encode() + b" " + lines[2]]
    path.write_bytes(head + b"end_header\n" + b"\n".join(lines))
    assert PlyFile.of(path, load_shape(path)) is None


def test_colors_are_bytes_whatever_they_were() -> None:
    before = example("ascii").replace(b"uchar diffuse_", b"float ")
    after = PlyFile.parsed("a.ply", before).with_columns(ply.color_columns(np.full((5, 4), 1 / 255)), {})
    assert after.count(b"property uchar green") == 1 and b"property float green" not in after
    np.testing.assert_array_equal(table(after, "vertex")["green"], 1)


def test_names_of_earlier_labels_go() -> None:
    words = PlyFile.parsed("a.ply", example("ascii")).with_columns(
        {"label": np.zeros(5, np.int32)}, {}, ["label 0 ", "label 1 b"]
    )
    assert words.count(b"comment label") == 2
    with pytest.warns(MeshmatchWarning, match="label of each vertex already"):
        numbers = PlyFile.parsed("a.ply", words).with_columns({"label": np.ones(5, np.int32)}, {})
    assert numbers.count(b"comment label") == 0


def test_a_polygon_without_triangles_has_no_label() -> None:
    before = example("ascii").replace(b"3 1 4 2 6 0.5 0.5 0.5 0.5 0.5 0.5", b"2 1 4 4 0.5 0.5 0.5 0.5")
    after = PlyFile.parsed("a.ply", before).with_columns({}, {"label": np.array([4, 4], np.int32)})
    np.testing.assert_array_equal(table(after, "face")["label"], [4, -1])


def test_a_text_keeps_digits_of_positions() -> None:
    far = np.add(PLACES, [4500000.123, 0, 0])
    after = PlyFile.parsed("a.ply", example("ascii")).with_positions(far, np.tile(np.eye(3), (5, 1, 1)))
    np.testing.assert_array_equal(table(after, "vertex")["x"], far[:, 0])


def test_a_file_that_has_changed_is_not_edited(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(example("binary_big_endian"))
    shape = load_shape(path)
    assert PlyFile.of(path, Shape(shape.verts + 1, shape.faces)) is None
    assert PlyFile.of(path, Shape(shape.verts + 1, shape.faces), moved=True) is not None
    assert PlyFile.of(path, Shape(shape.verts, shape.faces[:1]), faces=True) is None
    path.unlink()
    assert PlyFile.of(path, shape) is None
