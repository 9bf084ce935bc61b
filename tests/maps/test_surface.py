"""Closest points: exact on the triangles around the nearest vertex, and of the sheet that faces the same way."""

import numpy as np

from meshmatch.maps.footpoints import Surface
from meshmatch.shapes.shape import Shape
from tests.conftest import icosphere
from tests.maps.solids import grid
from tests.transfer.known import brute_force


def test_closest_points_of_a_fine_mesh_are_exact() -> None:
    ball = icosphere(2)
    points = 1.02 * np.random.default_rng(0).permutation(icosphere(2).verts)
    found = Surface(ball.verts, ball.faces, ball.vertex_normals).query(points, points / 1.02)
    distance, feet = brute_force(points, ball.verts, ball.faces)
    assert np.allclose(found.distance, distance)
    assert np.allclose(found.values(ball.faces, ball.verts), feet)


def test_a_vertex_without_a_face_is_no_closest_point() -> None:
    ball = icosphere(1)
    verts, faces = np.concatenate([[[9.0, 9, 9]], ball.verts, [[2.0, 0, 0]]]), ball.faces + 1
    found = Surface(verts, faces, np.zeros_like(verts)).query(np.array([[2.0, 0, 0]]), np.zeros((1, 3)))
    assert found.distance == np.linalg.norm(found.values(faces, verts) - [2, 0, 0])
    assert np.allclose(found.distance, brute_force(np.array([[2.0, 0, 0]]), ball.verts, ball.faces)[0])
    assert 0 < found.vertex[0] < len(verts) - 1


def test_a_thin_wall_has_two_sides() -> None:
    """Points in the wall, nearer to the side below: those that face up belong to the side above."""
    sheet = grid(10, 10, 0.1)
    above = sheet.verts + np.array([0, 0, 0.01])
    wall = Shape(np.concatenate([sheet.verts, above]), np.concatenate([sheet.faces[:, ::-1], sheet.faces + sheet.V]))
    points = sheet.verts + np.array([0, 0, 0.004])
    up = np.tile([0.0, 0, 1], (sheet.V, 1))
    surface = Surface(wall.verts, wall.faces, wall.vertex_normals)
    assert (surface.query(points, up).vertex >= sheet.V).all()
    assert (surface.query(points, -up).vertex < sheet.V).all()
    assert (surface.query(points, np.zeros_like(up)).vertex < sheet.V).all()


def test_updated_points_are_new_ones() -> None:
    ball = icosphere(1)
    surface = Surface(ball.verts, ball.faces, ball.vertex_normals)
    one, other = surface.query(ball.verts, ball.verts), surface.query(ball.verts[::-1], ball.verts[::-1])
    both = one.updated(np.array([3, 5]), surface.query(ball.verts[[8, 9]], ball.verts[[8, 9]]))
    assert both.vertex[[2, 3, 5]].tolist() == [2, 8, 9]
    assert one.vertex.tolist() == list(range(ball.V)) == other.vertex.tolist()[::-1]
