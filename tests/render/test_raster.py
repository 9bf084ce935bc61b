"""Rays into pixels: coverage is area, nothing thin is lost, light is smooth, and bands do not show."""

import numpy as np
import pytest

from meshmatch.render import raster
from meshmatch.render.figures import rotation_about_x
from meshmatch.render.raster import Layer, Viewport, composite, draw
from meshmatch.render.scene import Ground, Scene, visibility
from meshmatch.render.surface import Surface, VertexPaint, balls, discs, face_paint, mesh_surface

WINDOW = Viewport(90, 70, -0.45, 0.35, 0.01)
GREY = np.array([0.5, 0.5, 0.5])


def surface(verts: object, faces: object, color: np.ndarray = GREY) -> Surface:
    points, corners = np.array(verts, dtype=float), np.array(faces)
    return mesh_surface(points, corners, face_paint(np.tile(color, (len(corners), 1))))


def square(side: float, z: float = 0.0, color: np.ndarray = GREY, at: tuple[float, float] = (0, 0)) -> Surface:
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * side / 2 + np.array(at)
    return surface(np.column_stack([corners, np.full(4, z)]), [[0, 1, 2], [0, 2, 3]], color)


def test_the_square_stands_where_it_should() -> None:
    image = draw(Scene([square(0.4, at=(0.1, -0.05))]), WINDOW)
    rows, columns = np.nonzero(image.alpha)
    assert (columns.min(), columns.max() + 1) == (35, 75)
    assert (rows.min(), rows.max() + 1) == (20, 60)
    assert (image.alpha[20:60, 35:75] == 1).all()
    assert np.ptp(image.light[21:59, 36:74], axis=(0, 1)).max() < 1e-5
    assert (image.depth[20:60, 35:75] == 0).all()
    assert np.isneginf(image.depth[0]).all()


@pytest.mark.parametrize("degrees", [0.0, 1.0, 3.0, 20.0, 45.0, 71.3, 89.0])
def test_coverage_is_area(degrees: float) -> None:
    a = np.radians(degrees)
    turn = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    triangle = np.array([[-0.2, -0.15, 0], [0.22, -0.1, 0], [0.03, 0.2, 0]]) @ turn.T + [0.0013, 0.0027, 0]
    area = 0.5 * abs(np.cross(triangle[1] - triangle[0], triangle[2] - triangle[0])[2])
    image = draw(Scene([surface(triangle, [[0, 1, 2]])]), WINDOW)
    assert image.alpha.sum() * 1e-4 == pytest.approx(area, rel=2e-3)


def test_the_outline_of_a_ball() -> None:
    ball = balls(np.array([[0.013, -0.021, 0.0]]), 0.25, GREY[None])
    image = draw(Scene([ball]), WINDOW)
    assert image.alpha.sum() * 1e-4 == pytest.approx(np.pi * 0.25**2, rel=4e-3)
    row, column = np.indices(image.alpha.shape)
    x, y = WINDOW.at(column + 0.5, row + 0.5)
    distance = np.hypot(x - 0.013, y + 0.021)
    assert (image.alpha[distance < 0.24] == 1).all()
    assert (image.alpha[distance > 0.26] == 0).all()
    rim = image.alpha[np.abs(distance - 0.25) < 0.002]
    assert rim.mean() == pytest.approx(0.5, abs=0.1)


@pytest.mark.parametrize("slope", [0.02, 0.1, 0.5])
def test_an_edge_of_any_slope_has_no_steps(slope: float) -> None:
    image = draw(
        Scene([surface([[-1, -1, 0], [1, -1, 0], [1, slope, 0], [-1, -slope, 0]], [[0, 1, 2], [0, 2, 3]])]), WINDOW
    )
    height = image.alpha.sum(axis=0)
    wanted = 35 + slope * (np.arange(90) + 0.5 - 45)
    assert height == pytest.approx(wanted, abs=0.07)


