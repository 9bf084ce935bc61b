"""From two fits of one template to a map between the shapes."""

from __future__ import annotations

import numpy as np

from meshmatch.errors import OptionError
from meshmatch.fitting.fit import Fit
from meshmatch.geometry.triangles import unit, vertex_normals
from meshmatch.maps.noisy_clouds import expectation, is_noisy, most_likely_points, noise_level
from meshmatch.maps.surface import Footpoints, Surface
from meshmatch.maps.template_footpoints import (
    at_footpoints,
    closest_footpoints,
    in_core_frame,
    template_footpoints,
)
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.repair import Repaired
from meshmatch.shapes.shape import Shape

# Distance (units of sqrt(area)) at which confidence has fallen to about 0.37.
_FIT_SCALE = 0.03
# The same for how far agreement moved the two fits: what a shape alone said is not what both say.
_AGREED_SCALE = 0.05
# No vertex knows what is wrong with a poor fit: its whole map is believed half.
_POOR = 0.5
_ORDER = {"good": 0, "fair": 1, "poor": 2}


def build_map(
    source: Repaired,
    source_fit: Fit,
    target: Repaired,
    target_fit: Fit,
    workers: int = 1,
    before_agreement: tuple[Fit, Fit] | None = None,
) -> VertexMap:
    """Carry every source vertex through the template to the target.

    Source vertex -> closest point of the template as fitted to the source -> the same point of the template as
    fitted to the target -> closest point of the target. Closest points must face the same way, and belong to the
    same place of the template where two sheets touch (see `place`); of noisy clouds, see `scatter`.

    Parameters
    ----------
    source, target : Repaired
        The shapes as they were fitted; the map is of their *original* vertices.
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
    landed, confidence = carry(source.shape, source_fit, target.shape, target_fit, workers)
    if before_agreement is not None:
        confidence = confidence * agreement_confidence(
            source.shape, (source_fit, target_fit), before_agreement, workers
        )
    worst = max(source_fit, target_fit, key=lambda fit: _ORDER[fit.verdict])
    if worst.verdict == "poor":
        confidence = _POOR * confidence
    index = _nearest_corner(target.shape, landed)
    reasons = tuple(
        f"{part.shape.name}: {reason}"
        for part, fit in ((source, source_fit), (target, target_fit))
        for reason in fit.reasons
    )
    whole = source.original_to_repaired
    face, weights = _original_faces(target, landed)
    return VertexMap.between(
        source.original,
        target.original,
        index=target.kept_vertex[index][whole],
        face=face[whole],
        barycentric=weights[whole],
        confidence=confidence.astype(np.float32)[whole],
        verdict=worst.verdict,
        reasons=reasons,
    )


def carry(
    source: Shape, source_fit: Fit, target: Shape, target_fit: Fit, workers: int = 1
) -> tuple[Footpoints, np.ndarray]:
    """Where on the target every source vertex lands, and a confidence in 0..1."""
    if is_noisy(source):
        foot = closest_footpoints(source, source_fit, workers)
        points, noise = in_core_frame(source, source_fit)[0], noise_level(foot.distance)
        (moved, belongs), _ = expectation(points, source_fit, noise, [target_fit.points, source_fit.resting])
    else:
        foot, belongs = template_footpoints(source, source_fit, workers)
        moved = at_footpoints(foot, source_fit.faces, target_fit.points)
    if is_noisy(target):
        noise = noise_level(closest_footpoints(target, target_fit, workers).distance)
        landed = most_likely_points(target, target_fit, noise, moved, belongs, workers)
    else:
        landed = _closest(foot, source_fit, moved, belongs, target, target_fit, workers)
    confidence = np.exp(-np.square(foot.distance / _FIT_SCALE) - np.square(landed.distance / _FIT_SCALE))
    return landed, confidence


def agreement_confidence(
    source: Shape, fits: tuple[Fit, Fit], before_agreement: tuple[Fit, Fit], workers: int = 1
) -> np.ndarray:
    """How little (V,), in 0..1, the two fits moved under each source vertex when they had to agree."""
    foot = template_footpoints(source, fits[0], workers)[0]
    moved = np.zeros(len(foot.face))
    for fit, before in zip(fits, before_agreement, strict=True):
        moved += np.linalg.norm(at_footpoints(foot, fit.faces, fit.points - before.points), axis=1)
    return np.asarray(np.exp(-np.square(moved / _AGREED_SCALE)))


def _closest(
    foot: Footpoints,
    source_fit: Fit,
    moved: np.ndarray,
    belongs: np.ndarray,
    target: Shape,
    target_fit: Fit,
    workers: int,
) -> Footpoints:
    """Closest points of the target that face as the template does there and belong to the same place of it."""
    facing = unit(at_footpoints(foot, source_fit.faces, vertex_normals(target_fit.points, target_fit.faces)))
    points, normals = in_core_frame(target, target_fit)
    resting = template_footpoints(target, target_fit, workers)[1]
    if target.is_cloud:
        facing = np.zeros_like(facing)
    return Surface(points, target.faces, normals, resting).query(moved, facing, workers, belongs)


def _nearest_corner(target: Shape, landed: Footpoints) -> np.ndarray:
    """The vertex that stands for a point of a face: its heaviest corner."""
    if target.is_cloud:
        return landed.vertex
    return target.faces[landed.face, landed.barycentric.argmax(1)]


def _original_faces(target: Repaired, landed: Footpoints) -> tuple[np.ndarray, np.ndarray]:
    """Faces and weights in the numbering of the file; -1 where a face was not in the file as it is."""
    if target.shape.is_cloud:
        return landed.face, landed.barycentric
    return target.original_face(landed.face, landed.barycentric)
