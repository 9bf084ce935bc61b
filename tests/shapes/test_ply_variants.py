"""PLY files as different programs write them: names of lists and colors, strips, textures."""

import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from meshmatch.api.pictures import picture
from meshmatch.errors import InputError, MeshmatchWarning
from meshmatch.render.picture import Look
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.textured_files import find_appearance, load_appearance, load_coordinates
from tests.shapes.painted import encoded, quarters

POINTS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0, 2, 0], [1, 2, 1]], float)
STRIPS = [[0, 1, 2, 3], [2, 3, 4, 5], [1, 5, 3]]
# Each strip by itself, every second triangle turned round.
TRIANGLES = {(0, 1, 2), (2, 1, 3), (2, 3, 4), (4, 3, 5), (1, 5, 3)}


def rows(table: object, start: str = "") -> str:
    return "".join(start + " ".join(f"{x:.8g}" for x in row) + "\n" for row in np.asarray(table, float).tolist())


def head(*lines: str, order: str = "ascii", vertex: tuple[str, ...] = (), count: int = 6) -> str:
    own = ["ply", f"format {order} 1.0", f"element vertex {count}", *(f"property float {axis}" for axis in "xyz")]
    return "\n".join([*own, *(f"property {line}" for line in vertex), *lines, "end_header", ""])


def turned(triangle: np.ndarray) -> tuple[int, ...]:
    first = int(np.argmin(triangle))
    return tuple(np.roll(triangle, -first).tolist())


@pytest.mark.parametrize("order", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("split", ["rows", "minus one", "both"])
@pytest.mark.parametrize("name", ["vertex_indices", "vertex_indexes"])
def test_strips_stay_apart(tmp_path: Path, order: str, split: str, name: str) -> None:
    one = [*STRIPS[0], -1, *STRIPS[1], -1, *STRIPS[2]]
    listed = {"rows": STRIPS, "minus one": [one], "both": [[*STRIPS[0], -1, *STRIPS[1], -1], STRIPS[2]]}[split]
    header = head(f"element tristrips {len(listed)}", f"property list int int {name}", order=order)
    if order == "ascii":
        body = (rows(POINTS) + "".join(rows([[len(strip), *strip]]) for strip in listed)).encode()
    else:
        mark = "<" if "little" in order else ">"
        body = POINTS.astype(f"{mark}f4").tobytes()
        body += b"".join(struct.pack(f"{mark}{1 + len(strip)}i", len(strip), *strip) for strip in listed)
    (tmp_path / "a.ply").write_bytes(header.encode() + body)
    faces = load_shape(tmp_path / "a.ply").faces
    assert {turned(face) for face in faces} == {turned(np.array(face)) for face in TRIANGLES}
    assert len(faces) == len(TRIANGLES)


@pytest.mark.parametrize(
    "name", ["vertex_indexes", "Vertex_Indices", "vertexIndices", "vertices", "VertexIndex", "corners", "v", "indices"]
)
@pytest.mark.parametrize("element", ["face", "Face", "faces", "triangles"])
def test_faces_are_found_whatever_they_are_called(tmp_path: Path, name: str, element: str) -> None:
    more = [f"property list uchar float {label}" for label in ("texcoord", "weights")]
    lines = [f"element {element} 2", "property uchar flags", *more, f"property list uchar int {name}"]
    (tmp_path / "a.ply").write_text(head(*lines) + rows(POINTS) + "7 1 .5 0 3 0 1 2\n7 0 2 1 2 3 1 3 2\n")
    np.testing.assert_array_equal(load_shape(tmp_path / "a.ply").faces, [[0, 1, 2], [1, 3, 2]])


@pytest.mark.parametrize(
    ("lines", "body"),
    [
        (["property list uchar int a", "property list uchar int b"], "3 0 1 2 3 0 1 2\n"),
        (["property list uchar float texcoord"], "6 0 0 0 0 0 0\n"),
        (["property int v1", "property int v2", "property int v3"], "0 1 2\n"),
    ],
)
def test_faces_that_cannot_be_found_are_no_cloud(tmp_path: Path, lines: list[str], body: str) -> None:
    (tmp_path / "a.ply").write_text(head("element face 1", *lines) + rows(POINTS) + body)
    with pytest.raises(InputError, match="vertices of each face"):
        load_shape(tmp_path / "a.ply")


@pytest.mark.parametrize(
    ("names", "kind", "scale"),
    [
        (("red", "green", "blue", "alpha"), "uchar", 255),
        (("Red", "Green", "Blue", "Alpha"), "uchar", 255),
        (("diffuse_red", "diffuse_green", "diffuse_blue", "alpha"), "uchar", 255),
        (("r", "g", "b", "a"), "float", 1),
        (("red", "green", "blue", "alpha"), "float", 255),
        (("red", "green", "blue", "alpha"), "ushort", 65535),
    ],
)
def test_colors_by_any_name(tmp_path: Path, names: tuple[str, ...], kind: str, scale: float) -> None:
    colors = np.array(
        [[0.2, 0.4, 1, 1], [0, 0, 0, 0.6], [0.8, 0.2, 0, 1], [1, 1, 1, 0], [0.6, 0, 0.4, 1], [0, 1, 0, 1]]
    )
    given = np.rint(colors * scale) if kind != "float" else colors * scale
    text = head(vertex=tuple(f"{kind} {name}" for name in names)) + rows(np.hstack([POINTS, given]))
    (tmp_path / "a.ply").write_text(text)
    np.testing.assert_allclose(load_shape(tmp_path / "a.ply").colors, colors, atol=1e-6)


def test_dark_reds_among_bytes_as_floats(tmp_path: Path) -> None:
    """One channel that never gets above 1 counts to 255 as the others do."""
    colors = np.array([[1, 255, 51]] * 6, float)
    text = head(vertex=("float red", "float green", "float blue")) + rows(np.hstack([POINTS, colors]))
    (tmp_path / "a.ply").write_text(text)
    np.testing.assert_allclose(load_shape(tmp_path / "a.ply").colors[:, :3], colors / 255, atol=1e-6)


def test_colors_of_faces_become_means_around_vertices(tmp_path: Path) -> None:
    paint = [f"property uchar {name}" for name in ("red", "green", "blue")]
    lines = ["element face 2", "property list uchar int vertex_indices", *paint]
    (tmp_path / "a.ply").write_text(head(*lines) + rows(POINTS) + "3 0 1 2 255 0 0\n3 1 3 2 0 0 0\n")
    with pytest.warns(MeshmatchWarning, match="a color for each face"):
        colors = load_shape(tmp_path / "a.ply").colors
    half = 188 / 255  # half the light of red
    np.testing.assert_allclose(colors[:4], [[1, 0, 0, 1], [half, 0, 0, 1], [half, 0, 0, 1], [0, 0, 0, 1]], atol=2e-3)
    np.testing.assert_allclose(colors[4:], np.ones((2, 4)))


# --- textures

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
DOWN = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], float)  # v down
POLYGONS = {"triangles": [[0, 1, 2], [0, 2, 3]], "quad": [[0, 1, 2, 3]]}
CORNERS = DOWN[[[0, 1, 2], [0, 2, 3]]]


