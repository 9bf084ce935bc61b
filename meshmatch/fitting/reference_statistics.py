"""Trust in fits without known correspondence, by comparison with other fits of the same kind.

If no model learned correspondence, a fit that lies close to the shape may still be wrong: upside down, across the edge of a
cut, or onto something else. But then the template is stretched as on no other shape of its kind. Typical values come from
the other fits of the collection, or from the shapes that a model was trained on (its card). The comparison costs nothing
and has no units.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from meshmatch.fitting.fit import Fit
from meshmatch.fitting.judge.reasons import SIDE_IN_DOUBT, Reason, Verdict
from meshmatch.fitting.judge.verdict import LIMITS
from meshmatch.models.card import ModelCard

STATISTICS_KEY = "usual"
"""Key in a card's metrics for the medians over fits of the training shapes, see `Usual`."""
MIN_FITS = 5
"""Minimum number of fits from which typical values are computed."""
MIN_FAIR_TRUST = 0.5
"""Least trust of a fair fit, as for two shapes without a model."""
_GOOD_TRUST = 0.9
_SUPERSEDED_REASONS = ("unsupervised", "doubt", "residual", "outlier")  # dropped, as the comparison judges these anew
_DOUBTFUL_SIDE = 0.1  # a fit is doubtful if its mirror image fits better by more than this, see `Fit.side`
_OUTLIER_RATIO = 1.5  # multiple of the typical value above which a fit is reported as an outlier
# A kind has sides if at least a share of `_MIN_CLEAR_SHARE` of its shapes has |`Fit.side`| above `_CLEAR_SIDE`. Molars have
# 0.19 and more, cut femurs 0.17. Birds, which have no sides, have up to 0.01, and half of the leaves less than the limit.
_CLEAR_SIDE, _MIN_CLEAR_SHARE = 0.15, 0.8


def have_sides(leads: Sequence[float]) -> bool:
    """Return whether shapes of a kind have a left and a right form, as bones do.

    Nearly all of them must clearly differ from their mirror images. ``leads`` are the `Fit.side` of the shapes.
    """
    return len(leads) >= MIN_FITS and bool((np.abs(leads) > _CLEAR_SIDE).mean() >= _MIN_CLEAR_SHARE)


def drop_poor(fits: Sequence[Fit]) -> list[Fit]:
    """Filter fits of one kind without a model: keep those that are not poor, neither alone nor compared with the others."""
    usual = Usual.of([(fit.signs.stretch, fit.residual) for fit in fits if fit.signs is not None])
    if usual is not None:
        fits = [usual.judged(fit, fit.trust, fit.signs.stretch, fit.residual) for fit in fits if fit.signs is not None]
    return [fit for fit in fits if fit.verdict != "poor"]


@dataclass(frozen=True)
class Weights:
    """Weights of the logit of a right fit.

    From ``offset`` are subtracted, weighted, the logarithms of stretch and residual relative to typical values, and the
    logarithm of the share of folded vertices relative to what a good fit may have; each only if it is positive.
    """

    offset: float
    stretch: float
    residual: float
    folded: float = 4.0


TRUST_WEIGHTS = Weights(offset=3.1, stretch=2.4, residual=3.0)
"""Set by hand, to separate right from wrong fits of three collections of femurs, some of them cut, warped or replaced by
other shapes: right ones were stretched up to 2.5 times as much as is typical, wrong ones at least 4.9 times. Folds: 12 to
23 % of the vertices of wrongly fitted busts, all of which were stretched alike; up to 5 % of fish and chairs."""


@dataclass(frozen=True)
class Usual:
    """Typical values of fits of one kind.

    ``stretch`` is the median stretch of the template (see `FitFeatures`), ``residual`` the median distance to the shapes
    (units of sqrt(area)), and ``whom`` names the fits in messages.
    """

    stretch: float
    residual: float
    weights: Weights = TRUST_WEIGHTS
    whom: str = "the collection"

    @classmethod
    def of_card(cls, card: ModelCard) -> Usual | None:
        """Values for the shapes that a model was trained on; None if its card does not have them."""
        known = card.metrics.get(STATISTICS_KEY, {})
        stretch, residual = (known.get(name) for name in ("stretch", "residual"))
        if not all(isinstance(each, float | int) and 0 < each < np.inf for each in (stretch, residual)):
            return None
        return cls(float(stretch), float(residual), whom=f"what {card.name} learned from")

    @classmethod
    def of(cls, features: Sequence[tuple[float, float]], weights: Weights = TRUST_WEIGHTS) -> Usual | None:
        """Medians over (stretch, residual) of fits; None if there are too few."""
        if len(features) < MIN_FITS:
            return None
        stretch, residual = np.median(features, axis=0).tolist()
        return cls(stretch, residual, weights)

    def trust(self, likely: float, stretch: float, residual: float, inverted: float = 0.0) -> float:
        """Probability (0..1) that a fit is right, given its probability ``likely`` without this comparison."""
        own, (further, apart) = self.weights, self.signs(stretch, residual)
        folded = float(np.log(np.fmax(inverted / LIMITS.folded, 1.0)))
        against = own.stretch * further + own.residual * apart + own.folded * folded - own.offset
        return float(likely / (1 + np.exp(against)))

    def signs(self, stretch: float, residual: float) -> tuple[float, float]:
        """Logarithms of stretch and residual relative to the typical values; 0 if they are not larger."""
        further, apart = np.log(np.maximum([stretch / self.stretch, residual / self.residual], 1.0)).tolist()
        return further, apart

    def stands_out(self, stretch: float) -> bool:
        """Return whether the template is stretched much more than is typical."""
        return stretch > _OUTLIER_RATIO * self.stretch

    def judged(self, fit: Fit, likely: float, stretch: float, residual: float) -> Fit:
        """A fit with verdict, reasons and trust from the comparison with typical values."""
        trust = self.trust(likely, stretch, residual, 0.0 if fit.regularity is None else fit.regularity.inverted)
        reasons = [reason for reason in fit.reasons if reason.code not in _SUPERSEDED_REASONS]
        if self.stands_out(stretch):
            much = f"stretched or compressed {np.exp(stretch):.1f}-fold, {np.exp(self.stretch):.1f}-fold is usual"
            reasons = [reason for reason in reasons if reason.code != "crushed"]  # the outlier reason replaces it
            reasons.insert(0, Reason("outlier", f"stands out of {self.whom}: the template had to be {much}"))
        elif residual > _OUTLIER_RATIO * self.residual:
            apart = f"{100 * residual:.1f} % of sqrt(area) apart, {100 * self.residual:.1f} % is usual"
            reasons.insert(0, Reason("outlier", f"stands out of {self.whom}: template and shape stay {apart}"))
        if fit.side < -_DOUBTFUL_SIDE:
            reasons.append(Reason("side", SIDE_IN_DOUBT))
        verdict: Verdict = "good"
        if fit.verdict == "poor" or trust < MIN_FAIR_TRUST:
            verdict = "poor"
        elif trust < _GOOD_TRUST or reasons:
            verdict = "fair"
        if verdict != "good" and not reasons:
            reasons = [Reason("doubt", f"{int(100 * trust)} % likely to be right, beside {self.whom}")]
        return replace(fit, verdict=verdict, reasons=tuple(reasons), trust=trust)
