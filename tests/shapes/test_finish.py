"""What materials say besides color, from files and to files."""

import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from meshmatch.errors import MeshmatchWarning
from meshmatch.shapes.appearance import BakedMaterial, Finish, png_bytes
from meshmatch.shapes.dressed_files import Dressed
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.formats.gltf import Document
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.textured_files import load_appearance
from tests.shapes.painted import CORNERS, FACES, UV, encoded, quarters, write_gltf, write_square_obj

NOISE = np.random.default_rng(0).integers(0, 256, (3, 8, 8, 4), dtype=np.uint8)
NOISE[..., 3] = 255


def finish_of(path: Path) -> Finish:
    found = load_appearance(path, load_shape(path)).finish
    assert found is not None
    return found


def write_glossy(path: Path, **more: Any) -> None:
    """A square with all maps: colors, normals, roughness and metal with occlusion, light."""
    material = {
        "name": "glossy",
        "pbrMetallicRoughness": {
            "baseColorTexture": {"index": 0},
            "metallicRoughnessTexture": {"index": 2},
            "metallicFactor": 0.5,
        },
        "normalTexture": {"index": 1, "scale": 0.7},
        "occlusionTexture": {"index": 2, "strength": 0.3, "texCoord": 1},
        "emissiveTexture": {"index": 3},
        "emissiveFactor": [1, 0.5, 0],
        "extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 4}},
    }
    images = [encoded(quarters()), *(encoded(image) for image in NOISE)]
    write_gltf(path, images=images, primitives=[{"material": 0, "uv1": 0.5 * UV}], materials=[material | more])


def test_all_layers_of_a_gltf(tmp_path: Path) -> None:
    path = tmp_path / "a.glb"
    write_glossy(path, doubleSided=True)
    found = finish_of(path)
    assert (found.light, found.double_sided, found.unlit) == (4.0, True, False)
    normal, surface, occlusion, glow = (
        found.layers[k].materials[0] for k in ("normal", "surface", "occlusion", "glow")
    )
    for made, image in ((normal, NOISE[0]), (surface, NOISE[1]), (occlusion, NOISE[1]), (glow, NOISE[2])):
        np.testing.assert_array_equal(made.image, image)
    assert (normal.strength, occlusion.strength, surface.factor) == (0.7, 0.3, (1.0, 1.0, 0.5, 1.0))
    assert glow.factor == (1.0, 0.5, 0.0, 1.0) and not glow.linear and normal.linear
    np.testing.assert_allclose(found.layers["occlusion"].uv, 0.5 * UV[FACES])
    assert found.images == ("normal", "surface", "glow") and found.occluded


def test_numbers_of_a_gltf(tmp_path: Path) -> None:
    path = tmp_path / "a.glb"
    paint = {"baseColorTexture": {"index": 0}, "metallicFactor": 0.25, "roughnessFactor": 0.75}
    unlit = {"KHR_materials_unlit": {}}
    write_gltf(
        path,
        images=[encoded(quarters())],
        primitives=[{"material": 0}],
        materials=[{"pbrMetallicRoughness": paint, "extensions": unlit}],
    )
    found = finish_of(path)
    assert (found.images, found.unlit, found.double_sided) == ((), True, False)
    assert found.layers["surface"].materials[0].factor == (1.0, 0.75, 0.25, 1.0)


def test_what_cannot_be_read_is_told_and_the_rest_is_there(tmp_path: Path) -> None:
    path = tmp_path / "a.gltf"
    write_glossy(path, extensions={"KHR_materials_clearcoat": {}, "KHR_materials_unlit": {}})
    text = json.loads(path.read_text())
    text["images"][1] = {"uri": "gone.png"}
    path.write_text(json.dumps(text))
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        found = finish_of(path)
    assert [str(each.message) for each in told] == [
        "the normal map of a.gltf cannot be read and is left out: a.gltf needs the file gone.png, which is not in its "
        "folder",
        "the materials of a.gltf use extensions that are not transferred: clearcoat",
    ]
    assert sorted(found.layers) == ["glow", "occlusion", "surface"]


MADE = BakedMaterial(
    quarters(8),
    name="made",
    double_sided=False,
    normal=NOISE[0],
    surface=NOISE[1],
    occluded=True,
    metal=1.0,
    glow=NOISE[2],
    light=(3.0, 3.0, 3.0),
)


