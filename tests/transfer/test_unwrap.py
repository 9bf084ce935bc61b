"""Atlases: the file's own texture coordinates where they serve, else new ones."""

import numpy as np
import pytest

from meshmatch.errors import InputError, OptionError
from meshmatch.geometry.triangles import face_parts
from meshmatch.shapes.shape import Shape
from meshmatch.transfer import unwrap
from meshmatch.transfer.flat_layout import weld
from meshmatch.transfer.texels import draw_triangles, grow
from meshmatch.transfer.unwrap import atlas_of, tiles_of, unwrapped
from tests.conftest import icosphere
from tests.shapes.painted import CORNERS, FACES, UV

SQUARE = Shape(CORNERS, FACES, "square")
OWN = UV[FACES]


def charts(uv: np.ndarray, shape: Shape) -> np.ndarray:
    """(F,) a number for each piece of an atlas: faces that share a corner and its coordinates."""
    keys = np.concatenate([shape.faces.reshape(-1, 1), uv.reshape(-1, 2).round(6)], axis=1)
    corner = np.unique(keys, axis=0, return_inverse=True)[1].reshape(-1)
    return face_parts(corner.reshape(-1, 3), int(corner.max()) + 1)


@pytest.mark.parametrize(("name", "padding"), [("cube", 2), ("torus", 8)])
def test_new_coordinates_are_an_atlas(request: pytest.FixtureRequest, name: str, padding: int) -> None:
    """Also the same one each time."""
    shape: Shape = request.getfixturevalue(name)
    uv = unwrapped(shape, 256, padding)
    np.testing.assert_array_equal(unwrapped(shape, 256, padding), uv)
    assert uv.shape == (shape.F, 3, 2)
    assert uv.min() >= 0 and uv.max() <= 1
    found, twice = draw_triangles(uv * 256, 256)
    assert twice == 0
    number = charts(uv, shape)
    assert 1 < len(np.unique(number)) < shape.F
    image = np.where(found >= 0, number[found], -1).astype(np.int32)
    # from both sides, half of the padding may be walked without meeting
    for chart in np.unique(number):
        own, others = image == chart, (image >= 0) & (image != chart)
        found = np.where(own, 0, -1).astype(np.int32)
        grow(found, padding - 1)
        reach = found >= 0
        assert not (reach & others).any()


def test_faces_get_room_by_their_area(sphere: Shape) -> None:
    uv = unwrapped(sphere, 512, 4)
    one, two = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    room = np.abs(one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]) / 2
    ratio = room / sphere.face_areas
    assert ratio.max() / ratio.min() < 3
    assert room.sum() > 0.3


def test_faces_without_area_are_left_out(cube: Shape) -> None:
    faces = np.concatenate([cube.faces, [[0, 0, 1], [2, 2, 2]]])
    uv = unwrapped(Shape(cube.verts, faces), 64, 1)
    assert (uv[12:] == 0).all()
    assert (uv[:12].reshape(12, -1).max(axis=1) > 0).all()


def test_vertices_of_their_own_do_not_part_faces(torus: Shape) -> None:
    """As flat shading, old seams and stl files give them; nor do slivers between vertices at one place."""
    few = len(np.unique(charts(unwrapped(torus, 256, 2), torus)))
    loose = Shape(torus.verts[torus.faces].reshape(-1, 3), np.arange(3 * torus.F).reshape(-1, 3))
    uv = unwrapped(loose, 256, 2)
    assert len(np.unique(charts(uv, torus))) <= few + 2
    assert draw_triangles(uv * 256, 256)[1] == 0
    new, (a, b, c) = torus.V, torus.faces[0]
    verts = np.concatenate([torus.verts, torus.verts[[a]] + 1e-13])
    split = Shape(verts, np.concatenate([[[new, b, c]], torus.faces[1:], [[b, new, a], [new, c, a]]]))
    uv = unwrapped(split, 256, 2)
    assert not uv[torus.F :].any() and len(np.unique(charts(uv, split)[: torus.F])) <= few + 2


