"""Fits predicted by the network (core frame, code and learned corrections) from a given pose, and their residual.

The network has no built-in symmetry, so it may see a raised left arm and miss a right one. If a category's template is
symmetric, predicting from the mirrored samples and mirroring the prediction back gives another candidate for the same pose.
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

# Numbers of points of tilted copies, alternating: with few points, the network decides doubtful cases either way.
_VARIANT_POINTS = (700, 1400)
_PREDICT_POINTS = 2048  # number of points of all other samples
_SPREAD_COPIES, _SPREAD_SEED = 6, 5  # number and random seed of the tilted copies that give the spread
_SPREAD_TILT = 15.0  # degrees, see `Predictor.variants`
TYPICAL_SPREAD = 0.03  # assumed for fits that no network predicts (units of sqrt(area)), see `Predictor.spread`
# If predictions for tilted copies of the rest template deviate more than this (units of sqrt(area)), the network was not
# trained on tilted input, and `spread` is ignored; models that ship have 0.008 at most.
_MAX_TILT_DEVIATION = 0.02
_BATCH = 24  # clouds per call of the network: larger batches are no faster, and take memory
# Cost of a share near 0 over a share of 1, which favours the whole over a part. Set by hand.
_SHARE_COST = 0.004
# Exchanges left and right in the template frame, where bodies face along z and stand along y.
_FLIP = np.array([-1.0, 1.0, 1.0])
# A template is symmetric if every mirrored vertex is this near to another one (units of sqrt(area)). Set by hand.
_MAX_ASYMMETRY = 0.01
_RANKING_STRIDE = 4  # see `ranking_residual`
_RIDGE = 1e-6  # regularisation of the least squares, relative to the mean diagonal

Residual = Callable[[NodeSystem, OrientedPoints, Float[Floats, "K 3"]], float]
"""Residual of samples in the core frame and node vectors (K, 3)."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """One interpretation of the samples: a pose and node vectors; the samples show all of the surface or a share of it."""

    pose: RigidPose  # the core frame in the frame of the samples, after these are scaled to their share
    vectors: Float[Floats, "K 3"]  # node vectors, core frame
    residual: float  # mean distance between template and samples, normals included (units of sqrt(area))
    share: float = 1.0  # share (0..1) of the whole surface that the samples are assumed to show

    def local(self, samples: OrientedPoints) -> OrientedPoints:
        """Scale samples of area 1 to the candidate's share and transform them to its core frame."""
        return scaled_to_area(samples, self.share).to_local(self.pose)

    @property
    def cost(self) -> float:
        """The residual plus a small cost for what is not visible: small parts lie on a template more easily."""
        return self.residual + _SHARE_COST * (1 - self.share)


def best_first(candidates: Sequence[Candidate]) -> list[Candidate]:
    """Sort candidates by cost."""
    return sorted(candidates, key=lambda candidate: candidate.cost)


def scaled_to_area(samples: OrientedPoints, share: float) -> OrientedPoints:
    """Samples of area 1, scaled to area ``share``."""
    return replace(samples, points=samples.points * np.sqrt(share))


@dataclass(frozen=True, eq=False)
class Mirror:
    """The plane x = 0 of a symmetric template."""

    # Maps node vectors to those that move the template as the given ones move its mirror image, up to the flip.
    exchange: Float[Floats, "K K"]

    def points(self, points: Float[Floats, "N 3"]) -> Float[Floats, "N 3"]:
        """Mirror points, in the core frame."""
        return np.asarray(points * _FLIP)

    def vectors(self, vectors: Float[Floats, "K 3"]) -> Float[Floats, "K 3"]:
        """Node vectors of the mirrored deformation x -> M f(M x), where f is the given one and M the reflection."""
        return np.asarray(self.exchange @ vectors * _FLIP)


