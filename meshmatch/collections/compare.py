"""Compare the fits of a collection with each other: typical stretch and residual, and handedness."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from meshmatch.collections.setting import FAILED, Record
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.reference_statistics import TRUST_WEIGHTS, Usual, Weights, have_sides


@dataclass(frozen=True)
class Compared:
    """Typical stretch and residual in a collection, and the median sqrt(area) of its shapes, in the unit of the files."""

    usual: Usual
    scale: float

    @classmethod
    def of(cls, records: Sequence[Record], weights: Weights = TRUST_WEIGHTS) -> Compared | None:
        """Estimate from records; None for too few fits, or fits by a version that did not record stretch."""
        some = [each for each in records if each.stretch > 0 and each.residual > 0]
        usual = Usual.of([(each.stretch, each.residual) for each in some], weights)
        return None if usual is None else cls(usual, float(np.median([each.scale for each in some])))

    def trust(self, record: Record) -> float:
        """Probability (0..1) that a fit is right, given the other fits."""
        return self.usual.trust(record.likely, record.stretch, record.residual, record.inverted)

    def stands_out(self, record: Record) -> bool:
        """Whether the template stretched much more than is typical."""
        return record.fitted and self.usual.stands_out(record.stretch)

    def may_lack(self, record: Record) -> bool:
        """Whether a shape may be partial: its fit stands out or is poor."""
        return self.stands_out(record) or record.verdict == "poor"

    def judged(self, fit: Fit, record: Record) -> Fit:
        """Return the fit with verdict, reasons and trust by comparison with the others."""
        alone = replace(fit, side=record.side)
        return self.usual.judged(alone, record.likely, record.stretch, record.residual)


def opposite_side_names(records: Sequence[Record]) -> set[str]:
    """Names of shapes that were probably fitted with the wrong handedness.

    Their mirror images fit better (`Record.side` is negative), but not by enough to decide it from one shape. They count
    only if the other fits show that shapes of this kind have sides.
    """
    sided = have_sides([each.side for each in records if each.verdict not in ("poor", FAILED)])
    return {each.name for each in records if sided and each.side < 0}
