"""What files say about the look of their surfaces."""

import os
import re
import struct
import subprocess
import sys
import zlib
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image

from meshmatch.errors import InputError
from meshmatch.shapes import appearance
from meshmatch.shapes.appearance import Appearance, ImageReader
from meshmatch.shapes.colors import BYTE_TO_LINEAR, linear_to_bytes, to_linear, to_srgb
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.formats.obj_appearance import companions, second_index
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.textured_files import load_appearance
from tests.shapes.painted import CORNERS, FACES, UV, encoded, quarters, write_gltf, write_square_obj


def look(path: Path, image: Path | None = None) -> Appearance:
    return load_appearance(path, load_shape(path), image)


def one_material(**texture: Any) -> list[dict[str, Any]]:
    return [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0, **texture}}}]


# Light


def test_light_and_color_are_inverses_and_match_the_standard() -> None:
    values = np.linspace(0, 1, 1001)
    np.testing.assert_allclose(to_srgb(to_linear(values)), values, atol=1e-12)
    assert to_linear(0.5) == pytest.approx(0.21404, abs=1e-5)  # IEC 61966-2-1
    assert to_linear(1.0) == pytest.approx(1.0)


def test_the_nearest_byte_is_taken() -> None:
    assert (linear_to_bytes(BYTE_TO_LINEAR) == np.arange(256)).all()
    light = np.linspace(0, 1, 100_001).astype(np.float32)
    exact = 255 * to_srgb(light.astype(float))
    assert np.abs(linear_to_bytes(light) - exact).max() < 0.55
    assert linear_to_bytes(np.array([-1.0, 7.0], np.float32)).tolist() == [0, 255]


# glTF


@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
@pytest.mark.parametrize("embed", [True, False])
def test_a_square_of_gltf(tmp_path: Path, suffix: str, embed: bool) -> None:
    path = tmp_path / f"a{suffix}"
    write_gltf(path, images=[encoded(quarters(8))], embed=embed, primitives=[{"material": 0}])
    found = look(path)
    np.testing.assert_array_equal(found.uv, UV[FACES])
    np.testing.assert_array_equal(found.materials[0].image, quarters(8))
    assert found.materials[0].wrap == ("repeat", "repeat")
    assert (found.materials[0].alpha, found.materials[0].nearest) == ("opaque", False)
    assert found.textured and not found.plain


def test_an_image_in_the_folder_and_a_jpeg(tmp_path: Path) -> None:
    (tmp_path / "a b.jpg").write_bytes(encoded(quarters(32), "JPEG"))
    write_gltf(tmp_path / "a.gltf", images=["a%20b.jpg"], primitives=[{"material": 0}])
    image = look(tmp_path / "a.gltf").materials[0].image
    assert image is not None
    assert np.abs(image.astype(int) - quarters(32)).mean() < 4


def test_several_materials_images_and_parts_in_the_order_of_the_faces(tmp_path: Path) -> None:
    blue = np.full((4, 2, 4), (0, 0, 255, 255), np.uint8)
    primitives: list[dict[str, Any]] = [{"material": 1}, {"material": 0}, {"material": 1, "uv": None}, {}]
    write_gltf(tmp_path / "a.glb", images=[encoded(quarters()), encoded(blue)], primitives=primitives)
    shape, found = load_shape(tmp_path / "a.glb"), look(tmp_path / "a.glb")
    assert len(found.material) == shape.F == 8
    chosen = [found.materials[k] for k in found.material[::2].tolist()]
    np.testing.assert_array_equal(chosen[0].image, blue)
    np.testing.assert_array_equal(chosen[1].image, quarters())
    assert chosen[2].image is None and chosen[3].image is None
    assert chosen[3].factor == (1, 1, 1, 1)
    assert (found.uv[4:] == 0).all()


