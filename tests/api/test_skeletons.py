"""Garments and wraps move with a skeleton: that of the body, or their own."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import meshmatch
from meshmatch.api.skeletons import move_skeleton
from meshmatch.errors import InputError, MeshmatchWarning, OptionError
from meshmatch.shapes.deformed_files import save_moved
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.formats.gltf import Document
from meshmatch.shapes.formats.gltf_rig import read_rig
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.textured_files import load_appearance
from tests.shapes.painted import encoded, quarters
from tests.transfer.rigs import posed_verts, tube, write_tube
from tests.transfer.worn import same_numbers

WIDER = np.array([1.2, 1.0, 1.2])


def stocking() -> Shape:
    """The tube without its ends, a little wider."""
    shape = tube()
    return Shape(shape.verts * WIDER, shape.faces[:-32], "stocking")


@pytest.fixture
def body(tmp_path: Path) -> Path:
    path = tmp_path / "body.glb"
    write_tube(path)
    return path


def worn(body: Path, garment: Path) -> meshmatch.GarmentResult:
    shape = load_shape(body)
    return meshmatch.transfer_garment(garment, body, body, same_numbers(shape, shape))


@pytest.mark.parametrize("skinned", [False, True])
def test_a_garment_bends_with_the_body_that_it_sits_on(body: Path, skinned: bool) -> None:
    """By the weights below it, or by its own, whose joints have the same names."""
    garment, out = body.with_name("stocking.glb" if skinned else "stocking.ply"), body.with_name("out.glb")
    if skinned:
        write_tube(garment, clips=False)
    else:
        save_shape(garment, stocking())
    result = worn(body, garment)
    result.save(out)
    assert np.allclose(load_shape(out).verts, result.shape.verts, atol=1e-5)
    rows = slice(0, tube().V)
    for time in (0.0, 0.5, 1.0):
        away = np.linalg.norm(posed_verts(out, "bend", time)[rows] - posed_verts(body, "bend", time), axis=1)
        assert away.mean() < (0.005 if skinned else 0.06), time
    assert [clip.name for clip in read_rig(out, out.read_bytes()).clips] == ["bend"]


def test_both_are_written_into_one_file(body: Path) -> None:
    garment, out = body.with_name("stocking.obj"), body.with_name("out.glb")
    save_shape(garment, stocking())
    text = garment.read_text().replace("# meshmatch\n", "")
    garment.write_text(f"mtllib wool.mtl\nusemtl wool\ng leg\n{text}g cuff\n")
    garment.with_name("wool.mtl").write_text("newmtl wool\nKd 1 0 0\n")
    result = worn(body, garment)
    with pytest.warns(MeshmatchWarning, match="groups"):
        result.save(out, join=True)
    before, after = (Document(path, path.read_bytes()).json for path in (body, out))
    assert after["nodes"][: len(before["nodes"])] == before["nodes"]
    assert after["meshes"][: len(before["meshes"])] == before["meshes"]
    assert after["animations"] == before["animations"]
    assert after["skins"][1]["joints"] == after["skins"][0]["joints"]
    V = tube().V
    for time in (0.0, 1.0):
        now = posed_verts(out, "bend", time)
        assert np.allclose(now[:V], posed_verts(body, "bend", time), atol=1e-6)
        assert np.linalg.norm(now[V : 2 * V - 2] - now[: V - 2], axis=1).mean() < 0.06
    found = load_appearance(out, load_shape(out))
    assert [made.name for made in found.materials][-1] == "wool"
    image = found.materials[found.material[-1]].image
    assert image is not None and image[0, 0].tolist() == [255, 0, 0, 255]


def test_images_of_both_are_kept(body: Path) -> None:
    """And into a target without a skeleton a garment is put as it stands."""
    pictures = {"images": [{"uri": "own.png"}], "textures": [{"source": 0}]}
    paint = [{"name": "skin", "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]
    body.with_name("own.png").write_bytes(encoded(quarters()))
    garment, plain = body.with_name("stocking.glb"), body.with_name("plain.glb")
    write_tube(garment)
    nodes = Document(garment, garment.read_bytes()).json["nodes"]
    nodes[6]["extras"] = {"layer": 2}
    write_tube(garment, materials=paint, nodes=nodes, **pictures)
    save_shape(plain, tube())
    a, b = load_shape(body), load_shape(plain)
    result = meshmatch.transfer_garment(garment, body, plain, same_numbers(a, b))
    out = body.with_name("out.glb")
    result.save(out, join=True)
    found = Document(out, out.read_bytes())
    assert len(found.json["images"]) == 1 and found.view_bytes(found.json["images"][0]["bufferView"])[:4] == b"\x89PNG"
    assert "skins" not in found.json and found.json["nodes"][-1]["extras"] == {"layer": 2}
    assert np.allclose(load_shape(out).verts[b.V :], result.shape.verts, atol=1e-5)
    with pytest.raises(OptionError, match="nothing can be put into the target"):
        replace(result, body=None).save(out, join=True)
    with pytest.raises(OptionError, match="cannot hold the target"):
        result.save(out.with_suffix(".obj"), join=True)


def test_another_garment_follows_by_the_same_map(body: Path) -> None:
    """What the first was put into still takes the maps of the body; not as a source, which would be dressed."""
    out, more = body.with_name("out.glb"), body.with_name("more.glb")
    garment, shape = body.with_name("stocking.ply"), load_shape(body)
    save_shape(garment, stocking())
    made = same_numbers(shape, shape)
    meshmatch.transfer_garment(garment, body, body, made).save(out, join=True)
    meshmatch.transfer_garment(garment, body, out, made).save(more, join=True)
    assert load_shape(more).V == shape.V + 2 * stocking().V
    assert set(load_shape(more).made_of) == {shape.hash, load_shape(out).hash}
    with pytest.raises(InputError, match="the wrong way"):
        meshmatch.transfer_garment(garment, out, body, made)


def test_its_own_joints_go_where_the_skin_goes(body: Path) -> None:
    """A tube is laid onto a longer one that is bent and lies: it stands upright, and its clip plays from straight."""
    V, longer = tube().V, 1.5
    bent = longer * posed_verts(body, "bend", 1.0)
    lying = bent @ np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    now = Shape(lying, tube().faces, "body.glb")
    binding = move_skeleton(body, now, is_upright=False)
    out = body.with_name("out.glb")
    save_moved(out, body, now, np.tile(np.eye(3), (V, 1, 1)), binding)
    assert np.allclose(posed_verts(out), bent, atol=1e-4)
    for time in (0.0, 1.0):
        away = np.linalg.norm(posed_verts(out, "bend", time) - longer * posed_verts(body, "bend", time), axis=1)
        assert away.mean() < 0.05 * longer


@pytest.mark.parametrize(("stands", "up"), [(True, ""), (False, "+z"), (False, "")])
def test_a_garment_on_a_body_that_lies_stands_upright_in_a_glb(tmp_path: Path, stands: bool, up: str) -> None:
    """As the source does, if that stands, or as the map's file says; else it stays as it lies."""
    lie = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    source, target, garment = tmp_path / ("a.glb" if stands else "a.ply"), tmp_path / "b.ply", tmp_path / "stocking.ply"
    save_shape(source, tube())
    save_shape(target, Shape(tube().verts @ lie.T, tube().faces))
    save_shape(garment, tube())
    found = replace(same_numbers(load_shape(source), load_shape(target)), target_up=up)
    meshmatch.save_map(tmp_path / "map.npz", found)
    result = meshmatch.transfer_garment(garment, source, target, tmp_path / "map.npz")
    out = tmp_path / "out.glb"
    result.save(out)
    expected = result.shape.verts @ lie if stands or up else result.shape.verts
    np.testing.assert_allclose(load_shape(out).verts, expected, atol=1e-5)


def test_a_vrm_keeps_its_joints(body: Path) -> None:
    """Its extension says which node is which bone."""
    path = body.with_suffix(".vrm")
    path.write_bytes(body.read_bytes())
    write_tube(path.with_suffix(".glb"), extensionsUsed=["VRMC_vrm"], extensions={"VRMC_vrm": {}})
    path.write_bytes(path.with_suffix(".glb").read_bytes())
    assert move_skeleton(path, tube(), is_upright=True) is None


def test_a_body_whose_skeleton_cannot_be_followed_is_told(body: Path) -> None:
    document = Document(body, body.read_bytes()).json
    document["nodes"][0]["scale"] = [-100, 100, 100]
    write_tube(body, nodes=document["nodes"])
    garment = body.with_name("stocking.ply")
    save_shape(garment, stocking())
    with pytest.warns(MeshmatchWarning, match="stocking.ply does not move with body.glb: .* mirrored"):
        assert worn(body, garment).binding is None
