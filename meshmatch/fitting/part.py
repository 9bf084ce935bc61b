"""Fits of a part: one side of a body, or what is left of it beyond a cut.

A part does not say how large the whole is, so its share of the surface is one more thing to try. What the samples show
must lie on the template; what the template has besides is left to the network and to the prior on its gradient.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from meshmatch.fitting.completion import area_share, completed, visible_vertices
from meshmatch.fitting.initial_frames import frames_of_part
from meshmatch.fitting.network_fit import Candidate, Predictor, one_way_residual
from meshmatch.fitting.task import FitTask, Registration
from meshmatch.fitting.verdict import judge_registration
from meshmatch.geometry.frames import RigidPose
from meshmatch.geometry.oriented import OrientedPoints

STAGE = "fitting as a part"
# Shares of the surface that a part may show, and all that follows, were set by hand.
SHARES = (1.0, 0.8, 0.62, 0.48, 0.36)
_MIN_SHARE = 0.2  # that a shape is taken to show
# Residual that a share of 0 has to be better by than one of 1: rather the whole than a part.
_SHARE_COST = 0.004
# Candidates of each share that are fitted with care, in a narrow and in a wide search.
_CAREFUL, _CAREFUL_IF_WIDE = 6, 16
# Candidates that are completed and fitted again: so many once, of these so many twice, and so many three times.
_COMPLETED = (14, 7, 4)
_VARIED = 2  # candidates of which variants are sought
_COARSE = 2048


@dataclass(frozen=True, eq=False)
class PartCandidate:
    """One way to see samples as a part: the visible share of the surface, and a fit to the samples of that size."""

    share: float
    fit: Candidate

    def local(self, samples: OrientedPoints) -> OrientedPoints:
        """Samples of area 1 as large as their share, in the core frame."""
        return sized(samples, self.share).to_local(self.fit.pose)

    @property
    def cost(self) -> float:
        """See `cost`."""
        return cost(self.fit.residual, self.share)


# Of candidates, best first, to the fit.
RefinePart = Callable[[FitTask, list[PartCandidate]], PartCandidate]


def cost(residual: float, share: float) -> float:
    """A residual, and a little for what is not visible: the smaller the part, the easier it lies on a template."""
    return residual + _SHARE_COST * (1 - share)


def sized(samples: OrientedPoints, share: float) -> OrientedPoints:
    """Samples of area 1, scaled to area ``share``."""
    return replace(samples, points=samples.points * np.sqrt(share))


def fit_part(task: FitTask, refine: RefinePart) -> Registration:
    """Fit the template to a shape that may show only a part; where that is poor, from more orientations.

    ``refine`` turns the network's candidates into one fit, whose residual is from the samples to the template only.
    """
    found = _search(task, refine, wide=False)
    if judge_registration(found, partial=True)[0] != "poor":
        return found
    config = replace(task.config, copies=2 * task.config.copies, hypotheses=4 * task.config.hypotheses)
    again = _search(replace(task, config=config), refine, wide=True)
    return min(found, again, key=lambda each: cost(each.candidate.residual, each.share))


def _search(task: FitTask, refine: RefinePart, wide: bool) -> Registration:
    """The best fit of a part from some orientations; each search draws the same random numbers."""
    task = replace(task, predictor=Predictor.of(task.model, np.random.default_rng(task.config.seed)))
    progress = task.progress.stage(STAGE)
    candidates: list[PartCandidate] = []
    for number, share in enumerate(SHARES):
        candidates += _of_share(task, share, wide)
        progress(0.4 * (number + 1) / len(SHARES))
    for number, count in enumerate(_COMPLETED):
        candidates = [_fitted_again(task, each) for each in _best_first(candidates)[:count]]
        progress(0.4 + 0.2 * (number + 1) / len(_COMPLETED))
    candidates = _best_first(candidates)
    for candidate in candidates[:_VARIED]:
        candidates += _variants(task, candidate)
    best = refine(task, _best_first(candidates))
    root = float(np.sqrt(best.share))
    return Registration(task.rescaled(1 / root, sized(task.samples, best.share)), best.fit, best.share)


def _best_first(candidates: list[PartCandidate]) -> list[PartCandidate]:
    return sorted(candidates, key=lambda candidate: candidate.cost)


def _of_share(task: FitTask, share: float, wide: bool) -> list[PartCandidate]:
    """Careful fits from the best frames, if the samples show a share of the whole."""
    samples = sized(task.samples, share)
    coarse = samples.first(_COARSE)
    frames = frames_of_part(task.model, samples, task.config, wide)
    rough = [_fit(task, coarse, pose, rounds=1, draws=1) for pose in frames]
    rough.sort(key=lambda candidate: candidate.residual)
    count = _CAREFUL_IF_WIDE if wide else _CAREFUL
    return [PartCandidate(share, _fit(task, samples, each.pose, rounds=2, draws=2)) for each in rough[:count]]


def _fit(task: FitTask, samples: OrientedPoints, pose: RigidPose, rounds: int, draws: int) -> Candidate:
    found = task.predictor.fit(samples, pose, rounds, draws, stride=4)
    local = samples.to_local(found.pose)
    return replace(found, residual=one_way_residual(task.system, local, found.vectors))


def _fitted_again(task: FitTask, candidate: PartCandidate) -> PartCandidate:
    """A new fit of the samples, completed by the last fit; how much of that was visible is the new share."""
    system, last = task.system, candidate.fit
    local = candidate.local(task.samples)
    visible = visible_vertices(system, local.first(_COARSE), last.vectors)
    share = float(np.clip(area_share(system, visible), _MIN_SHARE, 1.0))
    whole = completed(system, local, last.vectors, candidate.share, task.predictor.rng)
    growth = np.sqrt(share / candidate.share)
    whole = replace(whole, points=whole.points * growth)
    again = task.predictor.fit(whole, RigidPose.identity(), stride=4)
    pose = RigidPose(last.pose.rotation, growth * last.pose.center) @ again.pose
    found = PartCandidate(share, replace(again, pose=pose))
    residual = one_way_residual(system, found.local(task.samples), again.vectors)
    return replace(found, fit=replace(found.fit, residual=residual))


def _variants(task: FitTask, candidate: PartCandidate) -> list[PartCandidate]:
    """Other interpretations of the completed samples."""
    local = candidate.local(task.samples)
    whole = completed(task.system, local, candidate.fit.vectors, candidate.share, task.predictor.rng)
    near, pose, config = local.first(_COARSE), candidate.fit.pose, task.config
    return [
        PartCandidate(candidate.share, replace(each, residual=one_way_residual(task.system, local, each.vectors)))
        for each in task.predictor.variants(whole, near, pose, config.variants, config.tilt)
    ]