def test_the_sampler_the_factor_and_alpha(tmp_path: Path) -> None:
    material = {
        "name": "cloth",
        "alphaMode": "MASK",
        "alphaCutoff": 0.25,
        "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "baseColorFactor": [0.5, 1, 0.25, 0.75]},
    }
    write_gltf(
        tmp_path / "a.glb",
        images=[encoded(quarters())],
        primitives=[{"material": 0}],
        materials=[material],
        textures=[{"source": 0, "sampler": 0}],
        samplers=[{"wrapS": 33071, "wrapT": 33648, "magFilter": 9728}],
    )
    found = look(tmp_path / "a.glb").materials[0]
    assert found.wrap == ("clamp", "mirror")
    assert found.nearest
    assert (found.name, found.alpha, found.cutoff) == ("cloth", "mask", 0.25)
    assert found.factor == (0.5, 1, 0.25, 0.75)


def test_the_transform_of_a_texture_is_the_one_of_the_extensions_own_example(tmp_path: Path) -> None:
    # "The lower left quadrant of the source image, rotated clockwise 90 degrees."
    transform = {"offset": [0, 1], "rotation": np.pi / 2, "scale": [0.5, 0.5]}
    write_gltf(
        tmp_path / "a.glb",
        images=[encoded(quarters())],
        primitives=[{"material": 0}],
        materials=one_material(extensions={"KHR_texture_transform": transform}),
    )
    uv = look(tmp_path / "a.glb").uv
    np.testing.assert_allclose(uv.min((0, 1)), (0, 0.5), atol=1e-12)
    np.testing.assert_allclose(uv.max((0, 1)), (0.5, 1), atol=1e-12)
    # seen upright, the top left corner of the square (u = v = 0) shows the bottom left corner of the image
    np.testing.assert_allclose(uv[1, 2], (0, 1), atol=1e-12)
    np.testing.assert_allclose(uv[1, 1], (0, 0.5), atol=1e-12)


def test_the_second_coordinates_where_a_texture_asks_for_them(tmp_path: Path) -> None:
    write_gltf(
        tmp_path / "a.glb",
        images=[encoded(quarters())],
        primitives=[{"material": 0, "uv1": 0.5 * UV}],
        materials=one_material(texCoord=1),
    )
    np.testing.assert_array_equal(look(tmp_path / "a.glb").uv, 0.5 * UV[FACES])


def test_specular_glossiness_and_webp(tmp_path: Path) -> None:
    gloss = {"diffuseTexture": {"index": 0}, "diffuseFactor": [0.5, 0.5, 0.5, 1]}
    write_gltf(
        tmp_path / "a.glb",
        images=[encoded(quarters(16), "WEBP")],
        primitives=[{"material": 0}],
        textures=[{"extensions": {"EXT_texture_webp": {"source": 0}}}],
        materials=[{"extensions": {"KHR_materials_pbrSpecularGlossiness": gloss}}],
    )
    found = look(tmp_path / "a.glb").materials[0]
    assert found.factor == (0.5, 0.5, 0.5, 1)
    assert found.image is not None and found.image.shape == (16, 16, 4)


def test_vertex_colors_of_gltf_are_light_already(tmp_path: Path) -> None:
    write_gltf(tmp_path / "a.glb", primitives=[{"colors": np.full((4, 3), 0.25)}, {}])
    colors = look(tmp_path / "a.glb").colors
    assert colors is not None
    np.testing.assert_array_equal(colors[:4], [[0.25, 0.25, 0.25, 1]] * 4)
    np.testing.assert_array_equal(colors[4:], np.ones((4, 4)))


def test_a_named_image_replaces_those_of_the_file(tmp_path: Path) -> None:
    blue = np.full((4, 2, 4), (0, 0, 255, 255), np.uint8)
    (tmp_path / "b.png").write_bytes(encoded(blue))
    factor = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "baseColorFactor": [0, 0, 0, 1]}}]
    write_gltf(tmp_path / "a.glb", images=["gone.png"], primitives=[{"material": 0}], materials=factor)
    found = look(tmp_path / "a.glb", tmp_path / "b.png").materials[0]
    np.testing.assert_array_equal(found.image, blue)
    assert found.factor == (1, 1, 1, 1)


