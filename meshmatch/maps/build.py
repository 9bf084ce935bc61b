"""From two fits of one template to a map between the shapes.

Of a noisy cloud no point of the template is known for a point, but how likely each is. Noise moves points across the
surface and along it alike. Taking the closest point of the template undoes the first and keeps the second. Here a point
belongs to all of the template within reach, with Gaussian weights. The map goes by the expectation, and a point of the
target that may belong to many places counts less than one that is better known.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import csr_matrix, identity, vstack
from scipy.spatial import cKDTree

from meshmatch.arrays import Float, Floats, Ints
from meshmatch.errors import OptionError
from meshmatch.fitting.fit import Fit
from meshmatch.geometry.triangles import blend, triangle_areas, unit, vertex_areas, vertex_normals
from meshmatch.maps.footpoints import (
    RESTING_WEIGHT,
    Footpoints,
    Surface,
    closest_footpoints,
    in_core_frame,
    template_footpoints,
)
from meshmatch.maps.vertex_map import VERDICTS, VertexMap
from meshmatch.shapes.repair import Repaired
from meshmatch.shapes.shape import Shape

# Set by hand, looking at matches of scanned bodies. Distance (units of sqrt(area)) at which confidence is 1/e = 0.37:
_DISTANCE_SCALE = 0.03
# the same for how far agreement moved the two fits: where it moved them much, one shape alone says something else;
_AGREEMENT_SCALE = 0.065
# and by what all confidences are multiplied if a fit is poor, whose vertices do not know what is wrong with it.
_POOR = 0.5
# Of noisy clouds, also set by hand:
_ROUGH = 0.5  # from this `Shape.roughness` on, noise is larger than the template's triangles
_SAMPLES = 48  # of the template that share a point
_NOISE_RANGE = 0.006, 0.03  # units of sqrt(area)
_CHUNK = 8192  # points at a time


def build_map(
    source: Repaired,
    source_fit: Fit,
    target: Repaired,
    target_fit: Fit,
    workers: int = 1,
    before_agreement: tuple[Fit, Fit] | None = None,
) -> VertexMap:
    """Map every source vertex through the template to the target.

    Source vertex -> closest point of the template as fitted to the source -> the same point of the template as
    fitted to the target -> closest point of the target. Closest points must face the same way, and belong to the
    same place of the template where two sheets touch (see `template_footpoints`).

    Both shapes are as they were fitted; the map is between their *original* vertices. `before_agreement` are both fits
    before they agreed on how the template stretches: where that moved them much, confidence is low. `OptionError` if
    the two fits are of different templates.
    """
    if source_fit.template_hash != target_fit.template_hash:
        both = f"{source_fit.template_hash}, {target_fit.template_hash}"
        raise OptionError(f"the fits use different templates ({both})", "fit both shapes with the same model")
    foot, resting = template_footpoints(source.shape, source_fit, workers)
    on_source, distance = foot, foot.distance
    moved = foot.values(source_fit.faces, target_fit.points)
    if is_noisy(source.shape):
        on_source = closest_footpoints(source.shape, source_fit, workers)
        distance = on_source.distance
        points, places = in_core_frame(source.shape, source_fit)[0], [target_fit.points, source_fit.resting]
        (moved, resting), _ = expectation(points, source_fit, noise_level(distance), places)
    normals = vertex_normals(target_fit.points, target_fit.faces)
    facing = unit(on_source.values(source_fit.faces, normals))
    found = _points_of_target(target.shape, target_fit, moved, facing, resting, workers)
    del moved, facing, resting  # of a million vertices 25 MB each

    confidence = np.exp(-np.square(distance / _DISTANCE_SCALE) - np.square(found.distance / _DISTANCE_SCALE))
    if before_agreement is not None:
        stretched = np.zeros(len(foot.face))  # how far the fits moved at points of the template when they had to agree
        for fit, before in zip((source_fit, target_fit), before_agreement, strict=True):
            stretched += np.linalg.norm(foot.values(fit.faces, fit.points - before.points), axis=1)
        confidence *= np.exp(-np.square(stretched / _AGREEMENT_SCALE))
    verdict = max(source_fit.verdict, target_fit.verdict, key=VERDICTS.index)
    if verdict == "poor":
        confidence *= _POOR
    sides = (source, source_fit), (target, target_fit)
    reasons = tuple(f"{side.shape.name}: {reason}" for side, fit in sides for reason in fit.reasons)
    original = source.original_to_repaired
    index, face, weights = _in_original(target, found)
    return VertexMap.between(
        source.original,
        target.original,
        index=index[original],
        face=face[original],
        barycentric=weights[original],
        confidence=confidence.astype(np.float32)[original],
        verdict=verdict,
        reasons=reasons,
    )


def _points_of_target(
    target: Shape,
    fit: Fit,
    moved: Float[Floats, "N 3"],
    facing: Float[Floats, "N 3"],
    resting: Float[Floats, "N 3"],
    workers: int,
) -> Footpoints:
    """Points of the target at points of its fitted template, which face this way and belong to these resting points."""
    if is_noisy(target):
        noise = noise_level(closest_footpoints(target, fit, workers).distance)
        return most_likely_points(target, fit, noise, moved, resting, workers)
    places = template_footpoints(target, fit, workers)[1]
    points, normals = in_core_frame(target, fit)
    surface = Surface(points, target.faces, normals, places)
    if target.is_cloud:
        facing = np.zeros_like(facing)
    return surface.query(moved, facing, workers, resting)


def _in_original(target: Repaired, found: Footpoints) -> tuple[Ints, Ints, Floats]:
    """Vertices, faces and weights in the numbering of the file; face -1 where the file has no such face."""
    if target.shape.is_cloud:
        return target.kept_vertex[found.vertex], found.face, found.barycentric
    nearest_corner = target.shape.faces[found.face, found.barycentric.argmax(1)]
    return target.kept_vertex[nearest_corner], *target.original_face(found.face, found.barycentric)


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
    weights = np.tile([1.0, 0.0, 0.0], (len(moved), 1))
    distance = np.linalg.norm(moved - points[vertex], axis=1)
    return Footpoints(vertex, np.full(len(moved), -1, np.int64), weights, distance)
