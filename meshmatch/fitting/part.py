"""Fits of a part: one side of a body, or what is left of it beyond a cut.

A part does not say how large the whole is, so its share of the surface is one more thing to try. What the samples show
must lie on the template; what the template has besides is left to the network and to the prior on its gradient.

The network was mostly shown complete shapes. Where samples show a part, the template's fitted surface stands in for
what is missing, and the network is asked again about both together. The refinement then holds what is not visible where
the network wants it, and nothing beyond a cut is pulled onto its edge.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from meshmatch.arrays import Bool, Bools, Float, Floats
from meshmatch.fitting.initial_frames import frames_of_part
from meshmatch.fitting.network_fit import Candidate, Predictor, best_first, one_way_residual, sized
from meshmatch.fitting.system import NodeSystem
from meshmatch.fitting.task import FitTask, Refine, Registration
from meshmatch.fitting.verdict import area_share, judge_registration, visible_vertices
from meshmatch.geometry.frames import RigidPose
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.progress import Progress
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape

STAGE = "fitting as a part"
# Shares of the surface that a part may show, and all that follows, were set by hand.
SHARES = (1.0, 0.8, 0.62, 0.48, 0.36)
_MIN_SHARE = 0.2  # that a shape is taken to show
_WIDE_SHARES = (0.8, 0.48)  # for which a wide search tries all frames
_ROUGH = 1024  # samples by which frames are ranked
# Candidates of each share that are fitted with care, in a narrow and in a wide search.
_CAREFUL, _CAREFUL_IF_WIDE = 6, 8
# Candidates that are completed and fitted again: so many once, of these so many twice, and so many three times.
_COMPLETED = (14, 7, 4)
_VARIED = 2  # candidates of which variants are sought
_COARSE = 2048
_MAX_ADDED = 3  # points that complete the samples, for each of them, at most


def fit_part(task: FitTask, refine: Refine) -> Registration:
    """Fit the template to a shape that may show only a part; where that is poor, from more orientations.

    ``refine`` turns the network's candidates into one fit, whose residual is from the samples to the template only.
    """
    found = _search(task, refine, wide=False)
    if judge_registration(found, partial=True)[0] != "poor":
        return found
    config = replace(task.config, copies=2 * task.config.copies, hypotheses=4 * task.config.hypotheses)
    again = _search(replace(task, config=config), refine, wide=True)
    return min(found, again, key=lambda each: each.candidate.cost)


def _search(task: FitTask, refine: Refine, wide: bool) -> Registration:
    """The best fit of a part from some orientations; each search draws the same random numbers."""
    task = replace(task, predictor=Predictor.of(task.model, np.random.default_rng(task.config.seed)))
    progress = task.progress.stage(STAGE)
    candidates = _careful(task, wide, progress.between(0.0, 0.4))
    for number, count in enumerate(_COMPLETED):
        candidates = _fitted_again(task, best_first(candidates)[:count])
        progress(0.4 + 0.2 * (number + 1) / len(_COMPLETED))
    candidates = best_first(candidates)
    for candidate in candidates[:_VARIED]:
        candidates += _variants(task, candidate)
    best = refine(task, best_first(candidates))
    root = float(np.sqrt(best.share))
    return Registration(task.rescaled(1 / root, sized(task.samples, best.share)), best)


def _careful(task: FitTask, wide: bool, progress: Progress) -> list[Candidate]:
    """Fits from the best frames if the samples show each of the shares.

    A wide search tries all its frames for some of the shares, and the best of these frames for the others.
    """
    found: list[Candidate] = []
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
        found += [replace(fit, share=share) for fit in task.predictor.fit_all(careful, measure=one_way_residual)]
        progress((number + 1) / len(order))
    return found


def _fitted_again(task: FitTask, candidates: Sequence[Candidate]) -> list[Candidate]:
    """New fits of the samples, completed by the last fits; how much of these was visible is the new share."""
    system, starts, shares = task.system, [], []
    for candidate in candidates:
        local, vectors = candidate.local(task.samples), candidate.vectors
        visible = visible_vertices(system, local.first(_COARSE), vectors)
        shares.append(float(np.clip(area_share(system, visible), _MIN_SHARE, 1.0)))
        whole = completed(system, local, vectors, candidate.share, task.predictor.rng, visible)
        growth = np.sqrt(shares[-1] / candidate.share)
        starts.append((replace(whole, points=whole.points * growth), RigidPose.identity()))
    found = []
    again = task.predictor.fit_all(starts, measure=_unmeasured)
    for candidate, fit, share in zip(candidates, again, shares, strict=True):
        last = candidate.pose
        pose = RigidPose(last.rotation, np.sqrt(share / candidate.share) * last.center) @ fit.pose
        placed = replace(fit, pose=pose, share=share)
        found.append(replace(placed, residual=one_way_residual(system, placed.local(task.samples), fit.vectors)))
    return found


def _unmeasured(*_: object) -> float:
    return 0.0  # the residual is that of other samples, once these are placed


def _variants(task: FitTask, candidate: Candidate) -> list[Candidate]:
    """Other interpretations of the completed samples."""
    local = candidate.local(task.samples)
    whole = completed(task.system, local, candidate.vectors, candidate.share, task.predictor.rng)
    near, pose, config = local.first(_COARSE), candidate.pose, task.config
    return [
        replace(each, residual=one_way_residual(task.system, local, each.vectors), share=candidate.share)
        for each in task.predictor.variants(whole, near, pose, config.variants, config.tilt)
    ]


def completed(
    system: NodeSystem,
    local: OrientedPoints,
    vectors: Float[Floats, "K 3"],
    share: float,
    rng: np.random.Generator,
    visible: Bool[Bools, " V"] | None = None,
) -> OrientedPoints:
    """Samples (core frame) of a ``share`` of the surface, with points of the fitted template where they show nothing.

    ``visible`` says where they do, if that is known: `visible_vertices` of as many samples as are asked.
    """
    surface = system.surface(vectors)
    if visible is None:
        visible = visible_vertices(system, local, vectors)
    faces = system.faces[~visible[system.faces].any(axis=1)]
    if not len(faces):
        return local
    missing = Shape(surface.points, faces)
    if not missing.area > 0:
        return local
    P = len(local.points)
    count = min(round(P * missing.area / share), _MAX_ADDED * P)
    added = sample_surface(missing, count, rng)
    local = local.facing(surface)
    order = rng.permutation(P + count)
    return replace(
        local,
        points=np.concatenate([local.points, added.points])[order],
        normals=np.concatenate([local.normals, added.normals])[order],
        weights=None if local.weights is None else np.append(local.weights, np.ones(count))[order],
    )
