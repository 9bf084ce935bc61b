"""Reading and writing shapes: every vertex in its order, in every format; clean words for bad files."""

import json
import re
import struct
import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import trimesh

from meshmatch.errors import InputError, OptionError, OutputError
from meshmatch.shapes.files import PLAIN_SUFFIXES, load_shape, save_shape
from meshmatch.shapes.shape import Shape
from tests.shapes.painted import write_document

CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 1]])
QUAD_AND_TRIANGLE = [[0, 1, 2], [0, 2, 3], [0, 1, 4]]


def load(folder: Path, name: str, content: str | bytes) -> Shape:
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return load_shape(path)


def check(shape: Shape) -> None:
    np.testing.assert_array_equal(shape.verts, CORNERS)
    np.testing.assert_array_equal(shape.faces, QUAD_AND_TRIANGLE)


# --- by hand, one format after the other


PLY_HEADER = """ply
format {format} 1.0
comment by hand
element vertex 5
property float x
property float y
property float z
element face 2
property list uchar int vertex_indices
end_header
"""


XYZ = "".join(f"property float {axis}\n" for axis in "xyz")
HUGE = "ply\nformat {} 1.0\nelement vertex {}\n" + XYZ + "end_header\n"


def test_ply_with_everything_at_once(tmp_path: Path) -> None:
    header = """ply
format binary_little_endian 1.0
obj_info scanned
element camera 1
property double focal
element vertex 5
property uchar red
property double x
property double y
property double z
property uchar green
property uchar blue
property list uchar short neighbours
element face 3
property list uchar uint vertex_indices
property list ushort float texcoord
property int label
element edge 1
property int vertex1
end_header
"""
    body = struct.pack("<d", 35.0)
    for k, (x, y, z) in enumerate(CORNERS):
        body += struct.pack("<BdddBB", 255, x, y, z, k, 51) + struct.pack(f"<B{k}h", k, *range(k))
    for k, face in enumerate(QUAD_AND_TRIANGLE):
        body += struct.pack("<B3I", 3, *face) + struct.pack(f"<H{2 * k}f", 2 * k, *[0.5] * (2 * k)) + b"\1\0\0\0"
    shape = load(tmp_path, "a.ply", header.encode() + body + b"\0\0\0\0")
    check(shape)
    assert shape.colors is not None
    np.testing.assert_allclose(shape.colors[:, 0], 1.0)
    np.testing.assert_allclose(shape.colors[:, 1], np.arange(5) / 255)
    np.testing.assert_allclose(shape.colors[:, 2:], [[0.2, 1.0]] * 5)


def test_ply_colors_are_rounded_not_cut(tmp_path: Path, cube: Shape) -> None:
    save_shape(tmp_path / "a.ply", Shape(cube.verts, cube.faces, colors=np.full((8, 4), 0.999)))
    np.testing.assert_array_equal(load_shape(tmp_path / "a.ply").colors, 1.0)


def test_ply_triangle_strips_turn_every_second_one(tmp_path: Path) -> None:
    header = PLY_HEADER.format(format="ascii").replace("element face 2", "element tristrips 1")
    rows = "0 0 0\n1 0 0\n1 1 0\n0 1 0\n.5 .5 1\n9 0 1 2 3 -1 2 3 4 0\n"
    shape = load(tmp_path, "a.ply", header + rows)
    np.testing.assert_array_equal(shape.faces, [[0, 1, 2], [2, 1, 3], [2, 3, 4], [4, 3, 0]])


def test_ply_text_colors_follow_the_header_not_the_values(tmp_path: Path) -> None:
    body = "0 0 0 0 1 1\n1 0 0 1 0 0\n0 1 0 0 0 1\n"
    head = "ply\nformat ascii 1.0\nelement vertex 3\n" + "".join(f"property float {c}\n" for c in "xyz")
    bytes_ = head + "".join(f"property uchar {c}\n" for c in ("red", "green", "blue")) + "end_header\n" + body
    reals = bytes_.replace("uchar", "float")
    dark, light = load(tmp_path, "a.ply", bytes_), load(tmp_path, "b.ply", reals)
    np.testing.assert_allclose(dark.colors, np.column_stack([light.colors[:, :3] / 255, np.ones(3)]))
    assert light.colors.max() == 1.0


OBJ = """# a comment with v 1 2 3
mtllib x.mtl
v 0 0 0
v 1 0 0   # and another
vn 0 0 1
v 1 1 0
vt 0.5 0.5
  v 0 1 0
g part
v 0.5 0.5 1 1.0
usemtl skin
f {quad}
l 1 2
s off
f {triangle}
"""


