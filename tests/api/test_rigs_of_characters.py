"""A skeleton in a .vrm: its bones are those of the character, which keeps everything else."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import meshmatch
from meshmatch.errors import MeshmatchWarning, OptionError
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.formats.gltf import Document
from meshmatch.shapes.formats.gltf_rig import read_rig
from tests.transfer.rigs import KNEE, posed_verts, tube, write_tube

BONES = {"hips": "hip", "head": "knee", "leftThumbMetacarpal": "foot"}
EYES = np.array([0.1, 0.2, 0.3])
"""Where the eyes are, beside the head."""


def write(path: Path, version: int | None, **more: Any) -> None:
    """The tube as a character; its bones are turned and a hundred times as large."""
    write_tube(path.with_suffix(".glb"))
    plain = Document(path, path.with_suffix(".glb").read_bytes())
    list(plain.primitives())
    names = [node["name"] for node in plain.nodes]
    number = {bone: names.index(name) for bone, name in BONES.items()}
    head = np.linalg.inv(plain.world[number["head"]])
    x, y, z = (head[:3, :3] @ EYES).tolist()
    nodes = plain.nodes
    old = {"hips": "hips", "head": "head", "leftThumbMetacarpal": "leftThumbProximal"}
    if version == 0:
        extensions = {
            "VRM": {
                "meta": {"author": "nobody"},
                "humanoid": {"humanBones": [{"bone": old[bone], "node": node} for bone, node in number.items()]},
                "firstPerson": {
                    "firstPersonBone": number["head"],
                    "firstPersonBoneOffset": {"x": x, "y": y, "z": -z},
                    "meshAnnotations": [{"mesh": 0, "firstPersonFlag": "Auto"}],
                },
                "secondaryAnimation": {
                    "boneGroups": [{"bones": [3], "center": -1, "colliderGroups": [0]}],
                    "colliderGroups": [{"node": 2, "colliders": []}],
                },
            }
        }
    else:
        extensions = {
            "VRMC_vrm": {
                "meta": {"name": "tube"},
                "humanoid": {"humanBones": {bone: {"node": node} for bone, node in number.items()}},
                "firstPerson": {"meshAnnotations": [{"node": 6, "type": "auto"}]},
                "lookAt": {"offsetFromHeadBone": [x, y, z]},
            },
            "VRMC_springBone": {"springs": [{"joints": [{"node": 3}]}]},
        }
        constraint = {"constraint": {"roll": {"source": 3, "rollAxis": "X"}}}
        nodes[5]["extensions"] = {"VRMC_node_constraint": constraint}
    if version is None:
        extensions = {}
        nodes[5].pop("extensions")
    used = [*extensions, *(["VRMC_node_constraint"] if version == 1 else [])]
    write_tube(path, **({"nodes": nodes, "extensions": extensions, "extensionsUsed": used} if used else {}) | more)


@pytest.mark.filterwarnings("ignore::meshmatch.errors.MeshmatchWarning")
@pytest.mark.parametrize("source", [0, 1, None])
@pytest.mark.parametrize("target", [0, 1])
def test_bones_of_a_character_are_those_that_move_it(tmp_path: Path, source: int | None, target: int) -> None:
    """Of a source that is no character, those with the names of the target's."""
    a, b, out = tmp_path / "a.vrm", tmp_path / "b.vrm", tmp_path / "out.vrm"
    write(a, source)
    write(b, target)
    result = meshmatch.transfer_rig(a, b)
    result.save(out)
    document = Document(out, out.read_bytes())
    nodes, extensions = document.json["nodes"], document.json["extensions"]
    assert [node["name"] for node in nodes] == ["tube", "a", "armature", "root", "hip", "knee", "tip", "foot"]
    joints = [nodes[joint]["name"] for joint in document.json["skins"][0]["joints"]]
    assert joints == ["root", "hip", "knee", "foot"]
    np.testing.assert_allclose(load_shape(out).verts, load_shape(b).verts, atol=1e-5)
    list(document.primitives())
    assert sorted(extensions) == (["VRM"] if target == 0 else ["VRMC_vrm"]) == document.json["extensionsUsed"]
    if target == 0:
        old = extensions["VRM"]
        named = {each["bone"]: nodes[each["node"]]["name"] for each in old["humanoid"]["humanBones"]}
        assert named == {"hips": "hip", "head": "knee", "leftThumbProximal": "foot"}
        assert not any(node.keys() & {"rotation", "scale", "matrix"} for node in nodes)
        assert old["secondaryAnimation"] == {"boneGroups": [], "colliderGroups": []}
        head = old["firstPerson"]["firstPersonBone"]
        offset = np.array([old["firstPerson"]["firstPersonBoneOffset"][axis] for axis in "xyz"]) * [1, 1, -1]
        assert "animations" not in document.json
    else:
        new = extensions["VRMC_vrm"]
        head, offset = new["humanoid"]["humanBones"]["head"]["node"], new["lookAt"]["offsetFromHeadBone"]
        assert {bone: nodes[each["node"]]["name"] for bone, each in new["humanoid"]["humanBones"].items()} == BONES
        assert nodes[new["firstPerson"]["meshAnnotations"][0]["node"]]["name"] == "tube"
        assert [clip["name"] for clip in document.json["animations"]] == ["bend"]
        assert np.linalg.norm(posed_verts(out, "bend", 0.0) - tube().verts, axis=1).mean() < 0.03
    assert nodes[head]["name"] == "knee"
    np.testing.assert_allclose(document.world[head][:3, 3], KNEE, atol=0.02)
    np.testing.assert_allclose((document.world[head] @ [*offset, 1])[:3], KNEE + EYES, atol=1e-4)
    moved = Document(out, out.read_bytes())
    moved.nodes[head]["translation"] = [value + 0.5 for value in moved.nodes[head]["translation"]]
    shift = moved.scene().verts - load_shape(b).verts
    height = tube().verts[:, 1]  # of the foot, which hangs from the root, nothing moves
    assert np.linalg.norm(shift[(height > 1.25) & (height < 1.65)], axis=1).min() > 0.8
    assert np.abs(shift[(height < 0.75) | (height > 1.95)]).max() < 1e-5


