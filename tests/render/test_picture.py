"""Pictures, looked at by their pixels."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from meshmatch.errors import OptionError, OutputError
from meshmatch.render import Look, Panel, position_colors, render_shapes
from meshmatch.render import picture as module
from meshmatch.render.picture import draw_apart
from meshmatch.render.scales import Scale, label_swatches
from meshmatch.shapes.appearance import vertex_colors_alone
from meshmatch.shapes.colors import label_colors, to_linear
from meshmatch.shapes.shape import Shape
from tests.conftest import icosphere

SMALL = Look(size=(96, 96), up="y", front="z", turn=0.0, tilt=0.0)
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


def draw(tmp_path: Path, *panels: object, look: Look = SMALL) -> np.ndarray:
    path = tmp_path / "picture.png"
    size = render_shapes(list(panels), path, look)  # type: ignore[arg-type]
    picture = pixels(path)
    assert picture.shape == (size[1], size[0], 3)
    return picture


def frame(seen: np.ndarray) -> list[int]:
    """First and last row, first and last column in which something is."""
    rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    return [int(rows[0]), int(rows[-1]), int(columns[0]), int(columns[-1])]


def test_a_shape_fills_its_picture_and_nothing_else(tmp_path: Path) -> None:
    for unit in (1e-3, 1e5):
        seen = something(draw(tmp_path, (box((0.5 * unit, unit, 0.2 * unit), (9e3 * unit, 0, 0)), None)))
        assert frame(seen) == pytest.approx([4, 91, 26, 69], abs=1)
        top, bottom, left, right = frame(seen)
        assert seen[top + 1 : bottom, left + 1 : right].all()
    wide = something(draw(tmp_path, (box((3, 1, 1)), None), look=replace(SMALL, size=(120, 60))))
    assert frame(wide)[2:] == pytest.approx([3, 116], abs=1)
    assert np.mean(frame(wide)[:2]) == pytest.approx(29.5, abs=1)


def redness(picture: np.ndarray, row: int, column: int) -> int:
    """How much more red than blue a pixel is."""
    return int(picture[row, column, 0] - picture[row, column, 2])


@pytest.mark.parametrize("up", ["x", "-y", "Z"])
def test_up_is_up(tmp_path: Path, up: str) -> None:
    shape, sign = box((1.0, 1.1, 1.2)), -1 if up.startswith("-") else 1
    colors = ends(shape, "xyz".index(up[-1].lower()))
    picture = draw(tmp_path, (shape, colors), look=replace(SMALL, up=up, front=None))
    assert sign * redness(picture, 20, 48) > 60 > -60 > sign * redness(picture, 76, 48)


@pytest.mark.parametrize("front", ["x", "-z"])
def test_front_is_to_the_viewer_and_left_stays_left(tmp_path: Path, front: str) -> None:
    shape = box((1.0, 1.0, 1.0))
    axis, sign = "xyz".index(front[-1]), -1 if front.startswith("-") else 1
    look = replace(SMALL, front=front)
    near = np.where((shape.verts[:, axis] * sign > 0)[:, None], RED, BLUE)
    assert redness(draw(tmp_path, (shape, near), look=look), 48, 48) > 60
    right = np.where((shape.verts @ np.cross([0, 1, 0], np.eye(3)[axis] * sign) > 0)[:, None], RED, BLUE)
    picture = draw(tmp_path, (shape, right), look=look)
    assert redness(picture, 48, 70) > 60 > -60 > redness(picture, 48, 25)


def test_a_rotation_of_the_panel_comes_first(tmp_path: Path) -> None:
    shape = box((1, 1.2, 1))
    upside_down = np.diag([1.0, -1.0, -1.0])
    picture = draw(tmp_path, Panel(shape, ends(shape, 1), rotation=upside_down))
    assert redness(picture, 20, 48) < -60


def test_turn_and_tilt(tmp_path: Path) -> None:
    shape = box((1, 1, 1))
    picture = draw(tmp_path, (shape, ends(shape, 1)), look=replace(SMALL, tilt=80.0))
    assert picture[48, 48, 0] > 2 * picture[48, 48, 2]  # from above, the lid
    left = np.where((shape.verts[:, 0] < 0)[:, None], RED, BLUE)  # x to the viewer's right
    picture = draw(tmp_path, (shape, left), look=replace(SMALL, turn=89.0))
    assert picture[48, 48, 0] > 2 * picture[48, 48, 2]  # turned to its own left it shows its right side


def test_what_is_nearer_hides_what_is_behind(tmp_path: Path) -> None:
    a, b = box((1, 1, 0.1), (0, 0, 1)), box((2, 2, 0.1), (0, 0, 0))
    both = Shape(np.concatenate([a.verts, b.verts]), np.concatenate([a.faces, b.faces + 8]))
    colors = np.repeat([RED, BLUE], 8, axis=0)
    picture = draw(tmp_path, (both, colors))
    assert picture[48, 48, 0] > 100 > picture[48, 48, 2]
    assert picture[10, 85, 2] > 100 > picture[10, 85, 0]
    picture = draw(tmp_path, (both, colors), look=replace(SMALL, front="-z"))
    assert picture[48, 48, 2] > 100 > picture[48, 48, 0]


def test_colors_are_interpolated_and_alpha_ignored(tmp_path: Path) -> None:
    shape = box((1, 1, 1))
    colors = np.where((shape.verts[:, 1] > 0)[:, None], [0.9, 0.9, 0.9], [0.1, 0.1, 0.1])
    picture = draw(tmp_path, (shape, colors))
    column = picture[10:86, 48, 0]
    assert (np.diff(column) <= 2).all()
    assert column[0] - column[-1] > 100
    rgba = np.concatenate([colors, np.zeros((8, 1))], axis=1)
    assert np.array_equal(draw(tmp_path, (shape, rgba)), picture)
    assert np.array_equal(draw(tmp_path, (Shape(shape.verts, shape.faces, "", rgba), None)), picture)


def test_sharp_colors_are_not_mixed(tmp_path: Path) -> None:
    shape = box((1, 1, 1))
    picture = draw(tmp_path, Panel(shape, ends(shape, 1), sharp=True))[8:88, 10:86]
    between = (picture[..., 0] > 60) & (picture[..., 2] > 60)
    assert between.mean() < 0.05  # the pixels of the border alone
    assert draw(tmp_path, Panel(shape, ends(shape, 1)))[48, 48, [0, 2]].min() > 60


def test_faces_have_colors_of_their_own(tmp_path: Path) -> None:
    shape = box((1, 1, 1))
    colors = np.where(np.arange(12)[:, None] == 10, RED, BLUE)
    picture = draw(tmp_path, Panel(shape, face_colors=colors))
    red = picture[..., 0] > picture[..., 2] + 40
    assert red.sum() == pytest.approx(88 * 88 / 2, rel=0.05)  # one of the two triangles in front


def test_a_square_seen_from_the_front_has_one_color(tmp_path: Path) -> None:
    square = Shape(np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]]), np.array([[0, 1, 2], [0, 2, 3]]))
    picture = draw(tmp_path, (square, np.tile([0.8, 0.4, 0.2], (4, 1))))
    inside = picture[6:90, 6:90].reshape(-1, 3)
    assert (np.ptp(inside, axis=0) <= 1).all()  # no noise, no slope
    light = to_linear(inside[0] / 255)
    assert light / light[0] == pytest.approx(to_linear(np.array([0.8, 0.4, 0.2])) / to_linear(0.8), abs=0.04)
    assert 0.6 < light[0] / to_linear(0.8) < 1.2  # about as light as it is


def test_a_large_cloud_is_thinned_not_cut(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    points = np.random.default_rng(0).random((1_500, 3))
    monkeypatch.setattr("meshmatch.render.figures.MAX_POINTS", 400)
    seen = something(draw(tmp_path, (Shape(points[np.argsort(points[:, 1])], None), None)))
    assert all(seen[rows, 10:86].mean() > 0.3 for rows in (slice(10, 30), slice(30, 60), slice(60, 86)))


def test_a_cloud_and_points_are_balls(tmp_path: Path) -> None:
    cloud = Shape(box((1, 1, 0.5)).verts, None, "dots")
    seen = something(draw(tmp_path, (cloud, np.tile(GREEN, (8, 1)))))
    assert 4 * 4 < seen.sum() < 4 * 60
    shape = box((1, 1, 1))
    panel = Panel(shape, np.tile(BLUE, (8, 1)), points=[[0, 0, 0.5]], point_colors=[RED], point_radius=0.2)
    picture = draw(tmp_path, panel)
    red = picture[:, :, 0] > picture[:, :, 2] + 40
    assert red.sum() == pytest.approx(np.pi * (0.2 * 88) ** 2, rel=0.08)
    assert np.argwhere(red).mean(axis=0) == pytest.approx([47.5, 47.5], abs=1)


def test_the_look_of_a_cloud_is_its_light(tmp_path: Path) -> None:
    """Appearance holds light, a shape's own colors are as written: a file of either kind looks the same."""
    points = box((1, 1, 0.5)).verts
    colors = np.tile([0.5, 0.25, 0.75, 1.0], (8, 1))
    cloud = Shape(points, None, "dots", colors)
    look = vertex_colors_alone(cloud)
    bare = Shape(points, None, "dots")
    assert np.abs(draw(tmp_path, Panel(bare, appearance=look)) - draw(tmp_path, (cloud, None))).max() <= 1


