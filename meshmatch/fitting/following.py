"""The frames of a sequence: each fit starts where the last one ended."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import get_args

from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fitter import Fitter, fit_of_registration
from meshmatch.fitting.judge.reasons import Verdict
from meshmatch.fitting.search.predictor import Candidate, two_way_residual
from meshmatch.fitting.search.refinement import REFINEMENTS
from meshmatch.fitting.search.task import FitTask, Registration
from meshmatch.geometry.frames import Frame, RigidPose
from meshmatch.progress import Progress
from meshmatch.shapes.shape import Shape

# Set by hand: a frame whose residual is so many times the last one's is lost,
_LOST = 1.2
# and so is one that is so many times as large, or as small;
_RESIZED = 1.3
# from the last frame's pose so few interpretations are sought.
_VARIANTS = 2


def follow(fitter: Fitter, shape: Shape, last: Fit) -> Fit:
    """Fit a repaired shape from where the last frame's fit ended, and from nothing where that is lost.

    Both are in the coordinates of one sequence. The orientation is not searched, so a frame costs less than a shape. The
    network is asked from the last frame's pose; what it says is refined rather than the last fit itself, for what slid in
    one frame would slide on in the next. The last fit is where a frame begins that is lost otherwise.
    """
    if last.partial or last.verdict == "poor" or fitter.config.partial == "yes":
        return fitter.fit(shape)
    began, progress = time.monotonic(), Progress(fitter.progress, shape.name)
    task = FitTask.of(fitter.model, fitter.config, shape, None, progress, last.frame.mirrored)
    ratio = last.frame.scale / task.frame.scale  # the size is known, and no longer estimated
    if not 1 / _RESIZED < ratio < _RESIZED:
        return fitter.fit(shape)
    task = task.rescaled(ratio)
    task = replace(task, config=replace(task.config, variants=_VARIANTS))
    pose = _pose_in(task.frame, last.frame)

    def asked() -> list[Candidate]:
        return task.predictor.fit_all([(task.samples, pose)])

    def held() -> list[Candidate]:
        local = task.samples.to_local(pose)
        return [Candidate(pose, last.vectors, two_way_residual(task.system, local, last.vectors))]

    tried: list[Fit] = []
    for candidates in (asked, held):
        best = REFINEMENTS[task.config.refine].whole(task, candidates())
        tried.append(fit_of_registration(Registration(task.on_visible_samples, best), False, began))
        if tried[-1].verdict != "poor" and tried[-1].residual <= _LOST * last.residual:
            return tried[-1]
    tried.append(fitter.fit(shape))
    return min(tried, key=lambda fit: (get_args(Verdict).index(fit.verdict), fit.residual))


def _pose_in(samples: Frame, core: Frame) -> RigidPose:
    """The pose of a core frame in the frame of samples; both are frames of one file, and of one scale."""
    rotation = samples.rotation @ core.rotation.T
    offset = (samples.center - core.center) @ core.rotation.T / core.scale
    return RigidPose(rotation, -offset @ rotation.T)
