"""Misplaced limbs, predicted again with the other limbs out of the way.

On people who cross their legs or fold their arms, the network mistakes one limb for another, or misses it among them. If a
fit is doubtful, the samples of its other limbs are therefore moved to where the rest template has these limbs, and the
network is run again: it predicts the one or two limbs that remain much better. The predictions are combined limb by limb,
taking whatever brings template and samples closest, and the result is refined.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from meshmatch.arrays import Float, Floats
from meshmatch.fitting.search.discontinuities import discontinuous_share, neighbours
from meshmatch.fitting.search.limbs import Branch, Limb, Limbs, limbs_of, uncovered_regions
from meshmatch.fitting.search.predictor import Predictor, best_first, is_tilt_consistent, weighted_mean
from meshmatch.fitting.search.refinement import WholeComparison, with_limb_bent
from meshmatch.fitting.search.task import Registration
from meshmatch.fitting.solve.system import NodeSystem
from meshmatch.geometry.frames import kabsch
from meshmatch.geometry.oriented import OrientedPoints


@dataclass(frozen=True, kw_only=True)
class UntanglingSettings:
    """All set by hand on people who touch themselves; lengths and residuals are in units of sqrt(area).

    Attributes
    ----------
    min_discontinuous : share of discontinuous pairs of neighbouring samples from which on parts are assumed to touch
    n_samples, n_compared : number of samples for the network, and for comparing its predictions
    max_distance : samples this close to a limb move with it
    tilts_by_kept_limbs : number of tilted copies and typical degrees of tilt, if one limb stays in place and if two do
    max_rounds : maximum number of passes over all limbs
    max_taken : maximum number of limbs taken from one group of predictions
    cap : maximum distance that counts
    min_gain : least reduction of the residual for which a predicted limb is taken
    margin : the result is accepted if its score is below this multiple of the original fit's
    """

    min_discontinuous: float = 0.005
    n_samples: int = 2048
    n_compared: int = 512
    max_distance: float = 0.08
    tilts_by_kept_limbs: tuple[tuple[int, float], ...] = ((5, 20.0), (4, 30.0))
    max_rounds: int = 2
    max_taken: int = 2
    cap: float = 0.1
    min_gain: float = 0.0002
    margin: float = 0.98


SETTINGS = UntanglingSettings()


def untangled(found: Registration) -> Registration | None:
    """Predict the limbs of a fit of a whole again, if parts touch or the shape has uncovered regions.

    None if there is nothing to predict again, or if the result is no better.
    """
    task, best, limbs = found.task, found.candidate, limbs_of(found.task.model)
    if not (limbs.branches and task.samples.signed and is_tilt_consistent(task.model)):
        return None
    coarse = task.coarse
    local = coarse.to_local(best.pose)
    touching = discontinuous_share(task.system, neighbours(coarse), local, best.vectors) >= SETTINGS.min_discontinuous
    if not (touching or uncovered_regions(local, task.system.surface(best.vectors))):
        return None
    predictor = replace(task.predictor, rng=np.random.default_rng(task.config.seed))
    local_samples = task.samples.to_local(best.pose)
    predictions = best_first(
        predictor.variants(local_samples, local, best.pose, task.config.variants, task.config.tilt)
    )
    comparison = WholeComparison(task, predictions)
    start = comparison.average_similar(predictions[0])
    predicted = replace(best, vectors=_predict_limbs(predictor, limbs, local.first(SETTINGS.n_samples), start.vectors))
    fit = with_limb_bent(comparison, predicted, comparison.refined(predicted, in_full=True))
    better = comparison.score(fit, False) < SETTINGS.margin * comparison.score(best, False)
    return replace(found, candidate=fit) if better else None


def _predict_limbs(
    predictor: Predictor, limbs: Limbs, samples: OrientedPoints, vectors: Float[Floats, "K 3"]
) -> Float[Floats, "K 3"]:
    """Node vectors with limbs taken from predictions for samples (core frame) whose other limbs are at rest."""
    system = predictor.system
    whole = _Composition(system, samples.first(SETTINGS.n_compared), vectors)
    for _ in range(SETTINGS.max_rounds):
        before = whole.residual
        for count in range(len(SETTINGS.tilts_by_kept_limbs), 0, -1):
            tilts, degrees = SETTINGS.tilts_by_kept_limbs[count - 1]
            for kept in combinations(limbs.branches, count):
                resting = _at_rest(
                    system, samples, whole.vectors, [each for each in limbs.branches if each not in kept]
                )
                predictions = predictor.predict_tilted(resting, tilts, degrees)
                whole = _with_best_limbs(whole, predictions, kept)
        if whole.residual > before - SETTINGS.min_gain:
            break
    return whole.vectors


def _at_rest(
    system: NodeSystem, samples: OrientedPoints, vectors: Float[Floats, "K 3"], branches: list[Branch]
) -> OrientedPoints:
    """Move the samples of some limbs, as rigid pieces, to where the rest template has these limbs."""
    surface = system.surface(vectors)
    nearest = surface.tree.query(samples.features)[1]
    close = np.linalg.norm(samples.points - surface.points[nearest], axis=1) < SETTINGS.max_distance
    points, normals = samples.points.copy(), samples.normals.copy()
    for branch in branches:
        base = kabsch(system.verts[branch.holder], surface.points[branch.holder])
        for piece in branch.pieces:
            chosen = close & np.isin(nearest, piece)
            motion = kabsch(surface.points[piece], base.to_world(system.verts[piece]))
            points[chosen], normals[chosen] = motion.to_world(points[chosen]), normals[chosen] @ motion.rotation.T
    return replace(samples, points=points, normals=normals)


class _Composition:
    """Node vectors, and the distances between template and samples (core frame) under them."""

    def __init__(self, system: NodeSystem, samples: OrientedPoints, vectors: Float[Floats, "K 3"]) -> None:
        self.system, self.samples, self.vectors = system, samples, vectors
        self.surface = system.surface(vectors)
        self.to_samples = self.distances_to_samples(self.surface)
        self.residual = self._residual(self.to_samples.sum(), self.distances_from_samples(self.surface))
        self._without: dict[Limb, tuple[float, Floats]] = {}

    def distances_to_samples(self, surface: OrientedPoints) -> Float[Floats, " N"]:
        """Capped distances (N,) from vertices of the template to the samples."""
        distance = self.samples.tree.query(surface.features, distance_upper_bound=SETTINGS.cap)[0]
        return np.minimum(distance, SETTINGS.cap)

    def distances_from_samples(self, surface: OrientedPoints) -> Float[Floats, " S"]:
        """Capped distances (S,) from the samples to some vertices of the template."""
        distance = surface.tree.query(self.samples.features, distance_upper_bound=SETTINGS.cap)[0]
        return np.minimum(distance, SETTINGS.cap)

    def residual_with(self, limb: Limb, to_samples: float, from_samples: Float[Floats, " S"]) -> float:
        """The residual with one limb elsewhere.

        ``to_samples`` is the sum of the limb's distances to the samples, ``from_samples`` are the samples' distances to it.
        """
        if limb not in self._without:
            others = np.ones(len(self.surface.points), bool)
            others[limb.verts] = False
            self._without[limb] = (
                float(self.to_samples[others].sum()),
                self.distances_from_samples(self.surface.rows(others)),
            )
        rest, rest_back = self._without[limb]
        return self._residual(rest + to_samples, np.minimum(rest_back, from_samples))

    def with_predicted_limb(self, limb: Limb, prediction: Float[Floats, "K 3"]) -> _Composition:
        """The same with one limb as predicted."""
        vectors = self.vectors + limb.share[:, None] * (prediction - self.vectors)
        return _Composition(self.system, self.samples, vectors)

    def _residual(self, to_samples: float, from_samples: Floats) -> float:
        return float(
            0.5 * to_samples / len(self.surface.points) + 0.5 * weighted_mean(from_samples, self.samples.weights)
        )


def _with_best_limbs(whole: _Composition, predictions: list[Floats], kept: tuple[Branch, ...]) -> _Composition:
    """Replace limbs by the predicted ones that bring the template closest to the samples."""
    limbs = [limb for branch in kept for limb in branch.limbs]
    if len(kept) > 1:
        limbs.append(Branch.together(kept))
    verts = np.concatenate([branch.limbs[0].verts for branch in kept])
    options = []
    for prediction in predictions:
        surface = whole.system.surface(prediction)
        to_samples = np.zeros(len(surface.points))
        to_samples[verts] = whole.distances_to_samples(surface.rows(verts))
        options += [
            (limb, prediction, to_samples[limb.verts].sum(), whole.distances_from_samples(surface.rows(limb.verts)))
            for limb in limbs
        ]
    for _ in range(SETTINGS.max_taken):
        limb, prediction = min(options, key=lambda each: whole.residual_with(each[0], *each[2:]))[:2]
        closer = whole.with_predicted_limb(limb, prediction)
        if closer.residual > whole.residual - SETTINGS.min_gain:
            break
        whole = closer
    return whole