def test_a_dense_cloud_is_a_closed_surface(tmp_path: Path, sphere: Shape) -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(12_100, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    left = np.where(points[:, :1] < 0, RED, BLUE)
    picture = draw(tmp_path, (Shape(points, None), left))
    y, x = np.mgrid[:96, :96] - 47.5
    disc = np.hypot(x, y) < 0.9 * 43
    assert something(picture)[disc].all()
    assert (picture[disc & (x < -4)][:, 0] > picture[disc & (x < -4)][:, 2]).all()
    assert (picture[disc & (x > 4)][:, 2] > picture[disc & (x > 4)][:, 0]).all()
    assert picture[disc].max(axis=1).min() > 40  # no disc is seen from its dark side


def test_a_vertex_without_a_position_is_not_drawn(tmp_path: Path) -> None:
    shape = box((1, 1, 1))
    verts = np.concatenate([shape.verts, [[50.0, 0, 0]]])
    faces = np.concatenate([shape.faces, [[0, 1, 8]]])
    broken = Shape(verts, faces, invalid=np.arange(9) == 8)
    whole = draw(tmp_path, (shape, None))
    assert np.array_equal(something(draw(tmp_path, (broken, None))), something(whole))
    colors = np.tile(RED, (12, 1))
    assert np.array_equal(
        draw(tmp_path, Panel(broken, face_colors=[*colors, BLUE])), draw(tmp_path, Panel(shape, face_colors=colors))
    )
    dots = Shape(verts, None, invalid=np.arange(9) == 8)
    assert np.array_equal(
        something(draw(tmp_path, (dots, None))), something(draw(tmp_path, (Shape(shape.verts, None), None)))
    )


def test_what_has_no_size_is_drawn_all_the_same(tmp_path: Path) -> None:
    triangle = np.array([[0, 1, 2]])
    for shape in (
        Shape(np.zeros((1, 3)), None, "a point"),
        Shape(np.zeros((3, 3)), triangle, "all at one place"),
        Shape(np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0.0]]), triangle, "a line"),
        Shape(np.eye(3), triangle, "lost", invalid=np.ones(3, bool)),
    ):
        draw(tmp_path, (shape, None), look=Look(size=(64, 64)))


