"""The page as a file: what it holds, what it must never hold, and that it is the same each time."""

import base64
import hashlib
import re
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from PIL import Image

from meshmatch.errors import InputError, OptionError, OutputError
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.render.facing import rotation_like
from meshmatch.render.scales import position_colors
from meshmatch.render.viewer.assembly import pack, small_integers
from meshmatch.render.viewer.drawn_shapes import draw, relative_size, view_rotations
from meshmatch.render.viewer.looks import Looks, look_arrays
from meshmatch.render.viewer.page import write_page
from meshmatch.shapes.appearance import Appearance, Material
from meshmatch.shapes.colors import UNKNOWN
from meshmatch.shapes.shape import Shape
from tests.render.pages import Page, read, unpacked
from tests.render.pairs import Pair, bump, identical_pair, shuffled_pair

HOSTILE = "</script><script>alert(1)</script ><script /x><!--<script <!--packed--><b a='\"'>&amp;\u2028\u202e.ply"


@pytest.fixture(scope="module")
def pair(make_sphere: Callable[[int], Shape]) -> Pair:
    return shuffled_pair(bump(make_sphere(2)))


@pytest.mark.parametrize(
    ("verdict", "confidence", "known"), [("unknown", 1.0, False), ("unknown", 0.5, True), ("good", 1.0, True)]
)
def test_unknown_confidence_is_not_certainty(
    tmp_path: Path, cube: Shape, verdict: str, confidence: float, known: bool
) -> None:
    found = VertexMap.between(cube, cube, np.arange(8), confidence=np.full(8, confidence, np.float32), verdict=verdict)
    words = page_of(tmp_path / "page.html", Pair(cube, cube, found, found)).words
    assert words["confidence"] == ([confidence, confidence] if known else None)


def page_of(path: Path, pair: Pair, **options: Any) -> Page:
    write_page(path, pair.source, pair.target, pair.there, pair.back, **options)
    return read(path)


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory, pair: Pair) -> Page:
    return page_of(tmp_path_factory.mktemp("page") / "page.html", pair)


def test_the_page_holds_both_shapes_and_the_map(page: Page, pair: Pair) -> None:
    arrays, words = page.arrays, page.words
    assert (words["source"]["name"], words["target"]["name"]) == ("egg.ply", "stirred")
    assert (words["verdict"], words["source"]["vertices"]) == ("good", pair.source.V)
    for side, shape, found in (("source", pair.source, pair.there), ("target", pair.target, pair.back)):
        assert np.array_equal(arrays[f"{side}.face"].reshape(-1, 3), shape.faces)
        assert np.array_equal(arrays[f"{side}.match"], found.index)
        assert np.array_equal(arrays[f"{side}.confidence"], np.round(255 * found.confidence))
    color = position_colors(pair.source, view_rotations(pair.source, pair.target, pair.there)[0])
    carried = np.where(pair.back.confidence[:, None] > 0, color[pair.back.index], UNKNOWN)
    for side, expected in (("source", color), ("target", carried)):
        assert np.abs(arrays[f"{side}.color"].reshape(-1, 3) / 255 - expected).max() < 0.6 / 255


def test_positions_are_exact_to_sixteen_bits_in_one_scale(page: Page, pair: Pair) -> None:
    """The target is the source turned and three times as large: on the page they are the same."""
    arrays, words = page.arrays, page.words
    own, other = ((arrays[f"{side}.position"].reshape(-1, 3) / 65535 - 0.5) for side in ("source", "target"))
    edge = np.ptp(pair.source.verts, axis=0).max()
    middle = pair.source.bounds.mean(axis=0)
    turn = view_rotations(pair.source, pair.target, pair.there)[0]
    assert np.abs(own - (pair.source.verts - middle) @ turn.T / edge).max() < 0.6 / 65535
    assert words["source"]["size"] == words["target"]["size"] == 1.0
    assert np.abs(own - other[pair.there.index]).max() < 1.1 / 65535


def test_a_match_is_where_the_other_shape_has_it(page: Page, pair: Pair) -> None:
    arrays = page.arrays
    for side, other, found in (("source", "target", pair.there), ("target", "source", pair.back)):
        place = arrays[f"{side}.place"].reshape(-1, 3)
        assert np.array_equal(place, arrays[f"{other}.position"].reshape(-1, 3)[found.index])