def test_trimesh_reads_the_same_coordinates_and_images(tmp_path: Path) -> None:
    write_gltf(tmp_path / "a.glb", images=[encoded(quarters(8))], primitives=[{"material": 0, "uv": UV * 0.75}])
    found = look(tmp_path / "a.glb")
    (other,) = trimesh.load_scene(tmp_path / "a.glb").geometry.values()
    theirs = other.visual.uv * (1, -1) + (0, 1)  # v up
    np.testing.assert_allclose(theirs[other.faces], found.uv, atol=1e-6)
    np.testing.assert_array_equal(
        np.asarray(other.visual.material.baseColorTexture.convert("RGBA")), found.materials[0].image
    )


# obj


def test_the_second_numbers_of_faces() -> None:
    assert second_index(b"1/2/3 4/5/6\n7//8 9 -1/-2/-3 12/ 3/44").split() == [
        *(b"2", b"5", b"0", b"0", b"-2", b"0", b"44")
    ]


def test_a_square_of_obj(tmp_path: Path) -> None:
    write_square_obj(tmp_path / "a.obj")
    (tmp_path / "square.mtl").write_text("newmtl paint\nKd 0.8 0.8 0.8\nmap_Kd deep\\quarters one.png\n")
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "quarters one.png").write_bytes(encoded(quarters(8)))
    found = look(tmp_path / "a.obj")
    np.testing.assert_array_equal(found.uv, UV[FACES])
    np.testing.assert_array_equal(found.materials[0].image, quarters(8))
    assert found.materials[0].factor == (1, 1, 1, 1)  # a grey Kd beside an image does not count
    assert found.materials[0].name == "paint"


def test_polygons_negative_numbers_and_faces_without_coordinates(tmp_path: Path) -> None:
    text = "mtllib m.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0 0\nvt 1 1\nusemtl a # first\n"
    text += "f -4/-3 -3/-2 -2/-1 -1/-1\nvt 0 1\nusemtl b\nf 1/1/1 2/2/1 3/4/1\nf 1 2 3\nusemtl a\nf 1//1 2//1 3//1\n"
    (tmp_path / "a.obj").write_text(text)
    (tmp_path / "m.mtl").write_text("newmtl a\nmap_Kd p.png\nnewmtl b\nKd 1 0.5 0\nnewmtl unused\nmap_Kd gone.png")
    (tmp_path / "p.png").write_bytes(encoded(quarters()))
    shape, found = load_shape(tmp_path / "a.obj"), look(tmp_path / "a.obj")
    assert shape.F == len(found.material) == 5
    down = 1 - np.array([0, 0, 1, 1])
    np.testing.assert_array_equal(found.uv[0], np.stack([[0, 1, 1], down[:3]], 1))
    np.testing.assert_array_equal(found.uv[1], np.stack([[0, 1, 1], [1, 0, 0]], 1))
    np.testing.assert_array_equal(found.uv[2], [[0, 1], [1, 1], [0, 0]])
    chosen = [found.materials[k] for k in found.material.tolist()]
    assert [m.name for m in chosen] == ["a", "a", "b", "b", "a"]
    assert [m.image is not None for m in chosen] == [True, True, False, False, False]
    assert chosen[2].factor == pytest.approx((1, 0.21404, 0, 1), abs=1e-5)


