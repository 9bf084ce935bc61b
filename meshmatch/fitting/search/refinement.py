"""From the network's candidates to the surface: the refinements that a user can choose, in one table.

A new refinement is a line of `REFINEMENTS`, and its name in `meshmatch.fitting.fit_config`.

The surface alone hardly tells which of several interpretations of a pose is right: a crossed arm taken for the other one
lies on it as well as the right one does. But points that are neighbours on the shape then belong far apart on the
template: the map is discontinuous. Interpretations that differ are each refined in full, and judged by both; where they tie,
as front and back of a robot do, by what the network reads in copies of the shape, and by how files usually stand.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from meshmatch.arrays import Float, Floats
from meshmatch.errors import needs
from meshmatch.fitting import fit_config
from meshmatch.fitting.search.candidates import STAGE, candidates_of_part, candidates_of_whole, completed, of_file
from meshmatch.fitting.search.discontinuities import Pairs, discontinuous_share, neighbours
from meshmatch.fitting.search.frames import USUAL, stands_upright
from meshmatch.fitting.search.limbs import bare_places, limbs_of
from meshmatch.fitting.search.predictor import (
    USUAL_SPREAD,
    Candidate,
    best_first,
    one_way_residual,
    reads_alike,
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
    """How interpretations are compared and refined. All set by hand; lengths and residuals are in units of sqrt(area).

    Attributes
    ----------
    discontinuity_cost : residual that a map discontinuous everywhere is worse by
    cap : a distance beyond this says no more
    different_share, different_distance : interpretations differ where this share of the template's vertices lies that far
        apart
    same_distance, max_averaged : interpretations closer than that are the same, and so many of these at most are averaged
    pool : among how many of the best those that are unlike each other are looked for
    screening_margin : an interpretation whose score is more than this times the best one's after a few steps is left: on 78
        bodies of SCAPE, FAUST and SHREC'19 the best after a few steps was the best at the end
    unusual_axes_cost : margin by which an orientation must win that is rare in files, or not that which the file states
    spread_cost : residual for each unit that the network's predictions for tilted copies lie from an interpretation, up to
        the usual spread, beyond which they tell no more: on robots of seeds 0 and 1 they tell front from back in 15 of 15
        ties
    part_finalists : interpretations of a part that get a few steps each
    screening_samples : samples that are enough to tell interpretations apart
    bent_margin : a fit with a limb bent is taken if its score is less than this times the score of that without
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
"""From a task's candidates, best first, to the fit."""


def fit_whole(task: FitTask) -> Registration:
    """Fit the template to a shape that is taken for complete."""
    task, candidates = candidates_of_whole(task)
    return Registration(task.on_visible_samples, REFINEMENTS[task.config.refine].whole(task, candidates))


def fit_part(task: FitTask, wide: bool = False) -> Registration | None:
    """Fit the template to a shape that may show only a part, from more orientations if the search is to be ``wide``; None
    where another search finds nothing near.

    The residual is from the samples to the template only.
    """
    task, candidates = candidates_of_part(task, wide)
    if not candidates:
        return None
    best = REFINEMENTS[task.config.refine].part(task, candidates)
    root = float(np.sqrt(best.share))
    return Registration(task.rescaled(1 / root, scaled_to_area(task.samples, best.share)), best)


@dataclass(frozen=True)
class Refinement:
    """What makes one fit of the network's candidates, for `fit_whole` and for `fit_part`.

    ``tries_parts``: quick enough to find out whether a shape is a part where the user does not say.
    """

    whole: Refine
    part: Refine
    tries_parts: bool = True


def _first(task: FitTask, candidates: list[Candidate]) -> Candidate:
    return candidates[0]


def _search_code(task: FitTask, candidates: list[Candidate]) -> Candidate:
    """The best candidate, refined by the paper's search over codes."""
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
    """The best of the candidates and of variants of the best one, refined by least squares on the nodes."""
    config, coarse = task.config, task.coarse
    pool: list[Candidate] = []
    for pose in (each.pose for each in (candidates[0], *of_file(task, candidates))):
        local = task.samples.to_local(pose)
        pool += task.predictor.variants(local, coarse.to_local(pose), pose, config.variants, config.tilt)
    for each in candidates:
        residual = two_way_residual(task.system, coarse.to_local(each.pose), each.vectors)
        pool.append(replace(each, residual=residual))
    found = best_first(pool)
    comparison = WholeComparison(task.on_visible_samples, found)
    progress = task.progress.stage("refinement")
    chosen, fit = choose([*of_file(task, found), *found], config.finalists, comparison, progress)
    return with_limb_bent(comparison, chosen, fit)


def _fit_nodes_to_part(task: FitTask, candidates: list[Candidate]) -> Candidate:
    """The best of several interpretations of a part, refined by least squares on the nodes."""
    return choose(candidates, SETTINGS.part_finalists, PartComparison(task), task.progress.stage(STAGE, 0.6, 1.0))[1]