def test_a_match_inside_a_triangle_is_there(tmp_path: Path, cube: Shape) -> None:
    one = Shape(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]]), "one")
    weights = np.array([[0.5, 0.25, 0.25], [1, 0, 0], [1, 0, 0]])
    face = np.array([4, -1, -1])
    there = VertexMap.between(one, cube, [cube.faces[4, 0], 2, 3], face=face, barycentric=weights)
    back = VertexMap.between(cube, one, np.zeros(8, np.int64))
    arrays = page_of(tmp_path / "page.html", Pair(one, cube, there, back)).arrays
    corners = arrays["target.position"].reshape(-1, 3)[cube.faces[4]]
    assert np.abs(arrays["source.place"].reshape(-1, 3)[0] - weights[0] @ corners).max() < 1


def test_the_same_input_gives_the_same_bytes(tmp_path: Path, page: Page, pair: Pair) -> None:
    assert page_of(tmp_path / "b.htm", pair).text == page.text


def test_nothing_is_loaded_from_elsewhere(page: Page) -> None:
    for tag, attrs, _ in page.elements:
        assert not {"src", "srcset", "action", "formaction", "background", "poster"} & set(attrs), tag
        assert attrs.get("href", "data:,") == "data:,"
    styles = "".join(text for _, text in page.all("style"))
    assert "url(" not in styles
    assert "@import" not in styles
    assert set(re.findall(r"https?://[^\s\"'`)<]+", page.text)) == {"http://www.w3.org/1999/xhtml"}  # a name


def test_the_policy_knows_every_script_and_forbids_the_rest(page: Page) -> None:
    (policy,) = (
        attrs["content"] for attrs, _ in page.all("meta") if attrs.get("http-equiv") == "Content-Security-Policy"
    )
    rules = {rule.split()[0]: rule.split()[1:] for rule in str(policy).split(";")}
    assert rules["default-src"] == rules["base-uri"] == rules["form-action"] == ["'none'"]
    assert rules["img-src"] == ["data:"]
    assert not any("unsafe" in word or "http" in word for rule in rules.values() for word in rule)
    programs = [text for attrs, text in page.all("script") if "type" not in attrs]
    assert rules["script-src"] == [sha256(text) for text in programs]
    assert rules["style-src"] == [sha256(text) for _, text in page.all("style")]
    assert not any(name.startswith("on") or name == "style" for _, attrs, _ in page.elements for name in attrs)


