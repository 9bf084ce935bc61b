"""Samples: on the surface, evenly spread, the same for the same seed; farthest points against a slow loop."""

import numpy as np
import pytest

from meshmatch.errors import InputError
from meshmatch.geometry.triangles import normalized
from meshmatch.shapes.sampling import farthest_points, sample_surface
from meshmatch.shapes.shape import Shape


def test_samples_lie_where_they_say(torus: Shape) -> None:
    samples = sample_surface(torus, 500, np.random.default_rng(0))
    corners = torus.verts[torus.faces[samples.face]]
    np.testing.assert_allclose(np.einsum("pk,pki->pi", samples.barycentric, corners), samples.points)
    np.testing.assert_allclose(samples.barycentric.sum(axis=1), 1.0)
    assert samples.barycentric.min() >= 0
    np.testing.assert_array_equal(samples.normals, normalized(torus.face_vectors)[samples.face])
    nearest = torus.faces[samples.face, samples.barycentric.argmax(axis=1)]
    np.testing.assert_array_equal(samples.vertex, nearest)


def test_each_face_gets_its_share(cube: Shape) -> None:
    """Stretched: two sides of area 1, four of area 9. Counts within five sigma of area, inside a face too."""
    box = Shape(cube.verts * [1, 1, 9], cube.faces)
    P = 40_000
    samples = sample_surface(box, P, np.random.default_rng(1))
    share = box.face_areas / box.area
    counts = np.bincount(samples.face, minlength=box.F)
    assert (np.abs(counts - P * share) < 5 * np.sqrt(P * share)).all()
    np.testing.assert_allclose(samples.barycentric.mean(axis=0), 1 / 3, atol=0.01)
    # uniform in a triangle: the mean of the squared weights is 1/6
    np.testing.assert_allclose((samples.barycentric**2).mean(axis=0), 1 / 6, atol=0.01)


def test_same_seed_same_samples(torus: Shape) -> None:
    one, two, other = (sample_surface(torus, 100, np.random.default_rng(s)) for s in (3, 3, 4))
    np.testing.assert_array_equal(one.points, two.points)
    assert (one.points != other.points).any()
    assert sample_surface(torus, 0, np.random.default_rng(0)).points.shape == (0, 3)


def test_faces_without_area_get_nothing() -> None:
    verts = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0]]
    shape = Shape(verts, [[0, 1, 3], [0, 1, 2], [0, 1, 3]])
    assert (sample_surface(shape, 200, np.random.default_rng(0)).face == 1).all()
    with pytest.raises(InputError, match="no surface to sample"):
        sample_surface(Shape(verts, [[0, 1, 3]]), 5, np.random.default_rng(0))


def test_cloud_draws_its_own_points_without_repetition(sphere: Shape) -> None:
    shape = Shape(sphere.verts, [])
    samples = sample_surface(shape, 400, np.random.default_rng(0))
    assert len(np.unique(samples.vertex)) == 400
    np.testing.assert_array_equal(samples.points, sphere.verts[samples.vertex])
    np.testing.assert_array_equal(samples.normals, shape.vertex_normals[samples.vertex])
    assert (samples.face == -1).all()
    np.testing.assert_array_equal(samples.barycentric, [[1, 0, 0]] * 400)
    more = sample_surface(shape, 1000, np.random.default_rng(0))
    assert len(np.unique(more.vertex)) == sphere.V  # all, and some again
    assert len(more.points) == 1000


def test_cloud_of_uneven_density_is_drawn_evenly() -> None:
    rng = np.random.default_rng(0)
    points = rng.random((12_000, 3)) * [1, 1, 0]
    points = np.vstack([points[:10_000] * [0.5, 1, 0], points[10_000:] * [0.5, 1, 0] + [0.5, 0, 0]])
    chosen = sample_surface(Shape(points, []), 1500, rng).points
    assert (points[:, 0] < 0.5).mean() > 0.8
    assert (chosen[:, 0] < 0.5).mean() == pytest.approx(0.5, abs=0.06)


def test_invalid_points_of_a_cloud_are_never_drawn(sphere: Shape) -> None:
    invalid = np.zeros(sphere.V, bool)
    invalid[::3] = True
    shape = Shape(sphere.verts, [], invalid=invalid)
    samples = sample_surface(shape, 1000, np.random.default_rng(0))
    assert not invalid[samples.vertex].any()


def slow_farthest(points: np.ndarray, K: int) -> list[int]:
    chosen = [0]
    while len(chosen) < K:
        distance = np.linalg.norm(points[:, None] - points[chosen][None], axis=2).min(axis=1)
        distance[chosen] = -1
        chosen.append(int(distance.argmax()))
    return chosen


@pytest.mark.parametrize("seed", [0, 17])
def test_farthest_points_against_the_slow_way(seed: int) -> None:
    points = np.random.default_rng(seed).normal(size=(80, 3))
    np.testing.assert_array_equal(farthest_points(points, 30), slow_farthest(points, 30))


def test_farthest_points_on_a_line_and_among_doubles() -> None:
    line = np.stack([np.arange(5.0), np.zeros(5), np.zeros(5)], axis=1)
    np.testing.assert_array_equal(farthest_points(line, 3), [0, 4, 2])
    assert sorted(farthest_points(np.zeros((4, 3)), 4)) == [0, 1, 2, 3]
    with pytest.raises(InputError, match="cannot choose 6 of 5"):
        farthest_points(line, 6)