REFINEMENTS: dict[fit_config.Refine, Refinement] = {
    "none": Refinement(_first, _first),
    "latent": Refinement(_search_code, _first, tries_parts=False),
    "nodes": Refinement(_fit_nodes, _fit_nodes_to_part),
}


def choose(
    candidates: Sequence[Candidate], count: int, comparison: WholeComparison, progress: Progress
) -> tuple[Candidate, Candidate]:
    """The best of several interpretations (best first), as it came and refined; at most ``count`` that are unlike each
    other are tried.
    """
    finalists: list[Candidate] = []
    known: list[Floats] = []
    for candidate in candidates[: SETTINGS.pool]:
        verts = comparison.vertices(candidate)
        if len(finalists) < count and all(differ(verts, each) for each in known):
            finalists.append(candidate)
            known.append(verts)
    if len(finalists) > 1:
        finalists = _screened(finalists, comparison, progress)
    progress(0.6)
    refined = parallel_map(lambda candidate: comparison.refined(candidate, in_full=True), finalists)
    progress(1.0)
    best = int(np.argmin([comparison.score(each, True) for each in refined])) if len(refined) > 1 else 0
    return finalists[best], refined[best]


def with_limb_bent(comparison: WholeComparison, chosen: Candidate, fit: Candidate) -> Candidate:
    """A fit with a limb bent to the one place that it leaves bare, if that is better and leaves nothing bare; ``chosen`` was
    refined to it.

    That is what is bent and refined anew, for a limb in a wrong place is deformed there by the fit. Where several places
    are bare several limbs are wrong: of two people each limb that was moved let another one go astray. What is bare of a
    cloud its noise hides.
    """
    task, limbs = comparison.task, limbs_of(comparison.task.model)
    if not limbs.bends or not task.samples.signed:
        return fit
    local = task.coarse.to_local(fit.pose)
    places = bare_places(local, task.system.surface(fit.vectors))
    if len(places) != 1:
        return fit
    reaching = limbs.reaching(local, comparison.averaged(chosen).vectors, places[0])
    if reaching is None:
        return fit
    bent = comparison.refined(replace(chosen, vectors=reaching), in_full=True)
    better = comparison.score(bent, False) < SETTINGS.bent_margin * comparison.score(fit, False)
    return bent if better and not bare_places(local, task.system.surface(bent.vectors)) else fit


def _screened(candidates: list[Candidate], comparison: WholeComparison, progress: Progress) -> list[Candidate]:
    """Those of several interpretations that a few steps neither bring together nor leave far behind, best first."""

    def tried(candidate: Candidate) -> tuple[float, Candidate, Floats]:
        found = comparison.refined(candidate, in_full=False)
        return comparison.score(found, False), candidate, comparison.vertices(found)

    progress(0.0)
    rough = sorted(parallel_map(tried, candidates), key=lambda entry: entry[0])
    kept: list[tuple[Candidate, Floats]] = []
    for score, candidate, verts in rough:
        if score <= SETTINGS.screening_margin * rough[0][0] and all(differ(verts, other) for _, other in kept):
            kept.append((candidate, verts))
    return [candidate for candidate, _ in kept]


class WholeComparison:
    """How interpretations of a whole are refined and told apart: ``in_full`` by all steps, or by a few that screen them."""

    def __init__(self, task: FitTask, candidates: list[Candidate], roughness: float | None = None) -> None:
        self.task, self._candidates = task, candidates
        roughness = task.roughness if roughness is None else roughness
        few = task.samples.first(SETTINGS.screening_samples)
        # by whether an interpretation is refined in full
        self.scorers = {
            in_full: CandidateScorer(task.system, samples, roughness)
            for in_full, samples in ((True, task.samples), (False, few))
        }
        self._landmarks = None
        if task.landmarks is not None:
            self._landmarks = task.landmarks[0], task.frame.apply(task.landmarks[1])

    def refined(self, candidate: Candidate, in_full: bool) -> Candidate:
        """An interpretation after its refinement."""
        task = self.task
        if in_full:
            candidate = self.averaged(candidate)
        fixed = None
        if self._landmarks is not None:
            fixed = self._landmarks[0], candidate.pose.to_local(self._landmarks[1])
        local = candidate.local(self.scorers[in_full].samples)
        facing = local if local.signed else local.facing(task.system.surface(candidate.vectors))
        vectors = refine_nodes(task.system, facing, candidate.vectors, self.schedule(in_full), fixed)
        return replace(candidate, vectors=vectors, residual=two_way_residual(task.system, local, vectors))

    def averaged(self, candidate: Candidate) -> Candidate:
        """An interpretation with the mean node vectors of those that agree with it, see `averaged`."""
        return averaged(self.task.system, candidate, self._candidates)

    def schedule(self, in_full: bool) -> fit_config.NodeRefineConfig:
        """All steps, or a few of the same schedule: they tell which interpretations the surface agrees with."""
        config = self.task.config
        if in_full:
            return config.nodes
        return replace(config.nodes, schedule=replace(config.nodes.schedule, steps=config.screening))

    def score(self, candidate: Candidate, in_full: bool) -> float:
        """How well a refined interpretation fits; lower is better."""
        scorer = self.scorers[in_full]
        residual = scorer.score(candidate.local(scorer.samples), candidate)
        cost = replace(candidate, residual=residual).cost
        if not in_full:
            return cost
        usual = stands_upright if self.task.shape.upright else has_common_axes
        return cost + (0.0 if usual(candidate.pose) else SETTINGS.unusual_axes_cost) + self.doubt(candidate)

    def doubt(self, candidate: Candidate) -> float:
        """What is added to the residual of an interpretation that the network reads less surely."""
        task = self.task
        if not reads_alike(task.model):
            return 0.0
        everywhere = np.ones(len(task.system.verts), bool)
        spread = task.predictor.spread(candidate.local(task.samples), candidate.vectors, everywhere)
        return SETTINGS.spread_cost * min(spread, USUAL_SPREAD)

    def vertices(self, candidate: Candidate) -> Float[Floats, "V 3"]:
        """Where an interpretation has the template's vertices, in one frame for all."""
        moved = self.task.system.moved(candidate.vectors)
        return np.asarray(candidate.pose.to_world(moved) / np.sqrt(candidate.share))


