"""What is estimated for a cloud: area and normals against surfaces whose own are known."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.sparse import csgraph

from meshmatch.shapes import cloud
from meshmatch.shapes.cloud import estimate_normals, local_areas, outlier_points, roughness
from meshmatch.shapes.faces import agreeing_flips
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape


def on_sphere(P: int, seed: int = 0, density: float = 0.0) -> np.ndarray:
    """Points of the unit sphere; `density` > 0 favours the upper half, up to e^(2 density) times."""
    rng = np.random.default_rng(seed)
    tried = 20 * P if density else P
    points = rng.normal(size=(tried, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    return points[rng.random(tried) < np.exp(density * (points[:, 2] - 1))][:P]


@pytest.mark.parametrize(("P", "seed"), [(500, 0), (500, 1), (2000, 0), (2000, 1), (10_000, 0), (25_000, 0)])
def test_area_of_a_sphere(P: int, seed: int) -> None:
    assert local_areas(on_sphere(P, seed)).sum() == pytest.approx(4 * np.pi, rel=0.05)


@pytest.mark.parametrize("scale", [1e-5, 1.0, 1750.0])
def test_area_scales_as_it_should(scale: float) -> None:
    points = on_sphere(1000)
    np.testing.assert_allclose(local_areas(points * scale), local_areas(points) * scale**2, rtol=1e-6)


@pytest.mark.parametrize("density", [1.0, 1.5])
def test_area_does_not_depend_on_density(density: float) -> None:
    points = on_sphere(8000, density=density)
    areas = local_areas(points)
    assert areas.sum() == pytest.approx(4 * np.pi, rel=0.07)
    # each half of the sphere gets its half although nearly all points are in one
    assert (points[:, 2] > 0).mean() > 0.7
    assert areas[points[:, 2] > 0].sum() == pytest.approx(2 * np.pi, rel=0.1)


@pytest.mark.parametrize("noise", [0.01, 0.03])
def test_area_of_a_noisy_sphere(noise: float) -> None:
    points = on_sphere(10_000)
    noisy = points + np.random.default_rng(5).normal(size=points.shape) * noise
    assert local_areas(noisy).sum() == pytest.approx(4 * np.pi, rel=0.08)


@pytest.mark.parametrize("splits", [3, 4])
def test_area_of_the_vertices_of_an_even_mesh(make_sphere: Callable[[int], Shape], splits: int) -> None:
    assert local_areas(make_sphere(splits).verts).sum() == pytest.approx(4 * np.pi, rel=0.12)


@pytest.mark.parametrize("slant", [0.0, 0.5])
def test_area_inside_a_regular_grid(slant: float) -> None:
    x, y = np.meshgrid(np.arange(60.0), np.arange(60.0))
    grid = np.stack([x + slant * y, y * (1 - slant**2) ** 0.5, 0 * x], axis=-1).reshape(-1, 3)
    inner = ((x > 5) & (x < 55) & (y > 5) & (y < 55)).ravel()  # a border has no neighbours outside
    assert local_areas(grid)[inner].mean() == pytest.approx((1 - slant**2) ** 0.5, rel=0.08)


def test_one_outlier_does_not_blow_up_the_area() -> None:
    points = np.vstack([on_sphere(2000), [[50, 0, 0]]])
    assert local_areas(points).sum() == pytest.approx(4 * np.pi, rel=0.08)


def test_few_points_and_points_in_one_place() -> None:
    assert (local_areas(np.zeros((3, 3))) == 0).all()
    assert (local_areas(np.zeros((50, 3))) == 0).all()
    assert (estimate_normals(np.zeros((2, 3))) == 0).all()
    assert np.isfinite(estimate_normals(np.zeros((50, 3)))).all()
    assert np.isfinite(local_areas(np.arange(15.0).reshape(5, 3))).all()


def test_invalid_points_count_for_nothing() -> None:
    points = on_sphere(1000)
    invalid = np.zeros(1000, bool)
    invalid[:10] = True
    points[invalid] = 0
    shape = Shape(points, [], invalid=invalid)
    assert (shape.vertex_areas[:10] == 0).all()
    assert (shape.vertex_normals[:10] == 0).all()
    assert shape.area == pytest.approx(4 * np.pi, rel=0.06)
    np.testing.assert_allclose(np.linalg.norm(shape.vertex_normals[10:], axis=1), 1)


@pytest.mark.parametrize("large", [False, True])
def test_normals_of_a_torus(torus: Shape, monkeypatch: pytest.MonkeyPatch, large: bool) -> None:
    samples = sample_surface(torus, 6000, np.random.default_rng(0))
    if large:
        monkeypatch.setattr(cloud, "LARGEST", 2500)
    normals = estimate_normals(samples.points)
    cosine = np.einsum("ni,ni->n", normals, samples.normals)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1)
    assert np.median(cosine) > 0.99
    assert (cosine > 0).mean() > 0.999  # outward everywhere, the hole's inner side too
    assert local_areas(samples.points).sum() == pytest.approx(torus.area, rel=0.05)


def test_normals_of_two_balls_are_outward_on_each() -> None:
    points = np.vstack([on_sphere(800), on_sphere(800, 1) * 0.5 + [5, 0, 0]])
    normals = estimate_normals(points)
    out = points.copy()
    out[800:] -= [5, 0, 0]
    assert (np.einsum("ni,ni->n", normals, out) > 0).all()


def test_large_cloud_gives_each_point_its_share(monkeypatch: pytest.MonkeyPatch) -> None:
    points = on_sphere(9000, density=1.0)
    small = local_areas(points)
    monkeypatch.setattr(cloud, "LARGEST", 3000)
    part = local_areas(points)
    assert part.sum() == pytest.approx(small.sum(), rel=0.03)
    upper = points[:, 2] > 0
    assert part[upper].sum() == pytest.approx(small[upper].sum(), rel=0.05)
    assert (part > 0).all()
    np.testing.assert_array_equal(part, local_areas(points))  # the part is always the same


@pytest.mark.parametrize("largest", [20_000, 700])
def test_strays(monkeypatch: pytest.MonkeyPatch, largest: int) -> None:
    monkeypatch.setattr(cloud, "LARGEST", largest)
    points = np.vstack([on_sphere(2000), [[3, 0, 0], [0, 0, 0]]])
    np.testing.assert_array_equal(np.flatnonzero(outlier_points(points)), [2000, 2001])
    assert not outlier_points(points[:10]).any()


def test_loose_point_of_a_dense_patch_is_no_stray() -> None:
    """It is far for its neighbours, who are crowded, but not for the cloud."""
    x, y = np.meshgrid(np.arange(30.0), np.arange(30.0))
    grid = np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3)
    patch = grid[:100] * 0.02 + [100, 0, 0]
    assert not outlier_points(np.vstack([grid, patch, [[100.3, 0.5, 0]]])).any()


def test_flips_against_the_slow_way() -> None:
    """On random graphs without contradictions the flips make every pair agree; parts are the graph's."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        n = int(rng.integers(2, 40))
        truth = rng.random(n) < 0.5
        pairs = rng.integers(0, n, (int(rng.integers(1, 60)), 2))
        pairs = pairs[pairs[:, 0] != pairs[:, 1]]
        differ = truth[pairs[:, 0]] ^ truth[pairs[:, 1]]
        flip, part = agreeing_flips(n, pairs, differ, rng.random(len(pairs)))
        np.testing.assert_array_equal(flip[pairs[:, 0]] ^ flip[pairs[:, 1]], differ)
        label = np.arange(n)
        for _ in range(n):
            for a, b in pairs:
                label[a] = label[b] = min(label[a], label[b])
        assert len(np.unique(part)) == len(np.unique(label))
        assert len(np.unique(np.stack([part, label]), axis=1).T) == len(np.unique(label))