@pytest.mark.filterwarnings("ignore:[ab].vrm has .* not transferred")
def test_what_a_character_loses_is_told(tmp_path: Path) -> None:
    a, old, new = tmp_path / "a.vrm", tmp_path / "old.vrm", tmp_path / "new.vrm"
    write(a, 1)
    write(old, 0)
    write(new, 1)
    with (
        pytest.warns(MeshmatchWarning, match="old.vrm does not have the clip bend of its skeleton"),
        pytest.warns(MeshmatchWarning, match="old.vrm does not have the 1 spring or constraint that moved its former"),
    ):
        meshmatch.transfer_rig(a, old).save(tmp_path / "out.vrm")
    with pytest.warns(MeshmatchWarning, match="new.vrm does not have the 2 springs and constraints"):
        meshmatch.transfer_rig(a, new).save(tmp_path / "out.vrm")


@pytest.mark.filterwarnings("ignore:[ab].vrm has .* not transferred")
@pytest.mark.parametrize("version", [0, 1])
def test_a_glb_of_a_character_keeps_its_bones(tmp_path: Path, version: int) -> None:
    """They move nothing, but nothing is said of others."""
    a, b, out = tmp_path / "a.vrm", tmp_path / "b.vrm", tmp_path / "out.glb"
    write(a, 1)
    write(b, version)
    meshmatch.transfer_rig(a, b).save(out)
    before, after = (Document(path, path.read_bytes()) for path in (b, out))
    assert after.json["extensions"] == before.json["extensions"]
    assert after.nodes[:6] == before.nodes[:6]
    assert read_rig(out, out.read_bytes()).names[0] == "a"


@pytest.mark.filterwarnings("ignore:[ab].vrm has .* not transferred")
def test_bones_that_nobody_names_make_no_character(tmp_path: Path) -> None:
    a, b, plain = tmp_path / "a.glb", tmp_path / "b.vrm", tmp_path / "plain.glb"
    write(b, 1)
    write_tube(plain)
    write_tube(a)
    nodes = Document(a, a.read_bytes()).nodes
    nodes[2]["name"] = "pelvis"
    write_tube(a, nodes=nodes)
    result = meshmatch.transfer_rig(a, b)
    with pytest.raises(OptionError, match=r"out.vrm would be no character: .* of a.glb are unknown"):
        result.save(tmp_path / "out.vrm")
    with pytest.raises(OptionError, match=r"out.vrm would be no character: plain.glb has no VRM extension"):
        meshmatch.transfer_rig(b, plain).save(tmp_path / "out.vrm")
    assert not (tmp_path / "out.vrm").exists()


@pytest.mark.parametrize(
    ("version", "told"), [(0, "a spring or constraint, which is"), (1, "2 springs and constraints, which are")]
)
def test_what_moves_the_source_beside_clips_is_told(tmp_path: Path, version: int, told: str) -> None:
    a, b = tmp_path / "a.vrm", tmp_path / "b.glb"
    write(a, version)
    write_tube(b)
    with pytest.warns(MeshmatchWarning, match=f"^a.vrm has {told} not transferred$"):
        meshmatch.transfer_rig(a, b)
