"""Points of a noisy cloud: what is known of them is not a place of the template, but how likely each place is.

Noise carries points across and along alike. The closest point of the template undoes the first and believes the second.
Here a point belongs to all of the template within reach, weighed by a Gaussian; what is carried over is the mean, and a
point of the target that may belong to many places stands back behind one that is known better.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from meshmatch.fitting.fit import Fit
from meshmatch.geometry.triangles import interpolate, triangle_areas, vertex_areas
from meshmatch.maps.surface import RESTING_WEIGHT, Footpoints
from meshmatch.maps.template_footpoints import in_core_frame
from meshmatch.shapes.shape import Shape

_ROUGH = 0.5  # from this `Shape.roughness` on, noise is larger than what triangles of a template span
_REACH = 48  # samples of the template that share a point
_NARROW, _WIDE = 0.006, 0.03  # bounds of the noise, units of sqrt(area)
_CHUNK = 8192  # points at a time


def is_noisy(shape: Shape) -> bool:
    """Whether a shape's points are worth asking this way."""
    return shape.roughness >= _ROUGH


def noise_level(distance: np.ndarray) -> float:
    """Standard deviation of noise, from distances (N,) between points and a surface: robust against strays."""
    return float(np.clip(np.median(distance) / 0.6745, _NARROW, _WIDE))


def expectation(
    points: np.ndarray, fit: Fit, noise: float, values: Sequence[np.ndarray]
) -> tuple[list[np.ndarray], np.ndarray]:
    """Means of values at the template over where points may belong, and how far the first of these scatter.

    Parameters
    ----------
    points : (N, 3) in the fit's core frame
    noise : standard deviation along each axis, units of sqrt(area)
    values : each (T, D), at the vertices of the fitted template

    Returns
    -------
    means : list of (N, D)
    variance : (N,) of the first values, summed over D
    """
    at, weight = _samples(fit)
    tree, priors = cKDTree(at @ fit.points), weight
    every = [at @ value for value in values]
    means = [np.empty((len(points), value.shape[1])) for value in values]
    variance = np.empty(len(points))
    for low in range(0, len(points), _CHUNK):
        part = slice(low, low + _CHUNK)
        apart, index = tree.query(points[part], min(_REACH, tree.n))
        closer = np.square(apart) - np.square(apart[:, :1])  # the closest always has its share
        share = priors[index] * np.exp(-0.5 * closer / noise**2)
        share /= share.sum(1, keepdims=True)
        for mean, value in zip(means, every, strict=True):
            mean[part] = interpolate(value, index, share)
        around = np.square(every[0][index] - means[0][part][:, None]).sum(2)
        variance[part] = (share * around).sum(1)
    return means, variance


def most_likely_points(
    target: Shape, fit: Fit, noise: float, moved: np.ndarray, belongs: np.ndarray, workers: int = 1
) -> Footpoints:
    """The points of a cloud that most likely lie where ``moved`` (N, 3) says, resting at ``belongs`` (N, 3).

    Least is the expected squared distance: between the means, and what the target's point scatters besides.
    """
    there = in_core_frame(target, fit)[0]
    (mean, resting), variance = expectation(there, fit, noise, [fit.points, fit.resting])
    tree = cKDTree(np.column_stack([mean, RESTING_WEIGHT * resting, np.sqrt(variance)]))
    sought = np.column_stack([moved, RESTING_WEIGHT * belongs, np.zeros(len(moved))])
    vertex = tree.query(sought, workers=workers)[1].astype(np.int64)
    weights = np.zeros((len(moved), 3))
    weights[:, 0] = 1.0
    distance = np.linalg.norm(moved - there[vertex], axis=1)
    return Footpoints(vertex, np.full(len(moved), -1, np.int64), weights, distance)


def _samples(fit: Fit):
    """Vertices and face centers as a matrix (S, T) over the vertices, and how much of the surface each stands for."""
    from scipy.sparse import csr_matrix, identity, vstack

    F, T = len(fit.faces), len(fit.points)
    rows = np.repeat(np.arange(F), 3)
    centers = csr_matrix((np.full(3 * F, 1 / 3), (rows, fit.faces.reshape(-1))), (F, T))
    area = vertex_areas(fit.points, fit.faces)  # a third of each face to each of its corners
    # Half of a face's area is its center's.
    return vstack([identity(T), centers]).tocsr(), np.concatenate(
        [0.5 * area, 0.5 * triangle_areas(fit.points, fit.faces)]
    )