@pytest.mark.parametrize("width", [0.002, 0.001])
@pytest.mark.parametrize("degrees", [0.0, 4.0, 37.0, 90.0])
def test_what_is_thinner_than_a_pixel_is_drawn_thinly(width: float, degrees: float) -> None:
    a = np.radians(degrees)
    along, across = np.array([np.cos(a), np.sin(a), 0]), np.array([-np.sin(a), np.cos(a), 0])
    corners = [s * 0.25 * along + t * width / 2 * across for s, t in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    wire = surface(np.array(corners) + np.array([0.0031, 0.0007, 0.5]), [[0, 1, 2], [0, 2, 3]], np.ones(3))
    alone = draw(Scene([wire]), WINDOW)
    assert alone.alpha.sum() * 1e-4 == pytest.approx(0.5 * width, rel=0.35)
    behind = draw(Scene([square(0.8, color=np.zeros(3)), wire]), WINDOW)
    bare = draw(Scene([square(0.8, color=np.zeros(3))]), WINDOW)
    brighter = (behind.light - bare.light).mean(axis=2)
    assert brighter[alone.alpha > 0.02].min() > 0


def test_bands_do_not_show(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    cloud = balls(rng.uniform(-0.3, 0.3, (20, 3)), 0.06, rng.random((20, 3)))
    floor = rotation_about_x(20) @ np.array([0.0, 1, 0])
    scene = Scene([cloud, square(0.5, -0.4)], Ground(floor, -0.35, np.array([[0, -0.2, 0.5, 0.2]])))
    whole = draw(scene, WINDOW)
    monkeypatch.setattr(raster, "BAND", 90 * 7)
    parts = draw(scene, WINDOW)
    assert np.array_equal(parts.alpha, whole.alpha)
    assert parts.light == pytest.approx(whole.light, abs=1e-6)
    assert np.array_equal(parts.depth, whole.depth)


def test_what_lies_outside_the_picture_is_left_out() -> None:
    image = draw(Scene([square(0.2, at=(3.0, 0.0))]), WINDOW)
    assert not image.alpha.any()
    half = draw(Scene([square(0.2, at=(0.45, 0.0))]), WINDOW)
    assert half.alpha.sum() == pytest.approx(10 * 20)


def test_a_hollow_is_darker_than_a_hill() -> None:
    y, x = np.mgrid[-0.4:0.4:41j, -0.4:0.4:41j]
    grid = np.arange(41 * 41).reshape(41, 41)
    a, b, c, d = grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    center = []
    for sign in (1, -1):
        z = sign * 0.4 * np.exp(-60 * (x**2 + y**2))
        image = draw(Scene([surface(np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1), faces)]), WINDOW)
        center.append(image.light[33:37, 43:47].mean())
    assert center[0] > 1.25 * center[1]


def test_light_that_nothing_blocks_is_whole_and_a_lid_takes_it() -> None:
    open_floor = Scene([square(0.8)])
    x = np.array([0.0, 0.1])
    hits = open_floor.trace(x, x, 0.01)
    rows = np.arange(2)
    assert (visibility(open_floor, hits, rows, rows, rows) == 1).all()
    lid = square(8.0, 0.02)
    covered = Scene([square(0.8), Surface(lid.verts, lid.faces, lid.normals, lid.paint)])
    seen = visibility(covered, hits, rows, rows, rows)
    assert (seen[:, 0] == 0).all()
    assert (seen[:, 1] < 0.35).all()  # some rays end before the lid: what is near counts most


def test_a_shadow_is_soft_and_has_no_noise() -> None:
    wall = surface([[-0.02, -0.9, 0], [-0.02, 0.9, 0], [-0.02, 0.9, 0.5], [-0.02, -0.9, 0.5]], [[0, 1, 2], [0, 2, 3]])
    image = draw(Scene([square(2.0), wall]), WINDOW)
    row = image.light[35, 50:, 0]
    assert row[0] < 0.8 * row[-1]
    steps = np.diff(row)
    assert steps.min() > -0.012
    assert steps.max() < 0.05
    columns = image.light[20:50, 50:88, 0]
    assert np.abs(np.diff(columns, axis=0)).max() < 0.01  # along the wall all is equal


def test_a_corner_stays_sharp_and_a_ball_smooth() -> None:
    s = 0.3
    corner = surface(
        [[-s, -s, 0], [0, -s, s], [0, s, s], [-s, s, 0], [s, -s, 0], [s, s, 0]],
        [[0, 1, 2], [0, 2, 3], [1, 4, 5], [1, 5, 2]],
    )
    row = draw(Scene([corner]), WINDOW).light[35, :, 0]
    steps = np.abs(np.diff(row))[20:70]
    assert steps[[24, 25]].max() > 0.03
    assert np.delete(steps, [23, 24, 25, 26]).max() < 0.006
    ball = balls(np.zeros((1, 3)), 0.3, GREY[None])
    inner = draw(Scene([ball]), WINDOW).light[20:50, 30:60, 0]
    assert np.abs(np.diff(inner, axis=1)).max() < 0.03


def test_seams_do_not_show() -> None:
    """The same ball with all its vertices torn apart, as an stl has them, looks the same."""
    whole = balls(np.zeros((1, 3)), 0.3, GREY[None])
    smooth = mesh_surface(whole.verts, whole.faces, whole.paint)
    torn = mesh_surface(
        whole.verts[whole.faces].reshape(-1, 3), np.arange(3 * len(whole.faces)).reshape(-1, 3), whole.paint
    )
    one, other = draw(Scene([smooth]), WINDOW), draw(Scene([torn]), WINDOW)
    assert one.light == pytest.approx(other.light, abs=1e-5)


def test_a_disc_lies_across_its_normal() -> None:
    centers, radius = np.array([[0.0, 0, 0], [0.3, 0, 0]]), np.array([0.1, 0.1])
    facing = discs(centers, np.array([[0, 0, 1.0], [1, 0, 0.0]]), radius, np.tile(GREY, (2, 1)))
    image = draw(Scene([facing]), WINDOW)
    octagon = 2 * np.sqrt(2) * 0.1**2
    assert image.alpha[:, :60].sum() * 1e-4 == pytest.approx(octagon, rel=0.01)
    assert image.alpha[:, 65:].sum() < 3  # seen from its edge


def test_the_nearest_corner_gives_a_sharp_color() -> None:
    paint = VertexPaint(np.eye(3), np.array([[0, 1, 2]]), sharp=True)
    weights = np.array([[0.5, 0.3, 0.2], [0.1, 0.2, 0.7], [0.3, 0.4, 0.3]])
    assert np.array_equal(paint(np.zeros(3, int), weights, 0.1), np.eye(3)[[0, 2, 1]])


def test_holes_of_a_texture_show_what_is_behind() -> None:
    class Holed:
        def __call__(self, faces: np.ndarray, weights: np.ndarray, footprint: float) -> np.ndarray:
            return np.column_stack([np.tile([1.0, 0, 0], (len(faces), 1)), np.where(weights[:, 1] > 0.5, 0.0, 1.0)])

    triangle = np.array([[-0.4, -0.3, 0.2], [0.4, -0.3, 0.2], [-0.4, 0.3, 0.2]])
    holed = mesh_surface(triangle, np.array([[0, 1, 2]]), Holed())
    image = draw(Scene([holed, square(2.0, color=np.array([0, 0, 1.0]))]), WINDOW)
    left, right = image.light[60, 10], image.light[60, 70]
    assert left[0] > 0.2 > left[2] + 0.1
    assert right[2] > 0.2 > right[0] + 0.1
    through = draw(Scene([holed]), WINDOW)
    assert through.alpha[60, 10] == 1
    assert through.alpha[60, 70] == 0


def test_glass_is_drawn_over_what_it_does_not_lie_behind() -> None:
    def plane(color: float, alpha: float, depth: float) -> Layer:
        color, alpha, depth = np.float32([color * alpha, alpha, depth])
        return Layer(np.full((1, 1, 3), color), np.full((1, 1), alpha), np.full((1, 1), depth))

    base = plane(0.2, 1.0, 0.0)
    assert composite(plane(1.0, 0.5, 0.1), base, 0.02).light[0, 0, 0] == pytest.approx(0.6)
    assert composite(plane(1.0, 0.5, -0.1), base, 0.02).light[0, 0, 0] == pytest.approx(0.2)
    assert composite(plane(1.0, 0.5, -0.01), base, 0.02).light[0, 0, 0] == pytest.approx(0.4)
    nothing = plane(0.0, 0.0, -np.inf)
    over = composite(plane(1.0, 0.5, -9.0), nothing, 0.02)
    assert (over.alpha[0, 0], over.light[0, 0, 0]) == (0.5, 0.5)
    assert composite(nothing, base, 0.02).light[0, 0, 0] == pytest.approx(0.2)


def test_edges_are_thinned_where_there_are_too_many(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene([square(0.8)])
    monkeypatch.setattr(raster, "MAX_POINTS", 10)
    points = raster.edge_points(scene, WINDOW)
    assert len(points) <= 4 + 3 * 10
    monkeypatch.undo()
    assert len(raster.edge_points(scene, WINDOW)) > 6 * 79