def test_written_to_a_glb_and_read_again(tmp_path: Path) -> None:
    path = tmp_path / "a.glb"
    Dressed(Shape(CORNERS, FACES, "square"), None, UV[FACES], False, MADE).save(path)
    found = finish_of(path)
    assert (found.light, found.double_sided, found.images) == (3.0, False, ("normal", "surface", "glow"))
    for layer, image in (("normal", NOISE[0]), ("surface", NOISE[1]), ("occlusion", NOISE[1]), ("glow", NOISE[2])):
        np.testing.assert_array_equal(found.layers[layer].materials[0].image, image)  # type: ignore[index]
    document = Document(path, path.read_bytes())
    assert document.json["extensionsUsed"] == ["KHR_materials_emissive_strength"]
    tangents = document.accessor(document.json["meshes"][0]["primitives"][0]["attributes"]["TANGENT"])
    np.testing.assert_allclose(tangents, np.tile([1.0, 0, 0, 1], (4, 1)), atol=1e-6)


@pytest.mark.filterwarnings("ignore:.*does not have an occlusion map")
def test_an_image_of_occlusion_alone_is_none_of_metal(tmp_path: Path) -> None:
    made = BakedMaterial(quarters(8), surface=NOISE[1], occluded=True, even=True, roughness=0.75)
    for suffix in (".glb", ".obj"):
        Dressed(Shape(CORNERS, FACES, "square"), None, UV[FACES], False, made).save(tmp_path / f"a{suffix}")
    found = finish_of(tmp_path / "a.glb")
    assert found.occluded and found.layers["surface"].plain
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a.glb", "a.mtl", "a.obj", "a.png"]
    assert "\nPr 0.75\nPm 0\n" in (tmp_path / "a.mtl").read_text()


def test_written_to_an_obj_and_read_again(tmp_path: Path) -> None:
    path = tmp_path / "a.obj"
    with pytest.warns(MeshmatchWarning, match=r"a\.obj does not have an occlusion map"):
        Dressed(Shape(CORNERS, FACES, "square"), None, UV[FACES], False, MADE).save(path)
    assert sorted(file.name for file in tmp_path.iterdir()) == [
        *("a-emission.png", "a-metal.png", "a-normal.png", "a-roughness.png", "a.mtl", "a.obj", "a.png")
    ]
    # without a strength Blender takes it to be 0, and `norm` alone it does not read
    assert "\nmap_Bump -bm 1 a-normal.png\n" in (tmp_path / "a.mtl").read_text()
    found = finish_of(path)
    assert found.images == ("normal", "surface", "glow")
    np.testing.assert_array_equal(found.layers["normal"].materials[0].image, NOISE[0])
    np.testing.assert_array_equal(found.layers["glow"].materials[0].image, NOISE[2])
    np.testing.assert_array_equal(found.layers["surface"].materials[0].image[..., 1:3], NOISE[1][..., 1:3])  # type: ignore[index]
    np.testing.assert_allclose(found.layers["normal"].uv, UV[FACES], atol=1e-6)


@pytest.mark.parametrize(
    ("lines", "said", "images"),
    [
        ("Pr 0.3\nPm 0.5\nKe 0 0 0", "", ()),
        ("Ke 0 0 0\nmap_Ke skin.png", "", ("glow",)),
        ("map_Bump -bm 0.4 skin.png", "", ("normal",)),
        ("bump grey.png", "the bump map of paint in square.obj holds heights, which are not transferred", ()),
        (
            "map_Pr gone.png",
            "square.obj needs the image gone.png of its material paint, which is not there; it is left out",
            (),
        ),
        ("Pr rough\nKe\nPm 1 2", "", None),
    ],
)
def test_materials_of_an_mtl(tmp_path: Path, lines: str, said: str, images: tuple[str, ...] | None) -> None:
    path = tmp_path / "square.obj"
    write_square_obj(path)
    (tmp_path / "square.mtl").write_text(f"newmtl paint\nmap_Kd skin.png\n{lines}\n")
    (tmp_path / "skin.png").write_bytes(encoded(NOISE[0]))
    (tmp_path / "grey.png").write_bytes(png_bytes(np.full((4, 4, 4), 128, np.uint8)))
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        found = load_appearance(path, load_shape(path)).finish
    assert [str(each.message) for each in told] == ([said] if said else [])
    assert (None if found is None else found.images) == images
    if lines.startswith("Pr 0.3"):
        assert found is not None and found.layers["surface"].materials[0].factor == (1.0, 0.3, 0.5, 1.0)
