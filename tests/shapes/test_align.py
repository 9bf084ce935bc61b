"""Rigid alignment: known turns are found, and the given orientation is believed where nothing speaks against it."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.shapes.alignment import ALIGNS, align, align_part, alignment_residual
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape


@pytest.fixture(scope="module")
def pear(sphere: Shape) -> OrientedPoints:
    """Three different axes, thick at one end of two of them: no turn brings it onto itself."""
    verts = sphere.verts * [0.25, 0.45, 0.33]
    verts[:, 0] *= 1 + 0.8 * sphere.verts[:, 1]
    verts[:, 2] *= 1 + 0.5 * sphere.verts[:, 0]
    samples = sample_surface(Shape(verts, sphere.faces), 400, np.random.default_rng(0))
    return OrientedPoints(samples.points - samples.points.mean(0), samples.normals)


def turned(part: OrientedPoints, rotation: np.ndarray, center: np.ndarray) -> OrientedPoints:
    return OrientedPoints(part.points @ rotation.T + center, part.normals @ rotation.T)


@pytest.mark.parametrize("seed", [0, 1])
def test_any_turn_is_found(pear: OrientedPoints, seed: int) -> None:
    rotation = Rotation.random(random_state=np.random.default_rng(seed)).as_matrix()
    center = np.array([0.02, -0.03, 0.01])
    best, *others = found = align(turned(pear, rotation, center), pear, "rigid", keep=4)
    assert np.allclose(best.pose.rotation, rotation, atol=0.02)
    assert np.allclose(best.pose.center, center, atol=0.01)
    assert best.residual < 0.02
    assert 1 <= len(others) <= 3
    for k, one in enumerate(found):  # answers are different turns
        for other in found[:k]:
            assert np.degrees(Rotation.from_matrix(one.pose.rotation.T @ other.pose.rotation).magnitude()) > 15


def test_near_improves_a_small_turn_and_none_leaves_it(pear: OrientedPoints) -> None:
    rotation = Rotation.from_rotvec([0.15, -0.1, 0.1]).as_matrix()
    shape = turned(pear, rotation, np.zeros(3))
    [near] = align(shape, pear, "near", keep=4)
    assert np.allclose(near.pose.rotation, rotation, atol=0.02)
    [still] = align(shape, pear, "none", keep=4)
    assert np.array_equal(still.pose.rotation, np.eye(3))
    assert still.residual > 2 * near.residual


def test_where_every_turn_fits_the_given_one_is_taken(sphere: Shape) -> None:
    drawn = (sample_surface(sphere, 600, np.random.default_rng(seed)) for seed in (0, 1))
    ball, other = (OrientedPoints(0.28 * samples.points, samples.normals) for samples in drawn)
    best, *others = align(ball, other, "rigid", keep=3)
    assert np.degrees(Rotation.from_matrix(best.pose.rotation).magnitude()) < 10
    assert len(others) == 2
    assert min(turn.residual for turn in others) < 1.1 * best.residual  # chance alone would have chosen one of these


def test_the_residual_by_hand() -> None:
    up = np.tile([0.0, 0.0, 1.0], (2, 1))
    a = OrientedPoints(np.array([[0.0, 0, 0], [1, 0, 0]]), up)
    b = OrientedPoints(np.array([[0.0, 0, 0.1], [1, 0, 0.1]]), up)
    assert alignment_residual(a, b) == pytest.approx(0.1)
    slanted = np.tile([np.sin(np.pi / 3), 0.0, 0.5], (2, 1))  # as far from up as up is long
    assert alignment_residual(a, OrientedPoints(b.points, slanted)) == pytest.approx(np.hypot(0.1, 0.15))
    assert alignment_residual(a, OrientedPoints(b.points + 50, up)) == pytest.approx(0.2)  # capped


def test_the_ways_have_names() -> None:
    assert ALIGNS == ("none", "near", "rigid")


@pytest.mark.parametrize("sign", [1, -1])
def test_an_end_finds_its_place(pear: OrientedPoints, sign: int) -> None:
    """Aligned by their centers, it lies in the middle of the whole."""
    along = sign * pear.points[:, 1]
    rows = np.flatnonzero(along > np.quantile(along, 0.7))
    rotation = Rotation.from_euler("xyz", [100, 20, 30], degrees=True).as_matrix()
    end = turned(pear.rows(rows), rotation, -rotation @ pear.points[rows].mean(0))
    best = align_part(end, pear, keep=2)[0]
    errors = [
        np.linalg.norm(each.pose.to_local(end.points) - pear.points[rows], axis=1).mean()
        for each in (best, align(end, pear, "rigid")[0])
    ]
    assert errors[0] < 0.01 < 0.05 < errors[1]
    assert best.residual < 0.01
