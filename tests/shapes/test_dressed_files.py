"""A glb or an obj that gets a texture or colors stays the file that it was, but for these."""

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from meshmatch.errors import MeshmatchWarning
from meshmatch.shapes.appearance import BakedMaterial
from meshmatch.shapes.dressed_files import Dressed, save_colored
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.formats.gltf import Document
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.textured_files import load_appearance, load_coordinates
from tests.blender_at_hand import stand_in
from tests.shapes.painted import CORNERS, FACES, UV, encoded, quarters, write_document, write_gltf
from tests.transfer.rigs import posed_verts, write_tube

PLAIN = BakedMaterial(quarters(8), name="paint")
UPRIGHT = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
LEAF = b"""# a leaf
mtllib leaf.mtl
o leaf
v 0 0 0 1 0 0
v 1 0 0 # the second
v 1 1 0
v 0 1 0
v 2 0 0
v 2 1 0
vt 0 0
vt 1 1
vn 0 0 1
g half
usemtl green
s 1
f 1/1/1 2/2/1 3/2/1 4//1 # a quad
usemtl red
f -5 -2/1 6 3
"""


def read(path: Path) -> Document:
    return Document(path, path.read_bytes())


def apart(shape: Shape) -> np.ndarray:
    """Coordinates of which no two triangles share any."""
    side = int(np.ceil(np.sqrt(shape.F)))
    k = np.arange(shape.F)
    corner = np.stack([k % side, k // side], axis=1)[:, None] + np.array([[0.1, 0.1], [0.8, 0.1], [0.1, 0.8]])
    return np.asarray(corner / side)


def dressed(path: Path, out: str = "out.glb", own: bool = False, material: BakedMaterial = PLAIN, **more: Any) -> Path:
    shape = load_shape(path)
    uv = load_coordinates(path, shape) if own else apart(shape)
    assert uv is not None
    Dressed(shape, path, uv, own, material, **more).save(path.with_name(out))
    return path.with_name(out)


# glb


def test_a_rigged_glb_keeps_its_skin_and_clips(tmp_path: Path) -> None:
    """Vertices are copied at seams, with the joints that move them, and move as before."""
    path = tmp_path / "tube.glb"
    shape = write_tube(path, stands=20)
    out = dressed(path)
    before, after = read(path), read(out)
    assert (after.json["nodes"], after.json["scenes"]) == (before.json["nodes"], before.json["scenes"])
    assert after.json["meshes"][0]["name"] == before.json["meshes"][0]["name"]
    vertex = np.abs(load_shape(out).verts[:, None] - load_shape(path).verts[None]).sum(axis=2).argmin(axis=1)
    assert len(vertex) == 3 * shape.F + (shape.V - len(np.unique(shape.faces))) and vertex[: shape.V].tolist() == [
        *range(shape.V)
    ]
    for time in (0.0, 0.6):
        np.testing.assert_allclose(posed_verts(out, "bend", time), posed_verts(path, "bend", time)[vertex], atol=1e-6)
    np.testing.assert_allclose(load_coordinates(out, load_shape(out)), apart(load_shape(path)), atol=1e-6)
    [material] = load_appearance(out, load_shape(out)).materials
    assert material.name == "paint"
    np.testing.assert_array_equal(material.image, quarters(8))


def test_coordinates_that_a_transform_moves_become_plain_ones(tmp_path: Path) -> None:
    """Whole numbers that a transform scales, as tools that compress write them; another map keeps its own."""
    path = tmp_path / "small.glb"
    scaled = {"KHR_texture_transform": {"scale": [1 / 4095, 1 / 4095]}}
    paint = {"baseColorTexture": {"index": 0, "extensions": scaled}}
    write_gltf(
        path,
        images=[encoded(quarters())],
        primitives=[{"material": 0, "uv": 4095 * UV}],
        materials=[{"pbrMetallicRoughness": paint, "occlusionTexture": {"index": 0, "extensions": scaled}}],
        extensionsUsed=["KHR_texture_transform"],
    )
    np.testing.assert_allclose(load_coordinates(path, load_shape(path)), UV[FACES], atol=1e-6)
    out = dressed(path, own=True)
    np.testing.assert_allclose(load_coordinates(out, load_shape(out)), UV[FACES], atol=1e-6)
    after = read(out)
    [material] = after.json["materials"]
    assert "extensions" not in material["pbrMetallicRoughness"]["baseColorTexture"]
    other = material["occlusionTexture"]
    assert other == {"index": other["index"], "extensions": scaled, "texCoord": 1}
    attributes = after.json["meshes"][0]["primitives"][0]["attributes"]
    np.testing.assert_array_equal(after.accessor(attributes["TEXCOORD_1"]), 4095 * UV)
    assert load_shape(out).V == 4  # nothing is copied


@pytest.mark.parametrize("other", [False, True])
def test_images_that_nobody_reads_go_when_they_are_replaced(tmp_path: Path, other: bool) -> None:
    """And what a program needs for them; unless another map is of that kind."""
    path, needed = tmp_path / "small.glb", "KHR_texture_basisu"
    write_gltf(
        path,
        images=[encoded(quarters()), encoded(quarters()[::-1])][: 1 + other],  # what they hold is not looked at
        primitives=[{"material": 0}],
        textures=[{"extensions": {needed: {"source": k}}} for k in range(1 + other)],
        materials=[
            {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}
            | ({"occlusionTexture": {"index": 1}} if other else {})
        ],
        extensionsUsed=[needed],
        extensionsRequired=[needed],
    )
    after = read(dressed(path, own=True)).json
    assert after.get("extensionsRequired") == after.get("extensionsUsed") == ([needed] if other else None)
    assert [image.get("name") for image in after["images"]].count("paint") == 1
    assert len(after["images"]) == 1 + other


def scene(path: Path, **more: Any) -> None:
    """Two squares with materials of their own, normals, a second set of coordinates, colors, and a morph target."""
    arrays = [
        CORNERS.astype("f4"),
        np.tile(np.array([[0.0, 0, 1]], "f4"), (4, 1)),
        UV.astype("f4"),
        (0.5 * UV).astype("f4"),
        FACES.ravel().astype("u2"),
        np.array([[255, 0, 0, 255]] * 4, "u1"),
        (0.1 * CORNERS).astype("f4"),
        np.frombuffer(encoded(quarters()), "u1"),
        np.tile(np.array([[1.0, 0, 0, 1]], "f4"), (4, 1)),
    ]
    attributes = {
        "POSITION": 0,
        "NORMAL": 1,
        "TEXCOORD_0": 2,
        "TEXCOORD_1": 3,
        "COLOR_0": 5,
        "COLOR_1": 5,
        "TANGENT": 8,
    }
    parts = [
        {"attributes": attributes, "indices": 4, "material": 0, "targets": [{"POSITION": 6}]},
        {"attributes": {"POSITION": 0, "TEXCOORD_0": 2}, "indices": 4, "material": 1, "targets": [{"POSITION": 6}]},
    ]
    materials = [
        {
            "name": "skin",
            "doubleSided": True,
            "extras": {"kept": 1},
            "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "baseColorFactor": [0.5, 1, 1, 1]},
            "normalTexture": {"index": 0, "scale": 2},
        },
        {"name": "glass", "alphaMode": "BLEND", "emissiveFactor": [1, 0, 0]},
    ]
    document = {
        "nodes": [{"mesh": 0, "name": "left"}, {"mesh": 0, "name": "right", "translation": [2, 0, 0]}],
        "meshes": [{"name": "squares", "primitives": parts, "extras": {"targetNames": ["swell"]}}],
        "materials": materials,
        "textures": [{"source": 0}],
        "images": [{"bufferView": 7, "mimeType": "image/png"}],
    }
    write_document(path, document | more, *arrays, normalized=5)


def test_everything_else_of_a_scene_stays(tmp_path: Path) -> None:
    path = tmp_path / "scene.glb"
    scene(path)
    out = dressed(path)
    document = read(out)
    assert [node["name"] for node in document.json["nodes"]] == ["left", "right"]
    first, second = (document.json["meshes"][node["mesh"]] for node in document.json["nodes"])
    assert first is not second and first["name"] == second["name"] == "squares"  # a place in the image for each
    skin, glass = document.json["materials"]
    assert (skin["name"], skin["doubleSided"], skin["extras"]) == ("skin", True, {"kept": 1})
    assert (glass["name"], "alphaMode" in glass, "emissiveFactor" in glass) == ("glass", False, False)
    color = skin["pbrMetallicRoughness"]["baseColorTexture"]["index"]
    assert "baseColorFactor" not in skin["pbrMetallicRoughness"]
    assert glass["pbrMetallicRoughness"]["baseColorTexture"]["index"] == color != skin["normalTexture"]["index"]
    # Its own normal map lies on what were the first coordinates.
    assert skin["normalTexture"] | {"index": 0} == {"index": 0, "scale": 2, "texCoord": 2}
    attributes = first["primitives"][0]["attributes"]
    vertex = np.array([0, 1, 2, 3, 0, 2])
    for key, values in {"TEXCOORD_2": UV, "TEXCOORD_1": 0.5 * UV, "_COLOR_0": np.tile([1.0, 0, 0, 1], (4, 1))}.items():
        np.testing.assert_allclose(document.accessor(attributes[key]), values[vertex])
    assert "COLOR_0" not in attributes  # it would tint the image
    assert "_COLOR_1" in attributes and "COLOR_1" not in attributes  # sets are counted from 0
    target = document.accessor(first["primitives"][1]["targets"][0]["POSITION"])
    np.testing.assert_allclose(target, 0.1 * CORNERS[vertex], atol=1e-7)
    np.testing.assert_allclose(load_coordinates(out, load_shape(out)), apart(load_shape(path)), atol=1e-6)


@pytest.mark.parametrize("own", [True, False])
def test_a_normal_map_brings_the_normals_that_it_was_baked_for(tmp_path: Path, own: bool) -> None:
    """Of a part without normals, viewers ignore tangents; those of another part of the mesh stay."""
    path = tmp_path / "scene.glb"
    scene(path)
    before = read(path)
    layers = BakedMaterial(quarters(8), name="made", normal=np.full((8, 8, 4), [128, 128, 255, 255], np.uint8))
    out = dressed(path, own=own, material=layers)
    document = read(out)
    assert len(document.json["meshes"]) == 2
    for mesh in document.json["meshes"]:
        first, second = (primitive["attributes"] for primitive in mesh["primitives"])
        assert (first["NORMAL"] == before.json["meshes"][0]["primitives"][0]["attributes"]["NORMAL"]) == own
        for part in (first, second):
            count = document.count(part["POSITION"])
            np.testing.assert_allclose(document.accessor(part["NORMAL"]), np.tile([0, 0, 1], (count, 1)), atol=1e-6)
            assert document.accessor(part["TANGENT"]).shape == (count, 4)


def test_coordinates_that_are_kept_split_nothing(tmp_path: Path) -> None:
    path = tmp_path / "own.gltf"
    write_gltf(path, images=[encoded(quarters())], primitives=[{"material": 0}])
    out = dressed(path, own=True)
    before, after = read(path), read(out)
    (old,), (new,) = (each.json["meshes"][0]["primitives"] for each in (before, after))
    for key in ("POSITION", "TEXCOORD_0"):
        np.testing.assert_array_equal(after.accessor(new["attributes"][key]), before.accessor(old["attributes"][key]))
    assert len(after.json["images"]) == 1  # the old one is gone
    np.testing.assert_array_equal(load_appearance(out, load_shape(out)).materials[0].image, quarters(8))


def test_strips_and_shared_materials(tmp_path: Path) -> None:
    """A strip becomes triangles; a material of a mesh that is not in the scene stays for that."""
    path = tmp_path / "strip.glb"
    strip = {"attributes": {"POSITION": 0}, "mode": 5, "material": 0}
    away = strip | {"mode": 6}
    document = {
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}, {"mesh": 1}],
        "meshes": [{"primitives": [strip]}, {"primitives": [away]}],
        "materials": [{"name": "both", "alphaMode": "BLEND"}],
    }
    write_document(path, document, CORNERS[[0, 1, 3, 2]].astype("f4"))
    out = dressed(path)
    after = read(out)
    worn, other = (mesh["primitives"][0]["material"] for mesh in after.json["meshes"])
    assert (other, after.json["materials"][0]) == (0, {"name": "both", "alphaMode": "BLEND"})
    assert after.json["materials"][worn]["name"] == "both" and worn == 1
    np.testing.assert_array_equal(
        load_shape(out).verts[load_shape(out).faces], load_shape(path).verts[load_shape(path).faces]
    )