def test_the_graph_of_flips_has_indices_that_every_scipy_takes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Before 1.17.1 `minimum_spanning_tree` takes 32-bit indices alone."""
    seen = []
    monkeypatch.setattr(csgraph, "minimum_spanning_tree", lambda graph: seen.append(graph.indices.dtype) or graph)
    agreeing_flips(3, np.array([[0, 1], [1, 2]]), np.array([True, False]), np.array([0.1, 0.2]))
    assert seen == [np.int32]


def test_flips_trust_the_cheap_pairs() -> None:
    pairs = np.array([[0, 1], [1, 2], [0, 2]])  # a contradiction: the dearest word is not heard
    flip, _ = agreeing_flips(3, pairs, np.array([True, False, False]), np.array([0.1, 0.2, 0.9]))
    assert flip[0] != flip[1]
    assert flip[1] == flip[2]


@pytest.mark.parametrize("noise", [0.0, 0.003, 0.01])
def test_bodies_keep_their_size_as_clouds(bench: Path, noise: float) -> None:
    """The scale of a cloud is within 5 % of its mesh's, noise of 1 % of the diagonal included."""
    rng = np.random.default_rng(0)
    for name in ("scape/mesh000.ply", "shrec19/1.ply", "faust_scans/test_scan_000.ply"):
        mesh = load_shape(bench / name)
        points = mesh.verts + rng.normal(size=mesh.verts.shape) * noise * mesh.diagonal
        assert np.sqrt(Shape(points, []).area / mesh.area) == pytest.approx(1.0, abs=0.05), name


def test_points_that_lie_on_each_other_are_judged_once() -> None:
    """A search among many at one place looks at all of them: it would take hours."""
    crowd = np.concatenate([np.tile([[0.0, 1.0, 2.0]], (3000, 1)), np.random.default_rng(0).normal(size=(2000, 3))])
    assert len(cloud._subset(crowd)) == 2001
    assert cloud._subset(crowd[2000:]) is not crowd and len(cloud._subset(crowd[2000:])) == 3000
    equal = np.ones((300, 3))
    assert (local_areas(equal) == 0).all() and (estimate_normals(equal) == 0).all() and roughness(equal) == 0
    assert local_areas(crowd).shape == (5000,)