@pytest.mark.parametrize("unit", [1e-25, 1e40])
def test_a_unit_is_any_number(tmp_path: Path, unit: float, cube: Shape) -> None:
    usual = draw(tmp_path, (cube, None), look=Look(size=(64, 64)))
    shape = Shape(unit * (cube.verts + 3), cube.faces)
    assert np.abs(draw(tmp_path, (shape, None), look=Look(size=(64, 64))) - usual).max() <= 3


def test_what_lies_far_away_makes_the_rest_small_and_nothing_worse(tmp_path: Path) -> None:
    for away, seen in ((30.0, True), (1e7, False)):
        near, far = box((1, 1, 1)), box((1, 1, 1), (away, 0, 0))
        both = Shape(np.concatenate([near.verts, far.verts]), np.concatenate([near.faces, far.faces + 8]))
        assert something(draw(tmp_path, (both, None), look=Look(size=(64, 64)))).any() == seen


def test_colors_that_are_no_numbers_are_black(tmp_path: Path) -> None:
    shape = box((1, 1, 1))
    colors = np.full((8, 3), np.nan)
    assert draw(tmp_path, (shape, colors))[48, 48].max() < 40


def test_glass_shows_what_is_in_it(tmp_path: Path) -> None:
    shape = box((1, 1, 1))
    inside = Panel(shape, points=[[0, 0, 0]], point_colors=[RED], point_radius=0.2)
    solid, clear = (draw(tmp_path, replace(inside, glass=glass)) for glass in (False, True))
    assert abs(solid[48, 48, 0] - solid[48, 48, 2]) < 20
    assert clear[48, 48, 0] > clear[48, 48, 2] + 30
    assert something(clear)[10:86, 10:86].all()
    assert clear[20, 20].min() > solid[20, 20].min()  # the white paper shines through


