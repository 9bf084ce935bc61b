"""glTF scenes whose vertices have moved: all else stays."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import meshmatch
from meshmatch.errors import MeshmatchWarning
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.deformed_files import save_moved
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.formats.gltf import INSTANCES, Document
from meshmatch.shapes.formats.gltf_edit import Editor
from meshmatch.shapes.formats.gltf_morphs import read_morphs
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.textured_files import load_appearance, load_coordinates
from meshmatch.templates.location import bundled_folder
from meshmatch.transfer.bake import colors_of_vertices
from tests.shapes.morphs import SCALE, TURN, UP, write_morphs
from tests.shapes.painted import CORNERS, FACES, glb, parts
from tests.transfer.rigs import BEND, posed_verts, write_tube

SPIN = Rotation.from_rotvec([0.4, -1.2, 0.8])
GROWN = 3.0


def square() -> tuple[np.ndarray, np.ndarray]:
    return CORNERS.astype(float), np.asarray(FACES)


def moved(path: Path) -> tuple[Path, Shape]:
    """The file turned, enlarged and shifted as a whole, and where its vertices are then."""
    shape = load_shape(path)
    verts = GROWN * shape.verts @ SPIN.as_matrix().T + [5.0, -1.0, 2.0]
    out = path.with_name("moved.glb")
    save_moved(out, path, Shape(verts, shape.faces, shape.name), np.tile(SPIN.as_matrix(), (shape.V, 1, 1)))
    return out, load_shape(out)


def test_nodes_meshes_and_clips_stay(scene: Path) -> None:
    before = load_shape(scene)
    out, after = moved(scene)
    assert np.allclose(after.verts, GROWN * before.verts @ SPIN.as_matrix().T + [5.0, -1.0, 2.0], atol=1e-5)
    assert np.array_equal(after.faces, before.faces)
    old, new = (Document(path, path.read_bytes()) for path in (scene, out))
    assert new.json["nodes"] == old.json["nodes"]
    assert [mesh["extras"] | {"name": mesh["name"]} for mesh in new.json["meshes"]] == [
        mesh["extras"] | {"name": mesh["name"]} for mesh in old.json["meshes"]
    ]
    assert [channel["target"] for channel in new.json["animations"][0]["channels"]] == [
        channel["target"] for channel in old.json["animations"][0]["channels"]
    ]
    primitive = new.json["meshes"][0]["primitives"][0]
    normals = new.accessor(primitive["attributes"]["NORMAL"])
    assert np.allclose(normals, (TURN.inv() * SPIN * TURN).apply(UP), atol=1e-6)


def test_morph_targets_turn_and_grow(scene: Path) -> None:
    before = read_morphs(scene, scene.read_bytes())
    out, _ = moved(scene)
    after = read_morphs(out, out.read_bytes())
    assert after.names == before.names
    assert np.allclose(after.moves, GROWN * before.moves @ SPIN.as_matrix().T, atol=1e-5)
    assert after.clips[0].weights.tolist() == before.clips[0].weights.tolist()


def test_a_skinned_mesh_stands_and_bends(tmp_path: Path) -> None:
    """Of a tube that stands with a bent knee: it stands where it was moved to, and its skin still bends it."""
    path = tmp_path / "tube.glb"
    write_tube(path, stands=40)
    shape = load_shape(path)
    shift = np.array([0.3, 0.0, 0.0])
    out = tmp_path / "moved.glb"
    with pytest.warns(MeshmatchWarning, match=r"the joints of tube.glb stay where they are in moved.glb: `meshmatch"):
        save_moved(out, path, Shape(shape.verts + shift, shape.faces), np.tile(np.eye(3), (shape.V, 1, 1)))
    assert np.allclose(load_shape(out).verts, shape.verts + shift, atol=1e-5)
    before, after = posed_verts(path, "bend", 1.0), posed_verts(out, "bend", 1.0)
    knee = Rotation.from_euler("x", BEND - 40, degrees=True)
    low, high = shape.verts[:, 1] < 0.7, load_shape(path).verts[:, 1] > 1.3
    assert np.allclose((after - before)[low], shift, atol=1e-5)
    assert np.allclose((after - before)[high], knee.apply(shift), atol=1e-4)
    a, b = (Document(each, each.read_bytes()).json for each in (path, out))
    assert (a["nodes"], a["skins"][0]["joints"]) == (b["nodes"], b["skins"][0]["joints"])


def test_tangents_and_rows_without_a_place(tmp_path: Path) -> None:
    path = tmp_path / "face.glb"
    write_morphs(path)
    document = Document(path, path.read_bytes())
    json_ = document.json
    tangents = np.tile([[1.0, 0, 0, -1.0]], (4, 1)).astype("f4")
    json_["buffers"].append({"byteLength": 64, "uri": "more.bin"})
    (tmp_path / "more.bin").write_bytes(tangents.tobytes())
    json_["buffers"][0]["uri"] = "body.bin"
    (tmp_path / "body.bin").write_bytes(document.body)
    json_["bufferViews"].append({"buffer": 1, "byteLength": 64})
    json_["accessors"].append({"bufferView": 8, "componentType": 5126, "count": 4, "type": "VEC4"})
    json_["meshes"][0]["primitives"][0]["attributes"]["TANGENT"] = 8
    path = path.with_suffix(".gltf")
    path.write_text(json.dumps(json_))
    shape = load_shape(path)
    verts = np.array(shape.verts @ SPIN.as_matrix().T)
    verts[1] = np.nan
    out = tmp_path / "moved.glb"
    save_moved(out, path, Shape.with_invalid(verts, shape.faces, "face"), np.tile(SPIN.as_matrix(), (shape.V, 1, 1)))
    new = Document(out, out.read_bytes())
    found = new.accessor(new.json["meshes"][0]["primitives"][0]["attributes"]["TANGENT"])
    own = (TURN.inv() * SPIN * TURN).apply([1.0, 0, 0])
    assert np.allclose(found[[0, 2, 3]], [[*own, -1]] * 3, atol=1e-6)
    assert np.allclose(load_shape(out).verts[1], shape.verts[1], atol=1e-6)


@pytest.mark.filterwarnings("ignore:out.ply does not have")
@pytest.mark.parametrize("original", [True, False])
def test_a_node_turns_what_lies_upright(tmp_path: Path, original: bool) -> None:
    """Vertices keep their frame below it; other formats have no nodes."""
    path = tmp_path / ("scene.glb" if original else "scene.ply")
    write_morphs(path) if original else save_shape(path, Shape(*square(), "square"))
    shape, still = load_shape(path), np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    turns = np.tile(np.eye(3), (shape.V, 1, 1))
    for out in (tmp_path / "out.glb", tmp_path / "out.ply"):
        save_moved(out, path, shape, turns, turn=still)
        expected = shape.verts @ still.T if out.suffix == ".glb" else shape.verts
        assert np.allclose(load_shape(out).verts, expected, atol=1e-6)
    document = Document(tmp_path / "out.glb", (tmp_path / "out.glb").read_bytes())
    assert "upright" in [node.get("name") for node in document.nodes]


@pytest.mark.filterwarnings("ignore:out.glb does not have the polygons")
def test_polygons_keep_their_texture_coordinates(tmp_path: Path) -> None:
    """Also one that is no longer convex, which a reader would split along the other diagonal."""
    path, out = tmp_path / "quad.obj", tmp_path / "out.glb"
    corners = ["0 0", "1 0", "1 1", "0 1"]
    path.write_text("".join([f"v {c} 0\nvt {c}\n" for c in corners] + ["f 1/1 2/2 3/3 4/4\n"]))
    shape = load_shape(path)
    dented = np.array([[0, 0, 0], [0.3, 0.7, 0], [1, 1, 0], [0, 1, 0]])
    save_moved(out, path, Shape(dented, shape.faces, shape.name), np.tile(np.eye(3), (4, 1, 1)))
    laid = load_coordinates(out, load_shape(out))
    assert laid is not None and np.array_equal(load_shape(out).faces, shape.faces)
    assert np.allclose(laid, shape.verts[shape.faces][..., :2] * [1, -1] + [0, 1])


def test_copies_of_a_mesh_become_one_mesh_each(tmp_path: Path) -> None:
    path = tmp_path / "face.gltf"
    more: dict[str, Any] = {"extensionsUsed": [INSTANCES]}
    write_morphs(path, nodes=[{"mesh": 0, "extensions": {INSTANCES: {"attributes": {"TRANSLATION": 2}}}}], **more)
    shape = load_shape(path)
    assert shape.V == 16
    with pytest.warns(MeshmatchWarning, match="does not have"):
        save_moved(
            tmp_path / "moved.glb", path, Shape(SCALE * shape.verts, shape.faces), np.tile(np.eye(3), (16, 1, 1))
        )
    assert np.allclose(load_shape(tmp_path / "moved.glb").verts, SCALE * shape.verts)


def mirrored(path: Path, scale: list[float]) -> Path:
    """The textured sample with a scale of its node."""
    editor = Editor(Document(path, (bundled_folder() / "samples" / "dancer-textured.glb").read_bytes()))
    next(node for node in editor.json["nodes"] if "mesh" in node)["scale"] = scale
    path.write_bytes(editor.to_bytes())
    return path


def test_a_mirrored_node_is_not_inside_out(tmp_path: Path) -> None:
    """Its triangles run the other way around (glTF 2.0, 3.7.4), and each corner keeps its texture coordinates."""
    plain, mirror = mirrored(tmp_path / "plain.glb", [1, 1, 1]), mirrored(tmp_path / "mirror.glb", [-1, 1, 1])
    one, other = load_shape(plain), load_shape(mirror)
    assert np.array_equal(other.faces, one.faces[:, ::-1])
    np.testing.assert_allclose(other.verts, one.verts * [-1, 1, 1])
    assert np.einsum("nd,nd->", other.verts[other.faces].mean(1) - other.verts.mean(0), other.face_vectors) > 0
    coordinates = [load_appearance(path, shape).uv for path, shape in ((plain, one), (mirror, other))]
    assert np.array_equal(coordinates[1], coordinates[0][:, ::-1])


def test_a_mirrored_node_wears_its_texture(tmp_path: Path) -> None:
    mirror = mirrored(tmp_path / "mirror.glb", [-1, 1, 1])
    meshmatch.transfer_texture(mirror, mirror, options=meshmatch.BakeOptions(size=256)).save(tmp_path / "worn.glb")
    assert np.array_equal(load_shape(tmp_path / "worn.glb").faces, load_shape(mirror).faces)
    colors = []
    for path in (mirror, tmp_path / "worn.glb"):
        shape = load_shape(path)
        colors.append(colors_of_vertices(shape, load_appearance(path, shape), shape, VertexMap.identity(shape))[:, :3])
    assert np.abs(colors[0] - colors[1]).mean() < 0.02 < 0.2 < colors[0].std()


def test_a_skin_below_a_mirrored_node_is_not_inside_out(tmp_path: Path) -> None:
    """Its joints say where its vertices are, not its node."""
    path = tmp_path / "tube.glb"
    write_tube(path)
    plain = load_shape(path)
    document, buffer = parts(path.read_bytes())
    next(node for node in document["nodes"] if "skin" in node)["scale"] = [-1, 1, 1]
    path.write_bytes(glb(document, buffer))
    assert np.array_equal(load_shape(path).faces, plain.faces)
    scene = document["scenes"][0]
    document["nodes"].append({"children": scene["nodes"], "scale": [-1, 1, 1]})
    scene["nodes"] = [len(document["nodes"]) - 1]
    path.write_bytes(glb(document, buffer))
    mirror = load_shape(path)
    np.testing.assert_allclose(mirror.verts, plain.verts * [-1, 1, 1], atol=1e-6)
    assert np.array_equal(mirror.faces, plain.faces[:, ::-1])
