"""Clouds: what a first fit says about their scale and their stray points.

The area of a cloud is only estimated, too small where points are few and noisy, and stray points look like
surface. The network's own fit knows better: its template has the area of a body, and a point far from it, with few
others around, is none of its surface.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import numpy as np
from scipy.spatial import cKDTree

from meshmatch.fitting.network_fit import Candidate
from meshmatch.fitting.scan import Scan
from meshmatch.fitting.system import NodeSystem
from meshmatch.geometry.triangles import vertex_areas
from meshmatch.shapes.cloud import outlier_points
from meshmatch.shapes.shape import Shape

_ROUNDS = 3
_LARGEST_CHANGE = 1.3  # of the scale, in all: more is a wrong fit, not a wrong area
_FAR = 0.06  # from the template, units of sqrt(area)
_LONELY = 1.5  # reach of the nearest points, against what is usual on the cloud
_NEIGHBOURS = 8
_APART = 1.3  # reach of a stray's nearest points, against that of these points and against the usual

Lay = Callable[[Scan, Candidate], Candidate]


@lru_cache(maxsize=4)
def without_outliers(shape: Shape) -> Shape:
    """A cloud without the points that lie apart from their neighbours; any other shape as it is.

    A stray among neighbours bends their normals and turns the signs of whole regions, and it counts as surface.
    """
    stray = outlier_points(shape.verts, _APART) if shape.is_cloud else np.zeros(0, bool)
    return Shape(shape.verts[~stray], shape.faces, shape.name) if stray.any() else shape


def settle(system: NodeSystem, scan: Scan, candidate: Candidate, lay: Lay) -> tuple[float, Scan, Candidate]:
    """Rescale a cloud by its fit and drop its stray points, fit again, a few times.

    Parameters
    ----------
    scan : samples of the cloud, area 1 by estimate
    candidate : the network's fit of it
    lay : fits again, from the orientation of a candidate

    Returns
    -------
    scale : float
        By which lengths of the old frame are to be divided.
    scan : Scan
        The samples that are left, in the new frame.
    candidate : Candidate
        The fit of these.
    """
    lonely = lonely_points(scan.points)
    total = 1.0
    for _ in range(_ROUNDS):
        moved = system.moved(candidate.vectors)
        resting = vertex_areas(system.verts, system.faces).sum()
        step = np.sqrt(vertex_areas(moved, system.faces).sum() / resting)
        step = np.clip(step, 1 / _LARGEST_CHANGE / total, _LARGEST_CHANGE / total)
        far = cKDTree(moved @ candidate.rotation.T + candidate.center).query(scan.points)[0] > _FAR
        keep = ~(far & lonely)
        total *= step
        scan, lonely = (
            replace(scan, points=scan.points[keep] / step, normals=scan.normals[keep]),
            lonely[keep],
        )
        start = Candidate(candidate.rotation, candidate.center / step, candidate.vectors, np.inf)
        candidate = lay(scan, start)
        if keep.all() and abs(step - 1) < 0.005:
            break
    return float(total), scan, candidate


def lonely_points(points: np.ndarray) -> np.ndarray:
    """(P,) True where the nearest few points lie further away than is usual on the cloud.

    Samples of a small cloud repeat its points; a point is no company to itself.
    """
    own, which = np.unique(points, axis=0, return_inverse=True)
    reach = cKDTree(own).query(own, min(_NEIGHBOURS + 1, len(own)))[0][:, -1]
    return np.asarray((reach > _LONELY * np.median(reach))[which.reshape(-1)])
