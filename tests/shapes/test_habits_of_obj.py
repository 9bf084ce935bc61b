"""How programs write obj and mtl (and off) that is not in the books, and what is made of it."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from meshmatch.errors import InputError, MeshmatchWarning
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.formats.obj_appearance import companions
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.textured_files import find_appearance, load_appearance
from tests.shapes.painted import encoded, write_gltf

VERTS = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
COORDINATES = "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
FACES = "f 1/1 2/2 3/3\nf 1/1 3/3 4/4\n"
HEAD = "mtllib a.mtl\n"
BODY = VERTS + COORDINATES + "usemtl skin\n" + FACES
PAINT = np.array([[[200, 10, 30, 255], [20, 150, 30, 255]], [[20, 10, 250, 255], [90, 90, 90, 255]]], np.uint8)


def write(folder: Path, mtl: str | bytes, text: str | bytes = HEAD + BODY, image: np.ndarray = PAINT) -> Path:
    for name, content in (("a.obj", text), ("a.mtl", mtl)):
        (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    (folder / "t.png").write_bytes(encoded(image))
    return folder / "a.obj"


def with_alpha(alpha: int) -> np.ndarray:
    return np.concatenate([PAINT[..., :3], np.full((2, 2, 1), alpha, np.uint8)], axis=-1)


# opacity


@pytest.mark.parametrize(
    ("lines", "opacity"),
    [
        ("", 1.0),
        ("d 0.5\n", 0.5),
        ("Tr 0.25\n", 0.75),
        ("d 1\nTr 1\n", 1.0),
        ("Tr 1\nd 1\n", 1.0),
        ("Tr 0.9\nd 0.5\n", 0.5),
        ("d 0.5\nTr 0\n", 0.5),
        ("Tr 0\nillum 2\n", 1.0),
    ],
)
def test_opacity(tmp_path: Path, lines: str, opacity: float) -> None:
    path = write(tmp_path, f"newmtl skin\n{lines}map_Kd t.png\n")
    [made] = load_appearance(path, load_shape(path)).materials
    assert made.factor[3] == pytest.approx(opacity)
    assert made.alpha == ("opaque" if opacity == 1 else "blend")


@pytest.mark.parametrize(
    "lines", ["Tr 1\n", "Tr 1.000000\nillum 2\n", "d 0\n", "d 0.0\nTr 1\n", "Tr 0.99\n", "d -halo 0\n"]
)
@pytest.mark.parametrize("image", ["map_Kd t.png\n", "Kd 0.5 0.2 0.1\n"], ids=["image", "color"])
def test_what_would_not_be_seen_is_opaque(tmp_path: Path, lines: str, image: str) -> None:
    path = write(
        tmp_path, f"newmtl other\nKd 1 0 0\nnewmtl skin\n{lines}{image}", HEAD + BODY + "usemtl other\n" + FACES
    )
    with pytest.warns(MeshmatchWarning, match=r"material skin of a\.obj is wholly transparent"):
        look = load_appearance(path, load_shape(path))
    assert [(m.alpha, m.factor[3]) for m in look.materials] == [("opaque", 1.0)] * 2


def test_decimal_commas_in_materials(tmp_path: Path) -> None:
    """As numbers, and never without the word where something else is meant."""
    text, mtl = HEAD + BODY, "newmtl skin\nKd 0{0}25 0{0}5 1\nd 0{0}5\nmap_Kd -s 0{0}5 2 -o 0{0}25 0 t.png\n"
    with_commas, with_points = (find_appearance(p, load_shape(p)) for p in _folders(tmp_path, text, mtl, ",."))
    assert with_commas is not None and with_points is not None
    assert np.array_equal(with_commas.uv, with_points.uv)
    for mine, theirs in zip(with_commas.materials, with_points.materials, strict=True):
        assert (mine.factor, mine.name) == (theirs.factor, theirs.name) and mine.factor[3] == 0.5
    for wrong in ("Kd 1,000.5 1 1", "d 1,2,3"):
        path = write(tmp_path, f"newmtl skin\n{wrong}\n")
        with pytest.raises(InputError, match=r"a\.mtl: cannot make sense") as caught:
            load_appearance(path, load_shape(path))
        assert "decimal comma" in caught.value.hint


def _folders(folder: Path, text: str, mtl: str, marks: str) -> Iterator[Path]:
    for k, mark in enumerate(marks):
        (folder / str(k)).mkdir()
        yield write(folder / str(k), mtl.format(mark), text)


@pytest.mark.parametrize("mtl", ["map_Kd t.png\n", "map_Kd k.png\nmap_d t.png\n", "Tr 1\nmap_Kd t.png\n"])
def test_an_image_without_any_alpha_is_opaque(tmp_path: Path, mtl: str) -> None:
    path = write(tmp_path, "newmtl skin\n" + mtl, image=with_alpha(0))
    (tmp_path / "k.png").write_bytes(encoded(PAINT))
    with pytest.warns(MeshmatchWarning, match="wholly transparent"):
        [made] = load_appearance(path, load_shape(path)).materials
    assert (made.alpha, made.factor[3]) == ("opaque", 1.0)


def test_holes_stay_where_the_opacity_is_mistaken(tmp_path: Path) -> None:
    image = PAINT.copy()
    image[0, 0, 3] = 0
    path = write(tmp_path, "newmtl skin\nTr 1\nmap_Kd t.png\n", image=image)
    with pytest.warns(MeshmatchWarning, match="wholly transparent"):
        [made] = load_appearance(path, load_shape(path)).materials
    assert (made.alpha, made.factor[3]) == ("blend", 1.0) and made.image is not None and made.image[0, 0, 3] == 0


@pytest.mark.parametrize(
    ("material", "alpha"),
    [
        ({"pbrMetallicRoughness": {"baseColorFactor": [1, 0, 0, 0]}}, "opaque"),  # ignored there, as specified: no word
        ({"pbrMetallicRoughness": {"baseColorFactor": [1, 0, 0, 0.5]}, "alphaMode": "BLEND"}, "blend"),
    ],
)
def test_gltf_says_what_alpha_means(tmp_path: Path, material: dict[str, object], alpha: str) -> None:
    path = tmp_path / "a.gltf"
    write_gltf(path, primitives=[{"material": 0}, {}], materials=[material])
    assert load_appearance(path, load_shape(path)).materials[0].alpha == alpha


@pytest.mark.parametrize(
    "mode", [{"alphaMode": "BLEND"}, {"alphaMode": "MASK"}, {"alphaMode": "MASK", "alphaCutoff": 0.1}]
)
def test_gltf_that_would_not_be_seen_is_opaque(tmp_path: Path, mode: dict[str, object]) -> None:
    path = tmp_path / "a.gltf"
    clear = {"pbrMetallicRoughness": {"baseColorFactor": [1, 0, 0, 0]}, "name": "coat"} | mode
    write_gltf(path, primitives=[{"material": 0}, {}], materials=[clear])
    with pytest.warns(MeshmatchWarning, match="material coat"):
        assert load_appearance(path, load_shape(path)).materials[0].alpha == "opaque"


@pytest.mark.parametrize("alpha", [0, 1])
def test_vertex_colors_without_alpha_are_opaque(tmp_path: Path, alpha: int) -> None:
    rows = "".join(f"{x} {y} 0 200 10 30 {alpha}\n" for x, y in ((0, 0), (1, 0), (0, 1)))
    kinds = "".join(f"property float {a}\n" for a in "xyz") + "".join(
        f"property uchar {c}\n" for c in ("red", "green", "blue", "alpha")
    )
    path = tmp_path / "a.ply"
    path.write_text(f"ply\nformat ascii 1.0\nelement vertex 3\n{kinds}end_header\n{rows}")
    with pytest.warns(MeshmatchWarning, match=r"a\.ply are transparent at every vertex"):
        colors = load_shape(path).colors
    np.testing.assert_allclose(colors, [[200 / 255, 10 / 255, 30 / 255, 1]] * 3)


# lines


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"], ids=["LF", "CRLF", "CR"])
@pytest.mark.parametrize(
    "text",
    [
        "# D:\\scans\\\n" + VERTS + FACES,
        VERTS + "# to \\ \nf 1 2 3\nf 1 3 4\n",
        VERTS.replace("v 1 1 0", "# \\\\\nv 1 1 0") + FACES,
        VERTS + "f 1 2 3 # first\\\nf 1 3 4\n",
        VERTS + "f 1 \\\n2 3\nf 1 3\\\n 4\n",
        VERTS + "f 1 \\ \n2 \\\t\n3\nf 1 3 4\n",
        VERTS + "g C:\\parts\\\nf 1 2 3\nf 1 3 4\n",
        VERTS + "f 1 2 3\\\nf 1 3 4\\\n",
        VERTS + "f 1 2 3\nf 1 3 4 \\",
        "\ufeff" + VERTS + FACES,
    ],
)
def test_lines_end_where_they_are_meant_to(tmp_path: Path, text: str, end: str) -> None:
    path = write(tmp_path, "", text.replace("\n", end))
    shape = load_shape(path)
    assert shape.V == 4
    np.testing.assert_array_equal(shape.faces, [[0, 1, 2], [0, 2, 3]])


@pytest.mark.parametrize("coding", ["utf-8-sig", "utf-16"])
@pytest.mark.parametrize("mtl", ["newmtl skin\nmap_Kd t.png\n", "newmtl skin\n# maps\\\nmap_Kd t.png\n"])
def test_marks_and_comments_in_materials(tmp_path: Path, coding: str, mtl: str) -> None:
    path = write(tmp_path, mtl.encode(coding), (HEAD + BODY).encode(coding))
    assert load_appearance(path, load_shape(path)).textured


@pytest.mark.parametrize("coding", ["utf-8-sig", "utf-16"])
@pytest.mark.parametrize("suffix", ["ply", "off", "xyz", "stl", "gltf"])
def test_marks_of_encodings_are_skipped(tmp_path: Path, suffix: str, coding: str) -> None:
    corners = "0 0 0\n1 0 0\n0 1 0\n"
    kinds = "".join(f"property float {a}\n" for a in "xyz") + "element face 1\nproperty list uchar int vertex_indices\n"
    path = tmp_path / f"a.{suffix}"
    write_gltf(tmp_path / "a.gltf", primitives=[{}])
    facet = "facet normal 0 0 1\nouter loop\n" + "".join(f"vertex {row}\n" for row in corners.splitlines())
    text = {
        "ply": f"ply\nformat ascii 1.0\nelement vertex 3\n{kinds}end_header\n{corners}3 0 1 2\n",
        "off": f"OFF\n3 1 0\n{corners}3 0 1 2\n",
        "xyz": corners,
        "stl": f"solid a\n{facet}endloop\nendfacet\nendsolid a\n",
        "gltf": (tmp_path / "a.gltf").read_text(),
    }[suffix]
    path.write_text(text)
    plain = load_shape(path)
    path.write_bytes(text.encode(coding))
    np.testing.assert_array_equal(load_shape(path).verts, plain.verts)
    np.testing.assert_array_equal(load_shape(path).faces, plain.faces)


# faces


@pytest.mark.parametrize(
    "faces",
    [
        "f 1 / 1 2 / 2 3 / 3\nf 1 / 1 3 / 3 4 / 4\n",
        "f 1 /1 2 /2 3 /3\nf 1/1 3/3 4/4\n",
        "f 1//1 2//1 3//1\nf 1 // 1 3 // 1 4 // 1\n",
        "f 1/ 2/ 3/\nf 1/1/ 3/3/ 4/4/\n",
        "f\t1/1/1\t2/2/1\t3/3/1\nf 1 3 4\n",
        "f +1 2.0 3e0\nf -4 -2 -1\n",
    ],
)
def test_faces_of_many_spellings(tmp_path: Path, faces: str) -> None:
    path = write(tmp_path, "newmtl skin\nKd 1 0 0\n", VERTS + COORDINATES + "vn 0 0 1\n" + faces)
    np.testing.assert_array_equal(load_shape(path).faces, [[0, 1, 2], [0, 2, 3]])
    find_appearance(path, load_shape(path))


@pytest.mark.parametrize("faces", ["f 1/ 1 2/ 2 3/ 3\n", "f /1 /2 /3\n", "f / / /\n", "f 1,2,3\n", "f 1|1 2|2 3|3\n"])
def test_faces_that_make_no_sense(tmp_path: Path, faces: str) -> None:
    with pytest.raises(InputError, match=r"face|number"):
        load_shape(write(tmp_path, "", VERTS + COORDINATES + faces))


# colors

SEEN = np.array([[255, 0, 51, 255], [0, 255, 0, 255], [0, 51, 255, 255], [255, 255, 255, 255]])


def colored(row: str) -> str:
    places = [line[2:] for line in VERTS.splitlines()]
    parts = [dict(zip(("r", "g", "b", "a"), each, strict=True)) for each in SEEN.tolist()]
    scaled = [{k.upper(): v / 255 for k, v in each.items()} for each in parts]
    return "".join(row.format(p=p, **a, **b) + "\n" for p, a, b in zip(places, parts, scaled, strict=True))


def polypaint(colors: np.ndarray, mask: str = "ff") -> str:
    words = [mask + bytes(row[:3]).hex() for row in colors.astype(np.uint8)]
    return f"#MRGB {''.join(words[:3])}\n#MRGB {words[3]}\n"


@pytest.mark.parametrize(
    "text",
    [
        colored("v {p} {R} {G} {B}") + FACES,
        colored("v {p} {r} {g} {b}") + FACES,
        colored("v {p} {R} {G} {B} {A}") + FACES,
        colored("v {p} {r} {g} {b} {a}") + FACES,
        colored("v {p} {r} {g} {b} {A}") + FACES,
        colored("v {p} {R} {G} {B}").rsplit("\n", 2)[0] + "\nv 0 1 0\n" + FACES,  # the last, white one without
        VERTS + polypaint(SEEN) + FACES,
        VERTS + polypaint(SEEN, "00") + FACES,
        VERTS + FACES + polypaint(SEEN).upper().replace("#MRGB", "#MRGB  ").replace("\n", "\r\n"),
        VERTS + colored("vc {R} {G} {B}") + FACES,
        VERTS + colored("  vc {R} {G} {B}") + FACES,
        VERTS + colored("\tvc\t{R} {G} {B}").replace("\n", "\r\n") + FACES,
        colored("vc {R} {G} {B}") + VERTS + FACES,
        (VERTS + polypaint(SEEN) + FACES).replace("\n", "\n  "),
    ],
)
def test_vertex_colors_of_obj(tmp_path: Path, text: str) -> None:
    colors = load_shape(write(tmp_path, "", text)).colors
    np.testing.assert_allclose(colors, SEEN / 255)


@pytest.mark.parametrize(
    ("paint", "word"),
    [("#MRGB ff00ff00\n", "for 1 vertices, but 4"), (polypaint(SEEN) * 2, "for 8 vertices"), ("#MRGB ff00f\n", "hexa")],
)
def test_polypaint_that_does_not_fit_is_said(tmp_path: Path, paint: str, word: str) -> None:
    with pytest.warns(MeshmatchWarning, match=word):
        assert load_shape(write(tmp_path, "", VERTS + paint + FACES)).V == 4


@pytest.mark.parametrize(
    ("head", "row", "has"),
    [
        ("OFF", "{p} {r} {g} {b}", True),
        ("OFF", "{p} {r} {g} {b} {a}", True),
        ("OFF", "{p} {R} {G} {B} {A}", True),
        ("COFF", "{p} {r} {g} {b} {A}", True),
        ("STCOFF", "{p} {r} {g} {b} 0.5 0.25", True),
        ("CNOFF", "{p} 0 0 1 {r} {g} {b}", True),
        ("OFF", "{p} 0 0.6 0.8", False),  # normals
        ("OFF", "{p} 0 0 -1", False),
        ("OFF", "{p} 0.25 0.75", False),
    ],
)
def test_vertex_colors_of_off(tmp_path: Path, head: str, row: str, has: bool) -> None:
    path = tmp_path / "a.off"
    path.write_text(f"{head}\n4 2 0\n{colored(row)}3 0 1 2\n3 0 2 3\n")
    colors = load_shape(path).colors
    assert (colors is not None) == has
    if has:
        np.testing.assert_allclose(colors, SEEN / 255)


def test_face_colors_of_off_are_mixed_at_vertices(tmp_path: Path) -> None:
    path = tmp_path / "a.off"
    path.write_text("OFF\n5 2 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n9 9 9\n3 0 1 2 255 0 0\n3 0 2 3 0 0 255 255\n")
    with pytest.warns(MeshmatchWarning, match="colors of faces"):
        colors = load_shape(path).colors
    half = 0.7353569  # half the light, as a screen shows it
    mixed = [half, 0, half, 1]
    np.testing.assert_allclose(colors, [mixed, [1, 0, 0, 1], mixed, [0, 0, 1, 1], [1, 1, 1, 1]], atol=1e-6)


# materials


def textured(path: Path, shape: Shape) -> list[str]:
    look = load_appearance(path, shape)
    return [m.name for m in look.materials if m.image is not None]


@pytest.mark.parametrize("use", ["", "usemtl Skin\n", "usemtl SKIN # x\n"])
def test_the_material_that_is_meant(tmp_path: Path, use: str) -> None:
    path = write(tmp_path, "newmtl skin\nmap_Kd t.png\n", HEAD + BODY.replace("usemtl skin\n", use))
    assert textured(path, load_shape(path)) == ["skin"]


def test_of_names_in_two_cases_the_exact_one(tmp_path: Path) -> None:
    path = write(tmp_path, "newmtl SKIN\nKd 1 0 0\nnewmtl skin\nmap_Kd t.png\nnewmtl Skin\nKd 0 1 0\n")
    assert textured(path, load_shape(path)) == ["skin"]


@pytest.mark.parametrize(
    ("use", "word"), [("usemtl cloth\n", "names a material cloth"), ("", "which of the 2 materials")]
)
def test_a_material_that_is_not_there_is_said(tmp_path: Path, use: str, word: str) -> None:
    text = HEAD + VERTS + COORDINATES + use + FACES
    path = write(tmp_path, "newmtl skin\nmap_Kd t.png\nnewmtl hair\nKd 0 0 0\n", text)
    with pytest.warns(MeshmatchWarning, match=word):
        assert find_appearance(path, load_shape(path)) is None


def test_a_material_named_again_and_again_is_one(tmp_path: Path) -> None:
    text = HEAD + VERTS + COORDINATES + "".join(f"usemtl m{k % 2}\n{FACES}" for k in range(400))
    path = write(tmp_path, "newmtl m0\nmap_Kd t.png\nnewmtl m1\nmap_Kd t.png\nKd 1 0 0\n", text)
    assert len(load_appearance(path, load_shape(path)).materials) == 2


def test_images_beside_the_obj_where_the_mtl_lies_below(tmp_path: Path) -> None:
    path = write(tmp_path, "", HEAD.replace("a.mtl", "materials\\A.mtl") + BODY)
    (tmp_path / "materials").mkdir()
    (tmp_path / "Textures").mkdir()
    (tmp_path / "materials" / "a.mtl").write_text("newmtl skin\nmap_Kd ..\\textures\\T.PNG\n")
    (tmp_path / "t.png").rename(tmp_path / "Textures" / "t.png")
    assert textured(path, load_shape(path)) == ["skin"]


@pytest.mark.parametrize(
    ("use", "mtl"),
    [
        ("Material #2", "newmtl Material #1\nKd 1 0 0\nnewmtl Material #2\nmap_Kd t.png\n"),
        ("skin # of the body", "newmtl skin # smooth\nd 1.0 # opaque\nKd 1 1 1 # white\nmap_Kd t.png # the image\n"),
        ("skin", "newmtl skin\nKd # none\nmap_Kd t.png\nmap_d\nTr\n"),
    ],
)
def test_a_mark_ends_a_name_or_begins_a_comment(tmp_path: Path, use: str, mtl: str) -> None:
    path = write(
        tmp_path, mtl, (HEAD + BODY).replace("usemtl skin", f"usemtl {use}").replace("a.mtl", "a.mtl # materials")
    )
    [made] = load_appearance(path, load_shape(path)).materials
    np.testing.assert_array_equal(made.image, PAINT)
    assert made.alpha == "opaque"


def test_two_byte_order_marks(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text("\ufeff\ufeff" + BODY, encoding="utf-8")
    assert load_shape(tmp_path / "a.obj").V == 4


def test_udim_tiles_are_images_of_their_own(tmp_path: Path) -> None:
    """The second triangle lies in the tile above and to the right of the first's."""
    path = write(tmp_path, "newmtl skin\nmap_Kd skin.<UDIM>.png\nnorm n_<udim>.png\n")
    far = "vt 1.1 1.1\nvt 1.9 1.9\nvt 1.1 1.9\n"
    path.write_text(HEAD + VERTS + COORDINATES + far + "usemtl skin\nf 1/1 2/2 3/3\nf 1/5 3/6 4/7\n")
    for tile, value in ((1001, 10), (1012, 200)):
        (tmp_path / f"skin.{tile}.png").write_bytes(encoded(np.full((2, 2, 4), [value, 0, 0, 255], np.uint8)))
        (tmp_path / f"n_{tile}.png").write_bytes(encoded(PAINT))
    look = load_appearance(path, load_shape(path))
    images = [look.materials[k].image for k in look.material.tolist()]
    assert [image[0, 0, 0] for image in images if image is not None] == [10, 200]
    assert look.finish is not None and len(look.finish.layers["normal"].materials) == 2
    found, missing = companions(path, path.read_bytes())
    assert {file.name for file in found} == {
        "a.mtl",
        *(f"{stem}{k}.png" for stem in ("skin.", "n_") for k in (1001, 1012)),
    }
    assert missing == []
    corner = "vt 0.5 1\nusemtl skin\nf 1/1 2/2 3/3\nf 1/5 3/6 4/7\nf 1/8 2/8 3/8\n"
    path.write_text(
        HEAD + VERTS + COORDINATES + far + corner
    )  # a face without area in the image, on the edge of a tile
    assert np.array_equal(load_appearance(path, load_shape(path)).material, [0, 1, 0])
    (tmp_path / "skin.1012.png").unlink()
    with pytest.raises(InputError, match=r"needs the image skin.1012.png"):
        load_appearance(path, load_shape(path))
    path.write_text(path.read_text().replace("vt 1.1 1.1", "vt 31.1 1.1"))
    with pytest.raises(InputError, match="in no tile"):
        load_appearance(path, load_shape(path))
