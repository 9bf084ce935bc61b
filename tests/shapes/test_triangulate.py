"""A cloud becomes a mesh where its points say how, and an error where they lie on no surface."""

import numpy as np
import pytest

from meshmatch.errors import InputError
from meshmatch.geometry.triangles import normalized
from meshmatch.shapes.sampling import sample_surface, triangulate_cloud
from meshmatch.shapes.shape import Shape

NONE = np.empty((0, 3), np.int64)


def test_a_ball_of_points_becomes_a_ball(sphere: Shape) -> None:
    cloud = Shape(sphere.verts, NONE, "ball")
    kept, faces = triangulate_cloud(cloud, 10_000)
    mesh = Shape(cloud.verts[kept], faces)
    assert mesh.area == pytest.approx(sphere.area, rel=0.02)
    centers = mesh.verts[mesh.faces].mean(1)
    assert ((normalized(mesh.face_vectors) * centers).sum(1) > 0.9).all()  # outwards, all of them


def test_many_points_are_thinned_and_noise_leaves_a_surface(sphere: Shape) -> None:
    rng = np.random.default_rng(0)
    points = sample_surface(sphere, 6000, rng).points + 0.01 * rng.standard_normal((6000, 3))
    kept, faces = triangulate_cloud(Shape(points, NONE), 1000)
    mesh = Shape(points[kept], faces)
    assert len(np.unique(kept)) == len(kept) <= 500
    assert mesh.area == pytest.approx(4 * np.pi, rel=0.1)


def test_points_of_no_surface_are_refused() -> None:
    points = np.random.default_rng(0).standard_normal((400, 3))
    with pytest.raises(InputError, match="too rough") as caught:
        triangulate_cloud(Shape(points, NONE, "fog"), 1000)
    assert "--template" in caught.value.hint