def wedges(polygons: list[list[int]], images: str = "", number: list[int] | None = None, name: str = "texcoord") -> str:
    extra = [] if number is None else ["property int texnumber"]
    lines = [f"element face {len(polygons)}", "property list uchar int vertex_indices"]
    lines += [f"property list uchar float {name}", *extra]
    text = head(*lines, count=4).replace("element vertex", images + "element vertex")
    body = rows(SQUARE)
    for k, polygon in enumerate(polygons):
        uv = [f"{u} {v}" for u, v in SQUARE[polygon][:, :2].tolist()]
        last = "" if number is None else f" {number[k]}"
        body += f"{len(polygon)} {' '.join(map(str, polygon))} {2 * len(polygon)} {' '.join(uv)}{last}\n"
    return text + body


def vertex_pairs(u: str, v: str, images: str) -> str:
    text = head(
        "element face 1", "property list uchar int vertex_indices", vertex=(f"float {u}", f"float {v}"), count=4
    )
    body = rows(np.hstack([SQUARE, SQUARE[:, :2]])) + "4 0 1 2 3\n"
    return text.replace("element vertex", images + "element vertex") + body


@pytest.mark.parametrize("polygons", list(POLYGONS))
@pytest.mark.parametrize("name", ["texcoord", "texCoords", "texture_uv"])
@pytest.mark.parametrize("spelled", ["tex.png", "Tex.PNG", "maps\\tex.png", "C:\\scans\\tex.png"])
def test_coordinates_of_corners(tmp_path: Path, polygons: str, name: str, spelled: str) -> None:
    (tmp_path / "tex.png").write_bytes(encoded(quarters()))
    (tmp_path / "a.ply").write_text(wedges(POLYGONS[polygons], f"comment TextureFile {spelled}\n", name=name))
    shape = load_shape(tmp_path / "a.ply")
    look = load_appearance(tmp_path / "a.ply", shape)
    np.testing.assert_array_equal(look.uv, CORNERS)
    np.testing.assert_array_equal(look.materials[0].image, quarters())
    np.testing.assert_array_equal(load_coordinates(tmp_path / "a.ply", shape), CORNERS)


