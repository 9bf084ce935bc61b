"""The network's own fits: core frame, code and learned corrections, for a pose to start from; and their residual."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from meshmatch.arrays import Float, Floats, Ints
from meshmatch.fitting.mirror import Mirror, mirror_of
from meshmatch.fitting.samples import draw
from meshmatch.fitting.system import NodeSystem, node_system
from meshmatch.geometry.frames import RigidPose, kabsch
from meshmatch.geometry.oriented import OrientedPoints, with_normals
from meshmatch.models.inference import Network
from meshmatch.models.trained import TrainedModel

# How many points the network sees of tilted copies, in turn: thin samples tip it either way where it is in doubt.
_VARIANT_POINTS = (700, 1400)
_PREDICT_POINTS = 2048  # it sees of other samples
_BATCH = 24  # clouds that it is asked about together: more save nothing, and take memory

# Of samples in the core frame and node vectors (K, 3).
Residual = Callable[[NodeSystem, OrientedPoints, Float[Floats, "K 3"]], float]


@dataclass(frozen=True, eq=False)
class Candidate:
    """One way to fit the template to samples.

    Attributes
    ----------
    pose : RigidPose
        The core frame (local) in the frame of the samples.
    vectors : (K, 3)
        Node vectors, core frame.
    residual : float
        Mean distance, normals included, of template and samples (units of sqrt(area)).
    """

    pose: RigidPose
    vectors: Float[Floats, "K 3"]
    residual: float


@dataclass(frozen=True, eq=False)
class Predictor:
    """The network, and what its answers move; draws its points with ``rng``.

    Attributes
    ----------
    network : Network
    system : NodeSystem
    core : (C,) int
        Vertices of the template by which the core frame is read off a fit.
    mirror : Mirror, optional
        Of a symmetric template: interpretations are then sought in the mirror too.
    rng : numpy.random.Generator
    """

    network: Network
    system: NodeSystem
    core: Ints
    mirror: Mirror | None
    rng: np.random.Generator

    @classmethod
    def of(cls, model: TrainedModel, rng: np.random.Generator) -> Predictor:
        """The predictor of a trained model."""
        return cls(model.inference, node_system(model), model.template.core, mirror_of(model), rng)

    def fit_all(
        self,
        starts: Sequence[tuple[OrientedPoints, RigidPose]],
        rounds: int = 2,
        draws: int = 2,
        measure: Residual | None = None,
    ) -> list[Candidate]:
        """For each start: predict, move the core frame to where the prediction puts the core, predict again.

        Parameters
        ----------
        starts : sequence of (samples, pose)
            Samples, and where their core frame is looked for first. All are asked for together, for the network's
            weights are then read from memory once.
        rounds, draws : int
            Predictions, and how many draws of samples each is the mean of.
        measure : (NodeSystem, samples in the core frame, node vectors) -> float, optional
            The residual; `two_way_residual` if not given.
        """
        measure, poses = measure or two_way_residual, [pose for _, pose in starts]
        for turn in range(rounds):
            clouds = [
                pose.to_local(samples.points[draw(samples, _PREDICT_POINTS, self.rng)])
                for (samples, _), pose in zip(starts, poses, strict=True)
                for _ in range(draws)
            ]
            answers = [self.network.predict(clouds[k : k + _BATCH]) for k in range(0, len(clouds), _BATCH)]
            rows = np.concatenate(answers)
            means = rows.reshape(len(poses), draws, *rows.shape[1:]).mean(1)
            if turn < rounds - 1:
                resting = self.system.verts[self.core]
                moved = [self.system.moved(vectors)[self.core] for vectors in means]
                poses = [pose @ kabsch(resting, core) for pose, core in zip(poses, moved, strict=True)]
        return [
            Candidate(pose, vectors, measure(self.system, samples.to_local(pose), vectors))
            for (samples, _), pose, vectors in zip(starts, poses, means, strict=True)
        ]

    def fit(
        self, samples: OrientedPoints, pose: RigidPose, rounds: int = 2, draws: int = 2, measure: Residual | None = None
    ) -> Candidate:
        """`fit_all` of one start."""
        return self.fit_all([(samples, pose)], rounds, draws, measure)[0]

    def variants(
        self, local: OrientedPoints, coarse: OrientedPoints, pose: RigidPose, count: int, degrees: float
    ) -> list[Candidate]:
        """Other interpretations of a hard pose: predictions from randomly tilted core frames, turned back.

        Where a limb could be one or the other, tilts and thinner samples tip the network either way, and the residual
        tells which interpretation is right. With a mirror, as many again are of the mirrored samples.

        Parameters
        ----------
        local, coarse : OrientedPoints
            Samples in the core frame: those to predict from, and those that give the residual.
        pose : RigidPose
            The core frame.
        count, degrees : int, float
            How many tilts, and how large they are (standard deviation about each axis).
        """
        tilts = Rotation.from_rotvec(np.radians(degrees) * self.rng.standard_normal((count, 3))).as_matrix()
        found = self._tilted(local, tilts)
        if self.mirror is not None:
            mirrored = replace(local, points=self.mirror.points(local.points))
            found += [self.mirror.vectors(vectors) for vectors in self._tilted(mirrored, tilts)]
        return [Candidate(pose, vectors, two_way_residual(self.system, coarse, vectors)) for vectors in found]

    def _tilted(self, samples: OrientedPoints, tilts: Float[Floats, "N 3 3"]) -> list[Floats]:
        """Node vectors (K, 3) predicted from tilted samples, turned back."""
        clouds = []
        for number, tilt in enumerate(tilts):
            size = _VARIANT_POINTS[number % len(_VARIANT_POINTS)]
            clouds.append(samples.points[draw(samples, size, self.rng)] @ tilt.T)
        found = self.network.predict(clouds)
        return [self.network.rotate_rows(vectors, tilt) for vectors, tilt in zip(found, tilts, strict=True)]


def two_way_residual(
    system: NodeSystem, samples: OrientedPoints, vectors: Float[Floats, "K 3"], stride: int = 2, cap: float = 0.1
) -> float:
    """Mean of the capped 6-D nearest-neighbour distances, template to samples and back (units of sqrt(area)).

    Every ``stride``-th point of both is asked for its neighbour. Distances to and from samples count by their weights.
    """
    surface = system.surface(vectors)
    moved, normals = surface.points[::stride], surface.normals[::stride]
    distance, nearest = _capped_distances(samples.tree, moved, normals, samples.signed, cap)
    weights = None if samples.weights is None else np.append(samples.weights, 1.0)[nearest]
    forward = weighted_mean(distance, weights)
    return float(0.5 * forward + 0.5 * _back_residual(surface, samples, stride, cap))


def one_way_residual(
    system: NodeSystem, samples: OrientedPoints, vectors: Float[Floats, "K 3"], stride: int = 2, cap: float = 0.1
) -> float:
    """Mean of the capped 6-D distances from every ``stride``-th sample to the template, by the samples' weights."""
    return float(_back_residual(system.surface(vectors), samples, stride, cap))