CORNERS_OF_OBJ = (
    ("1 2 3 4", "1 2 5"),
    ("1/1 2/1 3/1 4/1", "1/1 2/1 5/1"),
    ("1//1 2//1 3//1 4//1", "1//1 2//1 5//1"),
    ("1/1/1 2/1/1 3/1/1 4/1/1", "1/1/1\t2/1/1 \\\n5/1/1"),
    ("-5 -4 -3 -2", "-5/-1/-1 -4/-1/-1 -1/-1/-1"),
)
HEADS_OF_OFF = ("OFF\n5 2 0\n", "OFF 5 2 0\n", "OFF5 2 0\n", "# by\nOFF # x\n\n5 2\n", "OFF\r\n5 2 0\r\n")


def same_mesh() -> Iterator[tuple[str, bytes]]:
    """A quad and a triangle, as every format has them."""
    text, rows, polygons = (
        PLY_HEADER.format(format="ascii"),
        "0 0 0\n1 0 0\n1 1 0\n0 1 0\n.5 .5 1\n",
        "4 0 1 2 3\n3 0 1 4\n",
    )
    listed = text.replace("property float y", "property list uchar int n\nproperty float y")
    unequal = "0 0 0 0\n1 2 7 8 0 0\n1 1 9 1 0\n0 0 1 0\n.5 3 1 2 3 .5 1\n"
    for whole in (
        text + rows + polygons,
        text.replace("indices", "index") + rows + polygons,
        listed + unequal + polygons,
    ):
        yield "a.ply", whole.encode()
        yield "a.PLY", whole.replace("\n", "\r\n").encode()
    for order, name, wide in (("<", "little", False), (">", "big", False), (">", "big", True)):
        head = (
            PLY_HEADER.format(format=f"binary_{name}_endian").replace("uchar", "ushort" if wide else "uchar").encode()
        )
        size = "H" if wide else "B"
        body = struct.pack(f"{order}15f", *CORNERS.ravel()) + struct.pack(f"{order}{size}4i", 4, 0, 1, 2, 3)
        body += struct.pack(f"{order}{size}3i", 3, 0, 1, 4)
        yield "a.ply", head + body
        yield "a.ply", head.replace(b"\n", b"\r\n") + body
    for quad, triangle in CORNERS_OF_OBJ:
        obj = OBJ.format(quad=quad, triangle=triangle)
        for changed in (obj, obj.replace("\n", "\r\n"), obj.rstrip("\n"), obj.replace("  v", "\tv")):
            yield "a.obj", changed.encode()
    for head_of_off in HEADS_OF_OFF:
        more = "0 0 0\n1 0 0\n1 1 0 # corner\n\n0 1 0\n.5 .5 1\n4 0 1 2 3 7\n3 0 1 4\n"
        yield "a.off", (head_of_off + more).encode()


@pytest.mark.parametrize(("name", "content"), list(same_mesh()))
def test_one_mesh_in_every_format(tmp_path: Path, name: str, content: bytes) -> None:
    check(load(tmp_path, name, content))


def test_obj_counts_back_from_where_the_face_stands(tmp_path: Path) -> None:
    shape = load(tmp_path, "a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -2 -1\nv 0 0 1\nf -1 -2 -3\n")
    np.testing.assert_array_equal(shape.faces, [[0, 1, 2], [3, 2, 1]])


def test_obj_seams_split_nothing_and_unused_vertices_stay(tmp_path: Path) -> None:
    text = "v 9 9 9\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 0\nvt 0 0\nvt 1 1\nf 2/1 3/1 4/1\nf 4/2 3/2 2/2\n"
    shape = load(tmp_path, "a.obj", text)
    assert shape.V == 5
    np.testing.assert_array_equal(shape.faces, [[1, 2, 3], [3, 2, 1]])


@pytest.mark.parametrize(
    "text",
    [
        "0 0 0\n1 2 3\n4 5 6\n",
        "0,0,0\n1,2,3\n4,5,6",
        "3\n0 0 0\n1 2 3\n4 5 6\n",
        "# x y z\n0 0 0 9 9 9\n\n1 2 3 9 9 9\r\n4\t5 6 9 9 9 # last\n",
        "0;0;0;1\n1;2;3\n4;5;6;1;2\n",
    ],
)
def test_xyz(tmp_path: Path, text: str) -> None:
    shape = load(tmp_path, "a.xyz", text)
    assert shape.is_cloud
    np.testing.assert_array_equal(shape.verts, [[0, 0, 0], [1, 2, 3], [4, 5, 6]])


@pytest.mark.parametrize("kind", [np.float64, np.float32, np.int16])
@pytest.mark.parametrize("width", [3, 6])
def test_npy(tmp_path: Path, kind: type, width: int) -> None:
    points = np.arange(7 * width).reshape(7, width).astype(kind)
    np.save(tmp_path / "a.npy", np.asfortranarray(points))
    shape = load_shape(tmp_path / "a.npy")
    assert shape.is_cloud
    np.testing.assert_array_equal(shape.verts, points[:, :3])


