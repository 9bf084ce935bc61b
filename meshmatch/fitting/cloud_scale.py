"""Clouds: what a first fit says about their scale and their outliers.

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
from meshmatch.fitting.network_fit import Candidate
from meshmatch.fitting.system import NodeSystem
from meshmatch.geometry.frames import RigidPose
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.geometry.triangles import vertex_areas

# All of these were set by hand.
_ROUNDS = 3
_MAX_CHANGE = 1.3  # of the scale, in all: more is a wrong fit, not a wrong area
_FAR = 0.06  # from the template, units of sqrt(area)
_ISOLATED = 1.5  # reach of the nearest points, against the median of the cloud
_NEIGHBOURS = 8
_SETTLED = 0.005  # a relative change of the scale that ends the search

FitAgain = Callable[[OrientedPoints, RigidPose], Candidate]


def estimate_scale(
    system: NodeSystem, samples: OrientedPoints, candidate: Candidate, fit_again: FitAgain
) -> tuple[float, OrientedPoints, Candidate]:
    """Rescale a cloud by its fit and drop its outliers, fit again, a few times.

    Parameters
    ----------
    samples : of the cloud, area 1 by estimate
    candidate : the network's fit of them
    fit_again : fits samples from a pose

    Returns
    -------
    scale : float
        By which lengths of the old frame are to be divided.
    samples : OrientedPoints
        Those that are left, in the new frame.
    candidate : Candidate
        The fit of these.
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