def test_ends_of_open_edges_at_one_place_are_one_vertex() -> None:
    """And those of edges without length; but not where more than two sheets meet."""
    corners = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0), (1, 1, 1e-12), (2, 0, 0), (0, 0, 1)]
    verts = np.array([corners[k] for k in (0, 1, 2, 1, 2, 3, 4, 5, 1, 2, 6)], float)
    faces = np.array([[0, 1, 2], [3, 5, 4], [3, 6, 5], [3, 7, 6]])
    np.testing.assert_array_equal(weld(verts, faces), [[0, 1, 2], [1, 5, 2], [1, 5, 5], [1, 7, 5]])
    three = np.array([[0, 1, 2], [3, 5, 4], [8, 10, 9]])
    np.testing.assert_array_equal(weld(verts, three), three)


def test_size_and_place_of_a_shape_do_not_matter(cube: Shape) -> None:
    moved = Shape(cube.verts * 1e-4 + 1e3, cube.faces)
    np.testing.assert_allclose(unwrapped(moved, 64, 1), unwrapped(cube, 64, 1), atol=1e-3)


def test_own_coordinates_are_kept_as_they_are() -> None:
    for keep in ("auto", "keep"):
        atlas = atlas_of(SQUARE, OWN, 64, 2, keep)  # type: ignore[arg-type]
        assert atlas.own and not atlas.note
        np.testing.assert_array_equal(atlas.uv, OWN)
    assert not atlas_of(SQUARE, OWN, 64, 2, "new").own
    assert not atlas_of(SQUARE, None, 64, 2).own


def test_another_tile_of_the_image_is_the_same_place() -> None:
    tile = OWN + np.array([3.0, -2.0])
    tile[1] += (1.0, 5.0)
    atlas = atlas_of(SQUARE, tile, 64, 2)
    assert atlas.own
    np.testing.assert_allclose(atlas.uv, OWN, atol=1e-12)


def test_a_few_texels_that_are_shared_are_told() -> None:
    """The second triangle lies a little over the first."""
    uv = 0.1 + 0.8 * OWN
    uv[1] += (0.004, 0.004)
    atlas = atlas_of(SQUARE, uv, 512, 2)
    assert atlas.own and "of their texels, each of which shows only one of two places" in atlas.note
    assert atlas.shared == 0.0
    uv[1] += (0.02, 0.02)
    assert 0.01 < atlas_of(SQUARE, uv, 512, 2).shared < 0.1


def test_places_that_share_a_place_are_counted() -> None:
    """Whether they look alike is asked later."""
    atlas = atlas_of(SQUARE, np.stack([OWN[0], OWN[0]]), 64, 2, "keep")
    assert atlas.own and atlas.shared == 1.0


@pytest.mark.parametrize(
    ("uv", "word"),
    [
        (OWN * 2.0, "reach out of range, over the edge of the image"),
        (OWN + 0.5, "reach out of range"),
        (OWN * 0.01, "use only 0.0 % of the image"),
        (np.stack([OWN[0], np.zeros((3, 2))]), "50 % of the surface has no room"),
        (np.where(np.arange(6).reshape(2, 3, 1) == 4, np.nan, OWN), "not numbers"),
        (OWN * 1e7, "absurdly large"),
    ],
)
def test_own_coordinates_that_are_no_atlas(uv: np.ndarray, word: str) -> None:
    with pytest.raises(OptionError, match=f"cannot be used: .*{word}") as caught:
        atlas_of(SQUARE, uv, 64, 2, "keep")
    assert "--uv keep" in caught.value.hint


def test_new_ones_are_made_where_the_files_own_are_no_atlas() -> None:
    atlas = atlas_of(SQUARE, OWN * 2.0, 64, 2)
    assert not atlas.own
    assert "reach out of range" in atlas.note and "new ones were made" in atlas.note
    assert draw_triangles(atlas.uv * 64, 64)[1] == 0


def test_many_faces_on_one_place_are_refused_before_they_are_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    shape = Shape(CORNERS, np.tile(FACES, (500, 1)), "pile")
    monkeypatch.setattr(unwrap, "draw_triangles", lambda *_: pytest.fail("they were drawn"))
    with pytest.raises(OptionError, match="overlap"):
        atlas_of(shape, np.tile(OWN, (500, 1, 1)), 64, 2, "keep")


def test_what_cannot_be_unwrapped() -> None:
    with pytest.raises(OptionError, match="point cloud"):
        atlas_of(Shape(CORNERS, np.empty((0, 3), int), "cloud"), None, 64, 2)
    with pytest.raises(InputError, match="no triangle with an area"):
        atlas_of(Shape(CORNERS, np.array([[0, 0, 1]]), "flat"), None, 64, 2)
    with pytest.raises(OptionError, match="no texture coordinates to keep"):
        atlas_of(SQUARE, None, 64, 2, "keep")


