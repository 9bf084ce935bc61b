"""From the network's candidates to the surface: the refinements that a user can choose, in one table.

A new refinement is a line of `REFINEMENTS`, and its name in `meshmatch.fitting.choices`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from meshmatch.arrays import Float, Floats
from meshmatch.errors import needs
from meshmatch.fitting.candidates import CandidateScorer, Interpretation, averaged, choose
from meshmatch.fitting.choices import Refine
from meshmatch.fitting.completion import completed
from meshmatch.fitting.network_fit import Candidate, one_way_residual, two_way_residual
from meshmatch.fitting.nodes import refine_nodes
from meshmatch.fitting.part import STAGE, PartCandidate, RefinePart, cost
from meshmatch.fitting.task import FitTask
from meshmatch.fitting.whole import RefineWhole
from meshmatch.geometry.oriented import OrientedPoints

# Interpretations of a part that get a few steps each. Set by hand.
_PART_FINALISTS = 5
_SCREENED_SAMPLES = 4096  # enough to tell interpretations apart


@dataclass(frozen=True)
class Refinement:
    """What is done with the network's candidates, which come best first.

    Attributes
    ----------
    whole : (FitTask, list of Candidate) -> Candidate
        For `fit_whole`.
    part : (FitTask, list of PartCandidate) -> PartCandidate
        For `fit_part`.
    tries_parts : bool
        Quick enough to find out whether a shape is a part where the user does not say.
    """

    whole: RefineWhole
    part: RefinePart
    tries_parts: bool = True


def _first(task: FitTask, candidates: list[Interpretation]) -> Interpretation:
    return candidates[0]


def _search_code(task: FitTask, candidates: list[Candidate]) -> Candidate:
    """The best candidate, refined by the paper's search over codes."""
    with needs("torch", "train"):
        from meshmatch.fitting.latent import refine_code

    best = candidates[0]
    local = task.samples.to_local(best.pose)
    facing = local.facing(task.system.surface(best.vectors))
    progress = task.progress.stage("refinement")
    vectors = refine_code(task.model, facing, task.config.latent, task.predictor.rng, progress)
    return Candidate(best.pose, vectors, two_way_residual(task.system, local, vectors))


def _fit_nodes(task: FitTask, candidates: list[Candidate]) -> Candidate:
    """The best of several interpretations, refined by Gauss-Newton on the nodes."""
    found = _interpretations(task, candidates)
    comparison = _WholeComparison(task, found)
    return choose(found, task.config.finalists, comparison, task.progress.stage("refinement"))


def _interpretations(task: FitTask, candidates: list[Candidate]) -> list[Candidate]:
    """The candidates and variants of the best one, best first on the coarse samples."""
    config, coarse, pose = task.config, task.coarse, candidates[0].pose
    local = task.samples.to_local(pose)
    pool = task.predictor.variants(local, coarse.to_local(pose), pose, config.variants, config.tilt)
    for each in candidates:
        residual = two_way_residual(task.system, coarse.to_local(each.pose), each.vectors)
        pool.append(replace(each, residual=residual))
    return sorted(pool, key=lambda candidate: candidate.residual)


class _View:
    """Samples by which interpretations are refined and compared."""

    def __init__(self, task: FitTask, samples: OrientedPoints, roughness: float) -> None:
        self._task, self.samples, self._roughness = task, samples, roughness

    @cached_property
    def scorer(self) -> CandidateScorer:
        """Of these samples."""
        return CandidateScorer(self._task.system, self.samples, self._roughness)


def _views(task: FitTask, roughness: float) -> dict[bool, _View]:
    """What interpretations are refined in full with, and a little."""
    few = task.samples.first(_SCREENED_SAMPLES)
    return {True: _View(task, task.samples, roughness), False: _View(task, few, roughness)}


class _WholeComparison:
    """How interpretations of a whole are refined and told apart, see `meshmatch.fitting.candidates.Comparison`."""

    def __init__(self, task: FitTask, candidates: list[Candidate]) -> None:
        self._task, self._candidates = task, candidates
        self._views = _views(task, task.roughness)
        self._landmarks = None
        if task.landmarks is not None:
            self._landmarks = task.landmarks[0], task.frame.apply(task.landmarks[1])

    def refined(self, candidate: Candidate, in_full: bool) -> Candidate:
        task, config = self._task, self._task.config.nodes
        if in_full:
            candidate = averaged(task.system, candidate, self._candidates)
        else:  # a few steps of the same schedule tell which interpretations the surface agrees with
            config = replace(config, steps=task.config.screening)
        fixed = None
        if self._landmarks is not None:
            fixed = self._landmarks[0], candidate.pose.to_local(self._landmarks[1])
        local = self._views[in_full].samples.to_local(candidate.pose)
        facing = local.facing(task.system.surface(candidate.vectors))
        vectors = refine_nodes(task.system, facing, candidate.vectors, config, fixed)
        return Candidate(candidate.pose, vectors, two_way_residual(task.system, local, vectors))

    def score(self, candidate: Candidate, in_full: bool) -> float:
        view = self._views[in_full]
        return view.scorer.score(view.samples.to_local(candidate.pose), candidate)

    def vertices(self, candidate: Candidate) -> Float[Floats, "V 3"]:
        return candidate.pose.to_world(self._task.system.moved(candidate.vectors))


def _fit_nodes_to_part(task: FitTask, candidates: list[PartCandidate]) -> PartCandidate:
    """The best of several interpretations of a part, refined by Gauss-Newton on the nodes."""
    progress = task.progress.stage(STAGE, 0.6, 1.0)
    return choose(candidates, _PART_FINALISTS, _PartComparison(task), progress)


class _PartComparison:
    """The same for interpretations of a part: what it does not show is held where the fit has it."""

    def __init__(self, task: FitTask) -> None:
        self._task, self._views = task, _views(task, 0.0)

    def refined(self, candidate: PartCandidate, in_full: bool) -> PartCandidate:
        task, config = self._task, self._task.config.nodes
        if not in_full:
            config = replace(config, steps=task.config.screening)
        local, vectors = candidate.local(self._views[in_full].samples), candidate.fit.vectors
        both = completed(task.system, local, vectors, candidate.share, np.random.default_rng(0))
        vectors = refine_nodes(task.system, both, vectors, config)
        residual = one_way_residual(task.system, local, vectors)
        return replace(candidate, fit=Candidate(candidate.fit.pose, vectors, residual))

    def score(self, candidate: PartCandidate, in_full: bool) -> float:
        view = self._views[in_full]
        return cost(view.scorer.score(candidate.local(view.samples), candidate.fit), candidate.share)

    def vertices(self, candidate: PartCandidate) -> Float[Floats, "V 3"]:
        moved = self._task.system.moved(candidate.fit.vectors)
        return candidate.fit.pose.to_world(moved) / np.sqrt(candidate.share)


REFINEMENTS: dict[Refine, Refinement] = {
    "none": Refinement(_first, _first),
    "latent": Refinement(_search_code, _first, tries_parts=False),
    "nodes": Refinement(_fit_nodes, _fit_nodes_to_part),
}
