"""Refinement of the network's candidates: the methods that a user can choose, in one table.

To add a method, add a line to `REFINEMENTS` and its name to `meshmatch.fitting.fit_config`.

The distance to the surface hardly tells which of several candidates is right: a crossed arm taken for the other one lies on
the surface as well as the right one does. But then neighbouring points of the shape correspond to distant points of the
template, so the map is discontinuous. Candidates that differ are therefore each refined in full and scored by residual and
discontinuity. Ties, such as front and back of a robot, are decided by the network's predictions for tilted copies of the
shape, and by the orientation that files usually have.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from meshmatch.arrays import Float, Floats
from meshmatch.errors import needs
from meshmatch.fitting import fit_config
from meshmatch.fitting.search.candidates import (
    STAGE,
    candidates_of_part,
    candidates_of_whole,
    completed,
    upright_candidate,
)
from meshmatch.fitting.search.discontinuities import Pairs, discontinuous_share, neighbours
from meshmatch.fitting.search.frames import MIN_AXIS_COSINE, stands_upright
from meshmatch.fitting.search.limbs import limbs_of, uncovered_regions
from meshmatch.fitting.search.predictor import (
    TYPICAL_SPREAD,
    Candidate,
    best_first,
    is_tilt_consistent,
    one_way_residual,
    scaled_to_area,
    two_way_residual,
    weighted_mean,
)
from meshmatch.fitting.search.task import FitTask, Registration
from meshmatch.fitting.solve.nodes import refine_nodes
from meshmatch.fitting.solve.system import NodeSystem
from meshmatch.geometry.frames import RigidPose
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.geometry.trees import cKDTree
from meshmatch.progress import Progress
from meshmatch.threads import parallel_map


@dataclass(frozen=True, kw_only=True)
class RefinementSettings:
    """How candidates are compared and refined. All set by hand; lengths and residuals are in units of sqrt(area).

    Attributes
    ----------
    discontinuity_cost : added to the residual of a map that is discontinuous everywhere
    cap : maximum distance that counts
    different_share, different_distance : two candidates differ if more than this share of the template's vertices is
        farther apart than this distance
    same_distance, max_averaged : candidates closer than this distance are averaged, at most this many
    pool : how many of the best candidates are searched for ones that differ
    screening_margin : after screening, a candidate is dropped if its score exceeds this multiple of the best one's: on 78
        bodies of SCAPE, FAUST and SHREC'19 the best after screening was the best at the end
    unusual_axes_cost : margin by which an orientation must win that is rare in files, or differs from the one that the file
        states
    spread_cost : cost per unit of the distance between a candidate and the network's predictions for tilted copies, up to
        the typical spread; beyond that the distance is uninformative. On robots of seeds 0 and 1 it tells front from back
        in 15 of 15 ties
    part_finalists : candidates of a part that are screened
    screening_samples : samples that suffice to compare candidates
    bent_margin : a fit with a bent limb is accepted if its score is below this multiple of the original one's
    """

    discontinuity_cost: float = 0.1
    cap: float = 0.1
    different_share: float = 0.02
    different_distance: float = 0.1
    same_distance: float = 0.05
    max_averaged: int = 8
    pool: int = 24
    screening_margin: float = 1.05
    unusual_axes_cost: float = 0.001
    spread_cost: float = 0.3
    part_finalists: int = 4
    screening_samples: int = 4096
    bent_margin: float = 0.98


SETTINGS = RefinementSettings()


Refine = Callable[[FitTask, list[Candidate]], Candidate]
"""Turns a task's candidates, best first, into the fit."""


def fit_whole(task: FitTask) -> Registration:
    """Fit the template to a shape that is assumed to be complete."""
    task, candidates = candidates_of_whole(task)
    return Registration(task.on_visible_samples, REFINEMENTS[task.config.refine].whole(task, candidates))


def fit_part(task: FitTask, wide: bool = False) -> Registration | None:
    """Fit the template to a shape that may show only a part. The residual is from the samples to the template only.

    A ``wide`` search tries more orientations; any other search returns None if no candidate comes near.
    """
    task, candidates = candidates_of_part(task, wide)
    if not candidates:
        return None
    best = REFINEMENTS[task.config.refine].part(task, candidates)
    root = float(np.sqrt(best.share))
    return Registration(task.rescaled(1 / root, scaled_to_area(task.samples, best.share)), best)