def test_a_thread_is_refused_before_it_takes_hours() -> None:
    ball = icosphere(1)
    assert np.isfinite(unwrapped(Shape(ball.verts * [1.0, 1e-6, 1e-6], ball.faces, "thin"), 64, 1)).all()
    with pytest.raises(InputError, match="as thin as a thread"):
        unwrapped(Shape(ball.verts * [1.0, 1e-12, 1e-12], ball.faces, "thread"), 64, 1)


def test_no_seam_crosses_a_polygon() -> None:
    """The quads of a rough ball, which seams of triangles would cut."""
    around, along = 24, 12
    angle, height = np.meshgrid(np.arange(around) * 2 * np.pi / around, np.linspace(-0.45, 0.45, along) * np.pi)
    rough = 1 + np.random.default_rng(0).normal(0, 0.15, angle.shape)
    verts = np.stack([np.cos(angle) * np.cos(height), np.sin(height), np.sin(angle) * np.cos(height)], -1)
    verts = (rough[..., None] * verts).reshape(-1, 3)
    k = (np.arange(along - 1)[:, None] * around + np.arange(around)).ravel()
    right = k - k % around + (k + 1) % around
    faces = np.stack([k, right, right + around, k, right + around, k + around], axis=1).reshape(-1, 3)
    shape, polygons = Shape(verts, faces, "quads"), np.repeat(np.arange(len(k)), 2)

    def cut(uv: np.ndarray) -> int:
        diagonal = uv[0::2, [0, 2]] != uv[1::2, [0, 1]]
        return int(diagonal.any(axis=(1, 2)).sum())

    assert cut(unwrapped(shape, 512, 4)) > 0
    whole = unwrapped(shape, 512, 4, polygons)
    assert cut(whole) == 0
    found, twice = draw_triangles(whole * 512, 512)
    assert twice < 0.001 * (found >= 0).sum() and len(np.unique(found)) == shape.F + 1


def in_tiles() -> tuple[Shape, np.ndarray]:
    """Two squares side by side: the first fills tile 1001, the second 1012, above it and to the right."""
    verts = np.concatenate([CORNERS, CORNERS + np.array([2.0, 0.0, 0.0])])
    faces = np.concatenate([FACES, FACES + len(CORNERS)])
    return Shape(verts, faces, "two"), np.concatenate([OWN, OWN + np.array([1.0, -1.0])])


def test_coordinates_in_tiles_get_an_image_each() -> None:
    shape, uv = in_tiles()
    first = np.arange(shape.F) < len(FACES)
    tiles = tiles_of(shape, uv, 64)
    assert tiles is not None and tiles.tolist() == np.where(first, 1001, 1012).tolist()
    atlas = atlas_of(shape, uv, 64, 2, "keep")
    assert atlas.own and "the tiles 1001, 1012" in atlas.note
    np.testing.assert_allclose(atlas.laid, uv)
    np.testing.assert_allclose(atlas.uv, np.concatenate([OWN, OWN]), atol=1e-12)
    one = atlas.of_tile(1012)
    assert one.tiles is None and (one.uv[first] == 0).all() and (one.uv[~first] == atlas.uv[~first]).all()


@pytest.mark.parametrize(
    "move", ["apart in one image", "across a border", "below all tiles", "twice in a tile", "too large"]
)
def test_what_needs_no_tiles_or_fits_in_none(move: str) -> None:
    shape, uv = in_tiles()
    second, size = np.arange(shape.F) >= len(FACES), 64
    if move == "apart in one image":
        uv = np.where(second[:, None, None], uv * 0.4 + [0.5, -0.5], uv * 0.4)
        uv[second] += [1.0 - 0.4, 0.0]
    elif move == "across a border":
        uv[second] += [0.5, 0.0]
    elif move == "below all":
        uv[second] += [0.0, 3.0]
    elif move == "twice in a tile":
        shape = Shape(
            np.concatenate([shape.verts, shape.verts + 5]), np.concatenate([shape.faces, shape.faces + shape.V])
        )
        uv = np.concatenate([uv, uv])
    else:
        size = 16_384
    assert tiles_of(shape, uv, size) is None
