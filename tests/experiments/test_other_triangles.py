"""The same surface in other triangles: as large, as closed, and without its vertices."""

import numpy as np
from scipy.spatial import cKDTree

from meshmatch.experiments.makers.other_triangles import other_triangles
from meshmatch.geometry.triangles import is_watertight, triangle_areas, vertex_normals
from meshmatch.shapes.decimate import decimate
from meshmatch.shapes.shape import Shape
from tests.conftest import icosphere


def test_a_ball_stays_a_ball_without_its_vertices() -> None:
    ball = icosphere(3)
    weights, faces = other_triangles(ball.faces, ball.V)
    verts = weights @ ball.verts
    assert (len(verts), len(faces)) == (ball.V + len(ball.faces), 3 * len(ball.faces))
    assert is_watertight(faces)
    assert 0.97 < triangle_areas(verts, faces).sum() / ball.area < 1
    assert (vertex_normals(verts, faces) * verts).sum(1).min() > 0.9  # none is wound the other way
    edge = np.sqrt(ball.area / ball.V)
    thinned = decimate(Shape(verts, faces, "ball"), len(ball.faces))
    assert cKDTree(ball.verts).query(thinned.verts)[0].mean() > 0.2 * edge


def test_a_border_stays_where_it_is() -> None:
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    weights, faces = other_triangles(np.array([[0, 1, 2], [0, 2, 3]]), 4)
    assert np.allclose((weights @ square)[:4], square)
    assert np.isclose(triangle_areas(weights @ square, faces).sum(), 1)
    assert len(faces) == 6
