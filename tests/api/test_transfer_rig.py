"""Rigs on other shapes: maps are made by construction."""

import json
import re
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import meshmatch
from meshmatch.errors import InputError, MeshmatchWarning, OptionError
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.dressed_files import save_textured
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.formats import TexturedMesh
from meshmatch.shapes.formats.gltf import Document, digest
from meshmatch.shapes.formats.gltf_attachments import find_rigid_groups
from meshmatch.shapes.formats.gltf_edit import Editor
from meshmatch.shapes.formats.gltf_rig import read_rig
from meshmatch.shapes.repair import repair
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.textured_files import load_appearance, load_coordinates
from tests.conftest import some_fit
from tests.shapes.painted import encoded, quarters, write_document
from tests.transfer.rigs import AROUND, BEND, KNEE, NODES, posed_verts, tube, volume, weights_of, write_tube

UPRIGHT = np.array([[0, 0, 0, 1]] * 2, "f4")
JOINTS = ("root", "hip", "knee", "foot")


@pytest.fixture
def source(tmp_path: Path) -> Path:
    path = tmp_path / "source.glb"
    write_tube(path)
    return path


def same_order(source: Path, target: Path) -> VertexMap:
    """Vertex i to vertex i, round and round."""
    a, b = load_shape(source), load_shape(target)
    return VertexMap.between(a, b, np.arange(a.V) % b.V, verdict="good")


def to_both_parts(source: Path, target: Path) -> VertexMap:
    """Vertex i to vertex i of one of two meshes, in turn, so that neither is a copy of what was matched."""
    a, b = load_shape(source), load_shape(target)
    order = np.arange(a.V)
    return VertexMap.between(a, b, order + order % 2 * a.V, verdict="good")


def rigged(
    source: Path, target: Path, match: VertexMap | None = None, **options: Any
) -> tuple[Path, meshmatch.RiggedResult]:
    result = meshmatch.transfer_rig(source, target, match or same_order(source, target), **options)
    out = target.with_name("rigged.glb")
    result.save(out)
    return out, result


def joints_of(path: Path) -> dict[str, np.ndarray]:
    rig = read_rig(path, path.read_bytes())
    return dict(zip(rig.names, rig.worlds(), strict=True))


def test_a_larger_tube_that_lies_and_faces_elsewhere(source: Path) -> None:
    """The ply is z-up: it stands afterwards, its joints are where they belong, and it bends as the source does."""
    heading = Rotation.from_euler("y", 25, degrees=True).as_matrix()
    lying = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    shift = np.array([3.0, -2.0, 5.0])
    shape, target = tube(), source.with_name("target.ply")
    stands = 2 * shape.verts @ heading.T + shift
    save_shape(target, Shape(stands @ lying.T, shape.faces, "target"))
    out, result = rigged(source, target)
    raw = Document(out, out.read_bytes())
    assert np.allclose(raw.accessor(0), stands @ lying.T, atol=1e-5)  # the vertices are those of the file
    assert np.abs(posed_verts(out) - stands).max() < 1e-5
    before, after = joints_of(source), joints_of(out)
    assert list(after) == ["source", *NODES[:-1]]
    assert [after[name][:3, 3].tolist() for name in JOINTS] == [
        pytest.approx((2 * heading @ before[name][:3, 3] + shift).tolist(), abs=1e-5) for name in JOINTS
    ]
    rig = read_rig(out, out.read_bytes())
    assert [rig.names[parent] for parent in rig.parents[1:]] == ["source", "armature", "root", "hip", "knee", "root"]
    for time in (0.0, 0.5, 1.0):
        expected = 2 * posed_verts(source, "bend", time) @ heading.T + shift
        assert np.abs(posed_verts(out, "bend", time) - expected).max() < 1e-4
    assert result.unused == ()
    assert np.allclose(result.weights.matrix.sum(axis=1), 1)


def test_what_the_source_lacks_goes_with_what_it_hangs_from(source: Path) -> None:
    """A cape hangs down around the tube from its top, where the map takes it to what is nearest."""
    shape, target = tube(), source.with_name("target.ply")
    top = 40 * AROUND + np.arange(AROUND)
    cape = shape.verts[top] * [1.6, 0, 1.6] + np.linspace(1.9, 0.3, 13)[:, None, None] * [0.0, 1, 0]
    rows = np.concatenate([[top], shape.V + np.arange(13 * AROUND).reshape(13, AROUND)])
    one, two, three, four = rows[:-1], np.roll(rows[:-1], -1, 1), rows[1:], np.roll(rows[1:], -1, 1)
    sides = np.concatenate([np.stack([one, two, three], -1), np.stack([two, four, three], -1)]).reshape(-1, 3)
    faces = np.concatenate([shape.faces, sides])
    verts = np.concatenate([shape.verts, cape.reshape(-1, 3)])
    save_shape(target, Shape(verts, faces, "target"))
    a, b = load_shape(source), load_shape(target)
    nearest = np.linalg.norm(verts[:, None] - a.verts, axis=2).argmin(axis=1)
    forward, backward = VertexMap.between(a, b, np.arange(a.V), verdict="good"), VertexMap.between(b, a, nearest)
    maps = meshmatch.MapPair(a, b, forward, opposite=backward)
    found = meshmatch.transfer_rig(source, target, maps).weights
    foot = found.matrix.toarray()[:, found.names.index("foot")]
    assert foot[[*top, *range(a.V, b.V)]] == pytest.approx(np.ones(14 * AROUND))


