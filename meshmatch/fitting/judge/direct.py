"""What speaks for and against a fit of one shape to another, made without a model.

A wrong fit comes as near as a right one, if it is stretched enough. So fits are compared by an energy: how far the surfaces
stay apart, how much had to be stretched, how much was torn, and how far noses, eyes and other relief come to lie elsewhere.
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

# Weights of the energy beside the residual: of the stretch, where a fit is finished and where it has begun, of what is torn,
# and of relief. Chosen on 94 of the 450 pairs of `experiments.bench.any_shapes`, those that are hard to tell, and on a dozen
# that more weight of the stretch made wrong.
_STRETCH, _BEGUN, _TORN, _UNLIKE = 0.06, 0.03, 0.2, 0.01
LIKELY = 0.9
"""How likely (0..1) a map is to be right at least that is called good."""
_FAIR = 0.5
# Another fit whose energy is so little higher is as good; so many are told.
_TIE, _TOLD = 0.0015, 9


@dataclass(frozen=True, kw_only=True)
class DirectFeatures:
    """How a fit without a model came out.

    Attributes
    ----------
    residual : mean distance both ways, normals included (units of sqrt(area))
    stretch : root mean square over the shape of the norm of the logarithms of its stretches
    discontinuous : share (0..1) of neighbours on the target that belong far apart on the source
    likeness : correlation (0..1) of what stands out, or is sunk, on both shapes; 1 where it was not asked
    """

    residual: float
    stretch: float
    discontinuous: float = 0.0
    likeness: float = 1.0

    @classmethod
    def of(
        cls, system: NodeSystem, samples: OrientedPoints, vectors: Float[Floats, "K 3"], pairs: Pairs | None = None
    ) -> DirectFeatures:
        """Of node vectors; ``samples`` are of the target, ``pairs`` those that are neighbours (without them tears are not
        looked for)."""
        stretches = np.linalg.svd(system.deformation_gradient(vectors), compute_uv=False)
        logarithms = np.log(np.clip(stretches, 1e-3, 1e3))
        return cls(
            residual=two_way_residual(system, samples, vectors),
            stretch=float(np.sqrt(np.square(logarithms).sum(1)).mean()),
            discontinuous=0.0 if pairs is None else discontinuous_share(system, pairs, samples, vectors),
        )

    @property
    def energy(self) -> float:
        """Low for right fits."""
        return self._energy(_STRETCH)

    @property
    def early_energy(self) -> float:
        """The same of fits that have only begun: the right ones among them may yet have to stretch back."""
        return self._energy(_BEGUN)

    def _energy(self, stretch: float) -> float:
        unlike = 1.0 - self.likeness
        return self.residual + stretch * self.stretch + _TORN * self.discontinuous + _UNLIKE * unlike


def judge_direct(
    energy: float, leads: Sequence[float], calibration: DirectCalibration = DIRECT, turns: int = 1
) -> tuple[Verdict, float, tuple[Reason, ...]]:
    """Verdict, trust (0..1) and reasons of the best fit; ``leads`` are how much higher the energies are of other fits, which
    differ from it clearly, and ``turns`` by how many turns one of the shapes comes onto itself."""
    trust = float(1 / (1 + np.exp(-calibration.logit(energy, leads))))
    reasons = []
    if equal := max(sum(each < _TIE for each in leads), turns - 1):
        count = f"{min(equal, _TOLD) + 1}{' or more' if equal > _TOLD else ''}"
        reasons.append(
            Reason("ambiguous", f"ambiguous: {count} different maps are equally good, as of a symmetric shape")
        )
    if trust < LIKELY:
        reasons.append(Reason("unsupervised", f"matched without a model: {int(100 * trust)} % likely to be right"))
    verdict: Verdict = "poor" if trust < _FAIR else "fair" if reasons else "good"
    return verdict, trust, tuple(reasons)
