"""Skeletons read from glTF, and files that are not as they should be."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from meshmatch.api.rig import transfer_rig
from meshmatch.errors import InputError
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.formats import gltf_rig
from meshmatch.shapes.formats.gltf import Document
from meshmatch.shapes.formats.gltf_edit import Editor
from meshmatch.shapes.formats.gltf_rig import read_rig
from tests.transfer.rigs import KNEE, NODES, write_tube

Damage = Callable[[dict[str, Any]], Any]


def changed(path: Path, damage: Damage) -> None:
    """Write the tube with its description changed."""
    write_tube(path)
    document = json.loads(path.read_text())
    damage(document)
    path.write_text(json.dumps(document))


def test_nodes_joints_and_clips(tmp_path: Path) -> None:
    path = tmp_path / "tube.glb"
    write_tube(path, stands=30)
    rig = read_rig(path, path.read_bytes())
    assert rig.names == NODES[:-1]
    assert rig.parents.tolist() == [-1, 0, 1, 2, 3, 1]
    assert [rig.names[joint] for joint in rig.joints] == ["root", "hip", "knee", "foot"]
    document = Document(path, path.read_bytes())
    list(document.primitives())
    assert np.allclose(rig.worlds(), [document.world[node] for node in range(6)])
    assert np.allclose(rig.worlds()[3, :3, 3], KNEE)
    (clip,) = rig.clips
    assert [(rig.names[track.node], track.moves) for track in clip.tracks] == [
        ("knee", "rotation"), ("foot", "rotation"), ("foot", "translation")
    ]  # fmt: skip


def test_a_matrix_says_the_same(tmp_path: Path) -> None:
    path = tmp_path / "tube.gltf"
    write_tube(path)
    first = read_rig(path, path.read_bytes())
    world = first.worlds()[0]
    changed(
        path, lambda document: document["nodes"].__setitem__(0, {"matrix": world.T.ravel().tolist(), "children": [1]})
    )
    again = read_rig(path, path.read_bytes())
    assert np.allclose(again.worlds(), first.worlds())
    assert np.allclose(again.scales[0], 100)


WRONG: list[tuple[Damage, str]] = [
    (lambda document: document["nodes"][4].update(children=[0]), "has two parents"),
    (lambda document: document["nodes"][4].update(children=[4]), "has two parents"),
    (lambda document: document["scenes"][0].update(nodes=[6]), "no sense"),
    (lambda document: document["skins"][0].update(joints=[1, 2, 3, 77]), "no sense"),
    (lambda document: document["skins"][0].update(joints=5), "no sense"),
    (lambda document: document["nodes"][1].update(translation=[1e300, 0, 0]), "no sense"),
    (lambda document: document["nodes"][0].update(scale=[-100, 100, 100]), "mirrored by a negative scale"),
    (lambda document: document["animations"][0]["samplers"][0].update(output=0), "no sense"),
    (lambda document: document["animations"][0]["samplers"][0].update(interpolation="MAGIC"), "no sense"),
    (lambda document: document["animations"][0]["channels"][0].update(sampler=9), "no sense"),
    (lambda document: document["accessors"][6].update(count=10**9), "it needs"),
    (lambda document: document["accessors"][5].update(bufferView=0), "times of animation 0 go back"),
    (lambda document: document.update(animations={"name": "bend"}), "no sense"),
]


@pytest.mark.parametrize(("damage", "words"), WRONG)
def test_damage_is_told_in_a_line(tmp_path: Path, damage: Damage, words: str) -> None:
    path = tmp_path / "tube.gltf"
    changed(path, damage)
    with pytest.raises(InputError, match=words) as caught:
        read_rig(path, path.read_bytes())
    assert "\n" not in caught.value.message


def test_a_single_bind_matrix_does_not_serve_all_joints(tmp_path: Path) -> None:
    path = tmp_path / "tube.gltf"
    changed(path, lambda document: document["accessors"][4].update(count=1))
    with pytest.raises(InputError, match="skin 0 has fewer inverse bind matrices than joints"):
        load_shape(path)


def test_a_skeleton_that_collapses_its_skin_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "tube.gltf"
    shape = write_tube(tmp_path / "target.glb")
    changed(path, lambda document: document["nodes"][0].update(scale=[0, 0, 0]))
    with pytest.raises(InputError, match=r"tube\.gltf has no surface area"):
        transfer_rig(path, shape)


TARGETS: list[Damage] = [
    lambda document: document.update(animations=[{"channels": 3}]),
    lambda document: document.update(skins=[{"joints": [99], "inverseBindMatrices": 4}]),
    lambda document: document.update(images=[3]),
    lambda document: document["bufferViews"][3].update(buffer=7),
    lambda document: document["scenes"][0].update(nodes={"0": 1}),
    lambda document: next(node for node in document["nodes"] if "mesh" in node).update(weights=[float("nan")]),
]


@pytest.mark.parametrize("damage", TARGETS)
def test_a_damaged_target_is_told_in_a_line(tmp_path: Path, damage: Damage) -> None:
    source, target = tmp_path / "source.glb", tmp_path / "target.gltf"
    write_tube(source)
    changed(target, damage)
    with pytest.raises(InputError):
        transfer_rig(source, target, lambda a, b: VertexMap.between(a, b, np.arange(a.V)))


def test_joints_and_keys_have_a_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "tube.gltf"
    write_tube(path)
    monkeypatch.setattr(gltf_rig, "MAX_JOINTS", 3)
    with pytest.raises(InputError, match="has 4 joints, of 3 at most"):
        read_rig(path, path.read_bytes())
    monkeypatch.setattr(gltf_rig, "MAX_JOINTS", 4)
    monkeypatch.setattr(gltf_rig, "_BASE_KEYS", -100_000)
    many = [{"sampler": 0, "target": {"node": 3, "path": "rotation"}}] * 10_000
    changed(path, lambda document: document["animations"][0].update(channels=many))
    with pytest.raises(InputError, match="many of them shared"):
        read_rig(path, path.read_bytes())


def test_editing_keeps_what_is_there(tmp_path: Path) -> None:
    """Also where two buffers are one file."""
    path = tmp_path / "tube.gltf"
    write_tube(path)
    document = json.loads(path.read_text())
    data = Document(path, path.read_bytes()).buffer(0)
    (tmp_path / "data.bin").write_bytes(data)
    document["buffers"] = [{"uri": "data.bin", "byteLength": len(data)}] * 2
    document["bufferViews"][0]["buffer"] = 1
    path.write_text(json.dumps(document))
    editor = Editor(Document(path, path.read_bytes()))
    values = np.array([[1.5, 2, 3], [-1, 0, 7]], "f4")
    number = editor.add_array(values, bounds=True)
    made = tmp_path / "made.glb"
    made.write_bytes(editor.to_bytes())
    found = Document(made, made.read_bytes())
    assert found.json["accessors"][number]["min"] == [-1, 0, 3]
    assert np.array_equal(found.accessor(number), values)
    assert found.body.startswith(data) and len(found.body) == len(data) + 24
    (tmp_path / "data.bin").unlink()
    assert np.allclose(load_shape(made).verts, write_tube(path).verts, atol=1e-6)
    rig = read_rig(made, made.read_bytes())
    assert rig.names == NODES[:-1] and len(rig.clips) == 1


def test_a_shape_knows_what_joints_move(tmp_path: Path) -> None:
    path = tmp_path / "tube.gltf"
    write_tube(path)
    assert load_shape(path).skinned is not None and load_shape(path).skinned.all()
    changed(path, lambda document: document["nodes"].append({"mesh": 0}) or document["scenes"][0]["nodes"].append(7))
    shape = load_shape(path)
    assert shape.skinned.tolist() == [True] * (shape.V // 2) + [False] * (shape.V // 2)
    changed(path, lambda document: document["nodes"][6].pop("skin"))
    assert load_shape(path).skinned is None