def test_a_target_in_another_pose_plays_the_same_clips(source: Path) -> None:
    """It stands as it came, or as the source; bends from straight; and keeps its volume, its foot on the leg."""
    shape, target = tube(), source.with_name("target.ply")
    bent = posed_verts(source, "bend", 1.0)
    save_shape(target, Shape(bent, shape.faces, "target"))
    out, _ = rigged(source, target)
    assert np.abs(posed_verts(out) - bent).max() < 1e-5
    straight = posed_verts(out, "bend", 0.0)
    assert np.linalg.norm(straight - shape.verts, axis=1).mean() < 0.03
    assert np.linalg.norm(posed_verts(out, "bend", 1.0) - bent, axis=1).mean() < 0.03
    assert volume(straight, shape.faces) > 0.95 * volume(shape.verts, shape.faces) > 0
    out, result = rigged(source, target, pose="source")
    assert np.abs(posed_verts(out) - straight).max() < 1e-5
    assert {track.node for clip in result.rig.clips for track in clip.tracks} == {4, 6}  # the source's own alone
    angle = Rotation.from_matrix(result.rig.worlds()[4, :3, :3] @ result.rig.worlds()[3, :3, :3].T).magnitude()
    assert angle < np.radians(1)


def test_a_foot_that_hangs_from_the_root_stays_on_a_shorter_leg(source: Path) -> None:
    """Though the clip moves it as far as that of the source."""
    shape, target = tube(), source.with_name("target.ply")
    short = shape.verts.copy()
    short[:, 1] = np.where(short[:, 1] > 1, 1 + (short[:, 1] - 1) / 2, short[:, 1])
    save_shape(target, Shape(short, shape.faces, "target"))
    out, _ = rigged(source, target)
    for time in (0.0, 0.37, 1.0):
        turn = Rotation.from_euler("x", BEND * time, degrees=True)
        assert np.linalg.norm(posed_verts(out, "bend", time)[-1] - KNEE - turn.apply([0, 0.5, 0])) < 0.04


def test_what_somebody_noted_at_bones_and_clips_arrives(source: Path) -> None:
    editor = Editor(Document(source, source.read_bytes()))
    editor.json["nodes"][NODES.index("knee")]["extras"] = {"twist": 0}
    editor.json["animations"][0]["extras"] = {"loop": True}
    source.write_bytes(editor.to_bytes())
    target = source.with_name("target.ply")
    save_shape(target, tube())
    out, _ = rigged(source, target)
    found = Document(out, out.read_bytes()).json
    assert [node["name"] for node in found["nodes"] if node.get("extras") == {"twist": 0}] == ["knee"]
    assert [clip.get("extras") for clip in found["animations"]] == [{"loop": True}]


@pytest.mark.parametrize("interpolation", ["STEP", "CUBICSPLINE"])
def test_other_interpolations_are_kept(source: Path, interpolation: str) -> None:
    """The foot, which follows the knee, gets keys of its own."""
    document = Document(source, source.read_bytes())
    editor = Editor(document)
    for sampler in editor.json["animations"][0]["samplers"]:
        sampler["interpolation"] = interpolation
        if interpolation == "CUBICSPLINE":
            values = document.accessor(sampler["output"])
            slopes = np.gradient(values, axis=0) * (len(values) - 1)
            sampler["output"] = editor.add_array(
                np.stack([slopes, values, slopes], 1).reshape(-1, values.shape[1]).astype("f4")
            )
    source.write_bytes(editor.to_bytes())
    target = source.with_name("target.ply")
    save_shape(target, Shape(2 * tube().verts, tube().faces, "target"))
    _, result = rigged(source, target)
    before = read_rig(source, source.read_bytes()).clips[0].tracks
    after = result.rig.clips[0].tracks
    assert [track.interpolation for track in after[:2]] == [interpolation] * 2
    assert np.allclose(after[0].values, before[0].values, atol=1e-6)
    foot = next(track for track in after if track.moves == "translation" and result.rig.names[track.node] == "foot")
    values = before[2].values[1::3] if interpolation == "CUBICSPLINE" else before[2].values
    assert np.allclose(foot.values, 200 * values, atol=0.02)
    assert foot.interpolation == ("STEP" if interpolation == "STEP" else "LINEAR")


@pytest.mark.parametrize("clips", [True, False])
def test_joints_that_are_stretched_are_told(source: Path, clips: bool) -> None:
    """If there are clips, which show it."""
    write_tube(source, clips=clips)
    editor = Editor(Document(source, source.read_bytes()))
    knee = editor.json["nodes"][NODES.index("knee")]
    knee["scale"] = [1.0, 1.5, 1.0]
    source.write_bytes(editor.to_bytes())
    target = source.with_name("target.ply")
    save_shape(target, tube())
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        rigged(source, target)
    told = "1 of 4 joints of source.glb, such as knee, have a scale that differs by axis"
    assert [str(each.message).startswith(told) for each in said] == [True] * clips