PCD = "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z {rgb}\nSIZE 4 4 4 4\nTYPE F F F {kind}\nCOUNT 1 1 1 1\n"
PCD += "WIDTH 3\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 3\nDATA {how}\n"


@pytest.mark.parametrize("how", ["ascii", "binary"])
@pytest.mark.parametrize("field", ["rgb", "rgba"])
@pytest.mark.parametrize("kind", ["F", "U", "I"])
def test_pcd_with_packed_colours(tmp_path: Path, how: str, field: str, kind: str) -> None:
    verts = np.array([[0, 0, 0.5], [1, 2, 3], [np.nan, np.nan, np.nan]], np.float32)
    bytes_ = np.array([[255, 128, 0], [1, 2, 3], [0, 0, 255]], np.uint32)
    packed = bytes_ @ np.array([1 << 16, 1 << 8, 1], np.uint32)
    packed = packed.astype(np.uint32).view({"F": "f4", "U": "u4", "I": "i4"}[kind])
    head = PCD.format(rgb=field, kind=kind, how=how)
    if how == "ascii":
        body = "".join(
            f"{x} {y} {z} {c!s}\n" for (x, y, z), c in zip(verts.tolist(), packed.tolist(), strict=True)
        ).encode()
    else:
        rows = np.empty(3, [("v", "<f4", 3), ("c", packed.dtype)])
        rows["v"], rows["c"] = verts, packed
        body = rows.tobytes()
    shape = load(tmp_path, "a.pcd", head.encode() + body)
    assert shape.is_cloud and shape.invalid is not None
    np.testing.assert_array_equal(shape.verts[:2], verts[:2])
    np.testing.assert_array_equal(shape.invalid, [False, False, True])
    np.testing.assert_allclose(shape.colors, np.column_stack([bytes_ / 255, np.ones(3)]))


def test_pcd_as_pcl_packs_it(tmp_path: Path) -> None:
    """The number of the format's own description; padding between the fields; no colours at all."""
    text = PCD.format(rgb="rgb", kind="F", how="ascii").replace("POINTS 3", "POINTS 1")
    shape = load(tmp_path, "a.pcd", text + "0.93773 0.33763 0 4.2108e+06\n")
    np.testing.assert_allclose(255 * shape.colors, [[0x80, 0x80, 0xE0, 255]])
    head = "FIELDS x y z _ rgb\nSIZE 4 4 4 1 4\nTYPE F F F U U\nCOUNT 1 1 1 4 1\nPOINTS 2\nDATA binary\n"
    rows = np.zeros(2, [("v", "<f4", 3), ("_", "u1", 4), ("c", "<u4")])
    rows["v"], rows["c"] = [[1, 2, 3], [4, 5, 6]], 0xFF00FF
    shape = load(tmp_path, "b.pcd", head.encode() + rows.tobytes())
    np.testing.assert_array_equal(shape.verts, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_allclose(shape.colors, [[1, 0, 1, 1]] * 2)
    plain = "FIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nPOINTS 1\nDATA ascii\n1 2 3\n"
    assert load(tmp_path, "c.pcd", plain).colors is None


# --- glTF


def gltf(folder: Path, name: str, document: dict, *arrays: np.ndarray) -> Shape:
    """What is read of a file with these arrays; of a gltf they are in another file."""
    write_document(folder / name, document, *arrays, file="data.bin" if name.endswith(".gltf") else "")
    return load_shape(folder / name)


TRIANGLE = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)