def _back_residual(surface: OrientedPoints, samples: OrientedPoints, stride: int, cap: float) -> np.floating:
    points, normals = samples.points[::stride], samples.normals[::stride]
    distance, _ = _capped_distances(surface.tree, points, normals, samples.signed, cap)
    return weighted_mean(distance, None if samples.weights is None else samples.weights[::stride])


def _capped_distances(
    tree: cKDTree, points: Float[Floats, "N 3"], normals: Float[Floats, "N 3"], signed: bool, cap: float
) -> tuple[Floats, Ints]:
    """Capped 6-D distances (N,) to the nearest, and which that is (N,), ``tree.n`` beyond the cap.

    Normals without a sure sign are turned to the nearer side.
    """
    distance, index = np.full(len(points), cap), np.full(len(points), tree.n)
    for side in (1,) if signed else (1, -1):
        # A search without a bound visits every point of a tree that is far away.
        found, at = tree.query(with_normals(points, side * normals), distance_upper_bound=cap)
        index = np.where(found < distance, at, index)
        distance = np.minimum(distance, found)
    return distance, index


def weighted_mean(values: np.ndarray, weights: Float[Floats, " N"] | None) -> np.floating:
    """Mean of N values by weights that are not negative; without them, all count the same."""
    return values.mean() if weights is None else weights @ values / max(weights.sum(), 1e-300)