@pytest.mark.parametrize(
    ("u", "v"),
    [
        *(("texture_u", "texture_v"), ("s", "t"), ("u", "v"), ("texcoord_x", "texcoord_y"), ("tx", "ty")),
        *(("uv1", "uv2"), ("TEXCOORD_0_U", "TEXCOORD_0_V"), ("texture_coord_s", "texture_coord_t"), ("u0", "v0")),
    ],
)
def test_coordinates_of_vertices(tmp_path: Path, u: str, v: str) -> None:
    (tmp_path / "my tex.png").write_bytes(encoded(quarters()))
    (tmp_path / "a.ply").write_text(vertex_pairs(u, v, "comment TextureFile my tex.png\n"))
    shape = load_shape(tmp_path / "a.ply")
    look = load_appearance(tmp_path / "a.ply", shape)
    np.testing.assert_array_equal(look.uv, CORNERS)
    assert look.textured


def test_several_images_each_on_its_faces(tmp_path: Path) -> None:
    for k, color in enumerate(([255, 0, 0, 255], [0, 0, 255, 255])):
        (tmp_path / f"{k}.png").write_bytes(encoded(np.full((2, 2, 4), color, np.uint8)))
    comments = "comment TextureFile 0.png\ncomment made by a scanner\ncomment TextureFile 1.png\n"
    for number, shown in (([1, 0], [2, 0]), ([0, 0], [0, 0]), ([1, -1], [2, None]), ([0, 5], [0, None])):
        (tmp_path / "a.ply").write_text(wedges(POLYGONS["triangles"], comments, number))
        look = load_appearance(tmp_path / "a.ply", load_shape(tmp_path / "a.ply"))
        images = [look.materials[k].image for k in look.material.tolist()]
        assert [None if image is None else int(image[0, 0].argmax()) for image in images] == shown