@derived
def mirror_of(model: TrainedModel) -> Mirror | None:
    """The mirror plane of a model's template; None if the template is not symmetric or its field has no nodes."""
    template = model.template
    verts = np.asarray(template.shape.verts)
    distance = cKDTree(np.asarray(template.dense.verts)).query(verts * _FLIP)[0]
    if not model.has_nodes or distance.max() > _MAX_ASYMMETRY:
        return None
    try:
        mirrored_field = model.field(verts * _FLIP)
    except TemplateError:  # mirrored points have too few nodes in reach
        return None
    here = node_system(model).field
    assert isinstance(here, ShapeFunctions) and isinstance(mirrored_field, ShapeFunctions)
    phi, mirrored_phi = (field.phi.astype(np.float64) for field in (here, mirrored_field))
    square = _dense(phi.T @ phi)
    square += _RIDGE * np.trace(square) / len(square) * np.eye(len(square))
    return Mirror(np.asarray(np.linalg.solve(square, _dense(phi.T @ mirrored_phi))))


def _dense(matrix: Any) -> Floats:
    """A matrix as a dense array."""
    return np.asarray(matrix if isinstance(matrix, np.ndarray) else matrix.toarray())


@dataclass(frozen=True, eq=False, kw_only=True)
class Predictor:
    """Runs the network and evaluates its predictions; points are sampled with ``rng``."""

    network: Network
    system: NodeSystem
    core: Ints  # template vertices that define the core frame of a prediction
    mirror: Mirror | None  # of a symmetric template; mirrored samples then give further candidates
    rng: np.random.Generator

    @classmethod
    def of(cls, model: TrainedModel, rng: np.random.Generator, device: str = "cpu", mirrored: bool = True) -> Predictor:
        """Create the predictor of a trained model. The mirror takes time to build and is used by `variants` only."""
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
        """For each start: predict, move the core frame to where the prediction puts the core, and predict again.

        A start is samples and the first guess of their core frame. All starts are evaluated together, as the network's
        weights are then read from memory only once. Each of ``rounds`` predictions is the mean over ``draws`` random
        subsets of the samples. ``measure`` computes the residual (default: `two_way_residual`).
        """
        measure, poses = measure or two_way_residual, [pose for _, pose in starts]
        for round_number in range(rounds):
            clouds = [
                pose.to_local(samples.drawn(_PREDICT_POINTS, self.rng))
                for (samples, _), pose in zip(starts, poses, strict=True)
                for _ in range(draws)
            ]
            batches = [self.network.predict(clouds[k : k + _BATCH]) for k in range(0, len(clouds), _BATCH)]
            rows = np.concatenate(batches)
            means = rows.reshape(len(poses), draws, *rows.shape[1:]).mean(1)
            if round_number < rounds - 1:
                resting = self.system.verts[self.core]
                moved = [self.system.moved(vectors)[self.core] for vectors in means]
                poses = [pose @ kabsch(resting, core) for pose, core in zip(poses, moved, strict=True)]

        def measured(start: tuple[OrientedPoints, RigidPose], pose: RigidPose, vectors: Floats) -> Candidate:
            return Candidate(pose, vectors, measure(self.system, start[0].to_local(pose), vectors))

        return parallel_map(measured, starts, poses, means)

    def fit(
        self, samples: OrientedPoints, pose: RigidPose, rounds: int = 2, draws: int = 2, measure: Residual | None = None
    ) -> Candidate:
        """`fit_all` for one start."""
        return self.fit_all([(samples, pose)], rounds, draws, measure)[0]

    def variants(
        self, local: OrientedPoints, coarse: OrientedPoints, pose: RigidPose, count: int, degrees: float
    ) -> list[Candidate]:
        """Further candidates for a difficult pose: predictions from randomly tilted core frames, rotated back.

        Where one limb could be taken for another, tilts and fewer samples make the network decide either way, and the
        residual tells which candidate is right. With a mirror, the mirrored samples give as many again.

        Predictions are made from the samples ``local`` and their residuals from ``coarse``, both in the core frame, which
        is ``pose``. There are ``count`` tilts with a standard deviation of ``degrees`` about each axis.
        """
        found = self.predict_tilted(local, count, degrees)
        return parallel_map(
            lambda vectors: Candidate(pose, vectors, two_way_residual(self.system, coarse, vectors)), found
        )

    def spread(self, local: OrientedPoints, vectors: Float[Floats, "K 3"], at: Bool[Bools, " V"]) -> float:
        """Distance between a fit and the network's predictions for tilted copies of the samples (units of sqrt(area)).

        It is the mean over the template vertices ``at``, and the median over the predictions. For a shape that the network
        knows, all predictions are nearly the same.
        """
        seeded = replace(self, rng=np.random.default_rng(_SPREAD_SEED))
        fitted = self.system.moved(vectors)[at]
        predictions = seeded.predict_tilted(local, _SPREAD_COPIES, _SPREAD_TILT)
        return float(
            np.median([np.linalg.norm(self.system.moved(each)[at] - fitted, axis=1).mean() for each in predictions])
        )

    def predict_tilted(self, local: OrientedPoints, count: int, degrees: float) -> list[Floats]:
        """Predict node vectors (K, 3) from tilted copies of samples.

        With a mirror, as many are predicted from their mirror image.
        """
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
def is_tilt_consistent(model: TrainedModel) -> bool:
    """Return whether a model's predictions for tilted copies of its rest template agree.

    If they do not, `spread` is meaningless.
    """
    predictor = Predictor.of(model, np.random.default_rng(_SPREAD_SEED))
    system = predictor.system
    samples = sample_surface(model.template.shape, _PREDICT_POINTS, predictor.rng)
    still = np.zeros((system.K, 3))
    return predictor.spread(samples, still, np.ones(len(system.verts), bool)) <= _MAX_TILT_DEVIATION