@pytest.mark.parametrize("name", ["a.glb", "a.gltf"])
def test_gltf_scene_places_its_meshes(tmp_path: Path, name: str) -> None:
    document = {
        "scene": 0,
        "scenes": [{"nodes": [1]}],
        "nodes": [
            {"mesh": 0, "translation": [10, 0, 0], "scale": [2, 2, 2]},
            {"children": [2, 0], "rotation": [0, 0, 2**-0.5, 2**-0.5]},  # x to y
            {"mesh": 0, "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 5, 1]},
            {"mesh": 0, "name": "not in the scene"},
        ],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
    }
    shape = gltf(tmp_path, name, document, TRIANGLE, np.array([2, 1, 0], np.uint16))
    expected = [[0, 0, 5], [0, 1, 5], [-1, 0, 5], [0, 10, 0], [0, 12, 0], [-2, 10, 0]]
    np.testing.assert_allclose(shape.verts, expected, atol=1e-6)
    np.testing.assert_array_equal(shape.faces, [[2, 1, 0], [5, 4, 3]])


def test_gltf_strips_fans_points_and_unindexed(tmp_path: Path) -> None:
    five = np.vstack([TRIANGLE, TRIANGLE[:2] + 3]).astype(np.float32)
    primitives = [{"attributes": {"POSITION": 0}, "mode": mode} for mode in (5, 6, 0, 4, 1)]
    document = {"nodes": [{"mesh": 0}], "meshes": [{"primitives": primitives}]}
    shape = gltf(tmp_path, "a.glb", document, five)
    assert shape.V == 20  # lines (mode 1) are no surface
    strip, fan = [[0, 1, 2], [2, 1, 3], [2, 3, 4]], [[5, 6, 7], [5, 7, 8], [5, 8, 9]]
    np.testing.assert_array_equal(shape.faces, [*strip, *fan, [15, 16, 17]])


def test_gltf_skin_stands_as_its_joints_do(tmp_path: Path) -> None:
    joints = np.array([[0, 1, 0, 0]] * 3, np.uint8)
    weights = np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0.5, 0.5, 0, 0]], np.float32)
    bind = np.tile(np.eye(4, dtype=np.float32).ravel(), (2, 1))
    bind[1, 12:15] = [-1, 0, 0]  # the second joint was bound at x = 1
    document = {
        "scenes": [{"nodes": [0, 1, 2]}],
        "nodes": [
            {"mesh": 0, "skin": 0, "translation": [100, 100, 100]},  # ignored: a skin moves by joints alone
            {"translation": [0, 0, 7]},
            {"translation": [1, 0, 9]},
        ],
        "skins": [{"joints": [1, 2], "inverseBindMatrices": 3}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "JOINTS_0": 1, "WEIGHTS_0": 2}}]}],
    }
    shape = gltf(tmp_path, "a.glb", document, TRIANGLE, joints, weights, bind)
    np.testing.assert_allclose(shape.verts, TRIANGLE + np.array([[0, 0, 7], [0, 0, 9], [0, 0, 8]]), atol=1e-6)


def test_gltf_colors_sparse_and_strided_data(tmp_path: Path) -> None:
    rows = np.zeros((3, 4), np.float32)
    rows[:, :3] = TRIANGLE
    document = {
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "COLOR_0": 1}}, {"attributes": {"POSITION": 2}}]}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": 48, "byteStride": 16},
            {"buffer": 0, "byteOffset": 48, "byteLength": 12},
            {"buffer": 0, "byteOffset": 60, "byteLength": 4},
            {"buffer": 0, "byteOffset": 64, "byteLength": 12},
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5121, "count": 3, "type": "VEC4", "normalized": True},
            {
                "componentType": 5126,
                "count": 3,
                "type": "VEC3",
                "sparse": {
                    "count": 1,
                    "indices": {"bufferView": 2, "componentType": 5121},
                    "values": {"bufferView": 3},
                },
            },
        ],
    }
    colors = np.array([[255, 0, 0, 255], [0, 51, 0, 255], [0, 0, 0, 0]], np.uint8)
    parts = [rows, colors, np.array([2, 0, 0, 0], np.uint8), np.array([[4, 5, 6]], np.float32)]
    shape = gltf(tmp_path, "a.glb", document, *parts)
    np.testing.assert_allclose(shape.verts, [*TRIANGLE, [0, 0, 0], [0, 0, 0], [4, 5, 6]])
    # a fifth of the light (linear in glTF) looks like 0.4845 (IEC 61966-2-1)
    expected = [[1, 0, 0, 1], [0, 0.484529, 0, 1], [0, 0, 0, 0], *[[1, 1, 1, 1]] * 3]
    np.testing.assert_allclose(shape.colors, expected, atol=1e-6)


def test_colors_of_a_glb_are_light(tmp_path: Path, cube: Shape) -> None:
    """A middle grey (0.5 on a screen) is 0.214 of the light: in the file, to the eyes of another program, and back."""
    save_shape(tmp_path / "a.ply", Shape(cube.verts, cube.faces, "a", np.tile([0.5, 0.5, 0.5, 0.25], (8, 1))))
    save_shape(tmp_path / "a.glb", load_shape(tmp_path / "a.ply"))
    back = load_shape(tmp_path / "a.glb").colors
    np.testing.assert_allclose(back, load_shape(tmp_path / "a.ply").colors, atol=1e-6)
    scene = trimesh.load(tmp_path / "a.glb", process=False)
    theirs = next(iter(scene.geometry.values())).visual.vertex_colors / 255.0
    np.testing.assert_allclose(theirs[0], [0.2159, 0.2159, 0.2159, 0.251], atol=0.004)


