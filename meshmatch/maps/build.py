"""From what two fits of one template know to a map between their shapes."""

from __future__ import annotations

import numpy as np

from meshmatch.errors import OptionError
from meshmatch.maps.parts import kept_together
from meshmatch.maps.places import Places
from meshmatch.maps.vertex_map import VERDICTS, VertexMap

# The most likely values on the right and wrong fits that `meshmatch.fitting.verdict` learned from, where confidence is the
# probability that a vertex is within 5 cm of its true partner on a person. Distance (units of sqrt(area)) at which it is
# 1/e = 0.37:
_DISTANCE_SCALE = 0.042
# the same for how far agreement moved the two fits: where it moved them much, one shape alone says something else;
_AGREEMENT_SCALE = 0.081
# and of all vertices of a wrong fit, the share that is near nevertheless.
_BY_CHANCE = 0.07


def build_map(source: Places, target: Places, workers: int = 1) -> VertexMap:
    """Map every source vertex through the resting template to the point of the target that belongs nearest to its place.

    Where both shapes are put together from separate parts, parts go to their counterparts (`meshmatch.maps.parts`).
    Confidence is the probability that the error is at most 5 cm on a person, or 3.6 % of sqrt(area). It is low where a
    vertex, or the one that it is matched to, lies far from its fitted template; where the places are far apart, as on what
    one shape lacks; where fits moved much to agree; and everywhere if a fit is not to be trusted. `OptionError` if the
    places are on different templates.
    """
    if source.template_hash != target.template_hash:
        both = f"{source.template_hash}, {target.template_hash}"
        raise OptionError(f"the fits use different templates ({both})", "fit both shapes with the same model")
    found = kept_together(source, target, target.nearest(source.resting, workers), workers)
    along = np.square(found.distance) - np.square(source.height - target.height[found.vertex])
    apart = np.square(source.distance) + np.square(target.distance[found.vertex]) + np.maximum(along, 0.0)
    confidence = np.exp(-apart / _DISTANCE_SCALE**2)
    if source.shift is not None and target.shift is not None:
        stretched = source.shift + target.shift[found.vertex]
        confidence *= np.exp(-np.square(stretched / _AGREEMENT_SCALE))
    verdict = max(source.verdict, target.verdict, key=VERDICTS.index)
    confidence *= _BY_CHANCE + (1 - _BY_CHANCE) * source.trust * target.trust
    return VertexMap(
        source.name,
        target.name,
        found.vertex,
        found.face,
        found.barycentric,
        confidence.astype(np.float32),
        verdict,
        tuple(f"{side.name}: {reason}" for side in (source, target) for reason in side.reasons),
        len(source.resting),
        len(target.resting),
        source.hash,
        target.hash,
        target.faces.astype(np.int64),
    )