@dataclass(frozen=True)
class Refinement:
    """How candidates become one fit, for `fit_whole` and for `fit_part`.

    ``tries_parts``: fast enough to try a fit as a part without being asked.
    """

    whole: Refine
    part: Refine
    tries_parts: bool = True


def _first(task: FitTask, candidates: list[Candidate]) -> Candidate:
    return candidates[0]


def _refine_code(task: FitTask, candidates: list[Candidate]) -> Candidate:
    """Refine the best candidate by the paper's search over codes."""
    with needs("torch", "train"):
        from meshmatch.fitting.search.latent import refine_code

    best = candidates[0]
    local = task.samples.to_local(best.pose)
    facing = local.facing(task.system.surface(best.vectors))
    progress = task.progress.stage("refinement")
    config = task.config
    vectors = refine_code(task.model, facing, config.latent, task.predictor.rng, progress, device=config.device)
    return Candidate(best.pose, vectors, two_way_residual(task.system, local, vectors))


def _fit_nodes(task: FitTask, candidates: list[Candidate]) -> Candidate:
    """Refine the best of the candidates and their variants by least squares on the nodes."""
    config, coarse = task.config, task.coarse
    pool: list[Candidate] = []
    for pose in (each.pose for each in (candidates[0], *upright_candidate(task, candidates))):
        local = task.samples.to_local(pose)
        pool += task.predictor.variants(local, coarse.to_local(pose), pose, config.variants, config.tilt)
    for each in candidates:
        residual = two_way_residual(task.system, coarse.to_local(each.pose), each.vectors)
        pool.append(replace(each, residual=residual))
    ranked = best_first(pool)
    comparison = WholeComparison(task.on_visible_samples, ranked)
    progress = task.progress.stage("refinement")
    chosen, fit = choose([*upright_candidate(task, ranked), *ranked], config.finalists, comparison, progress)
    return with_limb_bent(comparison, chosen, fit)


def _fit_nodes_to_part(task: FitTask, candidates: list[Candidate]) -> Candidate:
    """Refine the best of several candidates of a part by least squares on the nodes."""
    return choose(candidates, SETTINGS.part_finalists, PartComparison(task), task.progress.stage(STAGE, 0.6, 1.0))[1]


REFINEMENTS: dict[fit_config.Refine, Refinement] = {
    "none": Refinement(_first, _first),
    "latent": Refinement(_refine_code, _first, tries_parts=False),
    "nodes": Refinement(_fit_nodes, _fit_nodes_to_part),
}


def choose(
    candidates: Sequence[Candidate], count: int, comparison: WholeComparison, progress: Progress
) -> tuple[Candidate, Candidate]:
    """Return the best of several candidates (given best first): as it was given, and refined.

    At most ``count`` candidates that differ from each other are tried.
    """
    finalists: list[Candidate] = []
    known: list[Floats] = []
    for candidate in candidates[: SETTINGS.pool]:
        verts = comparison.vertices(candidate)
        if len(finalists) < count and all(differ(verts, each) for each in known):
            finalists.append(candidate)
            known.append(verts)
    if len(finalists) > 1:
        finalists = _screen(finalists, comparison, progress)
    progress(0.6)
    refined = parallel_map(lambda candidate: comparison.refined(candidate, in_full=True), finalists)
    progress(1.0)
    best = int(np.argmin([comparison.score(each, True) for each in refined])) if len(refined) > 1 else 0
    return finalists[best], refined[best]


def with_limb_bent(comparison: WholeComparison, chosen: Candidate, fit: Candidate) -> Candidate:
    """Return the fit with one limb bent to a region that it leaves uncovered, if that is better and leaves none.

    ``chosen`` is the candidate from which ``fit`` was refined. Limbs are bent in both: in the refined fit a limb that is in
    the wrong place is deformed already, but the others are closer to theirs. The likeliest of each are refined. Fits with
    several uncovered regions are left alone, as several limbs are wrong: on two people, each limb that was moved let another
    one go astray. So are clouds, whose noise hides uncovered regions.
    """
    task, limbs = comparison.task, limbs_of(comparison.task.model)
    if not limbs.bends or not task.samples.signed:
        return fit
    local = task.coarse.to_local(fit.pose)
    regions = uncovered_regions(local, task.system.surface(fit.vectors))
    if len(regions) != 1:
        return fit
    starts = comparison.average_similar(chosen).vectors, fit.vectors
    tried = [bent for start in starts for bent in limbs.reaching(local, start, regions[0])]
    refined = parallel_map(lambda vectors: comparison.refined(replace(chosen, vectors=vectors), in_full=True), tried)
    complete = [each for each in refined if not uncovered_regions(local, task.system.surface(each.vectors))]
    bent = min(complete, key=lambda each: comparison.score(each, False), default=fit)
    return bent if comparison.score(bent, False) < SETTINGS.bent_margin * comparison.score(fit, False) else fit