def test_options_of_a_map_opacity_and_an_alpha_image(tmp_path: Path) -> None:
    write_square_obj(tmp_path / "a.obj", vt=True)
    mtl = "newmtl paint\nd 0.5\nmap_Kd -s 2 3 1 -o 0.25 -bm 1.0 -mm 0 1 -clamp on -blendu off my image.png\n"
    (tmp_path / "square.mtl").write_text(mtl + "map_d a.png\n")
    (tmp_path / "my image.png").write_bytes(encoded(quarters()))
    alpha = np.full((2, 2, 4), 255, np.uint8)
    alpha[..., :3] = 60 * np.arange(4).reshape(2, 2, 1)
    (tmp_path / "a.png").write_bytes(encoded(alpha))
    found = look(tmp_path / "a.obj")
    np.testing.assert_allclose(found.uv[0, :, 0], [0.25, 2.25, 2.25])
    np.testing.assert_allclose(found.uv[0, :, 1], [1, 1, -2])
    made = found.materials[0]
    assert made.wrap == ("clamp", "clamp")
    assert made.alpha == "blend" and made.factor == (1, 1, 1, 0.5)
    assert made.image is not None
    np.testing.assert_array_equal(made.image[..., 3], alpha[..., 0])
    np.testing.assert_array_equal(made.image[..., :3], quarters()[..., :3])


def test_an_obj_without_mtl_takes_the_image_that_is_named(tmp_path: Path) -> None:
    write_square_obj(tmp_path / "a.obj", mtl=None)
    (tmp_path / "b.png").write_bytes(encoded(quarters()))
    found = look(tmp_path / "a.obj", tmp_path / "b.png")
    np.testing.assert_array_equal(found.materials[0].image, quarters())
    np.testing.assert_array_equal(found.uv, UV[FACES])


def test_vertex_colors_where_nothing_else_is(tmp_path: Path) -> None:
    colors = np.array([[1, 0, 0, 1], [0, 1, 0, 1], [0.5, 0.5, 0.5, 1], [0, 0, 0, 1]])
    for suffix in ("ply", "obj", "off"):
        save_shape(tmp_path / f"a.{suffix}", Shape(CORNERS, FACES, "a", colors))
        found = look(tmp_path / f"a.{suffix}")
        assert found.colors is not None and not found.textured
        assert found.colors[2, 0] == pytest.approx(to_linear(0.5), abs=0.01)  # ply: 8 bits
    text = (tmp_path / "a.obj").read_text()
    (tmp_path / "a.obj").write_text("mtllib lost.mtl\n" + text)
    assert look(tmp_path / "a.obj").colors is not None


# What can be wrong


@pytest.mark.parametrize(
    ("line", "missing"), [("square.mtl lost.mtl", "lost.mtl"), ("my lost.mtl", "my lost.mtl"), ("lost.txt", "lost.txt")]
)
def test_only_what_is_missing_of_a_list_of_mtl_files_is_named(tmp_path: Path, line: str, missing: str) -> None:
    write_square_obj(tmp_path / "a.obj", line)
    (tmp_path / "square.mtl").write_text("newmtl paint\n")
    with pytest.raises(InputError, match=rf"in {re.escape(missing)}, which is not there"):
        look(tmp_path / "a.obj")
    assert companions(tmp_path / "a.obj", (tmp_path / "a.obj").read_bytes())[1] == [missing]


def test_a_name_with_spaces_may_have_a_comment_behind_it(tmp_path: Path) -> None:
    write_square_obj(tmp_path / "a.obj", "my square.mtl # of the body")
    (tmp_path / "my square.mtl").write_text("newmtl paint\nKd 1 0 0\n")
    assert companions(tmp_path / "a.obj", (tmp_path / "a.obj").read_bytes()) == ([tmp_path / "my square.mtl"], [])


def obj(folder: Path, *lines: str, vt: bool = True, corners: str = "") -> Path:
    """A square whose mtl has some lines; with none, it names no mtl."""
    write_square_obj(folder / "a.obj", "square.mtl" if lines else None, vt)
    with (folder / "a.obj").open("a") as file:
        file.write(corners)
    if any(lines):
        (folder / "square.mtl").write_text("\n".join(["newmtl paint", *lines, ""]))
    return folder / "a.obj"


