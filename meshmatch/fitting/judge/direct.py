"""Energy and verdict of a fit of one shape to another without a model.

A wrong fit comes as near as a right one if it is stretched enough. Fits are therefore compared by an energy: the distance
of the surfaces, the stretch, the discontinuities, and how badly the relief (noses, eyes) matches.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from meshmatch.arrays import Float, Floats
from meshmatch.fitting.judge.calibration import DIRECT, DirectCalibration
from meshmatch.fitting.judge.reasons import Reason, Verdict
from meshmatch.fitting.search.discontinuities import Pairs, discontinuous_share
from meshmatch.fitting.search.predictor import two_way_residual
from meshmatch.fitting.solve.system import NodeSystem
from meshmatch.geometry.oriented import OrientedPoints

# Weights of the energy, relative to the residual: stretch of a complete fit, stretch of an early one, discontinuities,
# relief. Chosen on the 94 of the 450 pairs of `experiments.bench.any_shapes` that are hard to decide, and on a dozen that
# more weight of the stretch made wrong.
_STRETCH_WEIGHT, _EARLY_STRETCH_WEIGHT, _DISCONTINUITY_WEIGHT, _RELIEF_WEIGHT = 0.06, 0.03, 0.2, 0.01
LIKELY = 0.9
"""Least trust (0..1) of a good map."""
_FAIR_TRUST = 0.5
# Fits whose energy is higher by less than the first number are equally good; at most the second number of them is reported.
_MAX_TIE, _MAX_REPORTED_TIES = 0.0015, 9


@dataclass(frozen=True, kw_only=True)
class DirectFeatures:
    """Features of a fit without a model.

    Attributes
    ----------
    residual : mean distance both ways, normals included (units of sqrt(area))
    stretch : mean over the shape of the norm of the logarithms of the principal stretches
    discontinuous : share (0..1) of neighbours on the target whose counterparts are far apart on the source
    likeness : correlation (0..1) of the shapes' relief under the map; 1 if it was not computed
    """

    residual: float
    stretch: float
    discontinuous: float = 0.0
    likeness: float = 1.0

    @classmethod
    def of(
        cls, system: NodeSystem, samples: OrientedPoints, vectors: Float[Floats, "K 3"], pairs: Pairs | None = None
    ) -> DirectFeatures:
        """Compute the features of node vectors.

        ``samples`` are of the target. Without ``pairs`` of neighbouring samples, discontinuities are not measured.
        """
        stretches = np.linalg.svd(system.deformation_gradient(vectors), compute_uv=False)
        logarithms = np.log(np.clip(stretches, 1e-3, 1e3))
        return cls(
            residual=two_way_residual(system, samples, vectors),
            stretch=float(np.sqrt(np.square(logarithms).sum(1)).mean()),
            discontinuous=0.0 if pairs is None else discontinuous_share(system, pairs, samples, vectors),
        )

    @property
    def energy(self) -> float:
        """Energy of a complete fit; low for right fits."""
        return self._energy(_STRETCH_WEIGHT)

    @property
    def early_energy(self) -> float:
        """Energy of an early fit; right fits may still be stretched too much."""
        return self._energy(_EARLY_STRETCH_WEIGHT)

    def _energy(self, stretch: float) -> float:
        unlike = 1.0 - self.likeness
        return (
            self.residual
            + stretch * self.stretch
            + _DISCONTINUITY_WEIGHT * self.discontinuous
            + _RELIEF_WEIGHT * unlike
        )


def judge_direct(
    energy: float, leads: Sequence[float], calibration: DirectCalibration = DIRECT, turns: int = 1
) -> tuple[Verdict, float, tuple[Reason, ...]]:
    """Verdict, trust (0..1) and reasons of the best fit.

    ``leads`` are the energies of clearly different fits minus that of the best one; ``turns`` is the number of rotations
    that map one of the shapes onto itself.
    """
    trust = float(1 / (1 + np.exp(-calibration.logit(energy, leads))))
    reasons = []
    if equal := max(sum(each < _MAX_TIE for each in leads), turns - 1):
        count = f"{min(equal, _MAX_REPORTED_TIES) + 1}{' or more' if equal > _MAX_REPORTED_TIES else ''}"
        reasons.append(
            Reason("ambiguous", f"ambiguous: {count} different maps are equally good, as of a symmetric shape")
        )
    if trust < LIKELY:
        reasons.append(Reason("unsupervised", f"matched without a model: {int(100 * trust)} % likely to be right"))
    verdict: Verdict = "poor" if trust < _FAIR_TRUST else "fair" if reasons else "good"
    return verdict, trust, tuple(reasons)