@pytest.mark.parametrize("clip", ["lies", "stands", "is not there"])
def test_a_source_that_lies_in_its_file_and_in_clips_is_told(source: Path, clip: str) -> None:
    """A node above the armature lays it down along z, out of which one clip turns it."""
    quarter = Rotation.from_euler("x", 90, degrees=True)
    up = [{"sampler": 0, "target": {"node": 7, "path": "rotation"}}]
    editor = Editor(Document(source, source.read_bytes()))
    editor.json["scenes"][0]["nodes"] = [
        editor.add("nodes", {"rotation": quarter.as_quat().tolist(), "children": [0]}),
        6,
    ]
    if clip == "stands":
        times, values = editor.add_array(np.zeros(1, "f4"), bounds=True), editor.add_array(UPRIGHT[:1])
        editor.json["animations"][0] = {"name": "up", "samplers": [{"input": times, "output": values}], "channels": up}
    elif clip != "lies":
        del editor.json["animations"]
    source.write_bytes(editor.to_bytes())
    target = source.with_name("target.ply")
    save_shape(target, tube())
    maps = replace(same_order(source, target), source_up="+z", target_up="+y")
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        meshmatch.transfer_rig(source, target, maps)
    told = "source.glb lies in its file, where +z is up, and target.ply will lie in its clips: export it with y up"
    assert [str(each.message) for each in said] == [told] * (clip == "lies")


