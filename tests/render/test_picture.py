"""Pictures, looked at by their pixels."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from meshmatch.errors import OptionError, OutputError
from meshmatch.render import Panel, position_colors, render_shapes
from meshmatch.render.colors import to_linear, to_srgb
from meshmatch.render.picture import facing
from meshmatch.shapes import Shape

SMALL = {"size": (96, 96), "turn": 0.0, "tilt": 0.0}
RED, GREEN, BLUE = np.eye(3)


def box(extent: tuple[float, float, float], center: tuple[float, float, float] = (0, 0, 0)) -> Shape:
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 2
    faces = np.array(
        [
            *([0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]),
            *([2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]),
        ]
    )
    return Shape(corners * np.array(extent) + np.array(center), faces, "box")


def ends(shape: Shape, axis: int) -> np.ndarray:
    """Red where the axis is high, blue where it is low."""
    return np.where((shape.verts[:, axis] > shape.verts[:, axis].mean())[:, None], RED, BLUE)


def pixels(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        assert image.mode == "RGB"
        return np.asarray(image, dtype=int)


def something(picture: np.ndarray) -> np.ndarray:
    return np.asarray((picture < 250).any(axis=2))


def draw(tmp_path: Path, *panels: object, **rest: object) -> np.ndarray:
    path = tmp_path / "picture.png"
    render_shapes(list(panels), path, **{**SMALL, **rest})  # type: ignore[arg-type]
    return pixels(path)


def test_a_shape_fills_its_panel_and_nothing_else(tmp_path: Path) -> None:
    for unit in (1e-3, 1.0, 1e5):
        seen = something(draw(tmp_path, (box((0.5 * unit, unit, 0.2 * unit), (9e3 * unit, 0, 0)), None)))
        rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
        assert rows[0] == pytest.approx(4, abs=1)
        assert rows[-1] == pytest.approx(91, abs=1)
        assert columns[0] == pytest.approx(26, abs=1)
        assert columns[-1] == pytest.approx(69, abs=1)
        assert seen[rows[0] + 1 : rows[-1], columns[0] + 1 : columns[-1]].all()


def test_a_wide_shape_is_limited_by_the_width(tmp_path: Path) -> None:
    seen = something(draw(tmp_path, (box((3, 1, 1)), None), up="y", size=(120, 60)))
    columns = np.flatnonzero(seen.any(axis=0))
    assert columns[0] == pytest.approx(5, abs=1)
    assert columns[-1] == pytest.approx(114, abs=1)


@pytest.mark.parametrize("up", ["x", "y", "z", "-x", "-y", "-z", "+z", "Z"])
def test_up_is_up(tmp_path: Path, up: str) -> None:
    axis = "xyz".index(up[-1].lower())
    shape = box((1.0, 1.1, 1.2))
    picture = draw(tmp_path, (shape, ends(shape, axis)), up=up)
    above, below = picture[20, 48], picture[76, 48]
    if up.startswith("-"):
        above, below = below, above
    assert above[0] > above[2] + 60
    assert below[2] > below[0] + 60


@pytest.mark.parametrize("front", ["x", "-x", "z", "-z"])
def test_front_is_to_the_viewer_and_left_stays_left(tmp_path: Path, front: str) -> None:
    shape = box((1.0, 1.0, 1.0))
    axis, sign = "xyz".index(front[-1]), -1 if front.startswith("-") else 1
    near = (shape.verts[:, axis] * sign > 0)[:, None]
    picture = draw(tmp_path, (shape, np.where(near, RED, BLUE)), up="y", front=front)
    assert picture[48, 48, 0] > picture[48, 48, 2] + 60
    rotation = facing(shape, "y", front)
    assert np.linalg.det(rotation) == pytest.approx(1)  # no mirror
    right = (shape.verts @ rotation[0] > 0)[:, None]
    picture = draw(tmp_path, (shape, np.where(right, RED, BLUE)), up="y", front=front)
    assert picture[48, 70, 0] > picture[48, 70, 2] + 60
    assert picture[48, 25, 2] > picture[48, 25, 0] + 60


def test_up_and_front_are_guessed_from_the_extents(tmp_path: Path) -> None:
    assert np.array_equal(facing(box((0.5, 0.3, 1.8))), [[-1, 0, 0], [0, 0, 1], [0, 1, 0]])
    assert facing(box((1, 1, 1)))[1].tolist() == [0, 1, 0]
    assert facing(box((1.8, 0.5, 0.3)))[1].tolist() == [1, 0, 0]
    assert facing(box((1, 2, 3)), front="z")[1].tolist() == [0, 1, 0]
    # Turned, the picture of a lying and a standing body is the same.
    standing, lying = box((0.5, 1.8, 0.3)), box((1.8, 0.3, 0.5))
    one, other = (something(draw(tmp_path, (shape, None))) for shape in (standing, lying))
    assert np.array_equal(one, other)


def test_a_rotation_of_the_panel_comes_first(tmp_path: Path) -> None:
    shape = box((1, 1.2, 1))
    upside_down = np.diag([1.0, -1.0, -1.0])
    picture = draw(tmp_path, Panel(shape, ends(shape, 1), rotation=upside_down), up="y")
    assert picture[20, 48, 2] > picture[20, 48, 0] + 60


def test_turn_and_tilt(tmp_path: Path) -> None:
    shape = box((1, 1, 1))
    picture = draw(tmp_path, (shape, ends(shape, 1)), up="y", front="z", tilt=80.0)
    assert picture[48, 48, 0] > 2 * picture[48, 48, 2]  # from above, the lid
    left = np.where((shape.verts[:, 0] < 0)[:, None], RED, BLUE)  # x to the viewer's right
    picture = draw(tmp_path, (shape, left), up="y", front="z", turn=89.0)
    assert picture[48, 48, 0] > 2 * picture[48, 48, 2]  # turned to its own left it shows its right side


def test_what_is_nearer_hides_what_is_behind(tmp_path: Path) -> None:
    a, b = box((1, 1, 0.1), (0, 0, 1)), box((2, 2, 0.1), (0, 0, 0))
    both = Shape(np.concatenate([a.verts, b.verts]), np.concatenate([a.faces, b.faces + 8]))
    colors = np.repeat([RED, BLUE], 8, axis=0)
    picture = draw(tmp_path, (both, colors), up="y", front="z")
    assert picture[48, 48, 0] > 100 > picture[48, 48, 2]
    assert picture[10, 85, 2] > 100 > picture[10, 85, 0]
    picture = draw(tmp_path, (both, colors), up="y", front="-z")
    assert picture[48, 48, 2] > 100 > picture[48, 48, 0]


def test_colors_are_interpolated_and_alpha_ignored(tmp_path: Path) -> None:
    shape = box((1, 1, 1))
    colors = np.where((shape.verts[:, 1] > 0)[:, None], [0.9, 0.9, 0.9], [0.1, 0.1, 0.1])
    picture = draw(tmp_path, (shape, colors), up="y", front="z")
    column = picture[10:86, 48, 0]
    assert (np.diff(column) <= 2).all()
    assert column[0] - column[-1] > 100
    rgba = np.concatenate([colors, np.zeros((8, 1))], axis=1)
    assert np.array_equal(draw(tmp_path, (shape, rgba), up="y", front="z"), picture)
    assert np.array_equal(
        draw(tmp_path, (Shape(shape.verts, shape.faces, "", rgba), None), up="y", front="z"), picture
    )


def test_edges_are_antialiased(tmp_path: Path) -> None:
    triangle = Shape(np.array([[0, 0, 0], [1, 0, 0], [0.3, 1.5, 0]]), np.array([[0, 1, 2]]))
    inside = draw(tmp_path, (triangle, None), front="z", samples=1)
    soft = draw(tmp_path, (triangle, None), front="z", samples=3)
    body = int(np.median(soft[something(soft)][:, 0]))
    between = [((p[:, :, 0] > body + 15) & (p[:, :, 0] < 240)).sum() for p in (inside, soft)]
    assert between[0] == 0
    assert between[1] > 60


def test_a_hollow_is_darker_than_a_hill(tmp_path: Path) -> None:
    y, x = np.mgrid[-1:1:41j, -1:1:41j]
    faces = []
    for r in range(40):
        for c in range(40):
            k = r * 41 + c
            faces += [[k, k + 1, k + 42], [k, k + 42, k + 41]]
    centre = []
    for sign in (1, -1):
        z = sign * 0.9 * np.exp(-12 * (x**2 + y**2))
        sheet = Shape(np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1), np.array(faces))
        centre.append(draw(tmp_path, (sheet, None), up="y", front="z")[46:51, 46:51].mean())
    assert centre[0] - centre[1] > 20


def test_a_cloud_and_points_are_balls(tmp_path: Path) -> None:
    cloud = Shape(box((1, 1, 0.5)).verts, np.zeros((0, 3), int), "dots")
    seen = something(draw(tmp_path, (cloud, np.tile(GREEN, (8, 1))), up="y", front="z"))
    assert 4 * 4 < seen.sum() < 4 * 60
    shape = box((1, 1, 1))
    panel = Panel(shape, np.tile(BLUE, (8, 1)), points=[[0, 0, 0.5]], point_colors=[RED], point_radius=0.2)
    picture = draw(tmp_path, panel, up="y", front="z")
    red = picture[:, :, 0] > picture[:, :, 2] + 40
    assert red.sum() == pytest.approx(np.pi * (0.2 * 88) ** 2, rel=0.12)
    assert np.argwhere(red).mean(axis=0) == pytest.approx([47.5, 47.5], abs=1)


def test_a_large_cloud_is_thinned_not_cut(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("meshmatch.render.picture._MOST_BALLS", 400)
    points = np.random.default_rng(0).random((1_500, 3))
    cloud = Shape(points[np.argsort(points[:, 1])], np.zeros((0, 3), int))
    seen = something(draw(tmp_path, (cloud, None), up="y", front="z"))
    assert all(seen[rows, 10:86].mean() > 0.3 for rows in (slice(10, 30), slice(30, 60), slice(60, 86)))


def test_a_vertex_without_a_position_is_not_drawn(tmp_path: Path) -> None:
    shape = box((1, 1, 1))
    verts = np.concatenate([shape.verts, [[50.0, 0, 0]]])
    faces = np.concatenate([shape.faces, [[0, 1, 8]]])
    broken = Shape(verts, faces, invalid=np.arange(9) == 8)
    assert np.array_equal(
        something(draw(tmp_path, (broken, None), up="y", front="z")),
        something(draw(tmp_path, (shape, None), up="y", front="z")),
    )
    dots = Shape(verts, np.zeros((0, 3), int), invalid=np.arange(9) == 8)
    assert np.array_equal(
        something(draw(tmp_path, (dots, None), up="y", front="z")),
        something(draw(tmp_path, (Shape(shape.verts, np.zeros((0, 3), int)), None), up="y", front="z")),
    )


def test_panels_stand_side_by_side_with_their_captions(tmp_path: Path) -> None:
    shape = box((1, 1, 1))
    bare = draw(tmp_path, (shape, None), (shape, None), size=(80, 64))
    assert bare.shape == (64, 160, 3)
    assert np.array_equal(bare[:, :80], bare[:, 80:])
    named = draw(tmp_path, (shape, None), Panel(shape, label="hidden"), size=(80, 64), labels=["a", ""])
    assert named.shape[0] > 64
    assert np.array_equal(named[:64], bare)
    strip = something(named[64:])
    assert strip[:, :80].any()
    assert not strip[:, 80:].any()
    long = draw(tmp_path, Panel(shape, label="a caption that is much too long for it"), size=(200, 160))
    columns = np.flatnonzero(something(long[160:]).any(axis=0))
    assert columns[0] >= 2
    assert columns[-1] <= 197


def test_the_same_picture_twice(tmp_path: Path) -> None:
    for name in ("one", "two"):
        render_shapes([(box((1, 2, 1)), None)], tmp_path / f"{name}.png", size=(64, 64))
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "two.png").read_bytes()


def test_refusals(tmp_path: Path) -> None:
    shape = box((1, 1, 1))
    path = tmp_path / "a.png"
    for panels, where, rest, message in (
        ([(shape, None)], tmp_path / "a.jpg", {}, "PNG"),
        ([], path, {}, "needs a shape"),
        ([(shape, None)], path, {"labels": ["a", "b"]}, "1 labels"),
        ([(shape, None)], path, {"up": "w"}, "up is no axis"),
        ([(shape, None)], path, {"front": "up"}, "front is no axis"),
        ([(shape, None)], path, {"up": "y", "front": "-y"}, "the same axis"),
        ([(shape, np.ones((7, 3)))], path, {}, r"\(8, 3\)"),
        ([Panel(shape, points=[[0, 0, 0]], point_colors=np.ones((2, 3)))], path, {}, r"\(1, 3\)"),
        ([(shape, None)], path, {"size": (5, 5)}, "16 x 16"),
        ([(shape, None)], path, {"samples": 0}, "16 x 16"),
    ):
        with pytest.raises(OptionError, match=message):
            render_shapes(panels, where, **rest)  # type: ignore[arg-type]
    with pytest.raises(OutputError, match="no folder"):
        render_shapes([(shape, None)], tmp_path / "deeper" / "a.png", size=(16, 16))
    assert not list(tmp_path.iterdir())


def test_position_colors_span_the_extent_and_follow_a_rotation() -> None:
    shape = box((1, 2, 3), (7, 8, 9))
    colors = position_colors(shape)
    assert colors.shape == (8, 3)
    assert colors.min() >= 0
    assert colors.max() <= 1
    assert np.array_equal(np.unique(colors, axis=0), np.unique(colors[::-1], axis=0))
    assert len(np.unique(colors, axis=0)) == 8
    turned = position_colors(shape, np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0]]))
    assert turned == pytest.approx(colors[:, [1, 2, 0]])
    flat = Shape(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]]), np.array([[0, 1, 2]]))
    assert np.isfinite(position_colors(flat)).all()


def test_light_and_its_written_form_are_inverse() -> None:
    values = np.linspace(0, 1, 101)
    assert to_srgb(to_linear(values)) == pytest.approx(values)
    assert to_linear(np.array([0.5]))[0] == pytest.approx(0.21404, abs=1e-5)
