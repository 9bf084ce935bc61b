"""glTF files that use extensions: read where that is possible, else refused in words; and nothing hidden is drawn."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from meshmatch.errors import InputError, MeshmatchWarning
from meshmatch.shapes.files import list_meshes, load_shape
from meshmatch.shapes.formats import gltf
from meshmatch.shapes.textured_files import find_appearance, load_coordinates
from tests.shapes.painted import write_document

TRIANGLE = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
SHIFT = np.array([[0, 0, 0], [5, 0, 0], [0, 0, 7]], np.float32)
TURN = np.array([[0, 0, 0, 1], [0, 0, 2**-0.5, 2**-0.5], [0, 0, 0, 1]], np.float32)  # x to y
SCALE = np.array([[1, 1, 1], [2, 2, 2], [1, 1, 3]], np.float32)
UP = np.array([0, 9, 0])


def scene(folder: Path, *arrays: np.ndarray, **changes: Any) -> Path:
    """A gltf of one triangle; accessor k is the k-th array, the first of them its positions."""
    document = {
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "nodes": [{"mesh": 0, "name": "one"}],
        "scenes": [{"nodes": [0]}],
    }
    write_document(folder / "a.gltf", document | changes, TRIANGLE, *arrays)
    return folder / "a.gltf"


def instances(**attributes: int) -> list[dict[str, Any]]:
    return [
        {"mesh": 0, "extensions": {"EXT_mesh_gpu_instancing": {"attributes": attributes}}, "translation": UP.tolist()}
    ]


def test_instances_stand_where_they_are_put(tmp_path: Path) -> None:
    nodes = instances(TRANSLATION=1, ROTATION=2, SCALE=3)
    path = scene(tmp_path, SHIFT, TURN, SCALE, nodes=nodes, extensionsRequired=["EXT_mesh_gpu_instancing"])
    shape = load_shape(path)
    turned = np.array([[0, 0, 0], [0, 2, 0], [-2, 0, 0]])
    own = np.concatenate([TRIANGLE, turned + SHIFT[1], [[0, 0, 7], [1, 0, 7], [0, 1, 7]]])
    np.testing.assert_allclose(shape.verts, own + UP, atol=1e-6)
    np.testing.assert_array_equal(shape.faces, np.arange(9).reshape(3, 3))
    only = load_shape(scene(tmp_path, SHIFT, nodes=instances(TRANSLATION=1)))
    np.testing.assert_allclose(only.verts, (TRIANGLE + SHIFT[:, None]).reshape(-1, 3) + UP)


def test_coordinates_and_looks_go_with_the_instances(tmp_path: Path) -> None:
    corners = np.array([[0, 0], [1, 0], [0, 1]], np.float32)
    meshes = [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 2}, "material": 0}]}]
    materials = [{"pbrMetallicRoughness": {"baseColorFactor": [1, 0, 0, 1]}}, {}]
    given = {"meshes": meshes, "materials": materials, "nodes": instances(TRANSLATION=1)}
    path = scene(tmp_path, SHIFT, corners, **given)
    shape = load_shape(path)
    np.testing.assert_array_equal(load_coordinates(path, shape), np.stack([corners] * 3))
    find_appearance(path, shape)  # of as many faces as the shape has


def test_instances_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gltf, "MAX_NODES", 2)
    with pytest.raises(InputError, match="over 2 nodes"):
        load_shape(scene(tmp_path, SHIFT, nodes=instances(TRANSLATION=1)))
    with pytest.raises(InputError, match="over 2 nodes"):
        load_shape(scene(tmp_path, SHIFT, nodes=instances(TRANSLATION=1), meshes=[{"primitives": []}]))


def test_instances_of_unequal_numbers_are_damage(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no sense"):
        load_shape(scene(tmp_path, SHIFT, SCALE[:2], nodes=instances(TRANSLATION=1, SCALE=2)))


def test_hidden_meshes_are_left_out_and_said(tmp_path: Path) -> None:
    hidden = {"KHR_node_visibility": {"visible": False}}
    nodes = [
        {"mesh": 0, "name": "seen", "extensions": {"KHR_node_visibility": {"visible": True}}},
        {"mesh": 0, "name": "spare", "extensions": hidden, "children": [2]},
        {"children": [3]},
        {"mesh": 0, "name": "below"},
    ]
    path = scene(tmp_path, nodes=nodes, scenes=[{"nodes": [0, 1]}], extensionsRequired=["KHR_node_visibility"])
    with pytest.warns(MeshmatchWarning, match="hides 2 of its meshes, which are left out: spare, below"):
        assert load_shape(path).V == 3
    with pytest.warns(MeshmatchWarning):
        assert list_meshes(path) == [("seen", 3)]


@pytest.mark.parametrize(
    ("extension", "fine"),
    [
        ("KHR_mesh_quantization", True),
        ("KHR_materials_unlit", True),
        ("KHR_texture_basisu", True),
        ("EXT_texture_webp", True),
        ("KHR_lights_punctual", True),
        ("KHR_animation_pointer", True),
        ("VRMC_vrm", True),
        ("CESIUM_RTC", False),
        ("KHR_gaussian_splatting", False),
        ("MADE_up_materials", False),
    ],
)
def test_what_a_file_may_require(tmp_path: Path, extension: str, fine: bool) -> None:
    path = scene(tmp_path, extensionsRequired=[extension])
    if fine:
        assert load_shape(path).V == 3
        return
    with pytest.raises(InputError, match=extension):
        load_shape(path)


@pytest.mark.parametrize("extension", ["KHR_draco_mesh_compression", "MADE_up_compression"])
def test_compression_that_is_not_listed_as_required(tmp_path: Path, extension: str) -> None:
    draco = {extension: {"bufferView": 0, "attributes": {"POSITION": 0}}}
    meshes = [{"primitives": [{"attributes": {"POSITION": 0}, "extensions": draco}]}]
    assert load_shape(scene(tmp_path, meshes=meshes)).V == 3  # plain data is there as well
    bare = [{"componentType": 5126, "count": 3, "type": "VEC3"}]
    with pytest.raises(InputError, match="compressed"):
        load_shape(scene(tmp_path, meshes=meshes, accessors=bare))


@pytest.mark.parametrize("fallback", [{"extensions": {"EXT_meshopt_compression": {"fallback": True}}}, {}])
def test_meshopt_without_its_plain_data(tmp_path: Path, fallback: dict[str, Any]) -> None:
    inside = {"EXT_meshopt_compression": {"buffer": 0, "byteLength": 9, "byteStride": 12, "count": 3}}
    view = {"buffer": 1, "byteLength": 36, "extensions": inside}
    first = {"byteLength": 9, "uri": "data:;base64,AAAAAAAAAAAA"}
    buffers = [first, {"byteLength": 36} | fallback]
    with pytest.raises(InputError, match="compressed"):
        load_shape(scene(tmp_path, bufferViews=[view], buffers=buffers))
    del view["extensions"]
    with pytest.raises(InputError, match="no data"):
        load_shape(scene(tmp_path, bufferViews=[view], buffers=buffers))


def test_a_part_without_positions_is_nothing(tmp_path: Path) -> None:
    primitives = [{"attributes": {"POSITION": 0}}, {"attributes": {"COLOR_0": 0}}, {"attributes": {}}, {}]
    assert load_shape(scene(tmp_path, meshes=[{"primitives": primitives}])).V == 3