def test_a_shape_laid_over_another_tints_it_where_it_is_in_front(tmp_path: Path) -> None:
    shape = box((1, 1, 1))
    bare = draw(tmp_path, (shape, None))
    outer, inner = box((1, 1, 1.04)), box((1, 1, 0.5))
    over, under = (draw(tmp_path, Panel(shape, over=other)) for other in (outer, inner))
    assert (over[48, 48, 2] - over[48, 48, 0]) > (bare[48, 48, 2] - bare[48, 48, 0]) + 30
    assert np.array_equal(under[10:86, 10:86], bare[10:86, 10:86])


def test_shapes_stand_in_a_row_on_one_ground_in_one_scale(tmp_path: Path) -> None:
    low, high = box((1, 0.5, 1)), box((1, 1, 1))
    seen = something(draw(tmp_path, (low, None), (high, None), look=replace(SMALL, size=(240, 100))))
    halves = [np.argwhere(half) for half in (seen[:, :120], seen[:, 120:])]
    assert halves[0].max(axis=0)[0] == halves[1].max(axis=0)[0]
    assert halves[0].min(axis=0)[0] > halves[1].min(axis=0)[0] + 10


def test_names_stay_in_the_picture(tmp_path: Path) -> None:
    panel = Panel(box((1, 1, 1)), label="a name that is much too long " * 3)
    columns = np.flatnonzero(something(draw(tmp_path, panel, look=replace(SMALL, size=(200, 200))))[-14:].any(axis=0))
    assert len(columns) > 100
    assert 2 <= columns[0] <= columns[-1] <= 197


def test_the_ground_has_a_shadow_beside_the_shape_alone(tmp_path: Path) -> None:
    look = replace(SMALL, size=(160, 120), tilt=20.0)
    with_ground = draw(tmp_path, (box((0.4, 1, 0.4)), None), look=look)
    without = draw(tmp_path, (box((0.4, 1, 0.4)), None), look=replace(look, ground=False))
    shadow = (with_ground < without - 2).any(axis=2)
    assert shadow.sum() > 150
    assert np.median(np.nonzero(shadow)[0]) > 80  # at its feet
    assert not shadow[:30].any()
    darker = without.astype(int) - with_ground
    assert np.ptp(darker[shadow], axis=1).max() <= 8  # grey
    assert (darker >= -8).all()


@pytest.mark.parametrize(
    ("background", "corner"), [("white", (255, 255, 255)), ("dark", (24, 26, 31)), ("#10A0ff", (16, 160, 255))]
)
def test_backgrounds(tmp_path: Path, background: str, corner: tuple[int, int, int]) -> None:
    shape = box((1, 1, 1))
    on_white = draw(tmp_path, (shape, None))
    picture = draw(tmp_path, (shape, None), look=replace(SMALL, background=background))
    assert tuple(picture[0, 0]) == corner
    assert np.array_equal(picture[10:86, 10:86], on_white[10:86, 10:86])


def test_without_a_background_the_alpha_is_the_coverage(tmp_path: Path) -> None:
    triangle = Shape(np.array([[0, 0, 0], [1, 0, 0], [0.3, 1.5, 0]]), np.array([[0, 1, 2]]))
    path = tmp_path / "a.png"
    render_shapes([(triangle, None)], path, replace(SMALL, background="transparent", ground=False))
    with Image.open(path) as image:
        assert image.mode == "RGBA"
        clear = np.asarray(image, dtype=float)
    height = 96 * 0.91
    area = 0.5 * height * height / 1.5
    assert clear[..., 3].sum() / 255 == pytest.approx(area, rel=4e-3)
    seen = clear[..., 3] > 100
    assert np.ptp(clear[seen][:, :3], axis=0).max() <= 3  # not darkened towards the edge
    assert (clear[clear[..., 3] == 0] == 0).all()


def test_letters_are_light_on_dark_paper(tmp_path: Path) -> None:
    shape = box((1, 1, 1))
    dark = draw(tmp_path, Panel(shape, label="nnn"), look=replace(SMALL, background="dark"))
    assert dark[-14:].max() > 180
    light = draw(tmp_path, Panel(shape, label="nnn"))
    assert light[-14:].min() < 90


