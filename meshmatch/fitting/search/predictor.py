"""The network's own fits: core frame, code and learned corrections, for a pose to start from; and their residual.

The network has no symmetry built in, so it may see a raised left arm and miss a right one. Where a category's template is
symmetric, so is every question about a shape: asked about the mirrored samples, its answer mirrored back is another
interpretation of the same pose.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from meshmatch.arrays import Bool, Bools, Float, Floats, Ints
from meshmatch.derived import derived
from meshmatch.errors import TemplateError
from meshmatch.fields.shape_functions import ShapeFunctions
from meshmatch.fitting.solve.system import NodeSystem, node_system
from meshmatch.geometry.frames import RigidPose, kabsch
from meshmatch.geometry.oriented import OrientedPoints, nearest_unsigned, with_normals
from meshmatch.geometry.trees import cKDTree
from meshmatch.models.network import Network
from meshmatch.models.trained import TrainedModel
from meshmatch.shapes.sampling import sample_surface
from meshmatch.threads import parallel_map

# How many points the network sees of tilted copies, in turn: thin samples tip it either way where it is in doubt.
_VARIANT_POINTS = (700, 1400)
_PREDICT_POINTS = 2048  # it sees of other samples
_SPREAD_READINGS, _SPREAD_SEED = 6, 5  # tilts by which it is found out how sure the network is
_SPREAD_TILT = 15.0  # degrees, see `Predictor.variants`
USUAL_SPREAD = 0.03  # of fits that no network predicts (units of sqrt(area)), see `Predictor.spread`
# If predictions for tilted copies of the resting template deviate more than this (units of sqrt(area)), the network was not
# trained on tilted input, and `spread` is ignored; models that ship have 0.008 at most.
_READS_ALIKE = 0.02
_BATCH = 24  # clouds that it is asked about together: more save nothing, and take memory
# Residual that a share of 0 has to be better by than one of 1: rather the whole than a part. Set by hand.
_SHARE_COST = 0.004
# Left and right are exchanged in the template frame, where bodies face along z and stand along y.
_FLIP = np.array([-1.0, 1.0, 1.0])
# Every mirrored vertex of a symmetric template is this near to another one (units of sqrt(area)). Set by hand.
_SYMMETRIC = 0.01
_RANKING_STRIDE = 4  # see `ranking_residual`
_RIDGE = 1e-6  # of the least squares, against the mean diagonal

# Of samples in the core frame and node vectors (K, 3).
Residual = Callable[[NodeSystem, OrientedPoints, Float[Floats, "K 3"]], float]


@dataclass(frozen=True, eq=False)
class Candidate:
    """One way to fit the template to samples, taken to show the whole surface or a share of it."""

    pose: RigidPose  # the core frame (local) in the frame of the samples, once they have the size of their share
    vectors: Float[Floats, "K 3"]  # node vectors, core frame
    residual: float  # mean distance, normals included, of template and samples (units of sqrt(area))
    share: float = 1.0  # of the whole surface (0..1) that the samples are taken to show

    def local(self, samples: OrientedPoints) -> OrientedPoints:
        """Samples of area 1 as large as their share, in the core frame."""
        return scaled_to_area(samples, self.share).to_local(self.pose)

    @property
    def cost(self) -> float:
        """The residual, and a little for what is not visible: the smaller the part, the easier it lies on a template."""
        return self.residual + _SHARE_COST * (1 - self.share)


def best_first(candidates: Sequence[Candidate]) -> list[Candidate]:
    """Candidates by their cost."""
    return sorted(candidates, key=lambda candidate: candidate.cost)


def scaled_to_area(samples: OrientedPoints, share: float) -> OrientedPoints:
    """Samples of area 1, scaled to area ``share``."""
    return replace(samples, points=samples.points * np.sqrt(share))


@dataclass(frozen=True, eq=False)
class Mirror:
    """The plane x = 0 of a symmetric template."""

    # Takes node vectors to those that move the template as these move its mirror image, up to the flip.
    exchange: Float[Floats, "K K"]

    def points(self, points: Float[Floats, "N 3"]) -> Float[Floats, "N 3"]:
        """Points of the mirrored shape, in the core frame."""
        return np.asarray(points * _FLIP)

    def vectors(self, vectors: Float[Floats, "K 3"]) -> Float[Floats, "K 3"]:
        """Node vectors of the mirrored deformation: x moves to M f(M x) where f moved it before."""
        return np.asarray(self.exchange @ vectors * _FLIP)


@derived
def mirror_of(model: TrainedModel) -> Mirror | None:
    """The mirror of a model's template; None where it is not symmetric, or its field has no nodes."""
    template = model.template
    verts = np.asarray(template.shape.verts)
    distance = cKDTree(np.asarray(template.dense.verts)).query(verts * _FLIP)[0]
    if not model.has_nodes or distance.max() > _SYMMETRIC:
        return None
    try:
        there = model.field(verts * _FLIP)
    except TemplateError:  # the mirrored side has too few nodes
        return None
    here = node_system(model).field
    assert isinstance(here, ShapeFunctions) and isinstance(there, ShapeFunctions)
    phi, across = (field.phi.astype(np.float64) for field in (here, there))
    square = _dense(phi.T @ phi)
    square += _RIDGE * np.trace(square) / len(square) * np.eye(len(square))
    return Mirror(np.asarray(np.linalg.solve(square, _dense(phi.T @ across))))