def _screen(candidates: list[Candidate], comparison: WholeComparison, progress: Progress) -> list[Candidate]:
    """Compare candidates after a few steps; return those that are worth all steps, best first.

    Candidates that become equal to a better one, or fall far behind, are dropped.
    """

    def screen(candidate: Candidate) -> tuple[float, Candidate, Floats]:
        refined = comparison.refined(candidate, in_full=False)
        return comparison.score(refined, False), candidate, comparison.vertices(refined)

    progress(0.0)
    scored = sorted(parallel_map(screen, candidates), key=lambda entry: entry[0])
    kept: list[tuple[Candidate, Floats]] = []
    for score, candidate, verts in scored:
        if score <= SETTINGS.screening_margin * scored[0][0] and all(differ(verts, other) for _, other in kept):
            kept.append((candidate, verts))
    return [candidate for candidate, _ in kept]


class WholeComparison:
    """Refines and scores candidates of a whole shape.

    ``in_full`` is with all steps, otherwise with the few steps of screening.
    """

    def __init__(self, task: FitTask, candidates: list[Candidate], roughness: float | None = None) -> None:
        self.task, self._candidates = task, candidates
        roughness = task.roughness if roughness is None else roughness
        screening = task.samples.first(SETTINGS.screening_samples)
        # keyed by ``in_full``
        self.scorers = {
            in_full: CandidateScorer(task.system, samples, roughness)
            for in_full, samples in ((True, task.samples), (False, screening))
        }
        self._landmarks = None
        if task.landmarks is not None:
            self._landmarks = task.landmarks[0], task.frame.apply(task.landmarks[1])

    def refined(self, candidate: Candidate, in_full: bool) -> Candidate:
        """Return a candidate after refinement."""
        task = self.task
        if in_full:
            candidate = self.average_similar(candidate)
        fixed = None
        if self._landmarks is not None:
            fixed = self._landmarks[0], candidate.pose.to_local(self._landmarks[1])
        local = candidate.local(self.scorers[in_full].samples)
        facing = local if local.signed else local.facing(task.system.surface(candidate.vectors))
        vectors = refine_nodes(task.system, facing, candidate.vectors, self.schedule(in_full), fixed)
        return replace(candidate, vectors=vectors, residual=two_way_residual(task.system, local, vectors))

    def average_similar(self, candidate: Candidate) -> Candidate:
        """Return a candidate with the mean node vectors of those that agree with it, see `average_similar`."""
        return average_similar(self.task.system, candidate, self._candidates)

    def schedule(self, in_full: bool) -> fit_config.NodeRefineConfig:
        """The configuration with all steps, or with the steps of screening, which suffice to rank candidates."""
        config = self.task.config
        if in_full:
            return config.nodes
        return replace(config.nodes, schedule=replace(config.nodes.schedule, steps=config.screening))

    def score(self, candidate: Candidate, in_full: bool) -> float:
        """Cost of a refined candidate; lower is better."""
        scorer = self.scorers[in_full]
        residual = scorer.score(candidate.local(scorer.samples), candidate)
        cost = replace(candidate, residual=residual).cost
        if not in_full:
            return cost
        is_expected = stands_upright if self.task.shape.upright else has_common_axes
        return cost + (0.0 if is_expected(candidate.pose) else SETTINGS.unusual_axes_cost) + self.doubt(candidate)

    def doubt(self, candidate: Candidate) -> float:
        """Cost of a candidate that differs from the network's predictions for tilted copies of the samples."""
        task = self.task
        if not is_tilt_consistent(task.model):
            return 0.0
        everywhere = np.ones(len(task.system.verts), bool)
        spread = task.predictor.spread(candidate.local(task.samples), candidate.vectors, everywhere)
        return SETTINGS.spread_cost * min(spread, TYPICAL_SPREAD)

    def vertices(self, candidate: Candidate) -> Float[Floats, "V 3"]:
        """Positions (V, 3) of the template's vertices under a candidate, in one frame for all candidates."""
        moved = self.task.system.moved(candidate.vectors)
        return np.asarray(candidate.pose.to_world(moved) / np.sqrt(candidate.share))