ONE = {"nodes": [{"mesh": 0}], "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}]}
INDEXED = {"meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}]}
CIRCLE = {"nodes": [{"children": [1]}, {"children": [0]}], "scenes": [{"nodes": [0]}]}


@pytest.mark.parametrize(
    ("document", "words"),
    [
        (ONE | CIRCLE, "has two parents"),
        (ONE | INDEXED, "refers to vertex 7"),
        ({"nodes": [{}]}, "no triangles and no points"),
        ({"nodes": [{"mesh": 3}]}, "makes no sense"),
        (ONE | {"asset": {"version": "1.0"}}, "not glTF version 2"),
    ],
)
def test_gltf_that_cannot_be_used(tmp_path: Path, document: dict, words: str) -> None:
    with pytest.raises(InputError, match=words):
        gltf(tmp_path, "a.glb", document, TRIANGLE, np.array([0, 1, 7], np.uint8))


@pytest.mark.parametrize(
    ("uri", "words"),
    [
        ("gone.bin", "needs the file gone.bin"),
        ("../../secret.bin", "not in its folder"),
        ("data:application/octet-stream;base64,!!!", "not base64"),
        ("data:application/octet-stream;base64,AAAA", "needs 36 bytes of data, but holds 3"),
    ],
)
def test_gltf_whose_data_is_not_there(tmp_path: Path, uri: str, words: str) -> None:
    buffers = {"bufferViews": [{"buffer": 0, "byteLength": 36}], "buffers": [{"uri": uri, "byteLength": 36}]}
    accessor = {"accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}]}
    with pytest.raises(InputError, match=re.escape(words)):
        load(tmp_path, "a.gltf", json.dumps({"asset": {"version": "2.0"}, **ONE, **buffers, **accessor}))


# --- write, then read


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".off", ".glb", ".stl", ".xyz", ".npy"])
@pytest.mark.parametrize("cloud", [False, True])
@pytest.mark.parametrize("colored", [False, True])
@pytest.mark.parametrize("single", [False, True])
@pytest.mark.parametrize("broken", [False, True])
def test_write_then_read(
    tmp_path: Path, sphere: Shape, suffix: str, cloud: bool, colored: bool, single: bool, broken: bool
) -> None:
    rng = np.random.default_rng(0)
    verts = sphere.verts * 1750 + 1e3
    verts = verts.astype(np.float32) if single else verts
    invalid = rng.random(sphere.V) < 0.05 if broken else None
    colors = rng.integers(0, 256, (sphere.V, 4)) / 255 if colored else None
    shape = Shape(verts, [] if cloud else sphere.faces, "s", colors, invalid)
    if (suffix == ".stl" and cloud) or (suffix in (".xyz", ".npy") and not cloud):
        with pytest.raises(OptionError, match="cannot hold"):
            save_shape(tmp_path / f"s{suffix}", shape)
        assert not list(tmp_path.iterdir())
        return
    save_shape(tmp_path / f"s{suffix}", shape)
    assert [p.name for p in tmp_path.iterdir()] == [f"s{suffix}"]
    back = load_shape(tmp_path / f"s{suffix}")
    if suffix == ".stl":
        np.testing.assert_array_equal(back.verts, shape.verts[shape.faces].reshape(-1, 3).astype(np.float32))
        return
    np.testing.assert_array_equal(back.faces, shape.faces)
    if broken and suffix != ".glb":
        np.testing.assert_array_equal(back.invalid, invalid)
        np.testing.assert_array_equal(back.verts[~invalid], shape.verts[~invalid])
        np.testing.assert_allclose(back.verts[invalid], [shape.verts[~invalid].mean(axis=0)] * invalid.sum())
    else:
        expected = shape.verts.astype(np.float32) if suffix == ".glb" else shape.verts
        np.testing.assert_array_equal(back.verts, expected)
    if colored and suffix in (".ply", ".off", ".glb"):
        np.testing.assert_allclose(back.colors, colors, atol=1e-7)
    elif colored and suffix == ".obj":
        np.testing.assert_allclose(back.colors[:, :3], colors[:, :3], atol=1e-12)
    else:
        assert back.colors is None


def test_ply_is_single_only_where_that_loses_nothing(tmp_path: Path, cube: Shape) -> None:
    save_shape(tmp_path / "a.ply", cube)
    save_shape(tmp_path / "b.ply", Shape(cube.verts + 0.1, cube.faces))
    assert b"property float x" in (tmp_path / "a.ply").read_bytes()
    assert b"property double x" in (tmp_path / "b.ply").read_bytes()


def test_writing_to_where_it_cannot_go(tmp_path: Path, cube: Shape) -> None:
    with pytest.raises(OutputError, match="no folder"):
        save_shape(tmp_path / "no" / "a.ply", cube)
    with pytest.raises(OptionError, match=r"gltf.* is not a format for shapes"):
        save_shape(tmp_path / "a.gltf", cube)


# --- bad files


def ply(*lines: str, body: str = "0 0 0\n1 0 0\n0 1 0\n") -> bytes:
    head = ["ply", "format ascii 1.0", "element vertex 3", *lines, "end_header", body]
    return "\n".join(head).encode()


def npy(header: bytes) -> bytes:
    return b"\x93NUMPY\x01\x00" + (len(header) + 1).to_bytes(2, "little") + header + b"\n"


AXES = XYZ.splitlines()
TWICE = ["element tristrips 1", "property list int int v", "property int v"]
FIVE = PLY_HEADER.format(format="ascii").encode() + b"0 0 0\n" * 5
BINARY = PLY_HEADER.format(format="binary_little_endian").encode() + bytes(60)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        *[(f"a{suffix}", b"", "0 bytes") for suffix in PLAIN_SUFFIXES],
        *[(f"a{suffix}", b"\x89PNG\r\n\x1a\n" + bytes(500), "") for suffix in PLAIN_SUFFIXES],
        *[(f"a{suffix}", b"<html><body>Not found</body></html>\n", "") for suffix in PLAIN_SUFFIXES],
        ("a.txt", b"1 2 3", "unsupported file format .txt"),
        ("a", b"1 2 3", "unsupported file format (no suffix)"),
        ("a.ply", HUGE.format("binary_little_endian", 10**9).encode() + bytes(24), "fewer vertex rows"),
        ("a.ply", HUGE.format("ascii", 10**9).encode() + b"1 2 3\n", "fewer vertex rows"),
        ("a.ply", HUGE.format("ascii", -1).encode() + b"1 2 3\n", "fewer vertex rows"),
        ("a.ply", HUGE.format("ascii", 0).encode(), "no vertices"),
        ("a.ply", HUGE.format("ascii", 2).encode() + b"1 2 3\n4 5", "fewer vertex rows"),
        ("a.ply", HUGE.format("ascii", 1).encode() + b"1 two 3\n", "'two' where a number should be"),
        ("a.ply", HUGE.format("ascii", 1).encode() + b"nan nan nan\n", "no vertex has a usable position"),
        ("a.ply", HUGE.format("morse", 1).encode() + b"1 2 3\n", "header line 'format morse 1.0'"),
        ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 1\nproperty int x\nend_header\n1", "no x, y and z"),
        ("a.ply", b"ply\nformat ascii 1.0\nelement face 0\nend_header\n", "declares no vertices"),
        ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 1\n", "header has no end"),
        ("a.ply", FIVE + b"3 0 1 9\n3 0 1 2", "refers to vertex 9"),
        ("a.ply", FIVE + b"3 0 1 2\n3 0", "fewer face rows"),
        ("a.ply", BINARY + b"\3" + bytes(12) + b"\xff" * 9, "fewer face rows"),
        ("a.ply", ply(), "no x, y and z"),
        ("a.ply", ply("property list uchar float x", *AXES[1:]), "declares x of the element vertex as lists"),
        ("a.ply", ply(*AXES, "property list uchar uchar red"), "red of the element vertex as lists"),
        ("a.ply", ply(*AXES, "element face 1", "property int vertex_indices"), "vertex_indices of the element face as"),
        ("a.ply", ply(*AXES, "element tristrips 1", "property int strip"), "strip of the element"),
        *[("a.ply", ply(*AXES, *more, body="0 0 0 1\n" * 9), "twice")
          for more in (["property float x"], ["property list uchar float x"], TWICE)],
        *[("a.ply", ply(*AXES, "element other 0", *[line] * 5000), "header has over")
          for line in ("element e 0", "comment x\nproperty int p")],
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nf ", "a face has no corners"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n", "refers to vertex 4, but there are only 3"),
        ("a.obj", b"v 0 0 0\nf 0 0 0\n", "count from 1"),
        ("a.obj", b"v 0 0\n", "fewer than 3 coordinates"),
        ("a.obj", b"v 0 0 0\nf 1 1 1.5\n", "not a whole number"),
        ("a.obj", b"v 0 0 0\nv x 0 0\n", "'x' where a number should be"),
        ("a.obj", b"f 1 2 3\n", "no 'v' lines"),
        ("a.obj", b"v nan nan nan\n", "no vertex has a usable position"),
        ("a.off", b"OFF\n1000000000 1 0\n0 0 0\n", "promises 1000000000 vertices"),
        ("a.off", b"OFF\n2 1 0\n0 0 0\n1 1 1\n", "only 2 lines"),
        ("a.off", b"OFF\n1 1 0\n0 0 0\n4 0 0 0\n", "fewer corners than it says"),
        ("a.off", b"OFF BINARY\n", "binary"),
        *[("a.off", b"OFF\n%s 0\n" % counts, "does not say how many")
          for counts in (b"9" * 5000 + b" 1", b"1 " + b"9" * 5000)],
        ("a.stl", b"x".ljust(80) + struct.pack("<I", 10**9) + bytes(50), "triangles"),
        ("a.stl", b"solid x\nfacet normal 0 0 0\nouter loop\nvertex 0 0 0\n", "triangles"),
        ("a.stl", b"solid x\nfacet normal 0 0 0\nouter loop\n" + b"vertex 0 0 1\n" * 2, "triangles"),
        ("a.stl", b"x".ljust(84, b"\0"), "triangles"),
        ("a.glb", b"glTF" + struct.pack("<III4s", 2, 10**9, 10**9, b"JSON"), "should be"),
        ("a.pcd", b"FIELDS x y\nSIZE 4 4\nTYPE F F\nPOINTS 1\nDATA ascii\n1 2\n", "no x, y and z"),
        ("a.pcd", b"FIELDS x\nSIZE 4\nTYPE F\nCOUNT 99999999999\nPOINTS 1\nDATA binary\n1 2\n", "fewer vertex rows"),
        ("a.pcd", b"FIELDS x\nSIZE 4\nTYPE Q\nPOINTS 1\nDATA binary\n1 2\n", "makes no sense"),
        ("a.pcd", b"FIELDS x\nDATA binary_compressed\n1 2\n", "plain binary points"),
        *[("a.npy", npy(b"{'descr': '%s', 'fortran_order': False, 'shape': (%s,), }" % how), "promises")
          for how in ((b"<f8", b"9" * 20 + b", 3"), (b"<f8", b"-1, 3"), (b"<U0", b"999999999"), (b"<f8", b"4L, 3"))],
        ("a.npy", npy(b"{'descr': '<f8', ''' 'fortran_order': False}"), "can be read"),
        ("a.npy", npy(b"(" * 3000), "can be read"),
        ("a.npy", npy(b"{'descr': f(), 'fortran_order': x}".ljust(59)), "can be read: malformed node or string on line 1"),
        ("a.xyz", b"# nothing\n", "no points"),
        ("a.xyz", b"1 2 3\n4 5\n", "point 1 has only 2 of 3"),
    ],
)  # fmt: skip
def test_bad_files_are_explained(tmp_path: Path, name: str, content: bytes, words: str) -> None:
    tracemalloc.start()
    with pytest.raises(InputError) as caught:
        load(tmp_path, name, content)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert words in caught.value.message
    assert name in caught.value.message
    assert "\n" not in caught.value.message + caught.value.hint
    assert caught.value.hint
    assert peak < 5e6  # whatever the header says


