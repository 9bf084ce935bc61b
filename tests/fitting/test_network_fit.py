"""The network's own fit: rigid motions, the residual, and readings from tilted frames."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from meshmatch.fitting.search import predictor
from meshmatch.fitting.search.predictor import Predictor, one_way_residual, two_way_residual
from meshmatch.fitting.solve.system import NodeSystem, node_system
from meshmatch.geometry.frames import RigidPose, kabsch
from meshmatch.geometry.oriented import OrientedPoints, with_normals
from meshmatch.models.trained import TrainedModel
from tests.fitting.eggs import bent_egg, gentle_vectors, scan_of


@pytest.fixture(scope="module")
def scan(model: TrainedModel) -> OrientedPoints:
    return scan_of(model.template.shape, 300)


def test_the_residual_is_that_of_a_plain_loop(system: NodeSystem, scan: OrientedPoints, model: TrainedModel) -> None:
    vectors = gentle_vectors(model)
    moved = system.moved(vectors)
    ours, theirs = with_normals(moved, system.normals(moved)), with_normals(scan.points, scan.normals)
    apart = np.sqrt(np.square(ours[:, None] - theirs).sum(-1))
    for cap in (0.1, 0.03):
        wanted = 0.5 * np.minimum(apart.min(1), cap).mean() + 0.5 * np.minimum(apart.min(0), cap).mean()
        assert two_way_residual(system, scan, vectors, stride=1, cap=cap) == pytest.approx(wanted)
    own = OrientedPoints(moved, system.normals(moved))
    assert two_way_residual(system, own, vectors) == 0
    assert two_way_residual(system, OrientedPoints(scan.points + 9, scan.normals), vectors) == pytest.approx(0.1)


def test_predictions_are_means_of_seeded_draws(
    model: TrainedModel, scan: OrientedPoints, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(predictor, "_PREDICT_POINTS", 100)
    still = RigidPose.identity()
    one, again, other = (
        Predictor.of(model, np.random.default_rng(k)).fit(scan, still, rounds=1, draws=3).vectors for k in (0, 0, 1)
    )
    assert np.array_equal(one, again)
    assert not np.array_equal(one, other)
    rng = np.random.default_rng(0)
    with torch.inference_mode():
        draws = [
            model.network(torch.from_numpy(scan.points[rng.choice(300, 100, replace=False)]).float()[None])[0]
            for _ in range(3)
        ]
    assert np.allclose(one, torch.stack(draws).mean(0), atol=1e-5)
    monkeypatch.setattr(predictor, "_PREDICT_POINTS", 10**6)  # more than there are
    assert Predictor.of(model, np.random.default_rng(5)).fit(scan, still).vectors.shape == (model.template.K, 3)


def test_starts_asked_together_are_fitted_as_each_alone(
    model: TrainedModel, scan: OrientedPoints, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(predictor, "_BATCH", 2)  # three starts are asked in two batches
    few = scan.first(200)  # so few that every draw is all of them
    poses = [RigidPose(Rotation.from_rotvec([0, angle, 0]).as_matrix(), np.zeros(3)) for angle in (0.0, 0.4, -0.7)]
    starts = [(few, pose) for pose in poses]
    together = Predictor.of(model, np.random.default_rng(0)).fit_all(starts, draws=1)
    for start, found in zip(starts, together, strict=True):
        alone = Predictor.of(model, np.random.default_rng(1)).fit(*start, draws=1)
        assert np.allclose(found.vectors, alone.vectors, atol=1e-5)
        assert np.allclose(found.pose.rotation, alone.pose.rotation, atol=1e-5)
        assert found.residual == pytest.approx(alone.residual, abs=1e-5)
    measured = Predictor.of(model, np.random.default_rng(0)).fit_all(starts, measure=one_way_residual)
    assert measured[1].residual == one_way_residual(
        node_system(model), few.to_local(measured[1].pose), measured[1].vectors
    )


def test_laying_on_again_moves_the_frame_to_where_the_core_went(model: TrainedModel, system: NodeSystem) -> None:
    scan = scan_of(bent_egg(model), 300)
    scan = OrientedPoints(scan.points / 5, scan.normals)
    core = model.template.core
    R, c = Rotation.from_rotvec([0.1, 0.4, 0]).as_matrix(), np.array([0.1, 0, 0])
    pose = RigidPose(R, c)
    first, second = (
        Predictor.of(model, np.random.default_rng(0)).fit(scan, pose, rounds=rounds, draws=1) for rounds in (1, 2)
    )
    assert first.pose is pose
    assert np.linalg.det(second.pose.rotation) == pytest.approx(1)
    # the template's core in the new frame lies, in the scan's, where the first prediction put it, rigidly
    there = system.moved(first.vectors)[core] @ R.T + c
    placed = second.pose.to_world(system.verts[core])
    assert np.allclose(placed, kabsch(system.verts[core], there).to_world(system.verts[core]))


def test_without_a_tilt_every_reading_is_the_networks_own(
    model: TrainedModel, system: NodeSystem, scan: OrientedPoints
) -> None:
    pose = RigidPose.identity()
    # so few points that every draw is all of them: the order does not matter to the network
    few = OrientedPoints(scan.points[:200], scan.normals[:200])
    plain = model.network(torch.from_numpy(few.points).float()[None])[0].detach().double().numpy()
    for degrees, count in ((0.0, 2), (15.0, 3)):
        predictor = replace(Predictor.of(model, np.random.default_rng(0)), mirror=None)
        found = predictor.variants(few, few, pose, count, degrees)
        assert len(found) == count
        for each in found:
            assert each.residual == two_way_residual(system, few, each.vectors)
            assert each.pose is pose
            assert np.allclose(each.vectors, plain, atol=1e-5) == (degrees == 0)


def test_a_tilted_reading_is_turned_back(model: TrainedModel, system: NodeSystem, scan: OrientedPoints) -> None:
    """A network that follows every turn reads the same from every frame."""
    nodes = torch.from_numpy(model.template.nodes).float()
    first = torch.from_numpy(scan.points[:200]).float()

    class Follower:
        def predict(self, clouds: Sequence[np.ndarray]) -> np.ndarray:
            return np.stack([self.follow(torch.from_numpy(cloud).float()[None]) for cloud in clouds])

        def follow(self, points: torch.Tensor) -> np.ndarray:
            # the points are the first ones, turned and in another order: their moments tell the turn
            U, _, Vh = torch.linalg.svd(_moment(points[0]).double() @ torch.linalg.inv(_moment(first).double()))
            return (((U @ Vh).float() @ nodes.T).T - nodes).double().numpy()

        def rotate_rows(self, vectors: np.ndarray, turn: np.ndarray) -> np.ndarray:
            return model.inference.rotate_rows(vectors, turn)

    def _moment(points: torch.Tensor) -> torch.Tensor:
        # third-order moments turn like vectors: three of them make a frame
        lengths = points.square().sum(1)
        return torch.stack(
            [points.mean(0), (points * lengths[:, None]).mean(0), (points * lengths[:, None] ** 2).mean(0)], 1
        )

    few = OrientedPoints(scan.points[:200], scan.normals[:200])
    pose = RigidPose.identity()
    network: Any = Follower()
    predictor = Predictor(
        network=network, system=system, core=model.template.core, mirror=None, rng=np.random.default_rng(0)
    )
    found = predictor.variants(few, few, pose, 3, 20.0)
    for each in found:
        assert np.abs(each.vectors).max() < 1e-3


def test_residuals_and_predictions_follow_the_weights_of_samples(
    model: TrainedModel, system: NodeSystem, scan: OrientedPoints
) -> None:
    vectors, half = gentle_vectors(model), np.arange(len(scan.points)) < 150
    masked = replace(scan, weights=half.astype(float))
    assert one_way_residual(system, masked, vectors, 1) == pytest.approx(
        one_way_residual(system, scan.rows(half), vectors, 1)
    )
    everywhere = replace(scan, weights=np.full(len(scan.points), 0.3))
    assert two_way_residual(system, everywhere, vectors) == pytest.approx(two_way_residual(system, scan, vectors))
    moved = replace(masked, points=np.where(half[:, None], scan.points, scan.points + 9))
    still = RigidPose.identity()
    first, second = (
        Predictor.of(model, np.random.default_rng(0)).fit(each, still, rounds=1, draws=1).vectors
        for each in (masked, moved)
    )
    assert np.array_equal(first, second)
