"""Scenes of very many nodes, joints, primitives or materials take time with their number, not with its square."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from meshmatch.outputs import make_unique
from meshmatch.shapes.appearance import BakedMaterial
from meshmatch.shapes.blend_shapes import BlendShapes, WeightClip
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.formats.gltf import Document
from meshmatch.shapes.formats.gltf_attachments import reattach_children
from meshmatch.shapes.formats.gltf_edit import Editor
from meshmatch.shapes.formats.gltf_humanoid import find_humanoid_bones
from meshmatch.shapes.formats.gltf_materials import with_material
from meshmatch.shapes.formats.gltf_morphs import read_morphs, with_morphs
from meshmatch.shapes.formats.gltf_prune import drop_nodes
from meshmatch.shapes.formats.gltf_rig import Binding, Rig, nodes_of_skeleton
from tests.growth import grows_with_size
from tests.shapes.painted import CORNERS, FACES, write_document


def chain(count: int, last: dict[str, Any]) -> list[dict[str, Any]]:
    """Nodes that hang from one another."""
    return [*({"children": [k + 1]} for k in range(count - 1)), last]


def write(path: Path, **document: Any) -> Document:
    """Squares, whose vertices all go with the first joint."""
    joints, weights = np.zeros((4, 4), "u2"), np.tile(np.array([1, 0, 0, 0], "f4"), (4, 1))
    arrays = CORNERS.astype("f4"), FACES.ravel().astype("u2"), joints, weights, np.zeros((4, 2), "f4")
    write_document(path, {"scenes": [{"nodes": [0]}], "scene": 0, **document}, *arrays)
    return Document(path, path.read_bytes())


SQUARE: dict[str, Any] = {"attributes": {"POSITION": 0}, "indices": 1}
BOUND = {"attributes": {"POSITION": 0, "JOINTS_0": 2, "WEIGHTS_0": 3}, "indices": 1}


@pytest.mark.parametrize("held", [True, False])
def test_a_long_chain_of_empty_nodes(held: bool) -> None:
    def prepared(count: int) -> Callable[[], int]:
        document: dict[str, Any] = {"nodes": chain(count, {"mesh": 0} if held else {}), "scenes": [{"nodes": [0]}]}

        def work() -> int:
            drop_nodes(document, range(count))
            return len(document["nodes"])

        return work

    assert grows_with_size(prepared, 12_000) == (12_000 if held else 0)


def test_what_is_above_a_node_that_stays_stays() -> None:
    """Two branches, of which one holds a camera."""
    nodes = [{"children": [1, 3]}, {"children": [2]}, {}, {"children": [4, 5]}, {"camera": 0}, {}]
    document: dict[str, Any] = {"nodes": nodes, "scenes": [{"nodes": [0]}]}
    drop_nodes(document, range(6))
    assert document["nodes"] == [{"children": [1]}, {"children": [2]}, {"camera": 0}]


def test_the_skeleton_of_a_long_chain(tmp_path: Path) -> None:
    def prepared(count: int) -> Callable[[], int]:
        document = write(tmp_path / "a.gltf", nodes=chain(count, {"mesh": 0}), meshes=[{"primitives": [SQUARE]}])
        list(document.primitives())
        return lambda: len(nodes_of_skeleton(document, [0]))

    assert grows_with_size(prepared, 24_000) == 23_999


def test_a_person_of_very_many_bones(tmp_path: Path) -> None:
    def prepared(count: int, named: bool) -> Callable[[], bool]:
        bones = {"hips": {"node": 1}, "head": {"node": 2}} | {f"{k}": {"node": k} for k in range(3, count)}
        nodes = [{"children": list(range(1, count))}, *({"name": f"{k}"} for k in range(1, count))]
        character = {"extensions": {"VRMC_vrm": {"humanoid": {"humanBones": bones}}}}
        skins = [{"joints": list(range(1, count))}]
        other = write(tmp_path / "a.gltf", nodes=nodes, skins=skins, meshes=[])
        one = write(tmp_path / "b.gltf", nodes=nodes, skins=skins, meshes=[], **character)

        def work() -> bool:
            found = find_humanoid_bones(one if named else other, one)
            return found is not None and found.bones == {bone: each["node"] for bone, each in bones.items()}

        return work

    for named in (True, False):
        assert grows_with_size(lambda count, named=named: prepared(count, named), 12_000)


def test_what_hangs_from_joints_that_move_nothing(tmp_path: Path) -> None:
    """Each of 3,200 holds a camera, and goes with the one joint that moves all."""

    def prepared(count: int) -> Callable[[], tuple[set[int], Editor]]:
        N, V = count, 64 * count
        nodes = [
            {"children": [1, N + 2]},
            *({"children": [k + 1, N + 2 + k]} for k in range(1, N)),
            {"children": [2 * N + 2]},
            {"mesh": 0, "skin": 0},
            *({"camera": 0} for _ in range(N + 1)),
        ]
        arrays = (
            np.zeros((V, 3), "f4"),
            np.zeros(3, "u2"),
            np.zeros((V, 4), "u1"),
            np.tile([1, 0, 0, 0], (V, 1)).astype("f4"),
        )
        document: dict[str, Any] = {"scenes": [{"nodes": [0, N + 1]}], "scene": 0, "nodes": nodes}
        document |= {"skins": [{"joints": list(range(N + 1))}], "meshes": [{"primitives": [BOUND]}]}
        path = tmp_path / "a.glb"
        write_document(path, document, *arrays)
        scene = Document(path, path.read_bytes())
        list(scene.primitives())
        rig = Rig(
            ("new",), np.array([-1]), np.array([0]), np.array([[0, 0, 0, 1.0]]), np.zeros((1, 3)), np.ones((1, 3)), ()
        )
        binding = Binding(rig, np.eye(4)[None], np.zeros((V, 1), np.int32), np.ones((V, 1), np.float32))
        editor = Editor(scene)
        editor.json["nodes"].append({})
        return lambda: (reattach_children(editor, scene, set(range(N + 1)), binding, [len(nodes)]), editor)

    hung, editor = grows_with_size(prepared, 3_200)
    assert hung == set(range(3_202, 6_403)) and set(editor.json["nodes"][-1]["children"]) == hung


def test_primitives_times_joints(tmp_path: Path) -> None:
    def prepared(count: int) -> Callable[[], int]:
        nodes = [{"mesh": 0, "skin": 0, "children": list(range(1, count))}, *({} for _ in range(1, count))]
        meshes = [{"primitives": [BOUND] * count}]
        document = write(tmp_path / "a.gltf", nodes=nodes, skins=[{"joints": list(range(count))}], meshes=meshes)
        return lambda: len(document.faces())

    assert grows_with_size(prepared, 6_000) == 2 * 6_000


@pytest.mark.parametrize("what", ["primitives", "targets"])
def test_morph_targets(tmp_path: Path, what: str) -> None:
    def prepared(count: int) -> Callable[[], tuple[int, ...]]:
        primitives, targets = (count, 1) if what == "primitives" else (1, 5 * count)
        square = SQUARE | {"targets": [{"POSITION": 0}] * targets}
        path = tmp_path / "a.gltf"
        write(path, nodes=[{"mesh": 0}], meshes=[{"primitives": [square] * primitives}])
        return lambda: read_morphs(path, path.read_bytes()).moves.shape

    assert grows_with_size(prepared, 8_000) == ((1, 32_000, 3) if what == "primitives" else (40_000, 4, 3))


@pytest.mark.parametrize("what", ["channels", "clips"])
def test_clips(tmp_path: Path, what: str) -> None:
    """A clip turns very many nodes, and animates weights; others are added."""

    def prepared(count: int) -> Callable[[], tuple[Document, int]]:
        nodes, channels, clips = (count, 80 * count, 0) if what == "channels" else (1, 0, 20 * count)
        square = SQUARE | {"targets": [{"POSITION": 0}]}
        document: dict[str, Any] = {
            "scenes": [{"nodes": [0]}],
            "scene": 0,
            "meshes": [{"primitives": [square]}] * nodes,
        }
        document["nodes"] = [{"mesh": k} | node for k, node in enumerate(chain(nodes, {}))] + [{}] * channels
        if channels:
            document["nodes"][-channels - 1]["children"] = list(range(nodes, nodes + channels))
        of_weights = [{"sampler": 0, "target": {"node": k, "path": "weights"}} for k in range(nodes)]
        turns = [{"sampler": 1, "target": {"node": nodes + k, "path": "rotation"}} for k in range(channels)]
        samplers = [{"input": 2, "output": 3}, {"input": 2, "output": 4}][: 2 if channels else 1]
        document["animations"] = [{"samplers": samplers, "channels": [*turns, *of_weights]}]
        path = tmp_path / "a.gltf"
        turned = np.array([[0, 0, 0, 1]], "f4")
        write_document(
            path, document, CORNERS.astype("f4"), FACES.ravel().astype("u2"), *np.zeros((2, 1), "f4"), turned
        )
        scene, shape = Document(path, path.read_bytes()), load_shape(path)
        added = tuple(WeightClip(f"new {k}", np.zeros(1), np.ones((1, 1)), "LINEAR") for k in range(clips))
        shapes = BlendShapes(("wide",), np.ones((1, shape.V, 3), np.float32), np.zeros(1), normals=False, clips=added)
        return lambda: (Document(tmp_path / "b.glb", with_morphs(scene, shape, shapes, np.eye(3))), nodes)

    made, nodes = grows_with_size(prepared, 400)
    first, *others = made.json["animations"]
    own = range(1, nodes + 1 + (what == "channels"))  # each node's weights have a sampler of their own
    assert {channel["sampler"] for channel in first["channels"]} == set(own)
    assert len(others) == (8_000 if what == "clips" else 0)


def test_materials(tmp_path: Path) -> None:
    """A primitive has very many variants."""

    def prepared(count: int) -> Callable[[], bytes]:
        mappings = [{"material": k, "variants": [k]} for k in range(1, count)]
        part = {"attributes": {"POSITION": 0, "TEXCOORD_0": 4}, "indices": 1, "material": 0}
        part["extensions"] = {"KHR_materials_variants": {"mappings": mappings}}
        materials = [{"name": f"{k}"} for k in range(count)]
        names = {"variants": [{"name": f"{k}"} for k in range(count)]}
        variants = {"extensionsUsed": ["KHR_materials_variants"], "extensions": {"KHR_materials_variants": names}}
        meshes = [{"primitives": [part]}]
        document = write(tmp_path / "a.gltf", nodes=[{"mesh": 0}], meshes=meshes, materials=materials, **variants)
        baked = BakedMaterial(np.full((4, 4, 4), 255, np.uint8))
        return lambda: with_material(document, np.zeros((2, 3, 2)), True, baked, np.eye(3))

    made = Document(tmp_path / "b.glb", grows_with_size(prepared, 20_000)).json["materials"]
    assert [each["name"] for each in made] == [f"{k}" for k in range(20_000)]


def test_names_that_are_alike() -> None:
    words = ["Smile", "smile", "smile-2", "smile", "open", "smile"]
    assert make_unique(words, "-", str.lower) == ["Smile", "smile-2", "smile-2-2", "smile-3", "open", "smile-4"]
    assert make_unique(words, " ") == ["Smile", "smile", "smile-2", "smile 2", "open", "smile 3"]
    assert grows_with_size(lambda count: lambda: make_unique(["_"] * count, "-"), 20_000)[-1] == "_-20000"
