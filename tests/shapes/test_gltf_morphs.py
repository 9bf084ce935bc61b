"""Morph targets of glTF scenes, read and added."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from meshmatch.errors import InputError
from meshmatch.shapes.blend_shapes import BlendShapes, WeightClip
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.formats.gltf import Document
from meshmatch.shapes.formats.gltf_morphs import read_morphs, with_morphs
from tests.shapes.morphs import ONE, SCALE, TURN, UP, write_morphs
from tests.shapes.painted import CORNERS
from tests.transfer.rigs import tube, write_tube

Damage = Callable[[dict[str, Any]], Any]


def read(path: Path) -> BlendShapes:
    return read_morphs(path, path.read_bytes())


def added(path: Path, shapes: BlendShapes, turn: np.ndarray = np.eye(3)) -> Path:  # noqa: B008
    """The file with shapes, beside it."""
    out = path.with_name("added.glb")
    out.write_bytes(with_morphs(Document(path, path.read_bytes()), load_shape(path), shapes, turn))
    return out


def shapes_of(moves: np.ndarray, *names: str, clips: tuple[WeightClip, ...] = ()) -> BlendShapes:
    return BlendShapes(names, np.asarray(moves, np.float32), np.zeros(len(names)), clips=clips)


def test_shapes_of_one_name_are_one_shape(scene: Path) -> None:
    found = read(scene)
    assert found.names == ("smile", "blink", "open")
    assert (found.weights.tolist(), found.normals) == ([0.25, 0.0, 0.0], True)
    none = np.zeros((4, 3))
    own = np.stack([np.vstack(pair) for pair in ((UP, none), (ONE, ONE), (none, UP))])
    assert np.allclose(found.moves, SCALE * np.einsum("ij,kvj->kvi", TURN.as_matrix(), own), atol=1e-6)
    (clip,) = found.clips
    assert (clip.name, clip.times.tolist(), clip.interpolation) == ("talk", [0, 1, 3], "LINEAR")
    assert clip.weights.tolist() == [[0, 0, 0], [1, 0.5, 1], [0, 1, 0]]  # blink as the first mesh has it


def test_clips_of_other_times_are_sampled_together(scene: Path) -> None:
    document = json.loads(scene.read_text())
    document["accessors"][4]["count"] = 2
    document["accessors"][5]["count"] = 4
    document["animations"][0]["samplers"][1] = {"input": 8, "output": 9}
    data = scene.with_name("more.bin")
    data.write_bytes(np.array([0.5, 1, 0, 0.5, 1, 0], "f4").tobytes())
    document["buffers"].append({"byteLength": 24, "uri": "more.bin"})
    document["bufferViews"] += [{"buffer": 1, "byteOffset": at, "byteLength": size} for at, size in ((0, 8), (8, 16))]
    for view, count in ((8, 2), (9, 4)):
        document["accessors"].append({"bufferView": view, "componentType": 5126, "count": count, "type": "SCALAR"})
    scene.write_text(json.dumps(document))
    (clip,) = read(scene).clips
    assert clip.times.tolist() == [0, 0.5, 1]
    assert np.allclose(clip.weights, [[0, 0, 0.5], [0.5, 0.25, 0.5], [1, 0.5, 0]])


def test_a_skin_turns_moves(tmp_path: Path) -> None:
    """Of a tube that stands with a bent knee: what is added moves it as it was asked to, and is read back."""
    path = tmp_path / "tube.glb"
    write_tube(path, stands=60)
    shape = load_shape(path)
    rng = np.random.default_rng(0)
    moves = rng.normal(size=(2, shape.V, 3))
    out = added(path, shapes_of(moves, "a", "b"))
    found = read(out)
    assert found.names == ("a", "b")
    assert np.allclose(found.moves, moves, atol=1e-4)
    foot = tube().verts[:, 1] > 1.95
    document = Document(out, out.read_bytes())
    own = document.accessor(document.json["meshes"][0]["primitives"][0]["targets"][0]["POSITION"])
    back = Rotation.from_euler("x", -60, degrees=True)
    assert np.allclose(own[foot], back.apply(moves[0][foot]), atol=1e-4)


def test_what_is_there_stays(scene: Path) -> None:
    """Targets of another name are kept with their clips; those of the same name are replaced."""
    moves = np.zeros((2, 8, 3))
    moves[0, :4] = [0, 1, 0]
    moves[1, 0] = [1, 0, 0]
    clip = WeightClip("nod", np.array([0.0, 1.0]), np.array([[0.0, 0.0], [1.0, 1.0]]), "LINEAR")
    out = added(scene, shapes_of(moves, "wink", "blink", clips=(clip,)))
    before, after = Document(scene, scene.read_bytes()), Document(out, out.read_bytes())
    face, teeth = after.json["meshes"]
    assert face["extras"] == {"targetNames": ["smile", "wink", "blink"], "mine": 7}
    assert (face["weights"], face["name"]) == ([0.25, 0.0, 0.0], "face")
    assert teeth == before.json["meshes"][1]  # no shape moves it
    assert after.json["nodes"] == before.json["nodes"]
    assert after.body.startswith(before.buffer(0))
    found = read(out)
    assert found.names == ("smile", "wink", "blink", "open")
    assert np.allclose(found.moves[1:3, :4], moves[:, :4], atol=1e-6)
    talk, nod = found.clips
    assert talk.weights[:, found.names.index("smile")].tolist() == [0, 1, 0]
    assert talk.weights[:, found.names.index("blink")].tolist() == [0, 0.5, 1]  # by name, as it was
    assert nod.name == "nod"
    assert np.allclose(nod.weights, [[0.25, 0, 0, 0], [0.25, 1, 1, 0]])
    primitive = face["primitives"][0]
    assert [sorted(target) for target in primitive["targets"]] == [["NORMAL", "POSITION"]] * 3


def test_normals_turn_with_the_surface(scene: Path) -> None:
    tilt = Rotation.from_euler("z", 30, degrees=True)
    shape = load_shape(scene)
    moves = np.zeros((1, 8, 3))
    moves[0, :4] = shape.verts[:4] @ tilt.as_matrix().T - shape.verts[:4]
    out = added(scene, shapes_of(moves, "tilt"))
    document = Document(out, out.read_bytes())
    target = document.json["meshes"][0]["primitives"][0]["targets"][-1]
    turned = (TURN.inv() * tilt * TURN).apply(UP)
    assert np.allclose(document.accessor(target["NORMAL"]), turned - UP, atol=1e-5)


def test_sparse_where_that_is_smaller(tmp_path: Path) -> None:
    path = tmp_path / "tube.glb"
    write_tube(path)
    few, all_, none = (np.zeros((tube().V, 3)) for _ in range(3))
    few[7] = [1, 2, 3]
    all_[:] = [0, 1, 0]
    out = added(path, shapes_of(np.stack([few, all_, none]), "few", "all", "none"))
    document = Document(out, out.read_bytes())
    stored = [document.json["accessors"][t["POSITION"]] for t in document.json["meshes"][0]["primitives"][0]["targets"]]
    assert [("sparse" in each, "bufferView" in each) for each in stored] == [
        (True, False),
        (False, True),
        (False, False),
    ]
    assert stored[0]["sparse"]["count"] == 1
    assert (stored[0]["min"], stored[0]["max"]) == ([0, 0, 0], [1, 2, 3])
    assert np.allclose(read(out).moves, [few, all_, none], atol=1e-5)


def test_each_node_of_a_mesh_gets_its_own(scene: Path) -> None:
    document = json.loads(scene.read_text())
    document["nodes"][2]["mesh"] = 0
    scene.write_text(json.dumps(document))
    moves = np.zeros((1, 8, 3))
    moves[0, :4], moves[0, 4:] = [0, 1, 0], [0, -1, 0]
    found = read(added(scene, shapes_of(moves, "apart")))
    assert np.allclose(found.moves[found.names.index("apart")], moves[0], atol=1e-6)


def test_a_clip_of_the_same_name_takes_weights_in(tmp_path: Path) -> None:
    path = tmp_path / "tube.glb"
    write_tube(path)
    clip = WeightClip("bend", np.array([0.0, 1.0]), np.array([[0.0], [1.0]]), "LINEAR")
    out = added(path, shapes_of(np.ones((1, tube().V, 3)), "swell", clips=(clip,)))
    (animation,) = Document(out, out.read_bytes()).json["animations"]
    assert [channel["target"]["path"] for channel in animation["channels"]][-2:] == ["translation", "weights"]
    assert read(out).clips[0].weights.tolist() == [[0], [1]]


def test_cubic_splines_keep_their_slopes(scene: Path) -> None:
    weights = np.arange(6.0).reshape(6, 1)
    clip = WeightClip("glide", np.array([0.0, 1.0]), weights, "CUBICSPLINE")
    moves = np.zeros((1, 8, 3))
    moves[0, :4] = 1
    out = added(scene, shapes_of(moves, "glide", clips=(clip,)))
    found = read(out)
    assert found.clips[1].interpolation == "CUBICSPLINE"
    assert found.clips[1].weights[:, found.names.index("glide")].tolist() == weights[:, 0].tolist()
    assert found.clips[1].weights[:, 0].tolist() == [0, 0.25, 0, 0, 0.25, 0]  # smile rests


def test_a_scene_is_turned_by_its_topmost_node(tmp_path: Path) -> None:
    path = tmp_path / "face.glb"
    moves = np.ones((1, 8, 3))
    for document in ({}, {"scenes": []}):  # which a file need not have
        write_morphs(path, nodes=[{"children": [1, 2]}, {"mesh": 0}, {"mesh": 1}], **document)
        turned = load_shape(added(path, shapes_of(moves, "one"), TURN.as_matrix()))
        assert np.allclose(turned.verts[:4], TURN.apply(CORNERS), atol=1e-6)


WRONG: list[tuple[Damage, str]] = [
    (lambda document: document["meshes"][1]["primitives"][0].pop("targets"), "no sense"),
    (lambda document: document["meshes"][0]["primitives"][0].update(targets=[{"POSITION": 77}]), "no sense"),
    (lambda document: document["meshes"][0].update(weights=["much"]), "no sense"),
    (lambda document: document["accessors"][3].update(count=3), "no sense"),
    (lambda document: document["animations"][0]["samplers"][0].update(output=4), "no sense"),
    (lambda document: document["animations"][0]["samplers"][0].update(interpolation="MAGIC"), "no sense"),
]


@pytest.mark.parametrize(("damage", "words"), WRONG)
def test_damage_is_told_in_a_line(scene: Path, damage: Damage, words: str) -> None:
    document = json.loads(scene.read_text())
    damage(document)
    scene.write_text(json.dumps(document))
    with pytest.raises(InputError, match=words):
        read(scene)


def test_more_shapes_than_a_file_can_mean(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("meshmatch.shapes.formats.MAX_ELEMENTS", 5)
    with pytest.raises(InputError, match="makes 6 vertices and faces, of 5 at most"):
        read(scene)


def test_a_scene_without_shapes(tmp_path: Path) -> None:
    path = tmp_path / "tube.glb"
    write_tube(path)
    with pytest.raises(InputError, match=r"tube.glb has no blendshapes \(morph targets\)"):
        read(path)
