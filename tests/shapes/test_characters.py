"""A .vrm stays a character: what its extensions say by number says the same in what is made of it."""

import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from meshmatch.errors import MeshmatchWarning, OptionError
from meshmatch.shapes.appearance import BakedMaterial
from meshmatch.shapes.blend_shapes import BlendShapes
from meshmatch.shapes.deformed_files import save_moved
from meshmatch.shapes.dressed_files import Dressed, save_colored
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.formats import gltf_vrm
from meshmatch.shapes.formats.gltf_morphs import read_morphs, with_morphs
from meshmatch.shapes.formats.gltf_vrm import check_character
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.textured_files import load_coordinates
from tests.shapes.characters import VERSIONS, image_of, read, read_extensions, toon_images, write_character
from tests.shapes.painted import encoded, quarters, write_gltf
from tests.shapes.test_dressed_files import apart

BAKED = BakedMaterial(quarters(8), name="new")


@pytest.fixture(params=VERSIONS)
def character(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    path = tmp_path / "square.vrm"
    write_character(path, request.param)
    return path


def dressed(path: Path, own: bool = False, material: BakedMaterial = BAKED) -> Path:
    shape, out = load_shape(path), path.with_name("out.vrm")
    uv = load_coordinates(path, shape) if own else apart(shape)
    assert uv is not None
    Dressed(shape, path, uv, own, material).save(out)
    return out


def properties(path: Path) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = read(path).json["extensions"]["VRM"]["materialProperties"]
    return found


def toon(path: Path) -> dict[str, Any]:
    found: dict[str, Any] = read(path).json["materials"][0]["extensions"]["VRMC_materials_mtoon"]
    return found


@pytest.mark.filterwarnings("ignore::meshmatch.errors.MeshmatchWarning")
def test_a_texture_is_what_the_lit_and_the_shaded_side_show(character: Path) -> None:
    before, out = read_extensions(character), dressed(character)
    assert read_extensions(out) == before
    document = read(out)
    shown = toon_images(document)
    assert (shown["_MainTex"], shown["_ShadeTexture"]) == ("new", "new")
    for material in document.json["materials"]:
        assert image_of(document, material["pbrMetallicRoughness"]["baseColorTexture"]["index"]) == "new"
    left = {image["name"] for image in document.json["images"]}
    assert not {"color", "shade"} & left and "thumbnail" in left  # what nothing shows any more is gone
    assert (
        document.json["materials"][0]["extensions"]["KHR_materials_unlit"] == {}
    )  # where nobody knows the toon material
    assert load_shape(out).V == 3 * 6
    old = document.json["nodes"][3]["mesh"], document.json["nodes"][4]["mesh"]
    assert old[0] != old[1]  # each eye has its own place in the image, and blinks and hides as before


def test_shading_keeps_its_tint(character: Path) -> None:
    with pytest.warns(MeshmatchWarning, match=r"separate shade images.*: skin$"):
        out = dressed(character, own=True)
    document = read(out)
    assert toon_images(document)["_RimTexture"] == "rim"  # its coordinates are still there
    if "VRM" in document.json["extensions"]:
        vectors = properties(out)[0]["vectorProperties"]
        linear = ((0.25 + 0.055) / 1.055) ** 2.4 / ((0.5 + 0.055) / 1.055) ** 2.4
        assert vectors["_Color"] == [1, 1, 1, 1]
        assert vectors["_ShadeColor"] == pytest.approx([1, 1.055 * linear ** (1 / 2.4) - 0.055, 1, 1], abs=1e-6)
        assert properties(out)[0]["floatProperties"] == {"_BlendMode": 0, "_RimLift": 0.5}
        assert properties(out)[1] == properties(character)[1] | properties(out)[1]
    else:
        assert toon(out)["shadeColorFactor"] == pytest.approx([1, 0.5, 1])
        assert (toon(out)["outlineWidthFactor"], toon(out)["rimMultiplyTexture"].get("texCoord", 0)) == (0.01, 0)


def test_other_textures_of_a_toon_material_under_new_coordinates_are_told(character: Path) -> None:
    with (
        pytest.warns(MeshmatchWarning, match="separate shade images"),
        pytest.warns(MeshmatchWarning, match=r"other textures of toon materials of square.vrm .*: skin$"),
    ):
        out = dressed(character)
    if "VRM" in read(out).json["extensions"]:
        assert "_RimTexture" not in properties(out)[0]["textureProperties"]
    else:
        assert toon(out)["rimMultiplyTexture"]["texCoord"] == 1


@pytest.mark.filterwarnings("ignore::meshmatch.errors.MeshmatchWarning")
@pytest.mark.parametrize(("alpha", "mode", "queue"), [("opaque", 0, 2000), ("mask", 1, 2450), ("blend", 2, 3000)])
def test_transparency(character: Path, alpha: Any, mode: int, queue: int) -> None:
    out = dressed(character, own=True, material=replace(BAKED, alpha=alpha, cutoff=0.25))
    assert read(out).json["materials"][0].get("alphaMode", "OPAQUE") == alpha.upper()
    if "VRM" not in read(out).json["extensions"]:
        return
    skin, iris = properties(out)
    words = {"opaque": [], "mask": ["_ALPHATEST_ON"], "blend": ["_ALPHABLEND_ON"]}[alpha]
    assert (skin["floatProperties"]["_BlendMode"], list(skin["keywordMap"]), skin["renderQueue"]) == (
        mode,
        words,
        queue,
    )
    assert (skin["floatProperties"].get("_Cutoff"), iris["renderQueue"]) == (0.25 if alpha == "mask" else None, queue)


@pytest.mark.filterwarnings("ignore::meshmatch.errors.MeshmatchWarning")
def test_normals_and_light_of_a_toon_material(tmp_path: Path) -> None:
    path = tmp_path / "square.vrm"
    write_character(path, 0)
    flat = np.tile(np.array([128, 128, 255, 255], np.uint8), (8, 8, 1))
    material = replace(BAKED, normal=flat, glow=quarters(8), light=(1.0, 0.5, 2.0))
    out = dressed(path, material=material)
    [skin, _] = properties(out)
    document, textures = read(out), skin["textureProperties"]
    assert (image_of(document, textures["_BumpMap"]), image_of(document, textures["_EmissionMap"])) == (
        "new normal",
        "new emission",
    )
    assert skin["vectorProperties"]["_EmissionColor"] == [1.0, 0.5, 2.0, 1.0] and skin["keywordMap"]["_NORMALMAP"]


@pytest.mark.filterwarnings("ignore::meshmatch.errors.MeshmatchWarning")
def test_a_material_that_is_needed_twice_is_tinted_twice(tmp_path: Path) -> None:
    """One of its primitives has another set of coordinates before."""
    path = tmp_path / "square.vrm"
    write_character(path, 1)
    from meshmatch.shapes.formats.gltf_edit import Editor

    editor = Editor(read(path))
    body = editor.json["meshes"][0]["primitives"][0]
    body["material"], body["attributes"]["TEXCOORD_1"] = 1, 1
    path.write_bytes(editor.to_bytes())
    out = dressed(path)
    assert read_extensions(out)["tints"]["oh"] == ["iris", "iris"]
    assert len(read(out).json["materials"]) == 3


def added(shape: Shape, *names: str) -> BlendShapes:
    moves = np.zeros((len(names), shape.V, 3), np.float32)
    moves[:, :, 1] = 0.7
    return BlendShapes(names, moves, np.zeros(len(names)), False, ())


def test_expressions_name_the_morph_targets_that_they_did(character: Path) -> None:
    """Also those behind one that is replaced, and where a mesh becomes two."""
    shape, before = load_shape(character), read_extensions(character)
    glb = with_morphs(read(character), shape, added(shape, "smile", "new", "a"), np.eye(3))
    out = character.with_name("out.vrm")
    out.write_bytes(glb)
    after = read_extensions(out)
    moved = [(name, "smile 0.700", weight) for name, _, weight in next(iter(before["binds"].values()))]
    first, *others = before["binds"]
    assert after["binds"] | {first: 0, others[-1]: 0} == before["binds"] | {first: 0, others[-1]: 0}
    assert after["binds"][first] == moved
    blinking = [(name, weight) for name, target, weight in after["binds"][others[-1]] if target == "shape 0 0.100"]
    assert blinking == [(name, weight) for name, _, weight in before["binds"][others[-1]]]
    assert {key: after[key] for key in after if key != "binds"} == {
        key: before[key] for key in before if key != "binds"
    }
    assert set(read_morphs(out, out.read_bytes()).names) == {"a", "o", "smile", "new", "shape 0"}


def test_names_of_morph_targets_may_stand_in_primitives(character: Path) -> None:
    assert read_morphs(character, character.read_bytes()).names == ("shape 0", "a", "o", "smile")


def test_colors_are_told_where_a_toon_material_shows_none(character: Path) -> None:
    before, out, shape = read_extensions(character), character.with_name("out.vrm"), load_shape(character)
    painted = Shape(shape.verts, shape.faces, "square", np.tile([1.0, 0, 0, 1], (shape.V, 1)))
    with pytest.warns(MeshmatchWarning, match="do not show vertex colors on the toon material skin of square.vrm"):
        save_colored(out, painted, character, np.eye(3))
    assert read_extensions(out) == before
    np.testing.assert_allclose(load_shape(out).colors, painted.colors, atol=1e-6)


def test_a_garment_in_a_character(character: Path, tmp_path: Path) -> None:
    """It gets a material of its own and is seen; without --join there would be no character."""
    garment, out, before = tmp_path / "coat.glb", tmp_path / "out.vrm", read_extensions(character)
    write_gltf(garment, images=[encoded(quarters())], primitives=[{"material": 0}])
    shape = load_shape(garment)
    turns = np.tile(np.eye(3), (shape.V, 1, 1))
    save_moved(out, garment, shape, turns, into=character)
    after = read_extensions(out)
    coat = read(out).json["materials"][-1]
    assert (len(read(out).json["materials"]), load_shape(out).V) == (3, 16)
    assert {key: after[key] for key in ("meta", "bones", "binds", "springs")} == {
        key: before[key] for key in ("meta", "bones", "binds", "springs")
    }
    assert list(after["seen"].values()) == [*before["seen"].values(), "Auto" if "eyes" in after else "auto"]
    if "eyes" in after:
        assert (
            properties(out)[2]["shader"] == "VRM_USE_GLTFSHADER"
            and str(coat.get("name", "")) == properties(out)[2]["name"]
        )
    with pytest.raises(OptionError, match=r"'.vrm' is not a format for shapes"):
        save_moved(out, garment, shape, turns)


@pytest.mark.filterwarnings("ignore:the joints of coat.vrm stay")
def test_a_toon_garment_stays_toon(tmp_path: Path) -> None:
    body, garment, out = tmp_path / "body.vrm", tmp_path / "coat.vrm", tmp_path / "out.vrm"
    write_character(body, 0)
    write_character(garment, 0)
    shape = load_shape(garment)
    save_moved(out, garment, shape, np.tile(np.eye(3), (shape.V, 1, 1)), into=body)
    document = read(out)
    assert toon_images(document, 2) == toon_images(document, 0) and properties(out)[2]["shader"] == "VRM/MToon"
    assert properties(out)[2]["textureProperties"]["_MainTex"] == 4
    assert len(properties(out)) == len(document.json["materials"]) == 4


def test_what_is_no_character_becomes_none(tmp_path: Path) -> None:
    plain, scan = tmp_path / "plain.vrm", tmp_path / "scan.ply"
    write_gltf(plain)
    save_shape(scan, load_shape(plain))
    for file in (plain, scan, None):
        with pytest.raises(OptionError, match=r"^out.vrm would be no character: .* has no VRM extension") as error:
            check_character(file, Path("out.vrm"))
        assert error.value.hint == "end the name in .glb"
        check_character(file, Path("out.glb"))


@pytest.mark.parametrize("broken", [None, [], {}, 3, {"meta": 3, "firstPerson": [], "expressions": {"preset": [1]}}])
def test_an_extension_without_sense_stops_nothing(broken: Any) -> None:
    json = {
        "extensions": {"VRM": broken, "VRMC_vrm": broken, "VRMC_springBone": broken},
        "nodes": [{}],
        "meshes": [{}, {}],
    }
    before = copy.deepcopy(json)
    assert list(gltf_vrm.references(json)) == [] and gltf_vrm.properties(json) == []
    gltf_vrm.copy_mesh(json, 0, 1)
    gltf_vrm.reorder_targets(json, 0, 0, [1, 0])
    gltf_vrm.copy_material(json, 0, 1)
    gltf_vrm.show_mesh(json, 0, 1)
    assert gltf_vrm.moving_textures(json, {0: "skin"}) == [] and json == before