def test_a_legend_stands_below(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "HEIGHT", 220)
    labels = label_swatches([0, 1], ["arm", "leg"])
    for legend, size in ((Scale(0, 1, "error (cm)"), None), (labels, (200, 220)), (labels, None)):
        picture = draw(tmp_path, (box((1, 1, 1)), None), look=replace(SMALL, size=size, legend=legend))
        strip = picture[-round(0.06 * len(picture)) - 20 :]
        assert np.ptp(strip, axis=2).max() > 60  # saturated
    colors = np.round(255 * label_colors([0, 1])).astype(int)
    assert all((picture == color).all(axis=2).sum() > 40 for color in colors)


def test_a_picture_too_small_for_its_legend_is_refused(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="no room"):
        draw(tmp_path, (box((1, 1, 1)), None), look=Look(size=(200, 40), legend=Scale(0, 1, "x")))


def test_the_same_picture_twice(tmp_path: Path) -> None:
    for name in ("one", "two"):
        render_shapes([(box((1, 2, 1)), None)], tmp_path / f"{name}.png", Look(size=(64, 64)))
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "two.png").read_bytes()


def test_refusals(tmp_path: Path) -> None:
    shape = box((1, 1, 1))
    path = tmp_path / "a.png"
    for panels, where, rest, message in (
        ([(shape, None)], tmp_path / "a.jpg", {}, "PNG"),
        ([], path, {}, "needs a shape"),
        ([(shape, None)], path, {"look": Look(up="w")}, "invalid axis 'w'"),
        ([(shape, np.ones((7, 3)))], path, {}, r"\(8, 3\)"),
        ([Panel(shape, points=[[0, 0, 0]], point_colors=np.ones((2, 3)))], path, {}, r"\(1, 3\)"),
        ([Panel(shape, face_colors=np.ones((8, 3)))], path, {}, r"\(12, 3\)"),
    ):
        with pytest.raises(OptionError, match=message):
            render_shapes(panels, where, **rest)  # type: ignore[arg-type]
    with pytest.raises(OutputError, match="no folder"):
        render_shapes([(shape, None)], tmp_path / "deeper" / "a.png", Look(size=(16, 16)))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("size", [(5, 500), (100_000, 20), (8_192, 8_192), (0, 0), (-5, 90)])
def test_sizes_that_cannot_be(size: tuple[int, int]) -> None:
    with pytest.raises(OptionError, match="pixels"):
        Look(size=size)


@pytest.mark.parametrize("background", ["blue", "#12345", "#gggggg", "", "0x1234"])
def test_backgrounds_that_cannot_be(background: str) -> None:
    with pytest.raises(OptionError, match="background"):
        Look(background=background)


def test_position_colors_follow_a_rotation_and_tell_places_apart() -> None:
    shape = box((1, 2, 3), (7, 8, 9))
    colors = position_colors(shape)
    assert colors.shape == (8, 3)
    assert colors.min() >= 0
    assert colors.max() <= 1
    apart = np.linalg.norm(colors[:, None] - colors[None], axis=2) + np.eye(8)
    assert apart.min() > 0.03
    turn = np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0.0]])
    there = Shape(shape.verts @ turn.T, shape.faces)
    assert position_colors(shape, turn) == pytest.approx(position_colors(there))
    left = shape.verts[:, 0] > 7
    assert np.linalg.norm(colors[left] - colors[~left], axis=1).min() > 0.25  # a flip is seen at once
    flat = Shape(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]]), np.array([[0, 1, 2]]))
    assert np.isfinite(position_colors(flat)).all()
    scene = Shape(np.append(shape.verts, [[900, 900, 900]], axis=0), shape.faces)  # a vertex that no face uses
    assert position_colors(scene)[:-1] == pytest.approx(colors)


def test_pictures_of_shapes_apart_have_one_scale() -> None:
    ball = icosphere(2)
    panels = [Panel(Shape(size * ball.verts, ball.faces), unit=1.0) for size in (1.0, 0.5)]
    large, small = draw_apart(panels, 64)
    assert large.shape[2] == 4 and large[0, 0, 3] == 0 and large[32, 32, 3] == 255
    assert max(large.shape) == pytest.approx(64, abs=1) and max(small.shape) == pytest.approx(33, abs=2)
