"""Fits of a part: one side of a body, or what is left of it beyond a cut.

A part does not say how large the whole is, so its share of the surface is one more thing to try. What the samples show
must lie on the template; what the template has besides is left to the network and to the prior on its gradient.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from meshmatch.fitting.completion import area_share, completed, visible_vertices
from meshmatch.fitting.initial_frames import frames_of_part
from meshmatch.fitting.network_fit import Candidate, Predictor, one_way_residual
from meshmatch.fitting.task import FitTask, Registration
from meshmatch.fitting.verdict import judge_registration
from meshmatch.geometry.frames import RigidPose
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.progress import Progress

STAGE = "fitting as a part"
# Shares of the surface that a part may show, and all that follows, were set by hand.
SHARES = (1.0, 0.8, 0.62, 0.48, 0.36)
_MIN_SHARE = 0.2  # that a shape is taken to show
# Residual that a share of 0 has to be better by than one of 1: rather the whole than a part.
_SHARE_COST = 0.004
_WIDE_SHARES = (0.8, 0.48)  # for which a wide search tries all frames
_ROUGH = 1024  # samples by which frames are ranked
# Candidates of each share that are fitted with care, in a narrow and in a wide search.
_CAREFUL, _CAREFUL_IF_WIDE = 6, 8
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
    candidates = _careful(task, wide, progress.between(0.0, 0.4))
    for number, count in enumerate(_COMPLETED):
        candidates = _fitted_again(task, _best_first(candidates)[:count])
        progress(0.4 + 0.2 * (number + 1) / len(_COMPLETED))
    candidates = _best_first(candidates)
    for candidate in candidates[:_VARIED]:
        candidates += _variants(task, candidate)
    best = refine(task, _best_first(candidates))
    root = float(np.sqrt(best.share))
    return Registration(task.rescaled(1 / root, sized(task.samples, best.share)), best.fit, best.share)


def _best_first(candidates: list[PartCandidate]) -> list[PartCandidate]:
    return sorted(candidates, key=lambda candidate: candidate.cost)


def _careful(task: FitTask, wide: bool, progress: Progress) -> list[PartCandidate]:
    """Fits from the best frames if the samples show each of the shares.

    A wide search tries all its frames for some of the shares, and the best of these frames for the others.
    """
    found: list[PartCandidate] = []
    best: dict[int, float] = {}  # residuals of the frames that all shares have in common
    order = sorted(SHARES, key=lambda share: wide and share not in _WIDE_SHARES)
    for number, share in enumerate(order):
        samples = sized(task.samples, share)
        frames, others = frames_of_part(task.model, samples, task.config, wide)
        tried = list(range(len(others)))
        if wide and number >= len(_WIDE_SHARES):
            tried = sorted(best, key=lambda frame: best[frame])[: len(others) // 4]
        thin = samples.first(_ROUGH)
        starts = [(thin, pose) for pose in [*(others[k] for k in tried), *frames]]
        rough = task.predictor.fit_all(starts, 1, 1, one_way_residual)
        for k, candidate in zip(tried, rough, strict=False):
            best[k] = min(candidate.residual, best.get(k, np.inf))
        rough.sort(key=lambda candidate: candidate.residual)
        count = _CAREFUL_IF_WIDE if wide else _CAREFUL
        careful = [(samples, each.pose) for each in rough[:count]]
        found += [PartCandidate(share, fit) for fit in task.predictor.fit_all(careful, measure=one_way_residual)]
        progress((number + 1) / len(order))
    return found


def _fitted_again(task: FitTask, candidates: Sequence[PartCandidate]) -> list[PartCandidate]:
    """New fits of the samples, completed by the last fits; how much of these was visible is the new share."""
    system, starts, shares = task.system, [], []
    for candidate in candidates:
        local, vectors = candidate.local(task.samples), candidate.fit.vectors
        visible = visible_vertices(system, local.first(_COARSE), vectors)
        shares.append(float(np.clip(area_share(system, visible), _MIN_SHARE, 1.0)))
        whole = completed(system, local, vectors, candidate.share, task.predictor.rng, visible)
        growth = np.sqrt(shares[-1] / candidate.share)
        starts.append((replace(whole, points=whole.points * growth), RigidPose.identity()))
    found = []
    again = task.predictor.fit_all(starts, measure=_unmeasured)
    for candidate, fit, share in zip(candidates, again, shares, strict=True):
        last = candidate.fit.pose
        pose = RigidPose(last.rotation, np.sqrt(share / candidate.share) * last.center) @ fit.pose
        placed = PartCandidate(share, replace(fit, pose=pose))
        residual = one_way_residual(system, placed.local(task.samples), fit.vectors)
        found.append(PartCandidate(share, replace(placed.fit, residual=residual)))
    return found


def _unmeasured(*_: object) -> float:
    return 0.0  # the residual is that of other samples, once these are placed


def _variants(task: FitTask, candidate: PartCandidate) -> list[PartCandidate]:
    """Other interpretations of the completed samples."""
    local = candidate.local(task.samples)
    whole = completed(task.system, local, candidate.fit.vectors, candidate.share, task.predictor.rng)
    near, pose, config = local.first(_COARSE), candidate.fit.pose, task.config
    return [
        PartCandidate(candidate.share, replace(each, residual=one_way_residual(task.system, local, each.vectors)))
        for each in task.predictor.variants(whole, near, pose, config.variants, config.tilt)
    ]