def test_missing_file_and_folder(tmp_path: Path) -> None:
    (tmp_path / "human.ply").touch()
    with pytest.raises(InputError, match="there is no file") as caught:
        load_shape(tmp_path / "humn.ply")
    assert "human.ply" in caught.value.hint
    with pytest.raises(InputError, match="is a folder"):
        load_shape(tmp_path)
    with pytest.raises(InputError, match="there is no file") as caught:
        load_shape(tmp_path / "no" / "a.ply")
    assert "no folder" in caught.value.hint


def test_npy_is_never_unpickled(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.array([{"a": 1}] * 3, object), allow_pickle=True)
    with pytest.raises(InputError, match="Python objects"):
        load_shape(tmp_path / "a.npy")


@pytest.mark.parametrize(
    ("array", "words"),
    [
        (np.zeros((4, 4)), "holds an array of (4, 4)"),
        (np.zeros(9), "holds an array of (9,)"),
        (np.zeros((0, 3)), ""),
        (np.zeros((3, 3), complex), "not hold an array of numbers"),
        (np.full((3, 3), np.nan), "no vertex has a usable position"),
    ],
)
def test_npy_of_something_else(tmp_path: Path, array: np.ndarray, words: str) -> None:
    np.save(tmp_path / "a.npy", array)
    with pytest.raises(InputError) as caught:
        load_shape(tmp_path / "a.npy")
    assert words in caught.value.message


