"""How far a fit of a collection is to be trusted, by what it has in common with the others.

Where no model learned what corresponds, a fit that lies close may be wrong. The template is then stretched as no other
shape of its kind stretches it: upside down, over the edge of a cut, or onto something else. What is usual, the others say;
it costs nothing, and is in no unit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from meshmatch.collections.setting import FAILED, Record
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.judge.reasons import SIDE_IN_DOUBT, Reason, Verdict

_FEWEST = 5  # fits, of which less say nothing about what is usual
_GOOD, FAIR = 0.9, 0.5
"""Trust from which a fit is good, and fair, as of two shapes without a model."""
_ALONE = ("unsupervised", "doubt", "residual")  # reasons of fits that no others are known of
# Shapes have sides where so many of them have one that is clear, see `Fit.side`: 0.19 and more of molars, 0.17 of cut
# femurs; of birds, which have none, up to 0.01, and of leaves half have less. What is so much worse than its mirror image
# may be wrong.
_CLEAR, _MOST, _WORSE = 0.15, 0.8, 0.1
_STANDS_OUT = 1.5  # so many times what is usual is told


@dataclass(frozen=True)
class Weights:
    """The logit of a right fit: ``offset``, less what the logarithms of stretch and residual over what is usual cost."""

    offset: float
    stretch: float
    residual: float


WEIGHTS = Weights(offset=3.1, stretch=2.4, residual=3.0)
"""Set by hand, between right and wrong fits of three collections of femurs, some cut, warped, or other shapes in their
place: right ones were stretched up to 2.5 times as much as usual, wrong ones 4.9 times and more."""


@dataclass(frozen=True)
class Usual:
    """Medians of a collection: how much the template is stretched, how far it stays from the shapes, and the sqrt(area) of
    these in the unit of the files.
    """

    stretch: float
    residual: float
    scale: float
    weights: Weights = WEIGHTS

    @classmethod
    def of(cls, records: Sequence[Record]) -> Usual | None:
        """None of few fits, or of those of a version that did not say."""
        some = [each for each in records if each.stretch > 0 and each.residual > 0]
        if len(some) < _FEWEST:
            return None
        stretch, residual, scale = (
            float(np.median([getattr(each, name) for each in some])) for name in ("stretch", "residual", "scale")
        )
        return cls(stretch, residual, scale)

    def trust(self, record: Record) -> float:
        """Probability (0..1) that a fit is right."""
        own, (stretch, residual) = self.weights, self.signs(record)
        return float(record.likely / (1 + np.exp(own.stretch * stretch + own.residual * residual - own.offset)))

    def signs(self, record: Record) -> tuple[float, float]:
        """What is weighed: logarithms of how many times as much as usual stretch and residual are, if it is more."""
        stretch, residual = np.log(np.maximum(self._times(record), 1.0)).tolist()
        return stretch, residual

    def stands_out(self, record: Record) -> bool:
        """Whether the template had to stretch much more than usual."""
        return record.fitted and record.stretch > _STANDS_OUT * self.stretch

    def may_lack(self, record: Record) -> bool:
        """Whether a shape may lack some of what the template shows."""
        return self.stands_out(record) or record.verdict == "poor"

    def _times(self, record: Record) -> tuple[float, float]:
        return record.stretch / self.stretch, record.residual / self.residual

    def judged(self, fit: Fit, record: Record) -> Fit:
        """A fit with verdict, reasons and trust among all of them."""
        trust, residual = self.trust(record), self._times(record)[1]
        reasons = [reason for reason in fit.reasons if reason.code not in _ALONE]
        if self.stands_out(record):
            much = (
                f"stretched or compressed {np.exp(record.stretch):.1f}-fold, {np.exp(self.stretch):.1f}-fold is usual"
            )
            reasons.insert(0, Reason("outlier", f"stands out of the collection: the template had to be {much}"))
        elif residual > _STANDS_OUT:
            apart = f"{100 * record.residual:.1f} % of sqrt(area) apart, {100 * self.residual:.1f} % is usual"
            reasons.insert(0, Reason("outlier", f"stands out of the collection: template and shape stay {apart}"))
        if record.side < -_WORSE:
            reasons.append(Reason("side", SIDE_IN_DOUBT))
        verdict: Verdict = "good"
        if fit.verdict == "poor" or trust < FAIR:
            verdict = "poor"
        elif trust < _GOOD or reasons:
            verdict = "fair"
        if verdict != "good" and not reasons:
            reasons = [Reason("doubt", f"{int(100 * trust)} % likely to be right, beside the others of the collection")]
        return replace(fit, verdict=verdict, reasons=tuple(reasons), trust=trust)


def on_the_other_side(records: Sequence[Record]) -> set[str]:
    """Names of shapes that were fitted as they are, for their mirror images are not much better; but all the others show
    that shapes of this kind have sides.
    """
    leads = np.array([each.side for each in records if each.verdict not in ("poor", FAILED)])
    if len(leads) < _FEWEST or (np.abs(leads) > _CLEAR).mean() < _MOST:
        return set()
    return {each.name for each in records if each.side < 0}