def test_a_lying_ply_is_turned_by_a_node(tmp_path: Path) -> None:
    path = tmp_path / "lying.ply"
    save_shape(path, Shape(CORNERS, FACES, "lying"))
    out = dressed(path, turn=UPRIGHT)
    document = read(out)
    assert document.accessor(0)[:4].tolist() == CORNERS.tolist()
    np.testing.assert_allclose(load_shape(out).verts[:4], CORNERS @ UPRIGHT.T, atol=1e-7)


def test_copies_of_a_mesh_become_one_mesh_and_are_told(tmp_path: Path) -> None:
    path = tmp_path / "copies.glb"
    instances = {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": 2}}}
    document = {
        "nodes": [{"mesh": 0, "extensions": instances}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
    }
    places = np.array([[0, 0, 0], [2, 0, 0]], "f4")
    write_document(path, document, CORNERS.astype("f4"), FACES.ravel().astype("u2"), places)
    with pytest.warns(MeshmatchWarning, match=r"copies\.glb draws copies of one mesh"):
        out = dressed(path)
    assert load_shape(out).F == 4


# obj


def test_an_obj_keeps_its_polygons_groups_and_normals(tmp_path: Path) -> None:
    path = tmp_path / "leaf.obj"
    path.write_bytes(LEAF)
    shape = load_shape(path)
    uv = np.zeros((4, 3, 2))
    corners = [UV[k] / 2 for k in range(4)], [0.5 + UV[k] / 2 for k in range(4)]
    for k, (quad, triangle) in enumerate(((0, (0, 1, 2)), (0, (0, 2, 3)), (1, (0, 1, 2)), (1, (0, 2, 3)))):
        uv[k] = [corners[quad][at] for at in triangle]
    out = tmp_path / "out" / "worn.obj"
    out.parent.mkdir()
    Dressed(shape, path, uv, False, PLAIN).save(out)
    lines = out.read_text().split("\n")
    assert lines[:3] == ["mtllib worn.mtl", "# a leaf", "o leaf"]
    assert [line for line in lines if line[:2] in ("g ", "s ", "us", "vn")] == [
        "vn 0 0 1", "g half", "usemtl green", "s 1", "usemtl red"
    ]  # fmt: skip
    faces = [line.split() for line in lines if line.startswith("f")]
    assert [[corner.split("/")[0] for corner in face[1:5]] for face in faces] == [
        ["1", "2", "3", "4"],
        ["-5", "-2", "6", "3"],
    ]
    assert [corner.split("/")[2:] for corner in faces[0][1:5]] == [["1"]] * 4 and "# a quad" in out.read_text()
    again = load_shape(out)
    np.testing.assert_array_equal(again.faces, shape.faces)
    np.testing.assert_allclose(load_coordinates(out, again), uv, atol=1e-7)
    look = load_appearance(out, again)
    assert [material.name for material in look.materials] == ["green", "red"]
    np.testing.assert_array_equal(look.materials[1].image, quarters(8))


def test_an_obj_whose_coordinates_are_kept_has_another_material_alone(tmp_path: Path) -> None:
    path = tmp_path / "own.obj"
    path.write_bytes(LEAF.replace(b"4//1", b"4/1/1").replace(b"-5 -2/1 6 3", b"-5/1 -2/1 6/2 3/2"))
    out = dressed(path, "worn.obj", own=True)
    before, after = (each.read_text().split("\n") for each in (path, out))
    assert [line for line in after if not line.startswith("mtllib")] == [
        line for line in before if not line.startswith("mtllib")
    ]


def test_faces_without_a_material_get_one(tmp_path: Path) -> None:
    path = tmp_path / "bare.obj"
    path.write_bytes(b"v 0 0 0\nv 1 0 0\nv 0 1 0\nfo 1 2 3\nusemtl late\nf 3 2 1")
    out = dressed(path, "worn.obj")
    look = load_appearance(out, load_shape(out))
    assert [material.name for material in look.materials] == ["paint", "late"]
    assert all(material.image is not None for material in look.materials)
    np.testing.assert_allclose(load_coordinates(out, load_shape(out)), apart(load_shape(path)), atol=1e-6)


# What is lost


@pytest.mark.parametrize(
    ("name", "out", "said"),
    [
        ("tube.glb", "out.obj", "out.obj does not have the nodes, skins and clips of tube.glb"),
        ("leaf.obj", "out.glb", "out.glb does not have the polygons, groups, materials and normals of leaf.obj"),
        ("leaf.obj", "out.fbx", "out.fbx does not have the polygons, groups, materials and normals of leaf.obj"),
        ("tube.glb", "out.glb", ""),
        ("tube.glb", "out.usdz", ""),
        ("leaf.obj", "out.obj", ""),
        ("plain.ply", "out.glb", ""),
    ],
)
def test_what_a_format_does_not_hold_is_one_line(
    tmp_path: Path, name: str, out: str, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    stand_in(tmp_path, monkeypatch)
    write_tube(tmp_path / "tube.glb")
    (tmp_path / "leaf.obj").write_bytes(LEAF)
    save_shape(tmp_path / "plain.ply", Shape(CORNERS, FACES, "plain"))
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        dressed(tmp_path / name, out)
    assert [str(each.message) for each in told] == ([said] if said else [])


# Colors


@pytest.mark.parametrize("name", ["tube.glb", "leaf.obj", "plain.ply"])
def test_colors_alone(tmp_path: Path, name: str) -> None:
    write_tube(tmp_path / "tube.glb", stands=20)
    (tmp_path / "leaf.obj").write_bytes(LEAF)
    save_shape(tmp_path / "plain.ply", Shape(CORNERS, FACES, "plain"))
    path = tmp_path / name
    shape = load_shape(path)
    colors = np.random.default_rng(0).random((shape.V, 4))
    colors[:, 3] = 1
    painted = Shape(shape.verts, shape.faces, shape.name, colors)
    out = tmp_path / ("out" + (".obj" if name == "leaf.obj" else ".glb"))
    save_colored(out, painted, path, UPRIGHT)
    again = load_shape(out)
    assert again.colors is not None
    np.testing.assert_allclose(again.colors, colors, atol=1e-6)
    np.testing.assert_array_equal(again.faces, shape.faces)
    if name == "tube.glb":
        np.testing.assert_allclose(posed_verts(out, "bend", 0.6), posed_verts(path, "bend", 0.6), atol=1e-6)
    elif name == "leaf.obj":
        same = [line for line in out.read_text().split("\n") if not line.startswith("v ")]
        assert same == [line for line in LEAF.decode().split("\n") if not line.startswith("v ")]
    else:
        np.testing.assert_allclose(again.verts, CORNERS @ UPRIGHT.T, atol=1e-7)