def _dense(matrix: Any) -> Floats:
    return np.asarray(matrix if isinstance(matrix, np.ndarray) else matrix.toarray())


@dataclass(frozen=True, eq=False, kw_only=True)
class Predictor:
    """The network, and what its answers move; draws its points with ``rng``."""

    network: Network
    system: NodeSystem
    core: Ints  # vertices of the template by which the core frame is read off a fit
    mirror: Mirror | None  # of a symmetric template: interpretations are then sought in the mirror too
    rng: np.random.Generator

    @classmethod
    def of(cls, model: TrainedModel, rng: np.random.Generator, device: str = "cpu", mirrored: bool = True) -> Predictor:
        """The predictor of a trained model; the mirror takes time to build, and serves `variants` alone."""
        mirror = mirror_of(model) if mirrored else None
        return cls(
            network=model.on(device), system=node_system(model), core=model.template.core, mirror=mirror, rng=rng
        )

    def fit_all(
        self,
        starts: Sequence[tuple[OrientedPoints, RigidPose]],
        rounds: int = 2,
        draws: int = 2,
        measure: Residual | None = None,
    ) -> list[Candidate]:
        """For each start: predict, move the core frame to where the prediction puts the core, predict again.

        A start is samples, and where their core frame is looked for first. All are asked for together, for the
        network's weights are then read from memory once. Each of ``rounds`` predictions is the mean of ``draws`` of the
        samples. ``measure`` gives the residual; `two_way_residual` if there is none.
        """
        measure, poses = measure or two_way_residual, [pose for _, pose in starts]
        for turn in range(rounds):
            clouds = [
                pose.to_local(samples.drawn(_PREDICT_POINTS, self.rng))
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

        def measured(start: tuple[OrientedPoints, RigidPose], pose: RigidPose, vectors: Floats) -> Candidate:
            return Candidate(pose, vectors, measure(self.system, start[0].to_local(pose), vectors))

        return parallel_map(measured, starts, poses, means)

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

        It is predicted from the samples ``local``, and ``coarse`` ones give the residual; both are in the core frame,
        which is ``pose``. There are ``count`` tilts with a standard deviation of ``degrees`` about each axis.
        """
        found = self.readings(local, count, degrees)
        return parallel_map(
            lambda vectors: Candidate(pose, vectors, two_way_residual(self.system, coarse, vectors)), found
        )

    def spread(self, local: OrientedPoints, vectors: Float[Floats, "K 3"], at: Bool[Bools, " V"]) -> float:
        """How far a fit lies from what the network reads in tilted copies of the samples: the mean over some vertices of
        the template, and of the readings the median (units of sqrt(area)).

        Of a shape that the network knows, all readings are much the same.
        """
        asked = replace(self, rng=np.random.default_rng(_SPREAD_SEED))
        here = self.system.moved(vectors)[at]
        readings = asked.readings(local, _SPREAD_READINGS, _SPREAD_TILT)
        return float(
            np.median([np.linalg.norm(self.system.moved(each)[at] - here, axis=1).mean() for each in readings])
        )

    def readings(self, local: OrientedPoints, count: int, degrees: float) -> list[Floats]:
        """Node vectors (K, 3) read in tilted copies of samples, and as many in those of their mirror image."""
        tilts = Rotation.from_rotvec(np.radians(degrees) * self.rng.standard_normal((count, 3))).as_matrix()
        sides = [local]
        if self.mirror is not None:
            sides.append(replace(local, points=self.mirror.points(local.points)))
        clouds = []
        for samples in sides:
            for number, tilt in enumerate(tilts):
                size = _VARIANT_POINTS[number % len(_VARIANT_POINTS)]
                clouds.append(samples.drawn(size, self.rng) @ tilt.T)
        found = list(self.network.predict(clouds)) if clouds else []
        turned = [self.network.rotate_rows(vectors, tilts[k % count]) for k, vectors in enumerate(found)]
        return turned[:count] + [self.mirror.vectors(vectors) for vectors in turned[count:] if self.mirror is not None]


@derived
def reads_alike(model: TrainedModel) -> bool:
    """Whether a model reads copies of its resting template much the same; if not, a spread says nothing of a fit."""
    predictor = Predictor.of(model, np.random.default_rng(_SPREAD_SEED))
    system = predictor.system
    samples = sample_surface(model.template.shape, _PREDICT_POINTS, predictor.rng)
    still = np.zeros((system.K, 3))
    return predictor.spread(samples, still, np.ones(len(system.verts), bool)) <= _READS_ALIKE


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


def part_residual(system: NodeSystem, samples: OrientedPoints, vectors: Float[Floats, "K 3"], beyond: float) -> float:
    """As `one_way_residual`; but samples that belong to the rim of the template, and so lie beyond it, count as ``beyond``,
    however far they are, unless they are more than half of all."""
    if not system.rim.any():
        return one_way_residual(system, samples, vectors)
    surface, some = system.surface(vectors), samples.rows(slice(None, None, 2))
    distance, at = _capped_distances(surface.tree, some.points, some.normals, some.signed, np.inf)
    outside, distance = system.rim[at], np.minimum(distance, 0.1)
    if outside.mean() <= 0.5:
        distance[outside] = beyond
    return float(weighted_mean(distance, some.weights))


def ranking_residual(system: NodeSystem, samples: OrientedPoints, vectors: Float[Floats, "K 3"]) -> float:
    """About `one_way_residual`, of few samples: to every fourth vertex of the template, for its tree takes longest."""
    few = system.surface(vectors).rows(slice(None, None, _RANKING_STRIDE))
    return float(_back_residual(few, samples, stride=1, cap=0.1))


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
    # A search without a bound visits every point of a tree that is far away.
    if signed:
        distance, index = tree.query(with_normals(points, normals), distance_upper_bound=cap)
    else:
        distance, index, _ = nearest_unsigned(tree, points, normals, cap)
    return np.minimum(distance, cap), index


def weighted_mean(values: np.ndarray, weights: Float[Floats, " N"] | None) -> np.floating:
    """Mean of N values by weights that are not negative; without them, all count the same."""
    mean: np.floating = values.mean() if weights is None else weights @ values / max(weights.sum(), 1e-300)
    return mean
