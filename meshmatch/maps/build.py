"""From two fits of one template to a map between the shapes."""

from __future__ import annotations

import numpy as np

from meshmatch.arrays import Float, Floats, Ints
from meshmatch.errors import OptionError
from meshmatch.fitting.fit import Fit
from meshmatch.geometry.triangles import unit, vertex_normals
from meshmatch.maps.noisy_clouds import expectation, is_noisy, most_likely_points, noise_level
from meshmatch.maps.surface import Footpoints, Surface
from meshmatch.maps.template_footpoints import closest_footpoints, in_core_frame, template_footpoints
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.repair import Repaired
from meshmatch.shapes.shape import Shape

# Set by hand, looking at matches of scanned bodies. Distance (units of sqrt(area)) at which confidence is 1/e = 0.37:
_DISTANCE_SCALE = 0.03
# the same for how far agreement moved the two fits: where it moved them much, one shape alone says something else;
_AGREEMENT_SCALE = 0.05
# and by what all confidences are multiplied if a fit is poor, whose vertices do not know what is wrong with it.
_POOR = 0.5
_VERDICTS = ("good", "fair", "poor")


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
    same place of the template where two sheets touch (see `template_footpoints`); for noisy clouds see
    `meshmatch.maps.noisy_clouds`.

    Parameters
    ----------
    source, target : Repaired
        The shapes as they were fitted; the map is between their *original* vertices.
    workers : int
        Threads.
    before_agreement : (Fit, Fit), optional
        Both fits before they agreed on how the template stretches: where that moved them much, confidence is low.

    Raises
    ------
    OptionError
        If the two fits are of different templates.
    """
    if source_fit.template_hash != target_fit.template_hash:
        raise OptionError(
            f"the fits use different templates ({source_fit.template_hash}, {target_fit.template_hash})",
            "fit both shapes with the same model",
        )
    foot, resting = template_footpoints(source.shape, source_fit, workers)
    on_source, distance = foot, foot.distance
    moved = foot.values(source_fit.faces, target_fit.points)
    if is_noisy(source.shape):
        on_source = closest_footpoints(source.shape, source_fit, workers)
        distance = on_source.distance
        points = in_core_frame(source.shape, source_fit)[0]
        (moved, resting), _ = expectation(
            points, source_fit, noise_level(distance), [target_fit.points, source_fit.resting]
        )
    normals = vertex_normals(target_fit.points, target_fit.faces)
    facing = unit(on_source.values(source_fit.faces, normals))
    found = _points_of_target(target.shape, target_fit, moved, facing, resting, workers)

    confidence = np.exp(-np.square(distance / _DISTANCE_SCALE) - np.square(found.distance / _DISTANCE_SCALE))
    if before_agreement is not None:
        confidence *= agreement_confidence(foot, (source_fit, target_fit), before_agreement)
    verdict = max(source_fit.verdict, target_fit.verdict, key=_VERDICTS.index)
    if verdict == "poor":
        confidence *= _POOR
    reasons = tuple(
        f"{side.shape.name}: {reason}"
        for side, fit in ((source, source_fit), (target, target_fit))
        for reason in fit.reasons
    )
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


def agreement_confidence(
    foot: Footpoints, fits: tuple[Fit, Fit], before_agreement: tuple[Fit, Fit]
) -> Float[Floats, " V"]:
    """How little, in 0..1, the two fits moved at points of the template when they had to agree: exp(-(d / scale)^2)."""
    moved = np.zeros(len(foot.face))
    for fit, before in zip(fits, before_agreement, strict=True):
        moved += np.linalg.norm(foot.values(fit.faces, fit.points - before.points), axis=1)
    return np.asarray(np.exp(-np.square(moved / _AGREEMENT_SCALE)))


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
    points, normals = in_core_frame(target, fit)
    surface = Surface(points, target.faces, normals, template_footpoints(target, fit, workers)[1])
    if target.is_cloud:
        facing = np.zeros_like(facing)
    return surface.query(moved, facing, workers, resting)


def _in_original(target: Repaired, found: Footpoints) -> tuple[Ints, Ints, Floats]:
    """Vertices, faces and weights in the numbering of the file; face -1 where the file has no such face."""
    if target.shape.is_cloud:
        return target.kept_vertex[found.vertex], found.face, found.barycentric
    nearest_corner = target.shape.faces[found.face, found.barycentric.argmax(1)]
    return target.kept_vertex[nearest_corner], *target.original_face(found.face, found.barycentric)
