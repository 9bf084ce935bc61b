"""Sliding on a surface."""

from collections.abc import Callable

import numpy as np

from meshmatch.geometry.triangles import interpolate
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.surface_walk import PointWalker, SurfaceWalker, duals
from tests.transfer.known import brute_force


def walked(walker: SurfaceWalker, points: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Faces, places in the walker's units and distances of (N, 3) points in these units."""
    face, weights, distance = walker.closest(points.T.astype(np.float32), start.astype(np.int32))
    np.testing.assert_allclose(weights.sum(axis=0), 1, atol=1e-5)
    assert weights.min() >= 0
    return face, interpolate(walker.verts, walker.faces[face], weights.T), distance


def sheets(gap: float) -> Shape:
    """Two flat squares of two triangles each, one above the other, that share nothing."""
    flat = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    return Shape(np.concatenate([flat, flat + np.array([0, 0, gap])]), np.concatenate([faces, faces + 4]))


def test_duals_give_the_weights_of_a_point() -> None:
    rng = np.random.default_rng(0)
    corners, weights = rng.normal(size=(20, 3, 3)), rng.dirichlet((1, 1, 1), 20)
    points = np.einsum("nk,nkd->nd", weights, corners)
    first, second = duals(corners)
    away = points - corners[:, 0]
    np.testing.assert_allclose(np.einsum("nd,nd->n", away, first), weights[:, 1], atol=1e-9)
    np.testing.assert_allclose(np.einsum("nd,nd->n", away, second), weights[:, 2], atol=1e-9)
    flat = duals(np.array([[[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]]))
    assert (flat[0] == 0).all() and (flat[1] == 0).all()


def test_points_near_a_sphere_find_the_closest_place(sphere: Shape) -> None:
    walker = SurfaceWalker(sphere)
    rng = np.random.default_rng(1)
    start = rng.integers(0, sphere.F, 100)
    direction = walker.verts[walker.faces[start]].mean(axis=1) + 0.12 * rng.normal(size=(100, 3))
    points = 0.28 * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    points *= 1 + 0.02 * rng.normal(size=(100, 1))
    _, places, distance = walked(walker, points, start)
    found = np.linalg.norm(places - points, axis=1)
    # within a rounding of the best; a face away where two are equally near
    np.testing.assert_allclose(found, brute_force(points, walker.verts, walker.faces)[0], atol=2e-4)
    assert (distance <= found + 1e-6).all()


def test_a_point_on_the_surface_stays_where_it_is(torus: Shape) -> None:
    walker = SurfaceWalker(torus)
    rng = np.random.default_rng(2)
    face, weights = rng.integers(0, torus.F, 200), rng.dirichlet((1, 1, 1), 200)
    points = interpolate(walker.verts, walker.faces[face], weights)
    beside = np.where(walker.opposite[face, 0] >= 0, walker.opposite[face, 0], face)
    found, places, distance = walked(walker, points, beside)
    np.testing.assert_allclose(places, points, atol=1e-6)
    assert (found == face).mean() > 0.98  # on an edge either will do
    assert distance.max() < 1e-6


def test_sliding_does_not_change_sheets() -> None:
    shape = sheets(0.1)
    walker = SurfaceWalker(shape)
    points = (np.array([[0.2, 0.3, 0.08], [0.7, 0.6, 0.08]]) - walker.center) / walker.unit
    face, places, _ = walked(walker, points, np.array([1, 1]))
    assert set(face.tolist()) <= {0, 1}  # the upper sheet is nearer
    np.testing.assert_allclose(places * walker.unit + walker.center, [[0.2, 0.3, 0], [0.7, 0.6, 0]], atol=1e-6)


def test_seams_in_the_file_are_no_edges(cube: Shape) -> None:
    """Every triangle with its own three vertices, as in an stl or along texture seams."""
    loose = Shape(cube.verts[cube.faces].reshape(-1, 3), np.arange(36).reshape(-1, 3))
    whole, apart = SurfaceWalker(cube), SurfaceWalker(loose)
    np.testing.assert_array_equal(whole.opposite, apart.opposite)
    assert (whole.opposite >= 0).all()
    for k in range(3):  # and back over the same edge
        back = whole.opposite[whole.opposite[:, k], whole.opposite_edge[:, k]]
        np.testing.assert_array_equal(back, np.arange(12))


def test_a_border_stops_a_point_and_tells_how_far_off_it_is() -> None:
    walker = SurfaceWalker(sheets(5.0))
    points = (np.array([[1.5, 0.5, 0.0]]) - walker.center) / walker.unit
    _, places, distance = walked(walker, points, np.array([0]))
    np.testing.assert_allclose(places * walker.unit + walker.center, [[1, 0.5, 0]], atol=1e-6)
    np.testing.assert_allclose(distance * walker.unit, [0.5], atol=1e-6)


def test_an_unknown_beginning_and_a_far_one(make_sphere: Callable[[int], Shape]) -> None:
    shape = make_sphere(5)  # half way round it takes more steps than one walk has
    walker = SurfaceWalker(shape)
    points = np.array([[0, 0, -0.29], [0.2, 0.2, 0.03]])
    top = np.array([walker.verts[walker.faces].mean(axis=1)[:, 2].argmax(), -1])
    _, places, _ = walked(walker, points, top)
    exact, _ = brute_force(points, walker.verts, walker.faces)
    np.testing.assert_allclose(np.linalg.norm(places - points, axis=1), exact, atol=1e-4)


def test_a_face_without_area_lets_points_pass() -> None:
    verts = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0.5, 0.5, 0]], float)
    shape = Shape(verts, np.array([[0, 1, 2], [1, 4, 2], [1, 3, 4], [4, 3, 2]]))
    walker = SurfaceWalker(shape)
    points = (np.array([[0.8, 0.75, 0.0]]) - walker.center) / walker.unit
    face, places, _ = walked(walker, points, np.array([0]))
    assert face.tolist() in ([2], [3])
    np.testing.assert_allclose(places, points, atol=1e-6)


def test_a_face_of_each_vertex(cube: Shape) -> None:
    lonely = Shape(np.concatenate([cube.verts, [[5, 5, 5]]]), cube.faces)
    face = SurfaceWalker(lonely).face_of_vertex
    assert face[8] == -1
    assert all(vertex in cube.faces[face[vertex]] for vertex in range(8))


def test_a_cloud_gives_the_nearest_points() -> None:
    rng = np.random.default_rng(3)
    shape = Shape(rng.normal(size=(50, 3)), np.empty((0, 3), int))
    walker = PointWalker(shape)
    face, places, _ = walked(walker, walker.verts, np.full(50, -1))
    np.testing.assert_array_equal(face, np.arange(50))
    np.testing.assert_allclose(places, walker.verts, atol=1e-5)


def test_a_cloud_of_one_point_and_one_of_nothing_but_nan() -> None:
    one = PointWalker(Shape(np.zeros((1, 3)), np.empty((0, 3), int)))
    assert one.closest(np.ones((3, 2), np.float32), np.array([-1, 0], np.int32))[0].tolist() == [0, 0]
    marked = Shape(np.eye(3), np.empty((0, 3), int), invalid=np.array([False, True, False]))
    face, _, _ = PointWalker(marked).closest(np.float32([[0], [1], [0]]), np.array([1], np.int32))
    assert face[0] != 1
