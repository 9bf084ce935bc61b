"""Points of noisy clouds: means over where they may belong, and who stands back."""

from dataclasses import replace

import numpy as np
import pytest

from meshmatch.fitting.fit import Fit
from meshmatch.maps import places
from meshmatch.maps.build import build_map
from meshmatch.maps.places import Places, expectation, is_noisy, noise_level
from meshmatch.shapes.repair import repair
from meshmatch.shapes.shape import Shape
from tests.conftest import some_fit
from tests.maps.solids import grid

NO_FACES = np.empty((0, 3), np.int64)


def plate(side: int = 21, height: float = 0.0) -> Fit:
    """A square plate of side 1, that rests where it lies."""
    sheet = grid(side - 1, side - 1, 1 / (side - 1))
    return some_fit(sheet.verts + np.array([0, 0, height]), sheet.faces)


def test_the_noise_is_that_of_the_distances_whatever_a_few_strays_do() -> None:
    apart = np.abs(0.015 * np.random.default_rng(0).standard_normal(4000))
    assert noise_level(apart) == pytest.approx(0.015, rel=0.06)
    apart[:200] = 3.0
    assert noise_level(apart) == pytest.approx(0.015, rel=0.12)
    assert (noise_level(0 * apart), noise_level(apart + 9)) == (0.006, 0.03)


def test_means_are_those_of_a_plain_loop() -> None:
    fit = plate(5)  # 25 vertices and 32 face centers; 48 of them are asked
    values = np.stack([fit.points[:, 0] ** 2, fit.points[:, 1]], 1)
    samples = np.concatenate([fit.points, fit.points[fit.faces].mean(1)])
    sampled = np.concatenate([values, values[fit.faces].mean(1)])
    areas = np.full(len(fit.faces), 1 / 32)
    prior = np.concatenate([np.bincount(fit.faces.reshape(-1), np.repeat(areas / 3, 3)), areas]) / 2
    asked = np.array([[0.4, 0.3, 0.1], [1.2, 0.5, 0]])
    (mean, other), variance = expectation(asked, fit, 0.2, [values, fit.points])
    for n, point in enumerate(asked):
        apart = np.linalg.norm(samples - point, axis=1)
        near = np.argsort(apart)[:48]
        share = prior[near] * np.exp(-0.5 * (apart[near] / 0.2) ** 2)
        share /= share.sum()
        assert np.allclose(mean[n], share @ sampled[near])
        assert np.allclose(other[n], share @ samples[near])
        around = np.square(sampled[near] - mean[n]).sum(1)
        assert variance[n] == pytest.approx(share @ around)


def test_a_point_far_from_everything_has_a_mean_all_the_same() -> None:
    fit = plate()
    (mean,), variance = expectation(np.array([[0.5, 0.5, 40.0]]), fit, 0.01, [fit.points])
    assert np.allclose(mean, [[0.5, 0.5, 0]], atol=0.05) and np.isfinite(variance).all()


def test_of_two_points_as_near_the_better_known_one_is_chosen() -> None:
    """Both belong to the same place on the average, but one of them might as well be elsewhere."""
    cloud = Shape(np.array([[0.5, 0.5, 0.0], [0.5, 0.5, 0.01]]), NO_FACES)
    known = Places.of(repair(cloud), plate())
    unsure = replace(known, resting=known.resting * np.float32([1, 1, 0]), spread=np.array([0.05, 0.01], np.float32))
    found = unsure.nearest(np.array([[0.5, 0.52, 0.0]], np.float32))
    assert found.vertex.tolist() == [1]
    assert found.distance == pytest.approx(np.hypot(0.01, 0.02), rel=1e-5)
    assert found.face.tolist() == [-1] and found.barycentric.tolist() == [[1, 0, 0]]


def noisy(shape: np.ndarray, size: float, seed: int) -> Shape:
    return Shape(shape + size * np.random.default_rng(seed).standard_normal(shape.shape), NO_FACES)


def rolled(sheet: np.ndarray, radius: float) -> np.ndarray:
    """Angles and heights (N, 2) on a cylinder."""
    return np.stack([radius * np.cos(sheet[:, 0]), radius * np.sin(sheet[:, 0]), sheet[:, 1]], 1)


def test_noise_costs_a_map_less_than_closest_points_do(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two noisy copies of the same points of a limb, laid on perfectly."""
    across, along = 0.04, np.random.default_rng(0).random(4000)
    angle = 2 * np.pi * np.random.default_rng(1).random(4000)
    clean = rolled(np.stack([angle, along], 1), across)
    flat = plate(41)
    limb = rolled(flat.points[:, :2] * [2 * np.pi, 1], across)
    fit = replace(flat, points=limb, resting=limb)
    source, target = noisy(clean, 0.015, 2), noisy(clean, 0.015, 3)
    assert is_noisy(source) and is_noisy(target) and not is_noisy(noisy(clean, 0.0, 1))
    errors = []
    for rule in (is_noisy, lambda shape: False):
        monkeypatch.setattr(places, "is_noisy", rule)
        found = build_map(Places.of(repair(source), fit), Places.of(repair(target), fit))
        errors.append(np.linalg.norm(clean[found.index] - clean, axis=1).mean())
    assert errors[0] < 0.99 * errors[1]