def two_way_residual(
    system: NodeSystem, samples: OrientedPoints, vectors: Float[Floats, "K 3"], stride: int = 2, cap: float = 0.1
) -> float:
    """Mean of the capped 6-D nearest-neighbour distances, template to samples and back (units of sqrt(area)).

    Only every ``stride``-th point of either side is queried. Distances from and to samples are weighted by the samples'
    weights.
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
    """Weighted mean of the capped 6-D distances from every ``stride``-th sample to the template."""
    return float(_back_residual(system.surface(vectors), samples, stride, cap))


def part_residual(system: NodeSystem, samples: OrientedPoints, vectors: Float[Floats, "K 3"], beyond: float) -> float:
    """`one_way_residual` for a template that may be cut, too.

    Samples nearest to the template's rim lie beyond its end; each counts as ``beyond``, however far away it is, unless more
    than half of all samples do.
    """
    if not system.rim.any():
        return one_way_residual(system, samples, vectors)
    surface, some = system.surface(vectors), samples.rows(slice(None, None, 2))
    distance, at = _capped_distances(surface.tree, some.points, some.normals, some.signed, np.inf)
    outside, distance = system.rim[at], np.minimum(distance, 0.1)
    if outside.mean() <= 0.5:
        distance[outside] = beyond
    return float(weighted_mean(distance, some.weights))


def ranking_residual(system: NodeSystem, samples: OrientedPoints, vectors: Float[Floats, "K 3"]) -> float:
    """Fast approximation of `one_way_residual` for few samples: distances to every fourth template vertex."""
    few = system.surface(vectors).rows(slice(None, None, _RANKING_STRIDE))
    return float(_back_residual(few, samples, stride=1, cap=0.1))


def _back_residual(surface: OrientedPoints, samples: OrientedPoints, stride: int, cap: float) -> np.floating:
    """Mean capped distance from every ``stride``-th sample to the surface."""
    points, normals = samples.points[::stride], samples.normals[::stride]
    distance, _ = _capped_distances(surface.tree, points, normals, samples.signed, cap)
    return weighted_mean(distance, None if samples.weights is None else samples.weights[::stride])


def _capped_distances(
    tree: cKDTree, points: Float[Floats, "N 3"], normals: Float[Floats, "N 3"], signed: bool, cap: float
) -> tuple[Floats, Ints]:
    """Capped 6-D distances (N,) to the nearest point, and its index (N,), which is ``tree.n`` beyond the cap.

    Normals without a known sign are flipped to the nearer side.
    """
    # A search without a bound visits every point of a tree that is far away.
    if signed:
        distance, index = tree.query(with_normals(points, normals), distance_upper_bound=cap)
    else:
        distance, index, _ = nearest_unsigned(tree, points, normals, cap)
    return np.minimum(distance, cap), index


def weighted_mean(values: np.ndarray, weights: Float[Floats, " N"] | None) -> np.floating:
    """Mean of N values with nonnegative weights, or with equal weights if there are none."""
    mean: np.floating = values.mean() if weights is None else weights @ values / max(weights.sum(), 1e-300)
    return mean
