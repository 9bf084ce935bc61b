"""Proposed core frames: every one is a rotation, obeys what it must, and turns along with the scan."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from meshmatch.errors import OptionError
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.search.frames import (
    ask_aligner,
    axis_vector,
    forced_frames,
    frames_anywhere,
    frames_to_try,
    principal_pose,
    propose,
    random_rotations,
    standing_grid,
    with_flips,
)
from meshmatch.geometry.frames import RigidPose
from meshmatch.models.trained import TrainedModel
from tests.fitting.eggs import bent_egg, scan_of

AXES = [sign * axis for axis in np.eye(3) for sign in (1, -1)]


@pytest.fixture(scope="module")
def points(model: TrainedModel) -> np.ndarray:
    drawn = scan_of(bent_egg(model), 300).points
    return drawn / np.ptp(drawn, axis=0).max() + [0.2, 0, -0.1]


def check_rotations(matrices: np.ndarray) -> None:
    assert np.allclose(matrices @ matrices.transpose(0, 2, 1), np.eye(3), atol=1e-6)
    assert np.allclose(np.linalg.det(matrices), 1, atol=1e-6)


def rotations(guesses: list[RigidPose]) -> np.ndarray:
    return np.stack([guess.rotation for guess in guesses])


def test_turned_copies_are_rotations_of_one_seed_and_begin_as_they_are() -> None:
    turns = random_rotations(12, 3)
    check_rotations(turns)
    assert np.array_equal(turns[0], np.eye(3))
    assert np.array_equal(turns, random_rotations(12, 3))
    assert not np.allclose(turns[1:], random_rotations(12, 4)[1:])


def test_asking_about_turned_copies_is_turning_the_points_and_asking(model: TrainedModel, points: np.ndarray) -> None:
    turns = random_rotations(5, 0)
    R, t = ask_aligner(model.network, points, turns)
    aligner = model.network.aligner
    assert aligner is not None
    middle = points.mean(0)
    for k, turn in enumerate(turns):
        copy = torch.from_numpy((points - middle) @ turn.T).float()[None]
        with torch.inference_mode():
            there, center = model.network.align(aligner.features(copy))
        assert np.allclose(R[k], turn.T @ there[0].numpy(), atol=1e-4)
        assert np.allclose(t[k], turn.T @ center[0].numpy() + middle, atol=1e-4)
    check_rotations(R)


def test_frames_move_along_with_the_scan(model: TrainedModel, points: np.ndarray) -> None:
    Q, shift = Rotation.from_rotvec([0.5, 1.0, -0.4]).as_matrix(), np.array([1.0, -2, 0.5])
    turns = random_rotations(4, 1)
    R, t = ask_aligner(model.network, points, turns @ Q)
    moved_R, moved_t = ask_aligner(model.network, points @ Q.T + shift, turns)
    assert np.allclose(moved_R, Q @ R, atol=1e-4)
    assert np.allclose(moved_t, t @ Q.T + shift, atol=1e-4)


def test_frames_do_not_depend_on_how_the_file_stands(model: TrainedModel) -> None:
    Q, shift = Rotation.from_rotvec([0.5, 1.0, -0.4]).as_matrix(), np.array([1.0, -2, 0.5])
    scan = scan_of(bent_egg(model), 300)
    turned = replace(scan, points=scan.points @ Q.T + shift, normals=scan.normals @ Q.T)
    for search in (frames_to_try, frames_anywhere):
        own, theirs = (search(model, each, FitConfig()) for each in (scan, turned))
        assert len(own) == len(theirs) > 1
        np.testing.assert_allclose(Q @ rotations(own), rotations(theirs), atol=1e-6)
        for one, other in zip(own, theirs, strict=True):
            np.testing.assert_allclose(Q @ one.center + shift, other.center, atol=1e-6)


def test_own_axes_turn_with_what_is_flat_or_mirrored() -> None:
    rng = np.random.default_rng(0)
    cloud = rng.gamma(2.0, size=(500, 3)) * [3, 2, 1]
    for points in (cloud * [1, 1, 0], np.concatenate([cloud, cloud * [1, 1, -1]])):
        own = principal_pose(points)
        for Q in Rotation.random(10, random_state=1).as_matrix():
            turned = principal_pose(points @ Q.T)
            check_rotations(turned.rotation[None])
            np.testing.assert_allclose(turned.to_local(points @ Q.T), own.to_local(points), atol=1e-9)


def test_hypotheses_are_rotations_with_the_most_voted_first(model: TrainedModel, points: np.ndarray) -> None:
    found = propose(model.network, points, copies=16, keep=3, seed=0)
    check_rotations(rotations(found))
    assert 1 <= len(found) <= 3
    again = propose(model.network, points, copies=16, keep=3, seed=0)
    assert np.array_equal(rotations(again), rotations(found))


def test_flips_keep_each_hypothesis_and_its_centre() -> None:
    guesses = [RigidPose(Rotation.random(random_state=k).as_matrix(), np.array([k, 0.0, 1])) for k in (0, 1)]
    flipped = with_flips(guesses)
    assert np.allclose(rotations(flipped[:2]), rotations(guesses))
    check_rotations(rotations(flipped))
    for k, guess in enumerate(guesses):
        own = flipped[k::2]
        assert all(np.array_equal(each.center, guess.center) for each in own)
        # about the guess's own axes: half turns about each, quarter turns about up
        relative = guess.rotation.T @ rotations(own)
        angles = np.degrees(Rotation.from_matrix(relative).magnitude())
        assert np.allclose(sorted(angles), [0, 90, 90, 180, 180, 180], atol=1e-4)
        halves = relative[np.isclose(angles, 180)]
        assert np.allclose(np.abs(halves), np.eye(3), atol=1e-9)
        assert len(np.unique(relative.round(6), axis=0)) == 6


def test_the_standing_grid_tries_all_axes_all_round() -> None:
    grid = standing_grid(np.array([1.0, 2, 3]))
    assert len(grid) == 72
    check_rotations(rotations(grid))
    assert all(np.array_equal(guess.center, [1, 2, 3]) for guess in grid)
    ups = rotations(grid)[:, :, 1]
    for axis in AXES:
        here = np.isclose(ups @ axis, 1)
        assert here.sum() == 12
        fronts = rotations(grid)[here][:, :, 2]
        nearest = np.sort(fronts @ fronts[0])[-2]
        assert nearest == pytest.approx(np.cos(np.radians(30)))


@pytest.mark.parametrize("up", AXES)
def test_frames_obey_the_axes_that_are_given(up: np.ndarray) -> None:
    alone = forced_frames(up, None)
    assert len(alone) == 12
    check_rotations(rotations(alone))
    assert np.allclose(rotations(alone)[:, :, 1], up)
    facing = forced_frames(None, up)
    check_rotations(rotations(facing))
    assert np.allclose(rotations(facing)[:, :, 2], up)
    for front in AXES:
        if abs(up @ front) < 0.5:
            (both,) = forced_frames(up, front)
            check_rotations(both.rotation[None])
            assert np.allclose(both.rotation[:, 1], up)
            assert np.allclose(both.rotation[:, 2], front)


@pytest.mark.parametrize(
    ("name", "vector"), [("y", (0, 1, 0)), ("+x", (1, 0, 0)), ("-z", (0, 0, -1)), ("Y", (0, 1, 0))]
)
def test_names_of_axes(name: str, vector: tuple[int, int, int]) -> None:
    assert np.array_equal(axis_vector(name), vector)


@pytest.mark.parametrize("name", ["", "w", "yy", "--y", "+", "y-"])
def test_invalid_axes(name: str) -> None:
    with pytest.raises(OptionError, match="invalid axis") as caught:
        axis_vector(name)
    assert caught.value.hint
