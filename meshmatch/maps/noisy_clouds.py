"""Maps of noisy clouds: no point of the template is known for a point, but how likely each is.

Noise moves points across the surface and along it alike. Taking the closest point of the template undoes the first and
keeps the second. Here a point belongs to all of the template within reach, with Gaussian weights. The map goes by the
expectation, and a point of the target that may belong to many places counts less than one that is better known.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import csr_matrix, identity, vstack
from scipy.spatial import cKDTree

from meshmatch.arrays import Float, Floats
from meshmatch.fitting.fit import Fit
from meshmatch.geometry.triangles import blend, triangle_areas, vertex_areas
from meshmatch.maps.surface import RESTING_WEIGHT, Footpoints
from meshmatch.maps.template_footpoints import in_core_frame
from meshmatch.shapes.shape import Shape

# All set by hand on noisy scans of bodies.
_ROUGH = 0.5  # from this `Shape.roughness` on, noise is larger than the template's triangles
_SAMPLES = 48  # of the template that share a point
_NOISE_RANGE = 0.006, 0.03  # units of sqrt(area)
_CHUNK = 8192  # points at a time


def is_noisy(shape: Shape) -> bool:
    """Whether a shape is a cloud so noisy that this pays."""
    return shape.roughness >= _ROUGH


def noise_level(distance: Float[Floats, " N"]) -> float:
    """Standard deviation of noise, from distances between points and a surface: robust against outliers.

    The median of a Gaussian's absolute values is 0.6745 standard deviations.
    """
    return float(np.clip(np.median(distance) / 0.6745, *_NOISE_RANGE))


def expectation(
    points: Float[Floats, "N 3"], fit: Fit, noise: float, values: Sequence[Float[Floats, "T D"]]
) -> tuple[list[Float[Floats, "N D"]], Float[Floats, " N"]]:
    """Expected values over the places of the template where points may belong, and how uncertain the first are.

    `points` are in the fit's core frame; `noise` is the standard deviation along each axis, in units of sqrt(area);
    `values` belong to the vertices of the fitted template. Returns the mean of each, and the variance of the first,
    summed over D.
    """
    # vertices and face centers of the template, as a matrix over the vertices, and the area that each stands for
    F, T = len(fit.faces), len(fit.points)
    rows = np.repeat(np.arange(F), 3)
    centers = csr_matrix((np.full(3 * F, 1 / 3), (rows, fit.faces.reshape(-1))), (F, T))
    matrix = vstack([identity(T), centers]).tocsr()
    areas = vertex_areas(fit.points, fit.faces), triangle_areas(fit.points, fit.faces)  # half of the whole each
    prior = np.concatenate([0.5 * area for area in areas])
    tree = cKDTree(matrix @ fit.points)
    sampled = [matrix @ value for value in values]
    means = [np.empty((len(points), value.shape[1])) for value in values]
    variance = np.empty(len(points))
    for low in range(0, len(points), _CHUNK):
        part = slice(low, low + _CHUNK)
        distance, index = tree.query(points[part], min(_SAMPLES, tree.n))
        further = np.square(distance) - np.square(distance[:, :1])  # the closest keeps its weight at any distance
        weight = prior[index] * np.exp(-0.5 * further / noise**2)
        weight /= weight.sum(1, keepdims=True)
        for mean, value in zip(means, sampled, strict=True):
            mean[part] = blend(value[index], weight)
        deviation = np.square(sampled[0][index] - means[0][part][:, None]).sum(2)
        variance[part] = (weight * deviation).sum(1)
    return means, variance


def most_likely_points(
    target: Shape, fit: Fit, noise: float, moved: Float[Floats, "N 3"], resting: Float[Floats, "N 3"], workers: int = 1
) -> Footpoints:
    """The points of a cloud that most likely lie at ``moved`` on the fitted and at ``resting`` on the resting template.

    The expected squared distance is minimised: that between the means, plus the variance of the target's point.
    """
    points = in_core_frame(target, fit)[0]
    (mean, resting_mean), variance = expectation(points, fit, noise, [fit.points, fit.resting])
    tree = cKDTree(np.column_stack([mean, RESTING_WEIGHT * resting_mean, np.sqrt(variance)]))
    query = np.column_stack([moved, RESTING_WEIGHT * resting, np.zeros(len(moved))])
    vertex = tree.query(query, workers=workers)[1].astype(np.int64)
    weights = np.zeros((len(moved), 3))
    weights[:, 0] = 1.0
    distance = np.linalg.norm(moved - points[vertex], axis=1)
    return Footpoints(vertex, np.full(len(moved), -1, np.int64), weights, distance)
