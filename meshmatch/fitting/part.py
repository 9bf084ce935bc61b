"""Fits of a part: one side of a body, or what is left of it beyond a cut.

A part does not say how large the whole is, so its share of the surface is one more thing to try. What the scan shows
must lie on the template; what the template has besides is left to the network and to the prior on its gradient.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from meshmatch.fitting.network_fit import Candidate, lay_on, one_way_residual, variants
from meshmatch.fitting.nodes import NodeRefineConfig, refine_nodes
from meshmatch.fitting.orientation import Hypothesis
from meshmatch.fitting.readings import Judge, choose, lying
from meshmatch.fitting.scan import Scan
from meshmatch.fitting.system import NodeSystem

if TYPE_CHECKING:
    from meshmatch.models.trained import TrainedModel

SHARES = (1.0, 0.8, 0.62, 0.48, 0.36)
_SHARE_COST = (
    0.004  # residual that a share of 0 has to be better by than one of 1: rather the whole than a part
)
_LAID, _READ, _FINALISTS = 8, 2, 5
_COARSE = 2048
_Sized = tuple[float, Candidate]  # visible share, and a fit to the scan of that size


def fit_part(
    model: TrainedModel,
    system: NodeSystem,
    scan: Scan,
    orient: Callable[[Scan], Sequence[Hypothesis]],
    nodes: NodeRefineConfig,
    rng: np.random.Generator,
    *,
    variants_count: int,
    tilt: float,
    screening: int,
    refine: bool = True,
    tell: Callable[[float], None] = lambda share: None,
) -> tuple[float, Scan, Candidate]:
    """Lay the template on a scan that may show only a part of the shape.

    Parameters
    ----------
    scan : samples of what there is, area 1
    orient : core frames to try for a scan
    nodes, screening : node refinement, and how many of its steps the finalists get
    variants_count, tilt : tilted readings of the best candidates

    Returns
    -------
    scale : float
        By which lengths of the scan's frame are to be divided: 1 / sqrt(visible share).
    scan : Scan
        The scan in the new frame.
    candidate : Candidate
        The fit; its residual is from the scan to the template only.
    """
    careful: list[tuple[float, float, Candidate]] = []
    scans = {share: Scan(scan.points * np.sqrt(share), scan.normals) for share in SHARES}
    for number, (share, sized) in enumerate(scans.items()):
        coarse = Scan(sized.points[:_COARSE], sized.normals[:_COARSE])
        rough = [_laid(model, system, coarse, guess, rng, rounds=1, draws=1) for guess in orient(sized)]
        for guess in sorted(rough, key=lambda laid: laid.residual)[:_LAID]:
            laid = _laid(model, system, sized, guess, rng, rounds=2, draws=2)
            careful.append((cost(laid.residual, share), share, laid))
        tell(0.5 * (number + 1) / len(scans))
    careful.sort(key=lambda entry: entry[0])
    for _, share, best in list(careful[:_READ]):
        here = scans[share].turned(best.rotation, best.centre)
        near = Scan(here.points[:_COARSE], here.normals[:_COARSE])
        for reading in variants(model.network, system, here, near, best, rng, variants_count, tilt):
            judged = replace(reading, residual=one_way_residual(system, here, reading.vectors))
            careful.append((cost(judged.residual, share), share, judged))
    careful.sort(key=lambda entry: entry[0])
    tell(0.6)
    if not refine:
        _, share, best = careful[0]
        return 1 / np.sqrt(share), scans[share], best

    judge = Judge(system, scan)

    def fitted(reading: _Sized, whole: bool) -> _Sized:
        share, candidate = reading
        local = scans[share].turned(candidate.rotation, candidate.centre)
        config = nodes if whole else replace(nodes, steps=screening)
        vectors = refine_nodes(system, local, candidate.vectors, config, one_sided=True)
        return share, replace(candidate, vectors=vectors, residual=one_way_residual(system, local, vectors))

    def score(reading: _Sized) -> float:
        share, candidate = reading
        return cost(judge.score(scans[share].turned(candidate.rotation, candidate.centre), candidate), share)

    share, chosen = choose(
        [(share, candidate) for _, share, candidate in careful],
        _FINALISTS,
        fitted,
        score,
        lambda reading: lying(system, reading[1]) / np.sqrt(reading[0]),
        lambda done: tell(0.6 + 0.4 * done),
    )
    return float(1 / np.sqrt(share)), scans[share], chosen


def _laid(model, system, scan, guess, rng, **how) -> Candidate:
    rotation, centre = guess.rotation, guess.centre
    laid = lay_on(model.network, system, model.template.core, scan, rotation, centre, rng, stride=4, **how)
    local = scan.turned(laid.rotation, laid.centre)
    return replace(laid, residual=one_way_residual(system, local, laid.vectors))


def cost(residual: float, share: float) -> float:
    """A residual, and a little for what is not seen: the smaller the part, the easier it lies on a template."""
    return residual + _SHARE_COST * (1 - share)
