"""Frames, rigid poses and the best rigid motion."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from meshmatch.errors import InputError
from meshmatch.geometry.frames import Frame, RigidPose, kabsch


def turned(seed: int) -> np.ndarray:
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


def test_frame_by_hand() -> None:
    quarter = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])  # x to y
    frame = Frame(2.0, quarter, [1, 0, 0])
    np.testing.assert_allclose(frame.apply([3, 0, 0]), [0, 1, 0], atol=1e-15)
    np.testing.assert_allclose(frame.undo([0, 1, 0]), [3, 0, 0], atol=1e-15)


@pytest.mark.parametrize("scale", [1e-6, 0.3, 1750.0])
def test_frame_laws(scale: float) -> None:
    rng = np.random.default_rng(1)
    frame = Frame(scale, turned(2), rng.normal(size=3) * scale)
    other = Frame(2.5, turned(3), rng.normal(size=3))
    points = rng.normal(size=(5, 4, 3)) * scale
    np.testing.assert_allclose(frame.undo(frame.apply(points)), points, rtol=0, atol=1e-12 * scale)
    np.testing.assert_allclose(frame.apply(frame.undo(points)), points, rtol=0, atol=1e-12 * max(scale, 1))
    composed = frame.compose(other)
    np.testing.assert_allclose(composed.apply(points), other.apply(frame.apply(points)), atol=1e-10)
    np.testing.assert_allclose(composed.undo(points), frame.undo(other.undo(points)), rtol=1e-9, atol=1e-9 * scale)
    same = frame.compose(Frame.identity())
    np.testing.assert_allclose(same.apply(points), frame.apply(points), atol=1e-12)
    np.testing.assert_array_equal(Frame.identity().apply(points), points)


@pytest.mark.parametrize(
    ("scale", "rotation", "center", "words"),
    [
        (0.0, np.eye(3), np.zeros(3), "scale must be positive"),
        (-1.0, np.eye(3), np.zeros(3), "scale must be positive"),
        (np.nan, np.eye(3), np.zeros(3), "scale must be positive"),
        (1.0, 2 * np.eye(3), np.zeros(3), "rotation must be orthonormal"),
        (1.0, 1e200 * np.eye(3), np.zeros(3), "rotation must be orthonormal"),
        (1.0, np.eye(4), np.zeros(3), "rotation and a"),
        (1.0, np.eye(3), [0, 0, np.inf], "center must be finite"),
    ],
)
def test_frame_refuses(scale: float, rotation: np.ndarray, center: np.ndarray, words: str) -> None:
    with pytest.raises(InputError, match=f"frame.*{words}"):
        Frame(scale, rotation, center)


def test_a_frame_may_mirror() -> None:
    points, plain = np.random.default_rng(1).normal(size=(5, 3)), Frame(2.0, turned(4), np.ones(3))
    frame = Frame(2.0, turned(4) * [[-1], [1], [1]], np.ones(3))
    np.testing.assert_allclose(frame.apply(points), plain.apply(points) * [-1, 1, 1])
    np.testing.assert_allclose(frame.undo(frame.apply(points)), points)
    assert frame.mirrored and not plain.mirrored
    np.testing.assert_allclose(frame.turn, turned(4))
    assert frame.compose(plain).mirrored and not frame.compose(frame).mirrored


def pose(seed: int) -> RigidPose:
    return RigidPose(turned(seed), np.random.default_rng(seed).normal(size=3))


def test_a_pose_by_hand() -> None:
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # x to y
    one = RigidPose(quarter, np.array([1.0, 2, 3]))
    assert np.allclose(one.to_world(np.array([[1.0, 0, 0]])), [[1, 3, 3]])
    assert np.allclose(one.to_local(np.array([[1.0, 3, 3]])), [[1, 0, 0]])
    assert one.angle_to(RigidPose.identity()) == pytest.approx(90)


def test_pose_laws() -> None:
    points = np.random.default_rng(0).normal(size=(7, 3))
    one, other = pose(1), pose(2)
    assert np.allclose(one.to_local(one.to_world(points)), points)
    assert np.allclose((one @ other).to_world(points), one.to_world(other.to_world(points)))
    assert np.allclose(one.frame.apply(points), one.to_local(points))
    assert one.angle_to(one) == pytest.approx(0, abs=1e-5)


def test_a_rigid_motion_is_found_again() -> None:
    source, true = np.random.default_rng(0).normal(size=(9, 3)), pose(3)
    for weights in (None, np.ones(9), np.linspace(1, 2, 9)):
        found = kabsch(source, true.to_world(source), weights)
        assert np.allclose(found.rotation, true.rotation)
        assert np.allclose(found.center, true.center)


def test_a_mirror_image_gets_a_rotation_all_the_same() -> None:
    source = np.random.default_rng(1).normal(size=(9, 3))
    assert np.linalg.det(kabsch(source, source * [-1, 1, 1]).rotation) == pytest.approx(1)


def test_a_weighted_motion_ignores_what_has_no_weight() -> None:
    source = np.random.default_rng(0).standard_normal((20, 3))
    rotation = Rotation.from_rotvec([0.3, 0.2, 0.1]).as_matrix()
    target = source @ rotation.T + [1, 2, 3]
    target[:5] += 10
    found = kabsch(source, target, np.repeat([0.0, 1.0], [5, 15]))
    assert np.allclose(found.rotation, rotation) and np.allclose(found.center, [1, 2, 3])
    assert not np.allclose(kabsch(source, target).rotation, rotation)
