"""From what two fits of one template know to a map between their shapes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.errors import OptionError
from meshmatch.maps.parts import kept_together
from meshmatch.maps.places import PlacedFit, Places
from meshmatch.maps.vertex_map import VERDICTS, VertexMap
from meshmatch.shapes.shape import Shape

# Where confidence is the probability that a vertex is within 5 cm of its true partner on a person. Distances, and how far
# agreement moved the two places against each other (where it moved them much, one shape alone says something else), at
# which it is 1/e = 0.37 (units of sqrt(area)):
_DISTANCE_SCALE, _AGREEMENT_SCALE = 0.0353, 0.0487
# the share that is near without distance, of wrong fits and of right ones; and what turns odds of being right to odds of it:
# the most likely values on 82 right and wrong fits, seeds 60 and 61 of docs/results.md, which measures it on others
_BY_CHANCE, _MOST, _ODDS, _MAX_TRUST = 0.072, 0.968, 0.091, 0.999
# Known pairs further apart than this on the target (units of sqrt(area); 5 and 14 cm on a person) are missed, or tell that
# the map is wrong; so many are told.
_MISSED, _LOST, _TOLD = 0.036, 0.1, 3


def build_map(source: Places, target: Places, workers: int = 1) -> VertexMap:
    """Map every source vertex through the resting template to the point of the target that belongs nearest to its place.

    Where both shapes are put together from separate parts, parts go to their counterparts (`meshmatch.maps.parts`).
    Confidence is the probability that the error is at most 5 cm on a person, or 3.6 % of sqrt(area). It is low where a
    vertex, or the one that it is matched to, lies far from its fitted template; where the places are far apart, as on what
    one shape lacks; where agreement changed the map much; and everywhere if a fit is not to be trusted. `OptionError` if the
    places are on different templates.
    """
    if source.template_hash != target.template_hash:
        both = f"{source.template_hash}, {target.template_hash}"
        raise OptionError(f"the fits use different templates ({both})", "fit both shapes with the same model")
    found = kept_together(source, target, target.nearest(source.resting, workers), workers)
    along = np.square(found.distance) - np.square(source.height - target.height[found.vertex])
    apart = np.square(source.distance) + np.square(target.distance[found.vertex]) + np.maximum(along, 0.0)
    doubt = apart / _DISTANCE_SCALE**2
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


def map_of_placed(source: PlacedFit, target: PlacedFit) -> VertexMap:
    """The same of two fits of a folder, which also know which axis of their files is up."""
    return replace(build_map(source.places, target.places), source_up=source.up, target_up=target.up)


def judged_by_pairs(
    found: VertexMap, target: Shape, pairs: tuple[Int[Ints, " N"], Int[Ints, " N"]], unit: float
) -> VertexMap:
    """A map with what it makes of known pairs, vertices of source and target: a reason for each that it misses, the
    furthest first, and a verdict no better than these allow. ``unit`` is sqrt(area) of the target, in the unit of its file.
    """
    off = np.linalg.norm(found.points(target)[pairs[0]] - target.verts[pairs[1]], axis=1) / unit
    missed = [k for k in np.argsort(-off, kind="stable") if off[k] > _MISSED]
    if not missed:
        return found
    reasons = tuple(
        f"the known pair {pairs[0][k]}, {pairs[1][k]} is missed by {100 * off[k]:.0f} % of sqrt(area)"
        for k in missed[:_TOLD]
    )
    verdict = max(found.verdict, "poor" if off.max() > _LOST else "fair", key=VERDICTS.index)
    return replace(found, verdict=verdict, reasons=(*reasons, *found.reasons))


def _confidence(doubt: Float[Floats, " V"], trust: float) -> Float[Floats, " V"]:
    """Probability that vertices are near, of squared distances in the units above, and of the trust in both fits.

    Far vertices of a doubtful fit are doubted more than either says.
    """
    trust = min(trust, _MAX_TRUST)
    odds = _ODDS * trust / (1 - trust) / np.sqrt(np.expm1(np.clip(doubt, 1e-6, 50.0)))
    return np.exp(-doubt) * (_BY_CHANCE + (_MOST - _BY_CHANCE) * odds / (1 + odds))
