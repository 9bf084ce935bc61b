"""Compactness, generalisation and specificity: against slow loops, and where wrong correspondences would be praised."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from meshmatch.collections.atlas import Atlas
from meshmatch.collections.measures import measure_atlas
from meshmatch.errors import InputError, OptionError
from meshmatch.shapes.shape import Shape
from tests.collections.ellipsoids import ellipsoids, moved
from tests.conftest import icosphere


def rough_ellipsoids(count: int) -> tuple[np.ndarray, np.ndarray]:
    given = ellipsoids(count, splits=1)
    return given.points + 0.01 * np.random.default_rng(1).standard_normal(given.points.shape), given.faces


def test_generalisation_is_leave_one_out() -> None:
    """By an atlas of the others, of plain components, for each shape."""
    points, faces = rough_ellipsoids(6)
    atlas = Atlas.of(points, faces)
    found = measure_atlas(atlas, points, samples=3)
    assert found.counts.tolist() == [1, 2, 3, 4]
    assert found.left_out == 1
    aligned, _ = atlas.align(points)
    root = np.sqrt(atlas.weights)[:, None]
    errors = np.empty((6, 4))
    for k in range(6):
        others = np.delete(aligned, k, axis=0)
        mean = others.mean(axis=0)
        known = replace(atlas, mean=mean).align(aligned[k][None])[0][0]
        sides = np.linalg.svd(((others - mean) * root).reshape(5, -1), full_matrices=False)[2]
        for count in range(1, 5):
            basis = sides[:count]
            part = (basis.T @ (basis @ ((known - mean) * root).ravel())).reshape(-1, 3) / root
            errors[k, count - 1] = atlas.weights @ np.linalg.norm(mean + part - known, axis=1)
    assert found.generalisation == pytest.approx(errors.mean(axis=0), rel=1e-4)
    assert found.generalisation_error == pytest.approx(errors.std(axis=0, ddof=1) / np.sqrt(6), rel=1e-3)
    assert (np.diff(found.generalisation) < 0).all()
    assert (found.generalisation_surface < found.generalisation).all()
    assert found.compactness == pytest.approx(atlas.compactness[:4])


def test_specificity_is_the_distance_to_the_nearest() -> None:
    points, faces = rough_ellipsoids(6)
    atlas = Atlas.of(points, faces)
    found = measure_atlas(atlas, points, samples=8, seed=4)
    aligned, _ = atlas.align(points)
    nearest = np.empty((8, 4))
    draws = np.random.default_rng(4).standard_normal((8, len(atlas.modes)))
    for number, draw in enumerate(draws):
        for count in range(1, 5):
            made = atlas.shape(draw[:count]).verts
            apart = (atlas.weights @ np.linalg.norm(made - each, axis=1) for each in aligned)
            nearest[number, count - 1] = min(apart)
    assert found.specificity == pytest.approx(nearest.mean(axis=0), rel=1e-6)
    assert found.specificity_error == pytest.approx(nearest.std(axis=0, ddof=1) / np.sqrt(8), rel=1e-6)
    assert (found.specificity_surface < found.specificity).all()
    again = measure_atlas(atlas, points, samples=8, seed=4)
    assert np.array_equal(found.specificity_surface, again.specificity_surface)


def test_two_balls_are_as_far_apart_as_their_surfaces() -> None:
    """Balls of radius 1 and 1 + t: t apart, point by point and surface to surface, but for flat triangles."""
    ball = icosphere(2)
    radii = np.array([1.0, 1.1, 1.2, 1.3, 1.4])
    points = ball.verts * radii[:, None, None]
    atlas = Atlas.of(points, ball.faces)
    found = measure_atlas(atlas, points, samples=60)
    assert found.counts.tolist() == [1]
    assert found.generalisation[0] < 1e-9
    assert found.generalisation_surface[0] < 1e-9
    draws = 1.2 + radii.std(ddof=1) * np.random.default_rng(0).standard_normal((60, len(atlas.modes)))[:, 0]
    true = np.abs(draws[:, None] - radii).min(axis=1).mean()
    assert found.specificity[0] == pytest.approx(true, rel=1e-6)
    assert found.specificity_surface[0] == pytest.approx(true, rel=0.1)


def slid(count: int) -> tuple[np.ndarray, np.ndarray]:
    """One ellipsoid, its points slid along the surface at random, in every shape in another way."""
    ball = icosphere(3)
    noise = 0.05 * np.random.default_rng(0).standard_normal((count, *ball.verts.shape))
    on_ball = ball.verts + noise
    return on_ball / np.linalg.norm(on_ball, axis=2, keepdims=True) * [1, 1.5, 2], ball.faces


def test_points_see_what_surfaces_do_not() -> None:
    points, faces = slid(6)
    found = measure_atlas(Atlas.of(points, faces), points, samples=5)
    assert found.generalisation_surface[0] < 0.3 * found.generalisation[0]


def test_the_shapes_themselves_may_be_given() -> None:
    """Registered shapes that all lie 0.1 inside: between their points nothing is wrong."""
    ball = icosphere(3)
    radii = np.array([1.0, 1.1, 1.2, 1.3, 1.4])
    points = ball.verts * radii[:, None, None]
    real = moved(ball.verts * (radii + 0.1)[:, None, None])
    turned = moved(points)
    atlas = Atlas.of(turned, ball.faces)
    surfaces = [Shape(verts, ball.faces) for verts in real]
    found = measure_atlas(atlas, turned, surfaces=surfaces, samples=2)
    assert found.generalisation[0] < 1e-9
    assert found.generalisation_surface[0] == pytest.approx(0.1, rel=0.03)


def test_what_the_registration_misses_counts() -> None:
    """Half of every shape is a second ball, 5 away, where no registered point lies: it is 4 away from the first."""
    ball = icosphere(2)
    radii = np.array([0.98, 0.99, 1.0, 1.01, 1.02])
    points = ball.verts * radii[:, None, None]
    atlas = Atlas.of(points, ball.faces)
    faces = np.concatenate([ball.faces, ball.faces + ball.V])
    away = np.array([5.0, 0, 0])
    surfaces = [Shape(np.concatenate([verts, verts + away]), faces) for verts in points]
    found = measure_atlas(atlas, points, surfaces=surfaces, samples=2)
    far = np.linalg.norm(ball.verts + away, axis=1).mean() - 1
    assert found.generalisation[0] < 1e-9
    assert found.generalisation_surface[0] == pytest.approx(
        far / 2 / 2, rel=0.05
    )  # half of the surface, one of two ways


def test_large_collections_are_measured_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    points, faces = rough_ellipsoids(10)
    atlas = Atlas.of(points, faces)
    seen: list[float] = []
    monkeypatch.setattr("meshmatch.collections.measures.MAX_FOLDS", 5)
    parts = measure_atlas(atlas, points, samples=2, progress=lambda stage, name, share: seen.append(share))
    monkeypatch.undo()
    whole = measure_atlas(atlas, points, samples=2)
    assert (parts.left_out, whole.left_out) == (2, 1)
    assert parts.counts[-1] == 7
    assert parts.generalisation[:3] == pytest.approx(whole.generalisation[:3], rel=0.3)
    assert seen == sorted(seen)
    assert seen[-1] == 1


def test_some_of_very_many_are_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    points, faces = rough_ellipsoids(12)
    atlas = Atlas.of(points, faces)
    monkeypatch.setattr("meshmatch.collections.measures.MAX_SHAPES", 6)
    found = measure_atlas(atlas, points, samples=2)
    assert found.counts[-1] == 4
    assert np.isfinite(found.generalisation).all()


@pytest.mark.parametrize("robust", [False, True])
def test_shapes_that_are_the_same_without_one(robust: bool) -> None:
    """Left out, it is as far from the others as it is: they have no mode."""
    given = ellipsoids(2, splits=1)
    points = np.stack([given.points[0]] * 3 + [given.points[1]])
    if robust:
        with pytest.raises(InputError, match="most of the shapes do not differ"):
            Atlas.of(points, given.faces, robust=True)
        return
    atlas = Atlas.of(points, given.faces)
    found = measure_atlas(atlas, points, samples=2)
    apart = atlas.weights @ np.linalg.norm(given.points[1] - given.points[0], axis=1)
    assert found.generalisation[0] == pytest.approx(apart / 4, rel=1e-3)


def test_what_cannot_be_measured() -> None:
    points, faces = rough_ellipsoids(5)
    atlas = Atlas.of(points, faces)
    with pytest.raises(InputError, match="5 shapes, not of 4"):
        measure_atlas(atlas, points[:4])
    with pytest.raises(OptionError, match="two random shapes"):
        measure_atlas(atlas, points, samples=1)
    with pytest.raises(InputError, match="four shapes"):
        measure_atlas(Atlas.of(points[:3], faces), points[:3])
