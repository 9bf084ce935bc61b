"""Shape and Frame: by hand on a cube, then the laws."""

import numpy as np
import pytest

from meshmatch.errors import InputError
from meshmatch.geometry.triangles import normalized
from meshmatch.shapes.shape import Shape


def test_cube_by_hand(cube: Shape) -> None:
    assert (cube.V, cube.F, cube.is_cloud) == (8, 12, False)
    assert cube.area == pytest.approx(6.0)
    np.testing.assert_allclose(cube.face_areas, 0.5)
    np.testing.assert_allclose(cube.bounds, [[0, 0, 0], [1, 1, 1]])
    assert cube.diagonal == pytest.approx(3**0.5)
    centers = cube.verts[cube.faces].mean(axis=1)
    np.testing.assert_allclose(np.abs(normalized(cube.face_vectors)).max(axis=1), 1.0)
    assert (np.einsum("fi,fi->f", normalized(cube.face_vectors), centers - 0.5) > 0.4).all()  # outward


def test_the_box_is_around_the_surface(cube: Shape) -> None:
    """And not around vertices that no face uses, or that have no position."""
    verts, invalid = np.concatenate([cube.verts, [[50, 50, 50], [0, 0, 0]]]), np.arange(10) > 8
    scene = Shape(verts, cube.faces, invalid=invalid)
    np.testing.assert_array_equal(scene.on_surface, np.arange(10) < 8)
    np.testing.assert_array_equal(scene.bounds, cube.bounds)
    lost = Shape(verts, [[0, 1, 9]], invalid=invalid)  # no face has three places
    cloud = Shape(verts, np.zeros((0, 3), int), invalid=invalid)
    for each in (lost, cloud):
        np.testing.assert_array_equal(each.on_surface, ~invalid)
        np.testing.assert_array_equal(each.bounds, [[0, 0, 0], [50, 50, 50]])


def test_sphere_normals_point_outward(sphere: Shape) -> None:
    np.testing.assert_allclose(np.linalg.norm(sphere.vertex_normals, axis=1), 1.0)
    assert np.einsum("vi,vi->v", sphere.vertex_normals, sphere.verts).min() > 0.999
    assert sphere.area == pytest.approx(4 * np.pi, rel=0.02)
    assert sphere.vertex_areas.sum() == pytest.approx(sphere.area)


def test_vertex_normals_are_weighted_by_area() -> None:
    verts = [[0, 0, 0], [3, 0, 0], [0, 3, 0], [0, 0, 1]]
    shape = Shape(verts, [[0, 1, 2], [0, 2, 3]])  # areas 4.5 up and 1.5 along x
    np.testing.assert_allclose(shape.vertex_normals[0], np.array([1.5, 0, 4.5]) / np.hypot(1.5, 4.5))
    np.testing.assert_allclose(shape.vertex_normals[1], [0, 0, 1])


def test_flat_face_has_a_zero_normal_and_no_nan() -> None:
    shape = Shape([[0, 0, 0], [1, 0, 0], [2, 0, 0], [5, 5, 5]], [[0, 1, 2]])
    assert shape.area == 0
    assert (normalized(shape.face_vectors) == 0).all()
    assert (shape.vertex_normals == 0).all()


@pytest.mark.parametrize(
    ("verts", "faces", "words"),
    [
        (np.zeros((3, 2)), [[0, 1, 2]], "must be an array of (V, 3)"),
        (np.zeros(3), [], "must be an array of (V, 3)"),
        (np.zeros((0, 3)), [], "has no vertices"),
        (np.zeros((3, 3)), [[0, 1]], "must be an array of (F, 3)"),
        (np.zeros((3, 3)), [[0, 1, 3]], "refers to vertex 3, but there are only 3"),
        (np.zeros((3, 3)), [[0, 1, -1]], "refers to vertex -1"),
        (np.zeros((3, 3)), [[0.0, 1.0, 2.0]], "must be integers"),
        ([[0, 0, np.nan]], [], "not finite"),
        ([[0, 0, np.inf]], [], "not finite"),
        ([["a", 0, 0]], [], "not an array of numbers"),
    ],
)
def test_shape_refuses(verts: object, faces: object, words: str) -> None:
    with pytest.raises(InputError) as caught:
        Shape(verts, faces, "thing")
    assert words in caught.value.message
    assert "thing" in caught.value.message


@pytest.mark.parametrize(
    "more",
    [{"colors": np.zeros((2, 3))}, {"invalid": np.zeros(3, bool)}, {"weights": np.ones(3)}, {"weights": [0.5, 1.5]}],
)
def test_shape_refuses_more_of_the_wrong_size(more: dict[str, object]) -> None:
    with pytest.raises(InputError, match=f"{next(iter(more))} must"):
        Shape(np.zeros((2, 3)), [], **more)


def test_arrays_are_its_own_and_read_only() -> None:
    verts, faces = np.zeros((3, 3)), np.array([[0, 1, 2]])
    shape = Shape(verts, faces)
    verts[0] = 9
    faces[0] = 0
    assert shape.verts[0, 0] == 0
    assert shape.faces[0, 2] == 2
    for array in (shape.verts, shape.faces, shape.face_areas, shape.vertex_normals, shape.bounds):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1
    assert verts.flags.writeable  # the caller's array was not frozen
    assert Shape(shape.verts, shape.faces).verts is shape.verts  # and nothing is copied twice


def test_read_only_view_of_a_writable_array_is_copied() -> None:
    base = np.zeros((3, 3))
    view = base[:]
    view.setflags(write=False)
    shape = Shape(view, [])
    base[0] = 9
    assert shape.verts[0, 0] == 0


def test_lists_and_small_integers_are_welcome() -> None:
    shape = Shape([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.array([[0, 1, 2]], np.uint8))
    assert shape.verts.dtype == np.float64
    assert shape.faces.dtype == np.int64
    assert Shape([[0, 0, 0]], None).faces.shape == (0, 3)


def test_hash_names_the_geometry(cube: Shape) -> None:
    assert len(cube.hash) == 16
    assert Shape(cube.verts.copy(), cube.faces.copy(), "other name").hash == cube.hash
    moved = cube.verts.copy()
    moved[0, 0] += 1e-12
    assert Shape(moved, cube.faces).hash != cube.hash
    assert Shape(cube.verts, cube.faces[::-1]).hash != cube.hash
    assert Shape(cube.verts, []).hash != cube.hash


def test_invalid_vertices_have_no_area(cube: Shape) -> None:
    invalid = np.zeros(8, bool)
    invalid[0] = True
    shape = Shape(cube.verts, cube.faces, invalid=invalid)
    touching = (cube.faces == 0).any(axis=1)
    assert shape.area == pytest.approx(0.5 * (~touching).sum())
    np.testing.assert_allclose(shape.face_areas[touching], 0)
    assert Shape(cube.verts, cube.faces, invalid=np.zeros(8, bool)).invalid is None
