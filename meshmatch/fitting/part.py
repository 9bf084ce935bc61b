"""Fits of a part: one side of a body, or what is left of it beyond a cut.

A part does not say how large the whole is, so its share of the surface is one more thing to try. What the scan shows
must lie on the template; what the template has besides is left to the network and to the prior on its gradient.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from meshmatch.fitting.candidates import CandidateScorer, choose, lying
from meshmatch.fitting.completion import completed, seen, seen_area
from meshmatch.fitting.mirror import mirror_of
from meshmatch.fitting.network_fit import Candidate, lay_on, one_way_residual, variants
from meshmatch.fitting.nodes import NodeRefineConfig, refine_nodes
from meshmatch.fitting.orientation import Hypothesis
from meshmatch.fitting.scan import Scan
from meshmatch.fitting.system import NodeSystem

if TYPE_CHECKING:
    from meshmatch.models.trained import TrainedModel

SHARES = (1.0, 0.8, 0.62, 0.48, 0.36)
_SHARE_COST = (
    0.004  # residual that a share of 0 has to be better by than one of 1: rather the whole than a part
)
# Readings that are completed and asked about again: so many once, of these so many twice, and so many three times.
_SOUGHT = (14, 7, 4)
_READ, _FINALISTS = 2, 5
_COARSE = 2048
_LEAST = 0.2  # share of a whole that a scan is taken to show at least


@dataclass(frozen=True, eq=False)
class PartReading:
    """One way to see a scan as a part: the visible share of the surface, and a fit to the scan of that size."""

    share: float
    fit: Candidate

    def local(self, scan: Scan) -> Scan:
        """A scan of area 1 where this reading lives: as large as its share, in the core frame."""
        sized = replace(scan, points=scan.points * np.sqrt(self.share))
        return sized.turned(self.fit.rotation, self.fit.center)

    @property
    def cost(self) -> float:
        return cost(self.fit.residual, self.share)


def fit_part(
    model: TrainedModel,
    system: NodeSystem,
    scan: Scan,
    orient: Callable[[Scan], Sequence[Hypothesis]],
    nodes: NodeRefineConfig,
    rng: np.random.Generator,
    *,
    laid: int,
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
    laid : how many frames of each share are laid on with care
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
    network, core, mirror = model.network, model.template.core, mirror_of(model)
    readings: list[PartReading] = []
    for number, share in enumerate(SHARES):
        sized = replace(scan, points=scan.points * np.sqrt(share))
        coarse = sized.first(_COARSE)
        rough = [_laid(model, system, coarse, guess, rng, rounds=1, draws=1) for guess in orient(sized)]
        for guess in sorted(rough, key=lambda laid: laid.residual)[:laid]:
            readings.append(PartReading(share, _laid(model, system, sized, guess, rng, rounds=2, draws=2)))
        tell(0.4 * (number + 1) / len(SHARES))
    for number, count in enumerate(_SOUGHT):
        best = sorted(readings, key=lambda reading: reading.cost)[:count]
        readings = [_asked_again(network, system, core, scan, reading, rng) for reading in best]
        tell(0.4 + 0.2 * (number + 1) / len(_SOUGHT))
    readings.sort(key=lambda reading: reading.cost)
    for reading in readings[:_READ]:
        local = reading.local(scan)
        whole = completed(system, local, reading.fit.vectors, reading.share, rng)
        near = local.first(_COARSE)
        for other in variants(network, system, whole, near, reading.fit, rng, variants_count, tilt, mirror):
            residual = one_way_residual(system, local, other.vectors)
            readings.append(PartReading(reading.share, replace(other, residual=residual)))
    readings.sort(key=lambda reading: reading.cost)
    if not refine:
        return _found(scan, readings[0])
    judge = CandidateScorer(system, scan)

    def fitted(reading: PartReading, whole: bool) -> PartReading:
        local, vectors = reading.local(scan), reading.fit.vectors
        config = nodes if whole else replace(nodes, steps=screening)
        both = completed(system, local, vectors, reading.share, np.random.default_rng(0))
        vectors = refine_nodes(system, both, vectors, config)
        residual = one_way_residual(system, local, vectors)
        return replace(reading, fit=replace(reading.fit, vectors=vectors, residual=residual))

    chosen = choose(
        readings,
        _FINALISTS,
        fitted,
        lambda reading: cost(judge.score(reading.local(scan), reading.fit), reading.share),
        lambda reading: lying(system, reading.fit) / np.sqrt(reading.share),
        lambda done: tell(0.6 + 0.4 * done),
    )
    return _found(scan, chosen)


def _found(scan: Scan, reading: PartReading) -> tuple[float, Scan, Candidate]:
    root = float(np.sqrt(reading.share))
    return 1 / root, replace(scan, points=scan.points * root), reading.fit


def _asked_again(network, system, core, scan: Scan, reading: PartReading, rng) -> PartReading:
    """The network's answer to a scan that its last answer completes; how much of it was seen is the new share."""
    local = reading.local(scan)
    there = seen(system, local.first(_COARSE), reading.fit.vectors)
    share = float(np.clip(seen_area(system, there), _LEAST, 1.0))
    whole = completed(system, local, reading.fit.vectors, reading.share, rng)
    grown = np.sqrt(share / reading.share)
    whole = replace(whole, points=whole.points * grown)
    again = lay_on(network, system, core, whole, np.eye(3), np.zeros(3), rng, stride=4)
    fit = replace(
        again,
        rotation=reading.fit.rotation @ again.rotation,
        center=grown * reading.fit.center + reading.fit.rotation @ again.center,
    )
    found = PartReading(share, fit)
    return replace(found, fit=replace(fit, residual=one_way_residual(system, found.local(scan), fit.vectors)))


def _laid(model, system, scan, guess, rng, **how) -> Candidate:
    rotation, center = guess.rotation, guess.center
    laid = lay_on(model.network, system, model.template.core, scan, rotation, center, rng, stride=4, **how)
    local = scan.turned(laid.rotation, laid.center)
    return replace(laid, residual=one_way_residual(system, local, laid.vectors))


def cost(residual: float, share: float) -> float:
    """A residual, and a little for what is not seen: the smaller the part, the easier it lies on a template."""
    return residual + _SHARE_COST * (1 - share)