class PartComparison(WholeComparison):
    """The same for interpretations of a part: what it does not show is held where the fit has it."""

    def __init__(self, task: FitTask) -> None:
        super().__init__(task, [], roughness=0.0)

    def refined(self, candidate: Candidate, in_full: bool) -> Candidate:
        system = self.task.system
        local = candidate.local(self.scorers[in_full].samples)
        both = completed(system, local, candidate.vectors, candidate.share, np.random.default_rng(0))
        vectors = refine_nodes(system, both, candidate.vectors, self.schedule(in_full))
        return replace(candidate, vectors=vectors, residual=one_way_residual(system, local, vectors))

    def doubt(self, candidate: Candidate) -> float:
        """None: of what a part does not show, the network's readings say nothing."""
        return 0.0


class CandidateScorer:
    """Scores candidates for one set of samples, in any frame and size: the lower the better.

    ``roughness`` is that of a cloud (0..1, see `Shape.roughness`): normals estimated from noise say little, and squares
    tell a limb that lies beside its points from one whose points scatter about it.
    """

    def __init__(self, system: NodeSystem, samples: OrientedPoints, roughness: float = 0.0) -> None:
        self._system, self.samples, self._roughness = system, samples, roughness

    @cached_property
    def _pairs(self) -> Pairs:
        return neighbours(self.samples)

    def score(self, local: OrientedPoints, candidate: Candidate) -> float:
        """Residual of a candidate and a cost for discontinuities; ``local``: the same samples in its core frame."""
        residual, rough = candidate.residual, self._roughness
        if rough > 0:
            residual += rough * (self.scatter(local, candidate.vectors) - residual)
        return residual + SETTINGS.discontinuity_cost * discontinuous_share(
            self._system, self._pairs, local, candidate.vectors
        )

    def scatter(self, local: OrientedPoints, vectors: Float[Floats, "K 3"]) -> float:
        """Root of the mean squared distance of nearest points, both ways, normals left out (units of sqrt(area))."""
        moved = self._system.moved(vectors)
        forward = cKDTree(local.points).query(moved, distance_upper_bound=SETTINGS.cap)[0]
        back = cKDTree(moved).query(local.points, distance_upper_bound=SETTINGS.cap)[0]
        squares = [np.square(np.minimum(distance, SETTINGS.cap)) for distance in (forward, back)]
        return float(np.sqrt(0.5 * (squares[0].mean() + weighted_mean(squares[1], local.weights))))


def has_common_axes(pose: RigidPose) -> bool:
    """Whether a core frame stands as shapes do in most files: up along y and front along z, or up along z and front
    along -y.
    """
    up, front = pose.rotation[:, 1], pose.rotation[:, 2]
    return bool(min(up[1], front[2]) > USUAL or min(up[2], -front[1]) > USUAL)


def differ(here: Float[Floats, "V 3"], there: Float[Floats, "V 3"], far: float = SETTINGS.different_distance) -> bool:
    """Whether two interpretations have parts of the template in different places."""
    return bool((np.linalg.norm(here - there, axis=1) > far).mean() > SETTINGS.different_share)


def averaged(system: NodeSystem, chosen: Candidate, candidates: Sequence[Candidate]) -> Candidate:
    """A candidate with the mean node vectors of those that agree with it in the same core frame; best first.

    Each prediction errs in its own way, and its stretch is what the refinement holds on to.
    """
    here = system.moved(chosen.vectors)
    alike = [
        other.vectors
        for other in candidates
        if other.pose is chosen.pose and not differ(here, system.moved(other.vectors), SETTINGS.same_distance)
    ]
    return replace(chosen, vectors=np.mean(alike[: SETTINGS.max_averaged], axis=0)) if alike else chosen