def test_the_other_image_and_what_is_missing(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    (tmp_path / "other.png").write_bytes(encoded(quarters()))
    path.write_text(wedges(POLYGONS["quad"]))
    shape = load_shape(path)
    assert find_appearance(path, shape) is None  # coordinates, and nothing to lay on them
    np.testing.assert_array_equal(load_appearance(path, shape, tmp_path / "other.png").materials[0].image, quarters())
    path.write_text(wedges(POLYGONS["quad"], "comment TextureFile gone.png\n"))
    with pytest.raises(InputError, match=r"needs the image gone\.png"):
        find_appearance(path, shape)
    path.write_text(vertex_pairs("a", "b", "comment TextureFile other.png\n"))
    with pytest.warns(MeshmatchWarning, match=r"names the image other\.png, but has no texture coordinates"):
        assert find_appearance(path, load_shape(path)) is None
    assert load_coordinates(path, load_shape(path)) is None
    with pytest.raises(InputError, match="no texture coordinates"):
        load_appearance(path, load_shape(path), tmp_path / "other.png")


def test_vertex_colors_stand_in_for_an_image_that_is_gone(tmp_path: Path) -> None:
    paint = tuple(f"uchar {name}" for name in ("red", "green", "blue"))
    lines = ["element face 1", "property list uchar int vertex_indices", "property list uchar float texcoord"]
    text = head(*lines, vertex=paint, count=4).replace("element vertex", "comment TextureFile gone.png\nelement vertex")
    body = rows(np.hstack([SQUARE, np.full((4, 3), 51)])) + "4 0 1 2 3 8 0 0 1 0 1 1 0 1\n"
    (tmp_path / "a.ply").write_text(text + body)
    shape = load_shape(tmp_path / "a.ply")
    with pytest.warns(MeshmatchWarning, match="vertex colors are used"):
        look = load_appearance(tmp_path / "a.ply", shape)
    assert not look.textured
    assert look.colors is not None


def test_a_picture_shows_the_image(tmp_path: Path) -> None:
    (tmp_path / "tex.png").write_bytes(encoded(np.full((4, 4, 4), [255, 0, 0, 255], np.uint8)))
    (tmp_path / "a.ply").write_text(wedges(POLYGONS["quad"], "comment TextureFile tex.png\n"))
    picture([tmp_path / "a.ply"], tmp_path / "a.png", look=Look(size=(100, 100)))
    pixels = np.asarray(Image.open(tmp_path / "a.png").convert("RGB")).astype(int)
    assert (pixels[..., 0] - pixels[..., 1:].max(axis=-1)).max() > 80


@pytest.mark.parametrize(
    "line",
    ["comment texture file: t.png", "comment TextureFile=t.png", "comment Texture t.png", "obj_info TextureFile t.png"],
)
def test_ways_to_name_an_image(tmp_path: Path, line: str) -> None:
    (tmp_path / "t.png").write_bytes(encoded(quarters()))
    (tmp_path / "a.ply").write_text(vertex_pairs("s", "t", f"{line}\n"))
    look = load_appearance(tmp_path / "a.ply", load_shape(tmp_path / "a.ply"))
    np.testing.assert_array_equal(look.materials[0].image, quarters())


def test_the_axes_of_a_tangent_are_no_texture_coordinates(tmp_path: Path) -> None:
    (tmp_path / "t.png").write_bytes(encoded(quarters()))
    names = ("tx", "ty", "u", "v")
    vertex = "".join(f"property float {name}\n" for name in names)
    text = vertex_pairs("a", "b", "comment TextureFile t.png\n").replace("property float a\nproperty float b\n", vertex)
    at = text.index("end_header\n") + len("end_header\n")
    lines = text[at:].splitlines()
    lines[:4] = [" ".join([*line.split()[:3], "9", "9", *line.split()[3:]]) for line in lines[:4]]
    (tmp_path / "a.ply").write_text(text[:at] + "\n".join(lines) + "\n")
    np.testing.assert_array_equal(load_appearance(tmp_path / "a.ply", load_shape(tmp_path / "a.ply")).uv, CORNERS)


@pytest.mark.parametrize("kind", ["uint", "float"])
def test_colors_packed_into_one_number(tmp_path: Path, kind: str) -> None:
    packed = np.array([0x00FF8000 + k for k in range(6)], "<u4")
    body = b"".join(p.tobytes() + c.tobytes() for p, c in zip(POINTS.astype("<f4"), packed, strict=True))
    header = head(order="binary_little_endian", vertex=(f"{kind} rgb",))
    (tmp_path / "a.ply").write_bytes(header.encode() + body)
    found = load_shape(tmp_path / "a.ply").colors
    assert found is not None
    np.testing.assert_allclose(found * 255, [[255, 128, k, 255] for k in range(6)])


@pytest.mark.parametrize("element", ["facet", "tri_strips", "trifans"])
def test_faces_of_other_elements_are_read_or_said(tmp_path: Path, element: str) -> None:
    text = head(f"element {element} 2", "property list uchar int vertex_indices") + rows(POINTS) + "3 0 1 2\n3 2 1 3\n"
    (tmp_path / "a.ply").write_text(text)
    if element == "trifans":
        with pytest.warns(MeshmatchWarning, match="its 2 trifans are not read"):
            assert load_shape(tmp_path / "a.ply").F == 0
    else:
        assert {turned(face) for face in load_shape(tmp_path / "a.ply").faces} == {(0, 1, 2), (1, 3, 2)}


@pytest.mark.parametrize("suffix", ["obj", "off", "ply"])
def test_faces_of_two_corners_are_said(tmp_path: Path, suffix: str) -> None:
    texts = {
        "obj": rows(POINTS, "v ") + "f 1 2\nf 2 3\n",
        "off": "OFF\n6 2 0\n" + rows(POINTS) + "2 0 1\n2 1 2\n",
        "ply": head("element face 2", "property list uchar int vertex_indices") + rows(POINTS) + "2 0 1\n2 1 2\n",
    }
    (tmp_path / f"a.{suffix}").write_text(texts[suffix])
    with pytest.warns(MeshmatchWarning, match="none of its 2 faces has three corners"):
        assert load_shape(tmp_path / f"a.{suffix}").V == 6
