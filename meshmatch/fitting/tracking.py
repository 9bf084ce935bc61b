"""Tracking: fits of the frames of a sequence, each starting from the last one."""

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

# Set by hand.
_MAX_RESIDUAL_RATIO = 1.2  # tracking is lost if the residual grows by more than this factor
_MAX_SCALE_RATIO = 1.3  # or if the size changes by more than this factor
_VARIANTS = 2  # candidates from tilted frames, about the last frame's pose


def track(fitter: Fitter, shape: Shape, last: Fit) -> Fit:
    """Fit a repaired shape starting from the last frame's fit, or from scratch if tracking is lost.

    Both shapes are in the coordinates of one sequence. The orientation is not searched, so a frame is faster than a single
    shape. The network predicts from the last frame's pose, and its prediction is refined rather than the last fit, because
    sliding along the surface would accumulate. The last fit itself is tried if the prediction fails.
    """
    if last.partial or last.verdict == "poor" or fitter.config.partial == "yes":
        return fitter.fit(shape)
    began, progress = time.monotonic(), Progress(fitter.progress, shape.name)
    task = FitTask.of(fitter.model, fitter.config, shape, None, progress, last.frame.mirrored)
    ratio = last.frame.scale / task.frame.scale  # the size is that of the last frame
    if not 1 / _MAX_SCALE_RATIO < ratio < _MAX_SCALE_RATIO:
        return fitter.fit(shape)
    task = task.rescaled(ratio)
    task = replace(task, config=replace(task.config, variants=_VARIANTS))
    pose = _pose_in(task.frame, last.frame)

    def predicted() -> list[Candidate]:
        return task.predictor.fit_all([(task.samples, pose)])

    def from_last_fit() -> list[Candidate]:
        local = task.samples.to_local(pose)
        return [Candidate(pose, last.vectors, two_way_residual(task.system, local, last.vectors))]

    tried: list[Fit] = []
    for candidates in (predicted, from_last_fit):
        best = REFINEMENTS[task.config.refine].whole(task, candidates())
        tried.append(fit_of_registration(Registration(task.on_visible_samples, best), False, began))
        if tried[-1].verdict != "poor" and tried[-1].residual <= _MAX_RESIDUAL_RATIO * last.residual:
            return tried[-1]
    tried.append(fitter.fit(shape))
    return min(tried, key=lambda fit: (get_args(Verdict).index(fit.verdict), fit.residual))


def _pose_in(samples: Frame, core: Frame) -> RigidPose:
    """The pose of a core frame in the frame of samples; both are frames of one file with the same scale."""
    rotation = samples.rotation @ core.rotation.T
    offset = (samples.center - core.center) @ core.rotation.T / core.scale
    return RigidPose(rotation, -offset @ rotation.T)