def test_npy_header_that_claims_a_billion_points(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.zeros((100, 3)))
    data = (tmp_path / "a.npy").read_bytes()
    tracemalloc.start()
    with pytest.raises(InputError, match="promises 23999999976 bytes"):
        load(tmp_path, "b.npy", data.replace(b"(100, 3)", b"(999999999, 3)").replace(b"      \n", b"\n", 1))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 5e6
    with pytest.raises(InputError, match="299"):
        load(tmp_path, "c.npy", data[:-1])


def test_some_nan_vertices_keep_their_place(tmp_path: Path) -> None:
    shape = load(tmp_path, "a.obj", "v 0 0 0\nv 2 0 0\nv nan 0 0\nv 0 inf 0\nv 1 1 1e99\nv 4 3 0\nf 1 2 6\nf 1 2 3\n")
    assert shape.V == 6
    np.testing.assert_array_equal(shape.invalid, [False, False, True, True, True, False])
    np.testing.assert_allclose(shape.verts[2:5], [[2, 1, 0]] * 3)  # the middle of the others
    np.testing.assert_allclose(shape.bounds, [[0, 0, 0], [4, 3, 0]])


@pytest.mark.parametrize("word", ["nan", "-nan", "NaN", "-nan(ind)", "1.#QNAN", "inf", "-Inf"])
def test_every_spelling_of_not_a_number(tmp_path: Path, word: str) -> None:
    head = HUGE.format("ascii", 2)
    shape = load(tmp_path, "a.ply", f"{head}1 2 3\n4 {word} 6\n")
    np.testing.assert_array_equal(shape.invalid, [False, True])


