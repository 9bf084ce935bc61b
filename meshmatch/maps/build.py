"""Build the map between two shapes from their fits of one template."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.errors import OptionError
from meshmatch.maps.parts import match_parts
from meshmatch.maps.places import PlacedFit, Places
from meshmatch.maps.vertex_map import VERDICTS, VertexMap
from meshmatch.shapes.shape import Shape

# Confidence is the probability that a vertex is within 5 cm of its true partner on a person. It falls to 1/e = 0.37 at these
# values (units of sqrt(area)): the distance of the vertices from their fits and places, and how far agreement moved the two
# places relative to each other (a large move means that the shape by itself was fitted differently).
_DISTANCE_SCALE, _AGREEMENT_SCALE = 0.0353, 0.0487
# Confidence at distance 0 of a wrong fit and of a right one; the factor from the odds that the fits are right to the odds
# that a vertex is. Maximum likelihood on 82 right and wrong fits, seeds 60 and 61 of docs/results.md, which measures
# calibration on other shapes.
_WRONG_FIT_CONFIDENCE, _RIGHT_FIT_CONFIDENCE, _ODDS_FACTOR, _MAX_TRUST = 0.072, 0.968, 0.091, 0.999
# A known pair is missed, or makes the map poor, if its image is farther off than this on the target (units of sqrt(area); 5
# and 14 cm on a person); the number of missed pairs to report.
_MISSED_DISTANCE, _POOR_DISTANCE, _MAX_REASONS = 0.036, 0.1, 3


def build_map(source: Places, target: Places, workers: int = 1) -> VertexMap:
    """Map every source vertex to the point of the target whose place on the rest template is nearest.

    If both shapes consist of separate parts, parts are matched as a whole (`meshmatch.maps.parts`). Confidence is the
    probability that the error is at most 5 cm on a person, or 3.6 % of sqrt(area). It is low where a vertex, or its
    match, lies far from the fitted template; where the two places are far apart, as on parts that one shape lacks; where
    agreement changed the map much; and everywhere if the trust in a fit is low. `OptionError` if the fits use different
    templates.
    """
    if source.template_hash != target.template_hash:
        both = f"{source.template_hash}, {target.template_hash}"
        raise OptionError(f"the fits use different templates ({both})", "fit both shapes with the same model")
    found = match_parts(source, target, target.nearest(source.resting, workers), workers)
    along = np.square(found.distance) - np.square(source.height - target.height[found.vertex])
    squared = np.square(source.distance) + np.square(target.distance[found.vertex]) + np.maximum(along, 0.0)
    doubt = squared / _DISTANCE_SCALE**2
    if source.moved is not None and target.moved is not None:
        doubt += np.square(source.moved - target.moved[found.vertex]).sum(1) / _AGREEMENT_SCALE**2
    confidence = _confidence(doubt, source.trust * target.trust)
    verdict = max(source.verdict, target.verdict, key=VERDICTS.index)
    sides = {"source": source, "target": target}
    return VertexMap(
        source.name,
        target.name,
        found.vertex,
        face=found.face,
        barycentric=found.barycentric,
        confidence=confidence.astype(np.float32),
        verdict=verdict,
        reasons=tuple(f"{side.name or what}: {reason}" for what, side in sides.items() for reason in side.reasons),
        source_vertices=len(source.resting),
        target_vertices=len(target.resting),
        source_hash=source.hash,
        target_hash=target.hash,
        target_faces=target.faces.astype(np.int64),
    )


def map_between_fits(source: PlacedFit, target: PlacedFit) -> VertexMap:
    """Map between two fits of a folder, as `build_map`, with the up axes of their files."""
    return replace(build_map(source.places, target.places), source_up=source.up, target_up=target.up)


def judge_by_pairs(
    found: VertexMap, target: Shape, pairs: tuple[Int[Ints, " N"], Int[Ints, " N"]], unit: float
) -> VertexMap:
    """Return the map with its verdict lowered, and reasons added, by how well it reproduces known pairs.

    ``pairs`` are vertices of source and target. A missed pair allows at most "fair", a pair missed by far "poor"; the worst
    pairs are named in the reasons. ``unit`` is sqrt(area) of the target, in the unit of its file.
    """
    distances = np.linalg.norm(found.points(target)[pairs[0]] - target.verts[pairs[1]], axis=1) / unit
    missed = [k for k in np.argsort(-distances, kind="stable") if distances[k] > _MISSED_DISTANCE]
    if not missed:
        return found
    reasons = tuple(
        f"the known pair {pairs[0][k]}, {pairs[1][k]} is missed by {100 * distances[k]:.0f} % of sqrt(area)"
        for k in missed[:_MAX_REASONS]
    )
    verdict = max(found.verdict, "poor" if distances.max() > _POOR_DISTANCE else "fair", key=VERDICTS.index)
    return replace(found, verdict=verdict, reasons=(*reasons, *found.reasons))


def _confidence(doubt: Float[Floats, " V"], trust: float) -> Float[Floats, " V"]:
    """Probability that vertices are near their true partners.

    ``doubt`` are squared distances in the scales above, ``trust`` is the product of the trust in both fits. The two combine
    as odds, so that far vertices of a doubtful fit get less than the product of both.
    """
    trust = min(trust, _MAX_TRUST)
    odds = _ODDS_FACTOR * trust / (1 - trust) / np.sqrt(np.expm1(np.clip(doubt, 1e-6, 50.0)))
    return np.exp(-doubt) * (
        _WRONG_FIT_CONFIDENCE + (_RIGHT_FIT_CONFIDENCE - _WRONG_FIT_CONFIDENCE) * odds / (1 + odds)
    )
