"""The frames that bring shapes to one size and place."""

import numpy as np
import pytest

from meshmatch.errors import InputError
from meshmatch.shapes.alignment import in_single_precision, sqrt_area_frame, unit_sphere_frame
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape


def test_cube_by_hand(cube: Shape) -> None:
    frame = sqrt_area_frame(cube)
    assert frame.scale == pytest.approx(6**0.5)
    np.testing.assert_allclose(frame.center, 0.5)
    np.testing.assert_array_equal(frame.rotation, np.eye(3))
    ball = unit_sphere_frame(cube)
    assert ball.scale == pytest.approx(0.75**0.5)
    np.testing.assert_allclose(ball.center, 0.5)


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1000.0])
def test_area_is_one_and_centroid_zero_in_any_unit(torus: Shape, unit: float) -> None:
    shape = Shape((torus.verts + np.array([3, -7, 20])) * unit, torus.faces)
    frame = sqrt_area_frame(shape)
    inside = Shape(frame.apply(shape.verts), shape.faces)
    assert inside.area == pytest.approx(1.0)
    np.testing.assert_allclose(sqrt_area_frame(inside).center, 0, atol=1e-12)
    np.testing.assert_allclose(inside.verts, sqrt_area_frame(torus).apply(torus.verts), atol=1e-10)
    np.testing.assert_allclose(frame.undo(inside.verts), shape.verts, rtol=1e-12)
    ball = unit_sphere_frame(shape).apply(shape.verts)
    assert np.linalg.norm(ball, axis=1).max() == pytest.approx(1.0)


def test_centroid_is_that_of_the_surface_not_of_the_vertices(sphere: Shape) -> None:
    a, b, c = sphere.faces[0]  # a crowd of vertices in one place does not pull
    crowd = np.repeat(sphere.verts[[a, b, c]].mean(axis=0)[None], 500, axis=0)
    shape = Shape(np.vstack([sphere.verts, crowd]), sphere.faces)
    np.testing.assert_allclose(sqrt_area_frame(shape).center, 0, atol=1e-9)
    areas, middles = sphere.face_areas, sphere.verts[sphere.faces].mean(axis=1)
    half = Shape(sphere.verts, sphere.faces[middles[:, 2] > 0])
    up = middles[:, 2] > 0
    expected = areas[up] @ middles[up] / areas[up].sum()
    np.testing.assert_allclose(sqrt_area_frame(half).center, expected, atol=1e-12)


def test_invalid_vertices_do_not_count(sphere: Shape) -> None:
    invalid = np.zeros(sphere.V, bool)
    invalid[5] = True
    verts = sphere.verts.copy()
    verts[5] = [1000, 0, 0]
    shape = Shape(verts, sphere.faces, invalid=invalid)
    assert sqrt_area_frame(shape).scale == pytest.approx(sqrt_area_frame(sphere).scale, rel=0.02)
    assert unit_sphere_frame(shape).scale == pytest.approx(1.0, rel=0.02)


def test_cloud_is_brought_to_the_size_of_its_surface(torus: Shape) -> None:
    points = sample_surface(torus, 5000, np.random.default_rng(0)).points + np.array([1, 2, 3])
    frame = sqrt_area_frame(Shape(points, []))
    assert frame.scale == pytest.approx(torus.area**0.5, rel=0.03)
    np.testing.assert_allclose(frame.center, [1, 2, 3], atol=0.03)


@pytest.mark.parametrize("faces", [[], [[0, 1, 2]]])
def test_shape_without_area_is_refused(faces: list[list[int]]) -> None:
    line = Shape([[0, 0, 0], [1, 1, 1], [2, 2, 2]], faces)
    with pytest.raises(InputError, match="no surface area"):
        sqrt_area_frame(line)
    point = Shape([[1, 1, 1]] * 5, [])
    with pytest.raises(InputError, match="no surface area"):
        sqrt_area_frame(point)
    with pytest.raises(InputError, match="no size"):
        unit_sphere_frame(point)


@pytest.mark.parametrize(("offset", "size", "rounded"), [(0, 1, True), (1e6, 1, False), (0, 1e60, False)])
def test_single_precision_moves_next_to_nothing(offset: float, size: float, rounded: bool) -> None:
    shape = Shape(size * np.random.default_rng(0).random((20, 3)) + offset, np.arange(18).reshape(-1, 3))
    single = in_single_precision(shape)
    assert (single is not shape) == rounded
    np.testing.assert_allclose(single.verts, shape.verts, atol=1e-7 * size)
    assert in_single_precision(single) is single