class PartComparison(WholeComparison):
    """Refines and scores candidates of a part; template that the part does not show is held where the fit has it."""

    def __init__(self, task: FitTask) -> None:
        super().__init__(task, [], roughness=0.0)

    def refined(self, candidate: Candidate, in_full: bool) -> Candidate:
        system = self.task.system
        local = candidate.local(self.scorers[in_full].samples)
        both = completed(system, local, candidate.vectors, candidate.share, np.random.default_rng(0))
        vectors = refine_nodes(system, both, candidate.vectors, self.schedule(in_full))
        return replace(candidate, vectors=vectors, residual=one_way_residual(system, local, vectors))

    def doubt(self, candidate: Candidate) -> float:
        """Zero: the network's predictions say nothing about what a part does not show."""
        return 0.0


class CandidateScorer:
    """Scores candidates against one set of samples, in any frame and size; lower is better.

    ``roughness`` is that of a cloud (0..1, see `Shape.roughness`). Normals that are estimated from noise say little, so
    squared distances replace them: they separate a limb next to its points from one among its scattered points.
    """

    def __init__(self, system: NodeSystem, samples: OrientedPoints, roughness: float = 0.0) -> None:
        self._system, self.samples, self._roughness = system, samples, roughness

    @cached_property
    def _pairs(self) -> Pairs:
        return neighbours(self.samples)

    def score(self, local: OrientedPoints, candidate: Candidate) -> float:
        """Residual of a candidate plus a cost for discontinuities; ``local`` are the same samples in its core frame."""
        residual, roughness = candidate.residual, self._roughness
        if roughness > 0:
            residual += roughness * (self.scatter(local, candidate.vectors) - residual)
        return residual + SETTINGS.discontinuity_cost * discontinuous_share(
            self._system, self._pairs, local, candidate.vectors
        )

    def scatter(self, local: OrientedPoints, vectors: Float[Floats, "K 3"]) -> float:
        """Root mean square distance of nearest points, both ways, without normals (units of sqrt(area))."""
        moved = self._system.moved(vectors)
        forward = cKDTree(local.points).query(moved, distance_upper_bound=SETTINGS.cap)[0]
        back = cKDTree(moved).query(local.points, distance_upper_bound=SETTINGS.cap)[0]
        squares = [np.square(np.minimum(distance, SETTINGS.cap)) for distance in (forward, back)]
        return float(np.sqrt(0.5 * (squares[0].mean() + weighted_mean(squares[1], local.weights))))


def has_common_axes(pose: RigidPose) -> bool:
    """Return whether a core frame has an orientation that most files have: y up and z front, or z up and -y front."""
    up, front = pose.rotation[:, 1], pose.rotation[:, 2]
    return bool(min(up[1], front[2]) > MIN_AXIS_COSINE or min(up[2], -front[1]) > MIN_AXIS_COSINE)


def differ(here: Float[Floats, "V 3"], there: Float[Floats, "V 3"], far: float = SETTINGS.different_distance) -> bool:
    """Return whether two candidates place parts of the template differently."""
    return bool((np.linalg.norm(here - there, axis=1) > far).mean() > SETTINGS.different_share)


def average_similar(system: NodeSystem, chosen: Candidate, candidates: Sequence[Candidate]) -> Candidate:
    """Replace a candidate's node vectors by the mean over those that agree with it in the same core frame (best first).

    Each prediction has its own error, and refinement keeps the stretch of the prediction that it starts from.
    """
    verts = system.moved(chosen.vectors)
    similar = [
        other.vectors
        for other in candidates
        if other.pose is chosen.pose and not differ(verts, system.moved(other.vectors), SETTINGS.same_distance)
    ]
    return replace(chosen, vectors=np.mean(similar[: SETTINGS.max_averaged], axis=0)) if similar else chosen