def sha256(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def test_the_scripts_that_ship_cannot_end_their_element() -> None:
    from meshmatch.render.viewer import page

    scripts = sorted(Path(page.__file__).parent.glob("*.js"))
    assert {f"{name}.js" for name in (*page.SCRIPTS, "three.min")} <= {path.name for path in scripts}
    for path in scripts:
        text = path.read_text(encoding="utf-8")
        for forbidden in ("</script", "<script", "<!--", "innerHTML", "eval(", "new Function", "document.write"):
            assert forbidden not in text, (path.name, forbidden)


def test_names_cannot_break_out(tmp_path: Path, page: Page, pair: Pair) -> None:
    there = VertexMap.between(pair.source, pair.target, pair.there.index, verdict="poor", reasons=(f"{HOSTILE}: far",))
    hostile = Pair(pair.source, pair.target, there, pair.back)
    broken = page_of(tmp_path / "page.html", hostile, names=(HOSTILE, "<!--title-->"))
    assert [tag for tag, *_ in broken.elements] == [tag for tag, *_ in page.elements]
    shown = HOSTILE.replace("\u2028", "\ufffd").replace("\u202e", "\ufffd")  # which end lines and turn words round
    assert broken.words["source"]["name"] == shown
    assert broken.words["target"]["name"] == "<!--title-->"
    assert broken.words["reasons"] == [f"{shown}: far"]
    ((_, title),) = broken.all("title")
    assert title == f"{shown} → <!--title-->"
    assert "alert(1)</script" not in broken.text


def test_a_name_that_is_no_text_is_shown_as_far_as_it_goes(tmp_path: Path, pair: Pair) -> None:
    broken = b"caf\xe9.ply".decode("utf-8", "surrogateescape")
    page = page_of(tmp_path / "page.html", pair, names=(broken, "\u05e9\n\u2066\x9b.ply"))
    assert page.words["source"]["name"] == "caf?.ply"
    assert page.words["target"]["name"] == "\u05e9\ufffd\ufffd\ufffd.ply"


def test_clouds_are_points_with_a_size(tmp_path: Path, pair: Pair) -> None:
    cloud = Shape(pair.source.verts, np.empty((0, 3), np.int64), "cloud.xyz")
    there = VertexMap.between(cloud, pair.target, pair.there.index)
    back = VertexMap.between(pair.target, cloud, pair.back.index)
    page = page_of(tmp_path / "page.html", Pair(cloud, pair.target, there, back))
    assert page.words["source"]["cloud"]
    assert not page.words["target"]["cloud"]
    assert 0 < page.words["source"]["radius"] < 0.2
    assert len(page.arrays["source.face"]) == 0
    normals = page.arrays["source.normal"].reshape(-1, 3) / 127
    assert np.allclose(np.linalg.norm(normals, axis=1), 1.0, atol=0.02)


def test_a_vertex_without_a_position_is_not_drawn(tmp_path: Path, cube: Shape) -> None:
    invalid = np.zeros(8, bool)
    invalid[3] = True
    broken = Shape(cube.verts, cube.faces, "broken", None, invalid)
    arrays = page_of(
        tmp_path / "page.html",
        Pair(broken, cube, VertexMap.between(broken, cube, range(8)), VertexMap.between(cube, broken, range(8))),
    ).arrays
    assert 3 not in arrays["source.face"]
    assert len(arrays["source.face"]) == 3 * (~(cube.faces == 3).any(axis=1)).sum()
    cloud = Shape(cube.verts, np.empty((0, 3), np.int64), "cloud", None, invalid)
    assert draw(cloud).vertex.tolist() == [0, 1, 2, 4, 5, 6, 7]
    nothing = Shape(cube.verts, cube.faces, "nothing", None, np.ones(8, bool))
    assert len(draw(nothing).vertex) == 8


def test_a_large_mesh_is_drawn_coarser_and_says_so(
    tmp_path: Path, make_sphere: Callable[[int], Shape], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("meshmatch.render.viewer.page.MAX_VERTICES", 900)
    fine = shuffled_pair(bump(make_sphere(4)))
    path = tmp_path / "page.html"
    report = write_page(path, fine.source, fine.target, fine.there, fine.back)
    assert all(200 < drawn <= 900 for drawn in report.drawn)
    assert report.size == path.stat().st_size
    assert report.notes[0] == f"egg.ply: drawn with {report.drawn[0]:,} of 2,562 vertices"
    page = read(path)
    assert page.words["target"]["note"] == f"drawn with {report.drawn[1]:,} of 2,562 vertices"
    rows = page.arrays["source.vertex"].astype(int)
    assert np.array_equal(page.arrays["source.match"], fine.there.index[rows])
    # each stands for a vertex close by, and its match is the exact one of that vertex
    position = page.arrays["source.position"].reshape(-1, 3) / 65535
    own = fine.source.verts @ view_rotations(fine.source, fine.target, fine.there)[0].T
    scaled = (own - own.min(axis=0)) / np.ptp(own, axis=0).max()
    gap = position - position.min(axis=0) - scaled[rows]
    assert np.linalg.norm(gap - np.median(gap, axis=0), axis=1).max() < 0.06


def test_a_large_cloud_is_drawn_with_fewer_points(make_sphere: Callable[[int], Shape]) -> None:
    cloud = Shape(make_sphere(4).verts, np.empty((0, 3), np.int64), "cloud")
    part = draw(cloud, most=900)
    assert len(part.vertex) == 600
    assert np.array_equal(part.verts, cloud.verts[part.vertex])
    assert len(np.unique(part.vertex)) == 600
    assert part.note == "drawn with 600 of 2,562 points"


def test_a_heap_of_single_triangles_is_drawn_as_points() -> None:
    rng = np.random.default_rng(0)
    corners = rng.normal(size=(400, 1, 3)) + 0.01 * rng.normal(size=(400, 3, 3))
    part = draw(Shape(corners.reshape(-1, 3), np.arange(1200).reshape(-1, 3), "heap"), most=300)
    assert len(part.faces) == 0
    assert part.note == "drawn with 200 of 1,200 points"


def test_seams_do_not_show_in_the_light(make_sphere: Callable[[int], Shape]) -> None:
    """Every corner of each triangle its own vertex, as in an stl: lit like the sphere that it is."""
    ball = make_sphere(3)
    loose = Shape(ball.verts[ball.faces].reshape(-1, 3), np.arange(3 * ball.F).reshape(-1, 3), "loose")
    part = draw(loose)
    assert np.array_equal(part.verts, loose.verts)
    assert np.einsum("ni,ni->n", part.normals, loose.verts).min() > 0.99


def test_a_target_lies_as_the_source_where_only_the_map_tells(pair: Pair) -> None:
    own, other = view_rotations(pair.source, pair.target, pair.there)
    a, b = pair.source.verts @ own.T, pair.target.verts[pair.there.index] @ other.T
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    assert np.allclose(3 * a, b)
    far = about(0, 0.9) @ about(1, 0.7)  # a file with no axis up
    away = Shape(pair.source.verts @ far.T, pair.source.faces, "away")
    there = VertexMap.between(pair.source, away, np.arange(away.V))
    assert np.allclose(view_rotations(pair.source, away, there)[1] @ far, own, atol=1e-6)
    poor = VertexMap.between(pair.source, away, np.arange(away.V), verdict="poor")
    assert np.array_equal(view_rotations(pair.source, away, poor)[1], own)


def about(axis: int, angle: float) -> np.ndarray:
    """Rotation about one of the axes."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    turn = np.eye(3)
    turn[i, i] = turn[j, j] = np.cos(angle)
    turn[j, i], turn[i, j] = np.sin(angle), -np.sin(angle)
    return turn


def test_a_fit_that_leans_is_levelled_where_the_shape_stands(make_sphere: Callable[[int], Shape]) -> None:
    ball = make_sphere(4)
    foot = np.array([-9, -2.2, -9])  # flat below
    tower = Shape(np.maximum(ball.verts * np.array([0.6, 3.0, 0.6]), foot), ball.faces, "tower")
    heading = about(1, 0.6)
    assert np.allclose(rotation_like(tower, tower.verts, tower.verts @ (about(0, 0.4) @ heading).T), heading)


def test_given_rotations_are_kept(pair: Pair) -> None:
    turn = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
    own, other = view_rotations(pair.source, pair.target, pair.there, (turn, np.eye(3)))
    assert np.array_equal(own, turn)
    assert np.array_equal(other, np.eye(3))


def test_sizes_are_compared_by_the_map(pair: Pair, cube: Shape) -> None:
    assert relative_size(pair.source, pair.target, pair.there) == pytest.approx(3.0)
    cloud = Shape(pair.source.verts, np.empty((0, 3), np.int64), "cloud")
    there = VertexMap.between(cloud, pair.target, pair.there.index)
    assert relative_size(cloud, pair.target, there) == pytest.approx(3.0, rel=1e-3)
    assert relative_size(cube, cube, VertexMap.between(cube, cube, np.zeros(8, np.int64))) == 1.0


def test_half_a_shape_is_drawn_in_the_scale_of_the_whole(tmp_path: Path, pair: Pair) -> None:
    upper = pair.target.verts[:, 2] > np.median(pair.target.verts[:, 2])
    kept = np.flatnonzero(upper)
    new = np.full(pair.target.V, -1)
    new[kept] = np.arange(len(kept))
    faces = new[pair.target.faces]
    half = Shape(pair.target.verts[kept], faces[(faces >= 0).all(axis=1)], "half")
    back = VertexMap.between(half, pair.source, pair.back.index[kept])
    near = np.linalg.norm(pair.target.verts[pair.there.index][:, None] - half.verts[None], axis=2).argmin(axis=1)
    there = VertexMap.between(pair.source, half, near, confidence=upper[pair.there.index].astype(np.float32))
    words = page_of(tmp_path / "page.html", Pair(pair.source, half, there, back)).words
    assert words["source"]["size"] == 1.0
    expected = np.ptp(half.verts, axis=0).max() / 3 / np.ptp(pair.source.verts, axis=0).max()
    assert words["target"]["size"] == pytest.approx(expected, rel=0.02)


def test_the_scale_of_a_poor_map_is_not_believed(tmp_path: Path, pair: Pair) -> None:
    wrong = np.zeros(pair.source.V, np.int64)
    wrong[::2] = pair.there.index[::2]  # every other vertex on one spot: all edges far too long
    for verdict, size in (("poor", 1.0), ("fair", None)):
        there = VertexMap.between(pair.source, pair.target, wrong, verdict=verdict)
        words = page_of(tmp_path / "page.html", Pair(pair.source, pair.target, there, pair.back)).words
        assert (words["target"]["size"] == size) == (verdict == "poor")


def image(height: int = 8, width: int = 16) -> np.ndarray:
    pixels = np.zeros((height, width, 4), np.uint8)
    pixels[..., 0] = np.linspace(0, 255, width)
    pixels[..., 1] = np.linspace(0, 255, height)[:, None]
    pixels[..., 3] = 255
    return pixels


def look_of(shape: Shape, pixels: np.ndarray | None, **material: Any) -> Appearance:
    """Half the faces wear an image by x and z, the others one color."""
    low = shape.bounds[0]
    uv = ((shape.verts - low) / np.ptp(shape.verts, axis=0))[:, [0, 2]][shape.faces]
    which = (np.arange(shape.F) % 2).astype(np.int64)
    return Appearance((Material("image", pixels, **material), Material("red", factor=(1.0, 0, 0, 1))), which, uv)


def worn_page(folder: Path, shape: Shape, look: Appearance, side: Literal["source", "target"] = "source") -> Page:
    """Of a shape that is both source and target, with one look."""
    return page_of(folder / "page.html", identical_pair(shape), looks=Looks(side, (look, look)))


def test_a_texture_keeps_its_corners_and_its_image(tmp_path: Path, cube: Shape) -> None:
    look = look_of(cube, image(), wrap=("clamp", "mirror"), nearest=True, alpha="mask", cutoff=0.25)
    page = page_of(tmp_path / "page.html", identical_pair(cube), looks=Looks("source", (look, look), look))
    words, arrays = page.words, page.arrays
    assert (words["look"], words["own"]) == ({"kind": "texture", "side": "source"}, True)
    skin = words["source"]["look"]
    textured, red = skin["groups"]
    assert textured == {
        **{"start": 0, "count": 18, "image": 0, "factor": [1.0, 1.0, 1.0, 1.0], "wrap": ["clamp", "mirror"]},
        **{"nearest": True, "alpha": "mask", "cutoff": 0.25},
    }
    assert (red["start"], red["count"], red["image"], red["factor"]) == (18, 18, None, [1.0, 0.0, 0.0, 1.0])
    corners = arrays["source.look.face"].astype(int)
    order = np.argsort(look.material, kind="stable")
    assert np.array_equal(arrays["source.look.vertex"][corners].reshape(-1, 3), cube.faces[order])
    assert np.allclose(arrays["source.look.uv"].reshape(-1, 2)[corners].reshape(-1, 3, 2), look.uv[order])
    assert arrays["source.look.image0"].tobytes().startswith(b"\x89PNG")
    assert np.array_equal(arrays["target.own.image0"], arrays["source.look.image0"])


def test_large_images_become_smaller(tmp_path: Path, cube: Shape, monkeypatch: pytest.MonkeyPatch) -> None:
    look = look_of(cube, image(2400, 1200))
    page = worn_page(tmp_path, cube, look)
    data = page.arrays["source.look.image0"].tobytes()
    assert page.words["source"]["look"]["images"] == ["image/jpeg"]
    with Image.open(BytesIO(data)) as picture:
        assert (picture.format, picture.size) == ("JPEG", (1024, 2048))
    monkeypatch.setattr("meshmatch.render.viewer.looks.MAX_PIXELS", 512 * 1024)
    page = worn_page(tmp_path, cube, look)
    with Image.open(BytesIO(page.arrays["source.look.image0"].tobytes())) as picture:
        assert picture.size == (512, 1024)


def test_alpha_is_kept_where_it_counts(tmp_path: Path, cube: Shape) -> None:
    pixels = image(300, 300)
    pixels[:150, :, 3] = 0
    for alpha, kind, mode in (("opaque", "image/jpeg", "RGB"), ("blend", "image/png", "RGBA")):
        look = look_of(cube, pixels, alpha=alpha)
        page = worn_page(tmp_path, cube, look, "target")
        assert page.words["source"]["look"]["images"] == [kind]
        with Image.open(BytesIO(page.arrays["source.look.image0"].tobytes())) as picture:
            assert picture.mode == mode
    assert page.words["look"] == {"kind": "texture", "side": "target"}
    assert not page.words["own"]


def test_vertex_colors_are_painted(tmp_path: Path, cube: Shape) -> None:
    light = np.linspace(0, 1, 32).reshape(8, 4)
    look = Appearance((Material(),), np.zeros(12, np.int64), np.zeros((12, 3, 2)), light)
    page = worn_page(tmp_path, cube, look)
    assert page.words["look"] == {"kind": "colors", "side": "source"}
    assert page.words["source"]["look"] is None
    paint = page.arrays["source.look.paint"].reshape(8, 3) / 255
    linear = np.where(paint <= 0.04045, paint / 12.92, ((paint + 0.055) / 1.055) ** 2.4)
    assert np.abs(linear - light[:, :3]).max() < 0.01


def test_a_texture_on_a_coarser_mesh_is_painted(
    tmp_path: Path, make_sphere: Callable[[int], Shape], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The image is read at each vertex: its red grows with x."""
    monkeypatch.setattr("meshmatch.render.viewer.page.MAX_VERTICES", 900)
    ball = bump(make_sphere(4))
    low, extent = ball.bounds[0], np.ptp(ball.verts, axis=0)
    uv = ((ball.verts - low) / extent)[:, [0, 2]][ball.faces]
    look = Appearance((Material("image", image(64, 64), wrap=("clamp", "clamp")),), np.zeros(ball.F, np.int64), uv)
    page = worn_page(tmp_path, ball, look)
    rows = page.arrays["source.vertex"].astype(int)
    expected = ((ball.verts[rows] - low) / extent)[:, 0]
    assert np.abs(page.arrays["source.look.paint"].reshape(-1, 3)[:, 0] / 255 - expected).max() < 0.03


@pytest.mark.parametrize(("wrap", "expected"), [("repeat", 0.25), ("mirror", 0.75), ("clamp", 1.0)])
def test_coordinates_outside_the_image_are_wrapped(cube: Shape, wrap: str, expected: float) -> None:
    uv = np.full((12, 3, 2), 1.25)
    look = Appearance((Material("i", image(4, 256), wrap=(wrap, wrap)),), np.zeros(12, np.int64), uv)
    points = draw(Shape(cube.verts, None))  # nothing that could wear the image itself
    paint, _ = look_arrays(look, cube, points)
    assert np.allclose(paint["paint"][:, 0] / 255, expected, atol=0.01)


def test_packing_is_undone_by_its_table() -> None:
    arrays = {
        "a": np.array([1, 2, 255], np.uint8),
        "b": np.array([-1.5, 3e8], np.float32),
        "c": np.empty(0, np.uint16),
        "d": np.array([70000], np.uint32),
        "e": np.array([-128, 127], np.int8),
    }
    found = unpacked(*pack(arrays))
    assert list(found) == list(arrays)
    for name, array in arrays.items():
        assert np.array_equal(found[name], array) and found[name].dtype == array.dtype
    assert small_integers(np.array([0, 65534])).dtype == np.uint16
    assert small_integers(np.array([0, 65535])).dtype == np.uint32


def test_what_cannot_be_a_page(tmp_path: Path, pair: Pair, cube: Shape) -> None:
    refused = [
        ("p.html", pair.source, cube, InputError, "another target"),
        ("p.html", cube, pair.target, InputError, "another source"),
        ("no/p.html", pair.source, pair.target, OutputError, "no folder"),
        *((name, pair.source, pair.target, OptionError, "a page is HTML") for name in ("p.png", "p", "p.xhtml")),
    ]
    for name, source, target, error, words in refused:
        with pytest.raises(error, match=words):
            write_page(tmp_path / name, source, target, pair.there, pair.back)
    assert list(tmp_path.iterdir()) == []
