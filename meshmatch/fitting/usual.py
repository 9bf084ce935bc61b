"""How far a fit is to be trusted, by what is usual of its kind.

Where no model learned what corresponds, a fit that lies close may be wrong. The template is then stretched as no other
shape of its kind stretches it: upside down, over the edge of a cut, or onto something else. What is usual, the others of its
collection say, or those that a model learned from (its card); it costs nothing, and is in no unit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from meshmatch.fitting.fit import Fit
from meshmatch.fitting.judge.reasons import SIDE_IN_DOUBT, Reason, Verdict
from meshmatch.fitting.judge.verdict import LIMITS
from meshmatch.models.card import ModelCard

USUAL = "usual"
"""Among the metrics of a card: what `Usual` has of fits of the shapes that the model learned from."""
FEWEST = 5
"""Fits, of which less say nothing about what is usual."""
FAIR = 0.5
"""Trust from which a fit is fair, as of two shapes without a model."""
_GOOD = 0.9
_ALONE = ("unsupervised", "doubt", "residual", "outlier")  # reasons of fits that no others, or fewer, are known of
_WORSE = 0.1  # what is so much worse than its mirror image may be wrong, see `Fit.side`
_STANDS_OUT = 1.5  # so many times what is usual is told
# Shapes have sides where so many of them have one that is clear, see `Fit.side`: 0.19 and more of molars, 0.17 of cut
# femurs; of birds, which have none, up to 0.01, and of leaves half have less.
_CLEAR, _MOST = 0.15, 0.8


def have_sides(leads: Sequence[float]) -> bool:
    """Whether shapes of a kind have sides, as bones have: nearly all are clearly unlike their mirror images. A lead is the
    `Fit.side` of one of them.
    """
    return len(leads) >= FEWEST and bool((np.abs(leads) > _CLEAR).mean() >= _MOST)


def believed(fits: Sequence[Fit]) -> list[Fit]:
    """Those of fits of one kind, without a model, that are not poor, alone and among the others."""
    usual = Usual.of([(fit.signs.stretch, fit.residual) for fit in fits if fit.signs is not None])
    if usual is not None:
        fits = [usual.judged(fit, fit.trust, fit.signs.stretch, fit.residual) for fit in fits if fit.signs is not None]
    return [fit for fit in fits if fit.verdict != "poor"]


@dataclass(frozen=True)
class Weights:
    """The logit of a right fit: ``offset``, less what the logarithms of stretch and residual over what is usual cost, and of
    the share of folded vertices over what a good fit may have."""

    offset: float
    stretch: float
    residual: float
    folded: float = 4.0


WEIGHTS = Weights(offset=3.1, stretch=2.4, residual=3.0)
"""Set by hand, between right and wrong fits of three collections of femurs, some cut, warped, or other shapes in their
place: right ones were stretched up to 2.5 times as much as usual, wrong ones 4.9 times and more. Folds: 12 to 23 % of the
vertices of busts that were fitted wrongly, of which all were stretched alike; up to 5 % of fish and chairs."""


@dataclass(frozen=True)
class Usual:
    """Medians of fits: how much the template is stretched, see `FitFeatures`, and how far it stays from the shapes (units of
    sqrt(area)); and of ``whom`` they are.
    """

    stretch: float
    residual: float
    weights: Weights = WEIGHTS
    whom: str = "the collection"

    @classmethod
    def of_card(cls, card: ModelCard) -> Usual | None:
        """Of the shapes that a model learned from, where its card says it."""
        known = card.metrics.get(USUAL, {})
        stretch, residual = (known.get(name) for name in ("stretch", "residual"))
        if not all(isinstance(each, float | int) and 0 < each < np.inf for each in (stretch, residual)):
            return None
        return cls(float(stretch), float(residual), whom=f"what {card.name} learned from")

    @classmethod
    def of(cls, signs: Sequence[tuple[float, float]], weights: Weights = WEIGHTS) -> Usual | None:
        """Of the stretches and residuals of fits; None of few."""
        if len(signs) < FEWEST:
            return None
        stretch, residual = np.median(signs, axis=0).tolist()
        return cls(stretch, residual, weights)

    def trust(self, likely: float, stretch: float, residual: float, inverted: float = 0.0) -> float:
        """Probability (0..1) that a fit is right, which alone is so ``likely``."""
        own, (further, apart) = self.weights, self.signs(stretch, residual)
        folded = float(np.log(np.fmax(inverted / LIMITS.folded, 1.0)))
        against = own.stretch * further + own.residual * apart + own.folded * folded - own.offset
        return float(likely / (1 + np.exp(against)))

    def signs(self, stretch: float, residual: float) -> tuple[float, float]:
        """What is weighed: logarithms of how many times as much as usual both are, if it is more."""
        further, apart = np.log(np.maximum([stretch / self.stretch, residual / self.residual], 1.0)).tolist()
        return further, apart

    def stands_out(self, stretch: float) -> bool:
        """Whether the template had to stretch much more than usual."""
        return stretch > _STANDS_OUT * self.stretch

    def judged(self, fit: Fit, likely: float, stretch: float, residual: float) -> Fit:
        """A fit with verdict, reasons and trust beside what is usual."""
        trust = self.trust(likely, stretch, residual, 0.0 if fit.regularity is None else fit.regularity.inverted)
        reasons = [reason for reason in fit.reasons if reason.code not in _ALONE]
        if self.stands_out(stretch):
            much = f"stretched or compressed {np.exp(stretch):.1f}-fold, {np.exp(self.stretch):.1f}-fold is usual"
            reasons = [reason for reason in reasons if reason.code != "crushed"]  # said already
            reasons.insert(0, Reason("outlier", f"stands out of {self.whom}: the template had to be {much}"))
        elif residual > _STANDS_OUT * self.residual:
            apart = f"{100 * residual:.1f} % of sqrt(area) apart, {100 * self.residual:.1f} % is usual"
            reasons.insert(0, Reason("outlier", f"stands out of {self.whom}: template and shape stay {apart}"))
        if fit.side < -_WORSE:
            reasons.append(Reason("side", SIDE_IN_DOUBT))
        verdict: Verdict = "good"
        if fit.verdict == "poor" or trust < FAIR:
            verdict = "poor"
        elif trust < _GOOD or reasons:
            verdict = "fair"
        if verdict != "good" and not reasons:
            reasons = [Reason("doubt", f"{int(100 * trust)} % likely to be right, beside {self.whom}")]
        return replace(fit, verdict=verdict, reasons=tuple(reasons), trust=trust)
