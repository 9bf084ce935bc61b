"""Points on the source of points near its image."""

import numpy as np
import pytest

from meshmatch.maps.mapped_mesh import MappedMesh, discontinuous_faces
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.shape import Shape
from tests.conftest import icosphere
from tests.maps.solids import bumpy_sphere
from tests.transfer.known import brute_force, split


def test_points_anywhere_find_their_closest_point() -> None:
    shape = bumpy_sphere()  # edges of many lengths, so that several classes of size are searched
    rng = np.random.default_rng(1)
    reach = np.repeat([0.01, 0.3, 3.0], 30)[:, None]
    points = shape.verts[rng.integers(0, shape.V, 90)] + rng.normal(size=(90, 3)) * reach
    image = MappedMesh.of(shape)
    assert len(image._trees) > 2
    places = image.query(points)
    distance, feet = brute_force(points, shape.verts, shape.faces)
    assert np.allclose(places.distance, distance, atol=1e-12)
    assert np.allclose(places.values(shape.faces, shape.verts), feet, atol=1e-9)
    heaviest = shape.faces[places.face, places.barycentric.argmax(axis=1)]
    assert np.array_equal(places.vertex, heaviest)


def test_more_points_than_one_portion_are_each_answered(monkeypatch: pytest.MonkeyPatch, sphere: Shape) -> None:
    points = np.random.default_rng(2).normal(size=(500, 3))
    whole = MappedMesh.of(sphere).query(points)
    monkeypatch.setattr("meshmatch.maps.mapped_mesh._CHUNK", 37)
    monkeypatch.setattr("meshmatch.maps.mapped_mesh._MIN_CHUNK", 11)
    parts = MappedMesh.of(sphere).query(points)
    shared = MappedMesh.of(sphere).query(points, workers=3)
    for each in (parts, shared):
        assert np.array_equal(whole.face, each.face)
        assert np.array_equal(whole.barycentric, each.barycentric)


def test_confidence_falls_with_the_distance(sphere: Shape) -> None:
    heights = np.array([0.0, 0.02, 0.1, 0.3])
    places = MappedMesh.of(sphere).query((1 + heights)[:, None] * sphere.verts[:1])
    assert places.confidence[0] == 1
    assert (np.diff(places.confidence) < 0).all()
    unit = np.sqrt(sphere.area)
    assert np.allclose(places.confidence, np.exp(-((heights / unit / 0.03) ** 2)))


def test_a_little_doubt_moves_nothing_but_a_guess_gives_way() -> None:
    shape = icosphere(2)
    confidence = np.ones(shape.V)
    confidence[0] = 0.7
    places = MappedMesh(VertexMap.between(shape, shape, np.arange(shape.V), confidence=confidence), shape, shape)
    assert places.query(shape.verts[:1]).vertex[0] == 0
    # A guess lies exactly here, and a sure vertex very near.
    index = np.arange(shape.V)
    index[1] = 0
    confidence = np.ones(shape.V)
    confidence[0] = 1e-6
    doubled = VertexMap.between(shape, shape, index, confidence=confidence)
    found = MappedMesh(doubled, shape, shape).query(shape.verts[:1])
    assert found.confidence[0] > 0.5
    assert found.vertex[0] != 0


def test_a_place_is_sought_near_where_it_is_said_to_be() -> None:
    """Two far points of the source lie on one point of the target."""
    two = Shape(np.array([[0.0, 0, 0], [1, 0, 0]]), np.empty((0, 3), int), "two")
    sphere = icosphere(1)
    image = MappedMesh(VertexMap.between(two, sphere, np.array([4, 4])), two, sphere)
    for k in (0, 1):
        assert image.query(sphere.verts[[4]], near=two.verts[[k]]).vertex.tolist() == [k]


def test_faces_are_torn_where_their_image_is_far_longer(sphere: Shape) -> None:
    index = np.arange(sphere.V)
    index[7] = int(np.argmin(sphere.verts @ sphere.verts[7]))
    found = VertexMap.between(sphere, sphere, index)
    torn = discontinuous_faces(found, sphere, sphere)
    assert np.array_equal(np.flatnonzero(torn), np.flatnonzero((sphere.faces == 7).any(axis=1)))


@pytest.mark.parametrize("size", [0.01, 1.0, 1000.0])
def test_whole_maps_are_not_torn_whatever_the_units(size: float) -> None:
    shape = icosphere(1)
    fine, forward, back = split(Shape(shape.verts * size, shape.faces))
    coarse = Shape(shape.verts * size, shape.faces)
    for found, a, b in ((forward, coarse, fine), (back, fine, coarse)):
        assert not discontinuous_faces(found, a, b).any()
    rounded = VertexMap.between(fine, coarse, back.index)  # each vertex by up to half an edge
    assert not discontinuous_faces(rounded, fine, coarse).any()


def test_rounding_to_a_coarse_target_tears_nothing(sphere: Shape) -> None:
    """Each edge becomes a point, or an edge of the target several times as long."""
    coarse = icosphere(0)
    index = np.linalg.norm(sphere.verts[:, None] - coarse.verts, axis=2).argmin(axis=1)
    found = VertexMap.between(sphere, coarse, index)
    points = found.points(coarse)
    longest = np.linalg.norm(points[sphere.faces] - points[sphere.faces[:, [1, 2, 0]]], axis=2).max()
    assert longest > 5 * np.linalg.norm(np.diff(sphere.verts[sphere.faces[0, :2]], axis=0))
    assert not discontinuous_faces(found, sphere, coarse).any()


def test_a_cloud_has_no_faces_to_tear(sphere: Shape) -> None:
    points = Shape(sphere.verts, np.empty((0, 3), int))
    found = VertexMap.identity(points)
    assert discontinuous_faces(found, points, points).shape == (0,)


def test_places_on_vertices_are_known_as_such() -> None:
    found = VertexMap(
        "",
        "",
        np.array([0, 1, 2]),
        face=np.array([-1, 4, 4]),
        barycentric=np.array([[1.0, 0, 0], [0, 1, 0], [0.5, 0.5, 0]]),
    )
    assert found.on_vertex.tolist() == [True, True, False]


def test_a_map_of_everything_to_one_point_still_answers(sphere: Shape) -> None:
    found = VertexMap.between(sphere, sphere, np.zeros(sphere.V, int))
    places = MappedMesh(found, sphere, sphere).query(sphere.verts)
    assert np.allclose(places.distance, np.linalg.norm(sphere.verts - sphere.verts[0], axis=1))


def test_the_only_vertex_with_a_place_is_found_though_all_its_faces_are_broken(sphere: Shape) -> None:
    broken = Shape(np.zeros((42, 3)), icosphere(1).faces, "broken", None, np.arange(42) > 0)
    huge = Shape(1e30 * sphere.verts, sphere.faces, "huge")
    for target in (sphere, huge):
        found = MappedMesh(VertexMap.between(broken, target, np.arange(42)), broken, target).query(target.verts)
        assert (found.vertex == 0).all()
        assert (found.face == -1).all()
