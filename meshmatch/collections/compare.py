"""What the fits of a collection have in common: what is usual of them, and their sides."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from meshmatch.collections.setting import FAILED, Record
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.usual import WEIGHTS, Usual, Weights, have_sides


@dataclass(frozen=True)
class Compared:
    """What is usual of a collection, and the sqrt(area) of its shapes in the unit of the files (median)."""

    usual: Usual
    scale: float

    @classmethod
    def of(cls, records: Sequence[Record], weights: Weights = WEIGHTS) -> Compared | None:
        """None of few fits, or of those of a version that did not say."""
        some = [each for each in records if each.stretch > 0 and each.residual > 0]
        usual = Usual.of([(each.stretch, each.residual) for each in some], weights)
        return None if usual is None else cls(usual, float(np.median([each.scale for each in some])))

    def trust(self, record: Record) -> float:
        """Probability (0..1) that a fit is right."""
        return self.usual.trust(record.likely, record.stretch, record.residual, record.inverted)

    def stands_out(self, record: Record) -> bool:
        """Whether the template had to stretch much more than usual."""
        return record.fitted and self.usual.stands_out(record.stretch)

    def may_lack(self, record: Record) -> bool:
        """Whether a shape may lack some of what the template shows."""
        return self.stands_out(record) or record.verdict == "poor"

    def judged(self, fit: Fit, record: Record) -> Fit:
        """A fit with verdict, reasons and trust among all of them."""
        alone = replace(fit, side=record.side)
        return self.usual.judged(alone, record.likely, record.stretch, record.residual)


def on_the_other_side(records: Sequence[Record]) -> set[str]:
    """Names of shapes that were fitted as they are, for their mirror images are not much better; but all the others show
    that shapes of this kind have sides.
    """
    sided = have_sides([each.side for each in records if each.verdict not in ("poor", FAILED)])
    return {each.name for each in records if sided and each.side < 0}
