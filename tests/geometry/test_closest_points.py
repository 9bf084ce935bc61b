"""Iterative closest points from many starts at once."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from meshmatch.geometry.closest_points import ClosestPoints
from meshmatch.geometry.frames import RigidPose
from meshmatch.geometry.oriented import OrientedPoints

TURN = RigidPose(Rotation.from_euler("xyz", [40, -25, 10], degrees=True).as_matrix(), np.array([0.02, -0.03, 0.01]))


@pytest.fixture(scope="module")
def target() -> OrientedPoints:
    box = trimesh.creation.box((1.0, 0.6, 0.3)).subdivide().subdivide()
    return OrientedPoints(np.asarray(box.vertices), np.asarray(box.vertex_normals))


def turned(target: OrientedPoints) -> OrientedPoints:
    return OrientedPoints(TURN.to_world(target.points), target.normals @ TURN.rotation.T)


def starts(count: int) -> list[RigidPose]:
    return [RigidPose(turn, np.zeros(3)) for turn in Rotation.random(count, random_state=1).as_matrix()]


def test_a_near_start_ends_where_the_shape_lies(target: OrientedPoints) -> None:
    near = RigidPose(TURN.rotation @ Rotation.from_euler("z", 8, degrees=True).as_matrix(), np.zeros(3))
    points = ClosestPoints(turned(target), target)
    (found,) = points.nearer([near], 30)
    assert np.allclose(found.rotation, TURN.rotation, atol=1e-3) and np.allclose(found.center, TURN.center, atol=1e-3)
    before, after = points.residuals([near, found])
    assert after < 1e-3 < before


@pytest.mark.parametrize("asking", [None, (np.arange(0, 90, 3), np.arange(0, 90, 2))])
def test_starts_together_go_where_each_goes_alone(
    target: OrientedPoints, asking: tuple[np.ndarray, np.ndarray] | None
) -> None:
    points, some = ClosestPoints(turned(target), target, asking), starts(7)
    together = points.nearer(some, 12)
    alone = [points.nearer([each], 12)[0] for each in some]
    for one, other in zip(together, alone, strict=True):
        assert np.allclose(one.rotation, other.rotation, atol=1e-9) and np.allclose(one.center, other.center, atol=1e-9)
        assert np.linalg.det(one.rotation) == pytest.approx(1)
    assert np.allclose(points.residuals(together), [points.residuals([each])[0] for each in together])


def test_no_step_leaves_poses_as_they_are(target: OrientedPoints) -> None:
    (found,) = ClosestPoints(target, target).nearer([TURN], 0)
    assert np.array_equal(found.rotation, TURN.rotation) and np.array_equal(found.center, TURN.center)