def gltf(folder: Path, name: str = "a.glb", **parts: Any) -> Path:
    write_gltf(folder / name, **{"primitives": [{"material": 0}], **parts})
    return folder / name


def bare_ply(folder: Path) -> Path:
    save_shape(folder / "a.ply", Shape(CORNERS, FACES))
    return folder / "a.ply"


def stray_uv(value: float) -> np.ndarray:
    uv = UV.copy()
    uv[2, 1] = value
    return uv


def huge_png() -> bytes:
    """An honest header of 60,000 x 60,000 pixels."""
    whole = bytearray(encoded(quarters()))
    whole[16:24] = (60_000).to_bytes(4, "big") * 2
    whole[29:33] = zlib.crc32(bytes(whole[12:29])).to_bytes(4, "big")
    return bytes(whole)


GOOD, LARGE = encoded(quarters()), encoded(quarters(64))
BASIS = [{"extensions": {"KHR_texture_basisu": {"source": 0}}}]
NOTHING, APART, NOWHERE = "has no texture and no vertex colors", "no texture coordinates", "which is not there"


@pytest.mark.parametrize(
    ("make", "image", "words"),
    [
        (bare_ply, None, NOTHING),
        (obj, None, NOTHING),
        (lambda folder: gltf(folder, primitives=[{}]), None, NOTHING),
        (lambda folder: obj(folder, ""), None, "a.obj has its materials in square.mtl"),
        (lambda folder: obj(folder, "map_Kd s.jpg"), None, "a.obj needs the image s.jpg of its material paint"),
        (lambda folder: gltf(folder, "a.gltf", images=["skin.png"]), None, "needs the file skin.png"),
        (lambda folder: obj(folder, "map_Kd ../p.png"), None, NOWHERE),
        (lambda folder: obj(folder, f"map_Kd {folder.parent / 'p.png'}"), None, NOWHERE),
        (lambda folder: gltf(folder, "a.gltf", images=["../p.png"]), None, "not in its folder"),
        (bare_ply, GOOD, APART),
        (lambda folder: obj(folder, vt=False), GOOD, APART),
        (lambda folder: gltf(folder, primitives=[{"uv": None}]), GOOD, APART),
        *[
            (
                lambda folder, bad=bad: gltf(folder, images=[GOOD], primitives=[{"material": 0, "uv": stray_uv(bad)}]),
                None,
                "texture coordinates of 2 faces are out of range",
            )
            for bad in (np.nan, np.inf, 1e9)
        ],
        (obj, LARGE[: len(LARGE) // 2], "damaged"),
        (obj, b"GIF89a" + LARGE, "cannot be read as an image"),
        (obj, LARGE[:40] + b"\0" * 40, ""),
        (obj, huge_png(), "too large"),
        (lambda folder: gltf(folder, images=[GOOD], primitives=[{"material": 7}]), None, "materials make no sense"),
        (lambda folder: gltf(folder, images=[b"..."], textures=BASIS), None, "KHR_texture_basisu"),
        *[
            (lambda folder, line=line: obj(folder, line), None, f"the line '{line}'")
            for line in ("Kd red", "map_Kd -what 1 a.png", "map_Kd -s a.png")  # empty statements say nothing
        ],
        (lambda folder: obj(folder, "Kd 1 0 0", corners="f 1/9 2/2 3/3\n"), None, "texture coordinate"),
        (lambda folder: obj(folder, "Kd 1 0 0", corners="f 1/-9 2/2 3/3\n"), None, "texture coordinate"),
    ],
)
def test_what_is_wrong_is_told(tmp_path: Path, make: Callable[[Path], Path], image: bytes | None, words: str) -> None:
    (tmp_path / "in").mkdir()
    (tmp_path / "p.png").write_bytes(GOOD)
    if image is not None:
        (tmp_path / "b.png").write_bytes(image)
    with pytest.raises(InputError) as caught:
        look(make(tmp_path / "in"), None if image is None else tmp_path / "b.png")
    assert words in caught.value.message and caught.value.hint


def test_a_path_that_leads_elsewhere_means_a_file_beside_the_mtl(tmp_path: Path) -> None:
    (tmp_path / "p.png").write_bytes(GOOD)
    assert look(obj(tmp_path, "map_Kd C:\\Users\\me\\p.png")).textured


def test_large_images_are_refused_before_they_are_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One, and several together."""
    monkeypatch.setattr(appearance, "MAX_ALL_PIXELS", 64 * 64 + 1)
    two = gltf(tmp_path, images=[LARGE, GOOD], primitives=[{"material": 0}, {"material": 1}])
    with pytest.raises(InputError, match="too large"):
        look(two)
    monkeypatch.setattr(appearance, "MAX_PIXELS", 64 * 63)
    monkeypatch.setattr(appearance, "_rgba", lambda image: pytest.fail("it was unpacked"))
    with pytest.raises(InputError, match="too large: 64 x 64"):
        ImageReader().decode(LARGE, "b.png")


def test_an_image_that_several_materials_name_counts_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(appearance, "MAX_ALL_PIXELS", 64 * 64)
    (tmp_path / "p.png").write_bytes(LARGE)
    lines = ("map_Kd p.png", "newmtl other", "map_Kd ./p.png")
    first, second = look(obj(tmp_path, *lines, corners="usemtl other\nf 1/1 2/2 3/3\n")).materials
    assert first.image is second.image is not None


def test_a_damaged_tiff_prints_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    """The library that reads it is of C, and would."""
    out = BytesIO()
    Image.fromarray(quarters(16)[..., :3]).save(out, "TIFF", compression="tiff_lzw")
    data = bytearray(out.getvalue())
    data[8:40] = b"\xff" * 32
    with pytest.raises(InputError, match="is a damaged image"):
        ImageReader().decode(bytes(data), "a.tif")
    assert capfd.readouterr().err == ""
    os.write(2, b"heard again")
    assert capfd.readouterr().err == "heard again"


def test_nothing_is_logged_where_nobody_listens(tmp_path: Path) -> None:
    """A tiff with more samples for a pixel than there are."""
    out = BytesIO()
    Image.fromarray(quarters(16)[..., :3]).save(out, "TIFF")
    samples = struct.pack("<HHIH", 277, 3, 1, 3)
    data = out.getvalue().replace(samples, samples[:-2] + struct.pack("<H", 60163))
    assert data != out.getvalue()
    (tmp_path / "a.tif").write_bytes(data)
    code = "import sys; from meshmatch.shapes.appearance import ImageReader\n"
    code += (
        "try: ImageReader().decode(open(sys.argv[1], 'rb').read(), 'a.tif')\nexcept Exception as error: print(error)"
    )
    words = [sys.executable, "-c", code, tmp_path / "a.tif"]
    told = subprocess.run(words, capture_output=True, text=True, check=True)
    assert (told.stderr, told.stdout) == ("", "a.tif cannot be read as an image\n")


def test_sixteen_bits_of_grey(tmp_path: Path) -> None:
    from PIL import Image

    write_square_obj(tmp_path / "a.obj", mtl=None)
    Image.fromarray(np.array([[0, 65535], [32768, 257]], np.uint16)).save(tmp_path / "b.png")
    image = look(tmp_path / "a.obj", tmp_path / "b.png").materials[0].image
    assert image is not None
    np.testing.assert_array_equal(image[..., 1], [[0, 255], [128, 1]])
    np.testing.assert_array_equal(image[..., 3], 255)


def test_the_shape_must_be_the_files(tmp_path: Path, cube: Shape) -> None:
    write_gltf(tmp_path / "a.glb", images=[encoded(quarters())], primitives=[{"material": 0}])
    with pytest.raises(InputError, match="is not the file"):
        load_appearance(tmp_path / "a.glb", cube)
