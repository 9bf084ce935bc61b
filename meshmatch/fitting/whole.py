"""Fits of a shape that is taken for complete: orientation, prediction, scale of a cloud, refinement."""

from __future__ import annotations

from collections.abc import Callable

from meshmatch.fitting.cloud_scale import estimate_scale
from meshmatch.fitting.initial_frames import frames_to_try
from meshmatch.fitting.network_fit import Candidate
from meshmatch.fitting.task import FitTask, Registration
from meshmatch.geometry.frames import RigidPose
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.progress import Progress

_BEHIND = 1.1  # times the best residual: candidates further behind say nothing about a cloud's scale. Set by hand.

# Of candidates, best first, to the fit.
RefineWhole = Callable[[FitTask, list[Candidate]], Candidate]


def fit_whole(task: FitTask, refine: RefineWhole) -> Registration:
    """Fit the template to a shape that is taken for complete; ``refine`` turns the network's candidates into one fit.

    Raises
    ------
    OptionError
        Axes of the user that are invalid, or up and front along the same axis.
    """
    orientation = task.progress.stage("orientation")
    candidates = _screened(task, orientation.between(0.0, 0.7))
    if task.shape.is_cloud:
        task, candidates = _rescaled(task, candidates)
    careful = task.predictor.fit_all([(task.samples, each.pose) for each in candidates[: task.config.careful]])
    orientation(1.0)
    return Registration(task, refine(task, _best_first(careful)))


def _screened(task: FitTask, progress: Progress) -> list[Candidate]:
    """A coarse fit from every frame that is tried, best first."""
    progress(0.0)
    frames = frames_to_try(task.model, task.samples, task.config)
    # A cloud's residual says little before its core frame is found; a second round finds it.
    care = 2 if task.shape.is_cloud else 1
    coarse = task.coarse
    found = task.predictor.fit_all([(coarse, pose) for pose in frames], rounds=care, draws=care)
    progress(1.0)
    return _best_first(found)


def _rescaled(task: FitTask, candidates: list[Candidate]) -> tuple[FitTask, list[Candidate]]:
    """The task and the best candidates of a cloud in the scale, and without the outliers, that the best fit tells."""

    def fit_again(samples: OrientedPoints, pose: RigidPose) -> Candidate:
        return task.predictor.fit(samples, pose, draws=1)

    near = _BEHIND * candidates[0].residual
    best = [each for each in candidates[: task.config.careful] if each.residual <= near]
    estimates = [estimate_scale(task.system, task.samples, candidate, fit_again) for candidate in best]
    scale, samples, first = min(estimates, key=lambda estimate: estimate[2].residual)
    others = [
        Candidate(RigidPose(each.pose.rotation, each.pose.center / scale), each.vectors, each.residual) for each in best
    ]
    return task.rescaled(scale, samples), [first, *others]


def _best_first(candidates: list[Candidate]) -> list[Candidate]:
    return sorted(candidates, key=lambda candidate: candidate.residual)
