"""Points with normals: moved, thinned, turned to face as others do."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from meshmatch.geometry.frames import Frame, RigidPose
from meshmatch.geometry.oriented import (
    NORMAL_WEIGHT,
    OrientedPoints,
    feature_tree,
    nearest_by_brute_force,
    nearest_unsigned,
    quick_tree,
    with_normals,
)
from meshmatch.geometry.triangles import edge_lengths, is_discontinuous, normalized


def ball(signed: bool = True) -> OrientedPoints:
    points = np.random.default_rng(0).normal(size=(300, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    return OrientedPoints(points, points.copy(), signed, np.linspace(0, 1, 300))


def test_a_pose_moves_points_and_turns_normals() -> None:
    pose = RigidPose(Rotation.from_rotvec([0, 0, 1.0]).as_matrix(), np.array([1.0, 0, 0]))
    moved = ball().to_local(pose)
    assert np.allclose(pose.to_world(moved.points), ball().points)
    assert np.allclose(moved.normals @ pose.rotation.T, ball().normals)
    assert moved.weights is not None and moved.weights[-1] == 1


def test_a_frame_scales_points_alone() -> None:
    frame = Frame(2.0, Rotation.from_rotvec([0, 0, 1.0]).as_matrix(), np.array([1.0, 0, 0]))
    moved = ball().in_frame(frame)
    assert np.allclose(moved.points, frame.apply(ball().points))
    assert np.allclose(moved.normals, ball().normals @ frame.rotation.T)


def test_thinning_keeps_every_third_with_its_weight() -> None:
    thin = ball().thinned(100)
    assert np.array_equal(thin.points, ball().points[::3])
    assert thin.weights is not None and np.array_equal(thin.weights, np.linspace(0, 1, 300)[::3])
    assert np.array_equal(ball().first(7).normals, ball().normals[:7])


def test_normals_back_to_back_are_apart() -> None:
    here = np.zeros((1, 3))
    up = np.array([[0.0, 0, 1]])
    assert np.allclose(np.linalg.norm(with_normals(here, up) - with_normals(here, -up)), 2 * NORMAL_WEIGHT)


def test_unsigned_normals_face_as_their_surroundings_do() -> None:
    wrong = OrientedPoints(ball().points, -ball().normals, signed=False)
    turned = wrong.facing(ball())
    assert turned.signed and np.allclose(turned.normals, ball().normals)
    sure = OrientedPoints(ball().points, -ball().normals)
    assert sure.facing(ball()) is sure


def test_images_far_apart_of_near_neighbours_are_discontinuous() -> None:
    images = np.array([[0, 0, 0], [0.08, 0, 0], [0.1, 0, 0], [0, 0.1, 0]])
    apart = edge_lengths(images, np.array([[0, 1], [0, 2], [3, 0]]))
    assert np.allclose(apart, [0.08, 0.1, 0.1])
    assert is_discontinuous(apart, np.array([0.01, 0.01, 0.02])).tolist() == [False, True, False]


def test_normals_without_a_sign_are_compared_both_ways() -> None:
    """What is found in groups is what two searches of all points find."""
    rng = np.random.default_rng(0)
    points, normals = rng.random((500, 3)), normalized(rng.standard_normal((500, 3)))
    tree = OrientedPoints(rng.random((300, 3)), normalized(rng.standard_normal((300, 3)))).tree
    both = [tree.query(with_normals(points, sign * normals), distance_upper_bound=0.2) for sign in (1, -1)]
    distance, index, turned = nearest_unsigned(tree, points, normals, 0.2)
    assert np.array_equal(distance, np.minimum(both[0][0], both[1][0]))
    assert np.array_equal(turned, both[1][0] < both[0][0]) and 50 < turned.sum() < 450
    assert np.array_equal(index, np.where(turned, both[1][1], both[0][1])) and (index == tree.n).any()
    assert [len(each) for each in nearest_unsigned(tree, points[:0], normals[:0], 0.2)] == [0, 0, 0]


@pytest.mark.parametrize(("P", "Q"), [(1, 5), (300, 2000), (512, 900), (3000, 768)])
@pytest.mark.parametrize("D", [3, 6])
def test_comparing_all_with_all_answers_as_a_tree_does_up_to_rounding(P: int, Q: int, D: int) -> None:
    rng = np.random.default_rng(0)
    points, queries = (rng.normal(size=(count, D)) + 100 for count in (P, Q))
    queries[::2] = 9 * (queries[::2] - 100) + 100  # far away
    distance, expected = quick_tree(points).query(queries)
    found = nearest_by_brute_force(points, queries)
    assert np.allclose(np.linalg.norm(points[found] - queries, axis=1), distance, rtol=1e-5)
    assert (found != expected).mean() < 0.001


@pytest.mark.parametrize("plant", [quick_tree, feature_tree])
def test_trees_that_are_built_quickly_find_the_nearest(plant: Callable[..., Any]) -> None:
    """Also among points that are unevenly spread, and of which many are the same."""
    rng = np.random.default_rng(2)
    points = np.concatenate([rng.normal(size=(300, 3)), 1e-3 * rng.normal(size=(300, 3)), np.zeros((200, 3))])
    asked = np.concatenate([rng.normal(size=(200, 3)), 1e-3 * rng.normal(size=(200, 3))])
    every = np.linalg.norm(points[None] - asked[:, None], axis=2)
    distance, index = plant(points).query(asked)
    assert np.allclose(distance, every.min(1))
    assert np.allclose(every[np.arange(len(asked)), index], distance)
