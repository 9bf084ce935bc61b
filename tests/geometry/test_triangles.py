"""Areas, normals and values of triangles; the closest point against a search."""

import numpy as np
import pytest

from meshmatch.geometry.triangles import (
    FacesAround,
    blend,
    closest_on_triangles,
    covering_balls,
    cross_product,
    dot,
    interpolate,
    normalized,
    squared_lengths,
    triangle_areas,
    triangle_vectors,
    vertex_areas,
    vertex_normals,
)

# A right triangle of area 2 in the plane z = 0, and one of area 6 upright on its long side.
VERTS = np.array([[0.0, 0, 0], [2, 0, 0], [0, 2, 0], [0, 0, -6]])
FACES = np.array([[0, 1, 2], [1, 0, 3]])


def test_areas_and_normals_by_hand() -> None:
    assert np.allclose(triangle_areas(VERTS, FACES), [2, 6])
    assert np.allclose(normalized(triangle_vectors(VERTS, FACES)), [[0, 0, 1], [0, -1, 0]])
    assert np.allclose(vertex_areas(VERTS, FACES), [8 / 3, 8 / 3, 2 / 3, 2])
    mean = np.array([0.0, -3, 1]) / np.sqrt(10)  # area-weighted
    assert np.allclose(vertex_normals(VERTS, FACES), [mean, mean, [0, 0, 1], [0, -1, 0]])


def test_a_flat_triangle_and_a_lone_vertex_have_no_normal() -> None:
    verts = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [9, 9, 9]])
    assert not normalized(triangle_vectors(verts, np.array([[0, 1, 2]]))).any()
    assert not vertex_normals(verts, np.array([[0, 1, 2]])).any()
    assert vertex_areas(verts, np.array([[0, 1, 2]])).tolist() == [0, 0, 0, 0]


def test_products_agree_with_numpys() -> None:
    a, b = np.random.default_rng(0).normal(size=(2, 50, 3))
    assert np.allclose(cross_product(a, b), np.cross(a, b))
    assert np.allclose(squared_lengths(a), np.linalg.norm(a, axis=1) ** 2)


def test_values_between_corners() -> None:
    weights = np.array([[0.5, 0.5, 0], [0, 0, 1]])
    assert np.allclose(interpolate(VERTS, FACES, weights), [[1, 0, 0], [0, 0, -6]])
    assert np.allclose(blend(VERTS[FACES], weights), [[1, 0, 0], [0, 0, -6]])


@pytest.mark.parametrize("flat", [False, True])
def test_no_point_of_the_triangle_is_closer(flat: bool) -> None:
    rng = np.random.default_rng(4)
    corners = rng.normal(size=(40, 3, 3))
    if flat:
        corners[:, 2] = 0.3 * corners[:, 0] + 0.7 * corners[:, 1]
    points = 2 * rng.normal(size=(40, 3))
    weights = closest_on_triangles(points, *corners.swapaxes(0, 1))
    assert (weights >= -1e-12).all() and np.allclose(weights.sum(1), 1)
    distance = np.linalg.norm(blend(corners, weights) - points, axis=1)
    tried = rng.dirichlet(np.ones(3), 500)
    nearest = np.linalg.norm(np.einsum("tk,nkd->ntd", tried, corners) - points[:, None], axis=2).min(1)
    assert (distance <= nearest + 1e-9).all()


def test_one_or_two_edges_are_enough() -> None:
    """Of sharp and obtuse triangles too, the closest point is that of the plane or the best of all three edges."""
    rng = np.random.default_rng(5)
    corners = rng.normal(size=(4000, 3, 3)) * 10.0 ** rng.uniform(-3, 0, (4000, 1, 3))
    points = corners.mean(1) + rng.normal(size=(4000, 3)) * 10.0 ** rng.uniform(-3, 0.5, (4000, 1))
    distance = np.linalg.norm(blend(corners, closest_on_triangles(points, *corners.swapaxes(0, 1))) - points, axis=1)
    edges = []
    for i, j in ((0, 1), (1, 2), (2, 0)):
        along = corners[:, j] - corners[:, i]
        t = np.clip(dot(points - corners[:, i], along) / dot(along, along), 0, 1)
        edges.append(np.linalg.norm(corners[:, i] + t[:, None] * along - points, axis=1))
    best = np.min(edges, axis=0)
    on_edges = distance > best - 1e-9
    assert 0.5 < on_edges.mean() < 0.99
    assert (distance <= best + 1e-9).all()
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    height = np.abs(dot(points - corners[:, 0], normal)) / np.linalg.norm(normal, axis=1)
    assert np.allclose(distance[~on_edges], height[~on_edges], atol=1e-8)


def test_balls_cover_triangles_of_any_form() -> None:
    """Every point of a triangle lies in one of its balls; long ones have several, thin as they are."""
    rng = np.random.default_rng(0)
    triangles = rng.normal(size=(300, 3, 3))
    triangles[:100, 2] = 0.5 * (triangles[:100, 0] + triangles[:100, 1]) + 0.01 * rng.normal(size=(100, 3))  # slivers
    triangles[100:110, 1:] = triangles[100:110, :1]  # points
    triangles[110:120, 2] = triangles[110:120, 1]  # lines
    item, center, radius = covering_balls(triangles)
    assert set(item) == set(range(300)) and 300 < len(item) <= 3 * 300
    weights = rng.dirichlet([0.5, 0.5, 0.5], 200)
    for k, triangle in enumerate(triangles):
        points = np.concatenate([weights @ triangle, triangle])
        own = item == k
        away = np.linalg.norm(points[:, None] - center[own], axis=2)
        assert (away <= radius[own] + 1e-12).any(axis=1).all()
    assert np.bincount(item)[:100].mean() > 2
    assert radius[np.isin(item, np.arange(100, 110))].max() < 1e-12


def test_faces_around_vertices() -> None:
    faces = np.array([[0, 1, 2], [2, 1, 3], [4, 3, 1]])
    around = FacesAround.of(faces, 6)
    found = [around.at(np.array(each, np.int64)).tolist() for each in ([0], [1], [0, 4], [5], [])]
    assert found == [[0], [0, 1, 2], [0, 2], [], []]