def two_parts(path: Path, hanging: bool = False) -> dict[str, Any]:
    """A glb or gltf with one mesh in two places, a material with an image, and more that is to stay; its document."""
    shape = tube()
    uv = np.random.default_rng(0).random((shape.V, 2))
    arrays = [shape.verts.astype("f4"), shape.faces.ravel().astype("u2"), uv.astype("f4")]
    arrays.append(np.frombuffer(encoded(quarters()), "u1"))
    primitive = {"attributes": {"POSITION": 0, "TEXCOORD_0": 2}, "indices": 1, "material": 0}
    document: dict[str, Any] = {
        "scene": 0,
        "scenes": [{"name": "all", "nodes": [0, 3]}],
        "nodes": [
            {"name": "holder", "translation": [0, 0.5, 0], "children": [1, 2], "extras": {"kept": True}},
            {"name": "left", "mesh": 0, "scale": [2, 2, 2]},
            {"name": "right", "mesh": 0, "translation": [1, 0, 0]},
            {"name": "lamp"},
        ],
        "meshes": [{"name": "part", "primitives": [primitive]}],
        "materials": [
            {"name": "paint", "doubleSided": True, "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}
        ],
        "textures": [{"source": 0}],
        "images": [{"name": "four", "bufferView": 3, "mimeType": "image/png"}],
    }
    if hanging:
        document["skins"] = [{"joints": [3]}]
        document["nodes"][3]["children"] = [2]
        document["nodes"][0]["children"] = [1]
    write_document(path, document, *arrays)
    return Document(path, path.read_bytes()).json


def test_a_glb_stays_as_it_came(source: Path) -> None:
    """Nodes, materials, images, arrays and their bytes. A mesh that stands twice is there twice, for its weights differ, and
    hangs from nothing but its skeleton, in the same order.
    """
    target = source.with_name("target.glb")
    before = two_parts(target)
    shape = load_shape(target)
    out, _ = rigged(source, target, to_both_parts(source, target))
    after = Document(out, out.read_bytes())
    assert after.json["asset"].pop("extras")["meshmatch"]["made_of"] == [shape.hash]
    for kind in ("materials", "textures", "images", "asset"):
        assert after.json[kind] == before[kind]
    for kind in ("accessors", "bufferViews"):
        assert after.json[kind][: len(before[kind])] == before[kind]
    for old, new in zip(before["nodes"], after.json["nodes"], strict=False):
        own = {key: value for key, value in old.items() if key not in ("children", "scale")}
        own.pop("translation" if "mesh" in old else "", None)
        assert new == own | {key: new[key] for key in ("mesh", "skin") if "mesh" in old}
    assert after.json["scenes"] == [{"name": "all", "nodes": [0, 1, 2, 3, 4]}]
    assert len(after.json["meshes"]) == 2
    for mesh in after.json["meshes"]:
        attributes = mesh["primitives"][0]["attributes"]
        assert attributes.pop("JOINTS_0") >= len(before["accessors"]) <= attributes.pop("WEIGHTS_0")
        assert mesh == before["meshes"][0]
    assert after.body.startswith(Document(target, target.read_bytes()).body)
    assert np.abs(load_shape(out).verts - shape.verts).max() < 1e-5
    assert np.array_equal(load_shape(out).faces, shape.faces)


def camera_place(path: Path) -> np.ndarray:
    document = Document(path, path.read_bytes())
    document.scene()
    return document.world[next(k for k, node in enumerate(document.nodes) if "camera" in node)]


def test_meshes_that_move_something_else(source: Path) -> None:
    """A camera stays where its mesh was; a mesh that hangs from a mesh does not."""
    target = source.with_name("target.glb")
    nodes = two_parts(target)["nodes"]
    nodes[0]["children"], nodes[1]["children"] = [1], [2]
    shape = tube()
    arrays = shape.verts.astype("f4"), shape.faces.ravel().astype("u2"), np.arange(2, dtype="f4"), UPRIGHT
    primitive = {"attributes": {"POSITION": 0}, "indices": 1}
    channels = [{"sampler": 0, "target": {"node": node, "path": "rotation"}} for node in (0, 1)]
    clip = {"name": "wave", "samplers": [{"input": 2, "output": 3}], "channels": channels}
    document = {"nodes": nodes, "meshes": [{"primitives": [primitive]}], "scenes": [{"nodes": [3, 0]}]}
    document |= {"animations": [clip]}
    write_document(target, document, *arrays)
    where = load_shape(target).verts
    with pytest.warns(MeshmatchWarning, match="clips of target.glb that moved a mesh as a whole no longer do"):
        out, _ = rigged(source, target, to_both_parts(source, target))
    found = Document(out, out.read_bytes()).json
    assert found["scenes"][0]["nodes"] == [3, 0, 1, 2, 4]
    assert [each["target"]["node"] for each in found["animations"][0]["channels"]] == [0]
    assert not any({"children", "scale"} & found["nodes"][k].keys() for k in (1, 2))
    np.testing.assert_allclose(load_shape(out).verts, where, atol=1e-5)
    nodes[1] |= {"camera": 0}
    camera = {"type": "perspective", "perspective": {"yfov": 1, "znear": 0.1}}
    write_document(target, document | {"cameras": [camera]}, *arrays)
    with pytest.warns(MeshmatchWarning, match="as a whole"):
        out, _ = rigged(source, target, to_both_parts(source, target))
    found = Document(out, out.read_bytes()).json
    assert found["scenes"][0]["nodes"][:4] == [3, 0, len(found["nodes"]) - 1, 2]
    assert found["nodes"][1] == {key: nodes[1][key] for key in ("name", "scale", "camera")}
    assert found["nodes"][-1]["name"] == "left"
    assert [each["target"]["node"] for each in found["animations"][0]["channels"]] == [0, 1]  # of the camera
    np.testing.assert_allclose(load_shape(out).verts, where, atol=1e-5)
    nodes[2] |= {"camera": nodes[1].pop("camera")}  # below a mesh
    write_document(target, document | {"cameras": [camera]}, *arrays)
    stood = camera_place(target)
    with pytest.warns(MeshmatchWarning, match="as a whole"):
        out, _ = rigged(source, target, to_both_parts(source, target))
    np.testing.assert_allclose(camera_place(out), stood, atol=1e-9)
    np.testing.assert_allclose(load_shape(out).verts, where, atol=1e-5)


def test_a_gltf_becomes_a_glb_that_needs_no_other_file(source: Path) -> None:
    target = source.with_name("target.gltf")
    two_parts(target)
    image = encoded(quarters())
    words = json.loads(target.read_text())
    words["images"] = [{"uri": "four.png"}, {"uri": "four.png", "name": "again"}]
    target.write_text(json.dumps(words))
    with pytest.raises(InputError, match=r"needs the file four\.png"):
        rigged(source, target, to_both_parts(source, target))
    target.with_name("four.png").write_bytes(image)
    shape = load_shape(target)
    out, _ = rigged(source, target, to_both_parts(source, target))
    target.with_name("four.png").unlink()
    found = Document(out, out.read_bytes())
    assert [found.view_bytes(entry["bufferView"]) for entry in found.json["images"]] == [image, image]
    assert "uri" not in json.dumps(found.json)
    assert np.abs(load_shape(out).verts - shape.verts).max() < 1e-5


def test_what_hangs_from_a_joint_stays_rigid(source: Path) -> None:
    """It lies where weights vary, below a node that is no joint, as a sword in a socket."""
    target = source.with_name("target.glb")
    two_parts(target, hanging=True)
    document = Document(target, target.read_bytes())
    editor = Editor(document)
    editor.json["nodes"][3]["children"] = [editor.add("nodes", {"name": "socket", "children": [2]})]
    editor.json["nodes"][2] |= {"translation": [0, 0.5, 0], "scale": [2.01, 2.01, 2.01]}
    target.write_bytes(editor.to_bytes())
    V = tube().V
    _, result = rigged(source, target)
    matrix = result.weights.matrix.toarray()
    assert len(np.unique(matrix[V:], axis=0)) == 1 and sorted(matrix[V]) == [0, 0, 0, 1]
    assert len(np.unique(matrix[:V], axis=0)) > 10


def test_what_hangs_from_a_joint_goes_with_what_that_moves(tmp_path: Path) -> None:
    """A pole at the tip, a joint that moves nothing, below the knee; and one at the root, which stands above all joints."""
    target = tmp_path / "target.glb"
    write_tube(target)
    json = Document(target, target.read_bytes()).json
    poles = [{"attributes": {"POSITION": 0}, "indices": 1}]
    nodes = [*json["nodes"], {"mesh": 1}, {"mesh": 1}]
    nodes[4]["children"], nodes[1]["children"] = [7], [8, 2, 5]
    write_tube(
        target, nodes=nodes, meshes=[*json["meshes"], {"primitives": poles}], skins=[{"joints": [1, 2, 3, 5, 4]}]
    )
    V, main = tube().V, weights_of(tube().verts[:, 1]).astype("f4").argmax(axis=1)
    at_root, at_tip = find_rigid_groups(Document(target, target.read_bytes()))
    assert np.array_equal(at_root[0], np.arange(V)) and not len(at_root[1])
    assert np.array_equal(at_tip[0], np.arange(V, 2 * V)) and np.array_equal(
        at_tip[1] - 2 * V, np.flatnonzero(main == 1)
    )


@pytest.mark.parametrize("stands", [0.0, 40.0])
def test_a_skeleton_of_its_own_is_replaced(source: Path, stands: float) -> None:
    """Vertices that it bends are stored as they stand; its clips go, and those of other nodes stay."""
    target = source.with_name("target.glb")
    write_tube(target, stands=stands)
    document = Document(target, target.read_bytes()).json
    nodes, animation = [*document["nodes"], {"name": "lamp"}], document["animations"][0]
    animation["name"] = "old"
    samplers = [animation["samplers"][0]] * 2
    channels = [{"sampler": k, "target": {"node": node, "path": "rotation"}} for k, node in enumerate((3, 7))]
    swings = {"name": "swings", "samplers": samplers, "channels": channels}
    write_tube(target, stands=stands, nodes=nodes, scenes=[{"nodes": [0, 6, 7]}], animations=[animation, swings])
    shape = load_shape(target)
    out, result = rigged(source, target)
    found = Document(out, out.read_bytes())
    assert (result.replaced, result.replaced_clips) == (4, ("old", "swings"))
    assert len(found.json["skins"]) == 1
    assert [node["name"] for node in found.json["nodes"]] == [
        "tube",
        "lamp",
        "source",
        *NODES[:-1],
    ]  # all of the old is gone
    assert [(each["name"], len(each["channels"])) for each in found.json["animations"]][:1] == [("swings", 1)]
    assert [each["name"] for each in found.json["animations"]][1:] == ["bend"]
    assert np.abs(load_shape(out).verts - shape.verts).max() < 1e-5
    same = found.json["meshes"][0]["primitives"][0]["attributes"]["POSITION"] == 0
    assert same == (stands == 0.0)
    assert np.linalg.norm(posed_verts(out, "bend", 0.0) - tube().verts, axis=1).mean() < 0.03


def test_a_clip_of_the_target_takes_in_that_of_its_name(source: Path) -> None:
    """Each does so once, with what it has and still moves."""
    document = Document(source, source.read_bytes())
    editor = Editor(document)
    editor.json["animations"] *= 2
    source.write_bytes(editor.to_bytes())
    target = source.with_name("target.glb")
    write_tube(target)
    before = Document(target, target.read_bytes()).json
    clip = before["animations"][0] | {"extras": {"loop": True}}
    clip["channels"] = [*clip["channels"], {"sampler": 0, "target": {"node": 7, "path": "rotation"}}]
    write_tube(target, nodes=[*before["nodes"], {"name": "lamp"}], scenes=[{"nodes": [0, 6, 7]}], animations=[clip])
    out, result = rigged(source, target)
    found = Document(out, out.read_bytes()).json
    names = [each["name"] for each in found["nodes"]]
    assert result.replaced_clips == ("bend",)
    assert [(each["name"], each.get("extras")) for each in found["animations"]] == [
        ("bend", {"loop": True}),
        ("bend", None),
    ]
    moved = [[names[each["target"]["node"]] for each in clip["channels"]] for clip in found["animations"]]
    assert moved[0] == ["lamp", *moved[1]] and "knee" in moved[1]
    expected = posed_verts(source, "bend", 1.0)
    assert np.abs(posed_verts(out, "bend", 1.0) - expected).max() < 1e-4


@pytest.mark.parametrize(
    ("alike", "away"),
    [
        pytest.param(False, 0.0, id="a flag"),
        pytest.param(True, 5.0, id="another character of the same pack"),
        pytest.param(True, 0.0, id="clothes with a copy of the skeleton"),
    ],
)
def test_a_thing_apart_keeps_its_skeleton(source: Path, alike: bool, away: float) -> None:
    """Its joints belong to a root of their own, and a clip moves them; but joints of the same names in the same places do
    not make another figure.
    """
    target = source.with_name("target.glb")
    write_tube(target)
    before = Document(target, target.read_bytes()).json
    nodes, meshes = [*before["nodes"], {"name": "flag", "mesh": 1, "skin": 1}], [before["meshes"][0]] * 2
    names = ("root", "hip", "knee", "foot") if alike else ("root", "pole", "cloth", "end")
    nodes += [{"name": names[0], "translation": [away, 0, 0], "children": [9, 10, 11]}]
    nodes += [{"name": name, "translation": [0, y, 0]} for name, y in zip(names[1:], (0.0, 1.0, 1.9), strict=True)]
    replaced = alike and not away
    skins = [before["skins"][0], {"joints": [8, 9, 10, 11]}]
    channels = [{"sampler": 0, "target": {"node": 9, "path": "rotation"}}]
    clips = [{"name": "wave", "samplers": before["animations"][0]["samplers"], "channels": channels}]
    scenes = [{"nodes": [0, 6, 7, 8]}]
    write_tube(target, nodes=nodes, meshes=meshes, skins=skins, animations=clips, scenes=scenes)
    stood = load_shape(target).verts
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        out, result = rigged(source, target)
    found = Document(out, out.read_bytes())
    told = "flag of target.glb keeps its own skeleton, apart from what was matched"
    assert [str(each.message) for each in said] == [told] * (not replaced)
    assert result.replaced == 4 + 4 * replaced
    assert [each["name"] for each in found.json["animations"]] == (["bend"] if replaced else ["wave", "bend"])
    flag = next(node for node in found.nodes if node["name"] == "flag")
    bones = [found.nodes[joint]["name"] for joint in found.json["skins"][flag["skin"]]["joints"]]
    assert bones == [*(JOINTS if replaced else names)]
    assert np.abs(load_shape(out).verts - stood).max() < 1e-5
    assert np.abs(posed_verts(out, "bend", 1.0)[: tube().V] - posed_verts(source, "bend", 1.0)).max() < 1e-4


def two_figures(path: Path, clip: str = "wave") -> Shape:
    """Write two tubes with a skeleton each below one root, the second with a clip; return the scene."""
    write_tube(path)
    before = Document(path, path.read_bytes()).json
    names = ("root", "pole", "cloth", "end")
    nodes = [*before["nodes"], {"name": "flag", "mesh": 1, "skin": 1}]
    nodes += [{"name": "root", "translation": [5, 0, 0], "children": [9, 10, 11]}]
    nodes += [{"name": name, "translation": [0, y, 0]} for name, y in zip(names[1:], (0.0, 1.0, 1.9), strict=True)]
    nodes += [{"name": "pack", "children": [0, 6, 7, 8]}]
    meshes = [before["meshes"][0]] * 2
    skins = [before["skins"][0], {"joints": [8, 9, 10, 11]}]
    channels = [{"sampler": 0, "target": {"node": 9, "path": "rotation"}}]
    clips = [
        *before["animations"],
        {"name": clip, "samplers": before["animations"][0]["samplers"], "channels": channels},
    ]
    write_tube(path, nodes=nodes, meshes=meshes, skins=skins, animations=clips, scenes=[{"nodes": [12]}])
    return load_shape(path)


def fitted_pair(source: Shape, target: Shape, index: np.ndarray) -> meshmatch.MatchResult:
    """A match by this map, whose source was fitted where its weights are not 0."""
    order = np.flatnonzero(source.weights)[: target.V]
    forward, backward = (
        VertexMap.between(source, target, index, verdict="good"),
        VertexMap.between(target, source, order),
    )
    known = some_fit(source.verts[:3], np.array([[0, 1, 2]]), repaired=repair(source))
    return meshmatch.MatchResult(forward, known, known, 0.0, (), (known, known), opposite=backward)


@pytest.mark.parametrize(
    ("number", "bones", "clip"), [(0, NODES[:-1], "bend"), (1, ("root", "pole", "cloth", "end"), "wave")]
)
def test_one_figure_of_two_gives_its_skeleton_alone(
    source: Path, number: int, bones: tuple[str, ...], clip: str
) -> None:
    """That of the figure that was fitted, with its ancestors and clips."""
    a, b = two_figures(source), tube()
    target = source.with_name("target.ply")
    save_shape(target, b)
    fitted = replace(a, weights=(np.arange(a.V) // b.V == number).astype(float))
    with pytest.warns(
        MeshmatchWarning, match=r"^4 joints and 1 clip of source.glb are of other figures than the one that"
    ):
        result = meshmatch.transfer_rig(
            source, target, lambda *_: fitted_pair(fitted, load_shape(target), np.arange(a.V) % b.V)
        )
    assert result.rig.names == ("source", "pack", *bones)
    assert [each.name for each in result.rig.clips] == [clip]
    assert len(result.weights.names) == len(result.rig.joints) == 4
    assert np.allclose(result.weights.matrix.sum(axis=1), 1)
    assert result.unused == ()


def test_what_was_fitted_may_have_no_skeleton(source: Path) -> None:
    write_tube(source)
    before = Document(source, source.read_bytes()).json
    write_tube(
        source, nodes=[*before["nodes"], {"name": "statue", "mesh": 0}], scenes=[{"nodes": [0, 6, 7]}]
    )  # fmt: skip
    a, b = load_shape(source), tube()
    fitted = replace(a, weights=(np.arange(a.V) >= b.V).astype(float))
    with pytest.raises(InputError, match=r"what was matched of source\.glb has no skeleton"):
        meshmatch.transfer_rig(source, b, lambda *_: fitted_pair(fitted, b, np.arange(a.V) % b.V))


@pytest.mark.parametrize("skinned", [True, False])
def test_a_mirror_above_a_target_turns_nothing_inside_out(source: Path, skinned: bool) -> None:
    """Programs differ in what mirrored joints do to triangles, so that none are left."""
    target = source.with_name("target.glb")
    write_tube(target)
    nodes = Document(target, target.read_bytes()).json["nodes"]
    nodes[6] = nodes[6] if skinned else {"mesh": 0}
    write_tube(
        target, nodes=[*nodes, {"scale": [-1, 1, 1], "children": [0, 6]}], scenes=[{"nodes": [7]}], animations=[]
    )
    shape = load_shape(target)
    out, _ = rigged(source, target)
    found = Document(out, out.read_bytes())
    ((number, part, place),) = found.primitives()
    stored = found.accessor(part["attributes"]["POSITION"])
    assert not found.is_mirrored(number, part, place) and np.linalg.det(place[:3, :3]) > 0
    assert volume(stored, found.triangles(part)) > 0
    assert np.abs(load_shape(out).verts - shape.verts).max() < 1e-5
    assert np.array_equal(load_shape(out).faces, shape.faces)


def test_nodes_that_something_else_needs_stay(source: Path) -> None:
    """A lamp and a socket go with the skin around them; a camera where there is none, somebody's data, and bones that an
    extension may name stay.
    """
    target = source.with_name("target.glb")
    write_tube(target)
    nodes = Document(target, target.read_bytes()).json["nodes"]
    nodes[4]["extensions"] = {"KHR_lights_punctual": {"light": 0}}
    nodes[5]["extras"] = {"mine": 1}
    nodes[1]["children"], nodes[3]["children"] = [*nodes[1]["children"], 7], [4, 8]
    nodes += [{"name": "eye", "camera": 0}, {"name": "socket", "translation": [0, 0, 0.1]}]
    lights = {"KHR_lights_punctual": {"lights": [{"type": "point"}]}}
    eye = {"type": "perspective", "perspective": {"yfov": 1, "znear": 0.1}}
    more: dict[str, Any] = {"nodes": nodes, "extensionsUsed": [*lights], "extensions": lights, "cameras": [eye]}
    write_tube(target, **more)
    before = Document(target, target.read_bytes())
    before.scene()
    with pytest.warns(
        MeshmatchWarning, match="^eye of target.glb, below the skeleton that is replaced, keeps its position"
    ):
        out, _ = rigged(source, target)
    found = Document(out, out.read_bytes())
    found.scene()
    names = [node["name"] for node in found.nodes]
    assert names[:7] == ["armature", "root", "tip", "foot", "tube", "eye", "socket"]
    above = {child: names[number] for number, node in enumerate(found.nodes) for child in node.get("children", [])}
    assert [above[k] for k in (2, 5, 6)] == ["knee", "root", "knee"]
    for name, number in (("tip", 4), ("eye", 7), ("socket", 8)):
        assert np.allclose(found.world[names.index(name)], before.world[number], atol=1e-6)
    nodes[1]["children"], nodes[3]["children"] = [2, 5], [4]
    nodes[4].pop("extensions")
    write_tube(target, nodes=nodes[:7], extensionsUsed=["VRMC_vrm"], extensions={"VRMC_vrm": {"hips": {"node": 2}}})
    out, _ = rigged(source, target)
    assert Document(out, out.read_bytes()).json["nodes"][2]["name"] == "hip"


def test_what_is_made_of_a_mesh_takes_its_maps(source: Path) -> None:
    """But not when its faces were changed since."""
    shape, target = tube(), source.with_name("target.ply")
    save_shape(target, shape)
    made = same_order(source, target)
    out, _ = rigged(source, target)
    again = load_shape(out)
    assert again.made_of == (load_shape(target).hash,) and again.hash not in again.made_of
    assert made.for_shapes(None, again).target_hash == again.hash
    for odd in ("x", [], {"made_of": 5}):  # somebody else's
        editor = Editor(Document(out, out.read_bytes()))
        editor.json["asset"]["extras"]["meshmatch"] = (
            odd | {"faces": digest(shape.faces)} if isinstance(odd, dict) else odd
        )
        target.with_suffix(".glb").write_bytes(editor.to_bytes())
        assert load_shape(target.with_suffix(".glb")).made_of == ()
    editor = Editor(Document(out, out.read_bytes()))
    part = editor.json["meshes"][0]["primitives"][0]
    part["indices"] = editor.add_indices(shape.faces[::-1], shape.V)
    out.write_bytes(editor.to_bytes())
    assert load_shape(out).made_of == ()
    with pytest.raises(InputError, match="was made for another target"):
        made.for_shapes(None, load_shape(out))


def test_a_mesh_of_an_obj_keeps_its_texture(source: Path) -> None:
    """Its seams split vertices, which move as before; what a glb does not hold is told."""
    plain, target, shape = source.with_name("plain.ply"), source.with_name("target.obj"), tube()
    save_shape(plain, Shape(2 * shape.verts, shape.faces))
    bare = rigged(source, plain)[0]
    expected = posed_verts(bare, "bend", 1.0)
    uv = np.random.default_rng(0).random((shape.F, 3, 2))
    save_textured(target, TexturedMesh(2 * shape.verts, shape.faces, uv), quarters())
    with target.open("a") as text:
        text.write("f 1/1 2/2 3/3 4/4\n")
    with pytest.warns(MeshmatchWarning, match=r"^rigged\.glb does not have the polygons of target\.obj$"):
        out, _ = rigged(source, target)
    before, after = load_shape(target), load_shape(out)
    assert after.V > before.V and digest(before.faces) != digest(after.faces)
    assert np.allclose(posed_verts(out, "bend", 1.0)[after.faces], expected[before.faces], atol=1e-5)
    given, kept = load_appearance(target, before), load_appearance(out, after)
    assert np.allclose(kept.uv, given.uv, atol=1e-6)
    assert np.array_equal(kept.materials[0].image, given.materials[0].image)
    assert before.hash in after.made_of  # and so takes its maps


@pytest.mark.parametrize(
    ("library", "told"),
    [
        (None, None),
        ("newmtl one\nKd 1 0 0\n", None),
        ("newmtl one\nmap_Kd lost.png\n", "the look of target.obj is left out: .*lost.png"),
        ("newmtl one\nKd 1 0 0\nnewmtl two\nKd 0 1 0\n", "does not have the materials of target.obj"),
    ],
)
def test_a_mesh_of_an_obj_keeps_its_texture_coordinates(source: Path, library: str | None, told: str | None) -> None:
    """Also without a material, with one color, a lost image, or materials that a glb cannot have."""
    target, shape = source.with_name("target.obj"), tube()
    uv = np.random.default_rng(0).random((shape.F, 3, 2))
    lines = [f"v {x} {y} {z}" for x, y, z in 2 * shape.verts] + [f"vt {u} {v}" for u, v in uv.reshape(-1, 2)]
    for k, face in enumerate(shape.faces + 1):
        if k in (0, 5):
            lines.append("usemtl two" if k and library and "two" in library else "usemtl one")
        lines.append("f " + " ".join(f"{vertex}/{3 * k + c + 1}" for c, vertex in enumerate(face)))
    if library is not None:
        target.with_suffix(".mtl").write_text(library)
        lines.insert(0, "mtllib target.mtl")
    target.write_text("\n".join([*lines, ""]))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        out, _ = rigged(source, target)
    assert [bool(re.search(told, str(each.message))) for each in said] == [True] if told else not said
    laid = load_coordinates(out, load_shape(out))
    assert laid is not None and np.allclose(laid, np.stack([uv[..., 0], 1 - uv[..., 1]], axis=2), atol=1e-6)
    assert load_shape(target).hash in load_shape(out).made_of
    assert Document(out, out.read_bytes()).json["meshes"][0]["name"] == "target"


def test_a_cloud_is_rigged_too(source: Path) -> None:
    target = source.with_name("target.ply")
    save_shape(target, Shape(tube().verts, np.empty((0, 3), int), "cloud"))
    out, _ = rigged(source, target)
    assert load_shape(out).is_cloud
    assert np.abs(posed_verts(out, "bend", 1.0) - posed_verts(source, "bend", 1.0)).max() < 0.02


def test_joints_without_a_vertex_are_named(source: Path) -> None:
    """The target is the lower half of the source."""
    shape, target = tube(), source.with_name("target.ply")
    half = shape.faces[(shape.verts[shape.faces, 1] < 1.5).all(axis=1)]
    used, faces = np.unique(half, return_inverse=True)
    save_shape(target, Shape(shape.verts[used], faces.reshape(-1, 3)))
    a, b = load_shape(source), load_shape(target)
    nearest = np.linalg.norm(a.verts[:, None] - b.verts[None], axis=2).argmin(axis=1)
    sure = (a.verts[:, 1] < 1.5).astype("f4")
    result = meshmatch.transfer_rig(source, target, VertexMap.between(a, b, nearest, confidence=sure))
    assert result.unused == ("foot",)
    assert [result.rig.names[joint] for joint in result.rig.joints] == list(JOINTS)


@pytest.mark.parametrize(
    "others",
    [
        pytest.param(
            [{"mesh": 0, "scale": [1.02, 1.02, 1.02]}], id="an outline, which toon shading draws around a mesh"
        ),
        pytest.param([{"mesh": 1}, {"mesh": 1, "translation": [3.0, 0, 0]}], id="a prop that is drawn twice"),
    ],
)
def test_what_moves_with_a_target_is_no_copy_of_it(source: Path, others: list[dict[str, Any]]) -> None:
    target, shape = source.with_name("target.glb"), tube()
    nodes = [{"mesh": 0}, *others]
    document = {
        "scene": 0,
        "scenes": [{"nodes": list(range(len(nodes)))}],
        "nodes": nodes,
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": k}]} for k in (1, 2)],
    }
    faces = shape.faces.ravel().astype("u2")
    write_document(target, document, shape.verts.astype("f4"), faces, faces[: len(faces) // 2])
    assert set(rigged(source, target)[1].rig.names) >= set(JOINTS)


def test_what_cannot_be_rigged_is_told(source: Path) -> None:
    target = source.with_name("target.ply")
    save_shape(target, tube())
    with pytest.raises(InputError, match=r"target\.ply has no skeleton"):
        meshmatch.transfer_rig(target, target)
    with pytest.raises(OptionError, match="invalid pose"):
        meshmatch.transfer_rig(source, target, pose="sitting")  # type: ignore[arg-type]
    plain = source.with_name("plain.glb")
    two_parts(plain)
    with pytest.raises(InputError, match=r"plain\.glb has no skin"):
        meshmatch.transfer_rig(plain, target)
    copies = source.with_name("copies.glb")
    document = two_parts(copies)
    document["nodes"][1]["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": 3}}}
    del document["accessors"], document["bufferViews"], document["buffers"], document["images"], document["textures"]
    shape = tube()
    uv = np.zeros((shape.V, 2), "f4")
    write_document(
        copies, document, shape.verts.astype("f4"), shape.faces.ravel().astype("u2"), uv, np.eye(3, dtype="f4")
    )
    with pytest.raises(InputError, match="draws copies of one mesh"):
        meshmatch.transfer_rig(source, copies)
    with pytest.raises(InputError, match=r"plain\.glb draws one figure several times"):
        rigged(source, plain)
    with pytest.raises(OptionError, match="not a format for rigs"):
        rigged(source, target)[1].save("out.obj")