@pytest.mark.filterwarnings("ignore::meshmatch.errors.MeshmatchWarning")
def test_any_damage_gives_a_shape_or_a_clean_error(tmp_path: Path, make_sphere) -> None:
    """Cut, change and drop bytes at random: never another exception."""
    rng = np.random.default_rng(0)
    mesh = make_sphere(0)
    mesh = Shape(mesh.verts, mesh.faces, "s", rng.random((mesh.V, 4)))
    outcomes = {"shape": 0, "error": 0}
    for suffix in (".ply", ".obj", ".off", ".stl", ".glb", ".xyz", ".npy"):
        shape = Shape(mesh.verts, []) if suffix in (".xyz", ".npy") else mesh
        save_shape(tmp_path / f"good{suffix}", shape)
        good = (tmp_path / f"good{suffix}").read_bytes()
        for trial in range(36):
            data = bytearray(good)
            if trial % 3 == 0:
                data = data[: rng.integers(len(data))]
            elif trial % 3 == 1:
                data[rng.integers(min(len(data), 400))] = rng.integers(256)
            else:
                start = rng.integers(len(data))
                del data[start : start + rng.integers(1, 30)]
            try:
                load(tmp_path, f"bad{suffix}", bytes(data))
                outcomes["shape"] += 1
            except InputError:
                outcomes["error"] += 1
    assert min(outcomes.values()) > 30  # both kinds were met


# --- real files


def test_plies_of_the_bench_have_the_counts_of_its_header(bench: Path) -> None:
    files = sorted(bench.rglob("*.ply"))
    assert len(files) > 100
    for path in files[::5]:
        head = path.read_bytes()[:2000]
        V, F = (int(re.search(rb"element %s (\d+)" % key, head).group(1)) for key in (b"vertex", b"face"))
        shape = load_shape(path)
        assert (shape.V, shape.F, shape.invalid) == (V, F, None), path


def test_textured_cow_keeps_its_v_lines(bench: Path) -> None:
    path = bench / "textured" / "spot_triangulated.obj"
    rows = [line.split()[1:4] for line in path.read_text().splitlines() if line.startswith("v ")]
    shape = load_shape(path)
    np.testing.assert_array_equal(shape.verts, np.array(rows, float))
    seams = sum(line.startswith("vt ") for line in path.read_text().splitlines())
    assert seams > shape.V


@pytest.mark.slow
def test_a_game_character_keeps_every_vertex(bench: Path) -> None:
    path = bench / "textured" / "Rogue_Hooded.glb"
    data = path.read_bytes()
    document = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    primitives = [p for n in document["nodes"] if "mesh" in n for p in document["meshes"][n["mesh"]]["primitives"]]
    accessors = document["accessors"]
    shape = load_shape(path)
    V = sum(accessors[p["attributes"]["POSITION"]]["count"] for p in primitives)
    F = sum(accessors[p["indices"]]["count"] for p in primitives) // 3
    assert (shape.V, shape.F) == (V, F)
    other = trimesh.load(path, process=False).to_geometry()
    np.testing.assert_allclose(shape.bounds, other.bounds, atol=1e-5)
    assert shape.area == pytest.approx(other.area, rel=1e-5)


def test_plies_agree_with_an_independent_reader(bench: Path) -> None:
    for path in [*sorted(bench.glob("shrec19/*.ply"))[:4], *sorted(bench.glob("heart/*.ply"))[:2]]:
        other = trimesh.load(path, process=False)
        shape = load_shape(path)
        np.testing.assert_array_equal(shape.verts, other.vertices)
        np.testing.assert_array_equal(shape.faces, other.faces)


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".off", ".glb"])
def test_an_independent_reader_reads_what_is_written(tmp_path: Path, sphere: Shape, suffix: str) -> None:
    save_shape(tmp_path / f"s{suffix}", sphere)
    other = trimesh.load(tmp_path / f"s{suffix}", process=False, force="mesh")
    np.testing.assert_allclose(other.vertices, sphere.verts, atol=1e-7)
    np.testing.assert_array_equal(other.faces, sphere.faces)
