"""Fits of a shape that is taken for complete: orientation, prediction, scale of a cloud, refinement.

The area of a cloud is only estimated, too small where points are few and noisy, and outliers look like surface. The
network's own fit knows better: its template has the area of a body, and a point far from it, with few others around, is
not on its surface.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from meshmatch.arrays import Bool, Bools, Float, Floats
from meshmatch.fitting.initial_frames import frames_to_try
from meshmatch.fitting.network_fit import Candidate, best_first
from meshmatch.fitting.system import NodeSystem
from meshmatch.fitting.task import FitTask, Refine, Registration
from meshmatch.geometry.frames import RigidPose
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.geometry.triangles import vertex_areas
from meshmatch.progress import Progress

# All of these were set by hand.
_ROUNDS = 3
_MAX_CHANGE = 1.3  # of the scale, in all: more is a wrong fit, not a wrong area
_FAR = 0.06  # from the template, units of sqrt(area)
_ISOLATED = 1.5  # reach of the nearest points, against the median of the cloud
_NEIGHBOURS = 8
_SETTLED = 0.005  # a relative change of the scale that ends the search
_BEHIND = 1.1  # times the best residual: candidates further behind say nothing about a cloud's scale

FitAgain = Callable[[OrientedPoints, RigidPose], Candidate]


def fit_whole(task: FitTask, refine: Refine) -> Registration:
    """Fit the template to a shape that is taken for complete; ``refine`` turns the network's candidates into one fit."""
    orientation = task.progress.stage("orientation")
    candidates = _screened(task, orientation.between(0.0, 0.7))
    if task.shape.is_cloud:
        task, candidates = _rescaled(task, candidates)
    careful = task.predictor.fit_all([(task.samples, each.pose) for each in candidates[: task.config.careful]])
    orientation(1.0)
    return Registration(task, refine(task, best_first(careful)))


def _screened(task: FitTask, progress: Progress) -> list[Candidate]:
    """A coarse fit from every frame that is tried, best first."""
    progress(0.0)
    frames = frames_to_try(task.model, task.samples, task.config)
    # A cloud's residual says little before its core frame is found; a second round finds it.
    care = 2 if task.shape.is_cloud else 1
    coarse = task.coarse
    found = task.predictor.fit_all([(coarse, pose) for pose in frames], rounds=care, draws=care)
    progress(1.0)
    return best_first(found)


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


def estimate_scale(
    system: NodeSystem, samples: OrientedPoints, candidate: Candidate, fit_again: FitAgain
) -> tuple[float, OrientedPoints, Candidate]:
    """Rescale samples of a cloud (area 1 by estimate) by the network's fit, drop outliers, fit again, a few times.

    Returns the scale, by which lengths of the old frame are to be divided; the samples that are left, in the new frame;
    and their fit.
    """
    isolated = isolated_points(samples.points)
    resting = vertex_areas(system.verts, system.faces).sum()
    total = 1.0
    for _ in range(_ROUNDS):
        moved, pose = system.moved(candidate.vectors), candidate.pose
        step = np.sqrt(vertex_areas(moved, system.faces).sum() / resting)
        step = np.clip(step, 1 / _MAX_CHANGE / total, _MAX_CHANGE / total)
        far = cKDTree(pose.to_world(moved)).query(samples.points)[0] > _FAR
        keep = ~(far & isolated)
        total *= step
        samples, isolated = samples.rows(keep), isolated[keep]
        samples = replace(samples, points=samples.points / step)
        candidate = fit_again(samples, RigidPose(pose.rotation, pose.center / step))
        if keep.all() and abs(step - 1) < _SETTLED:
            break
    return float(total), samples, candidate


def isolated_points(points: Float[Floats, "P 3"]) -> Bool[Bools, " P"]:
    """Whether the nearest few points lie further away than is usual on the cloud.

    Samples of a small cloud repeat its points; copies of a point do not count as its neighbours.
    """
    own, which = np.unique(points, axis=0, return_inverse=True)
    reach = cKDTree(own).query(own, min(_NEIGHBOURS + 1, len(own)))[0][:, -1]
    return np.asarray((reach > _ISOLATED * np.median(reach))[which.reshape(-1)])
