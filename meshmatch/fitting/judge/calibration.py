"""Calibrated weights of verdicts. Do not edit them by hand: commands fit and print them.

`experiments.bench.verdicts` and `experiments.bench.any_shapes` with ``--fit`` fit the weights to right and wrong fits with
known truth (logistic regression) and print what belongs here, with data, seeds and date.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """The logit of a wrong fit: ``offset`` plus the dot product of ``weights`` and `FitFeatures.values`."""

    weights: tuple[float, ...]  # in the order of `FitFeatures.values`
    offset: float
    data: str  # the shapes that were used
    seeds: tuple[int, ...]
    date: str


CALIBRATION = Calibration(
    weights=(0.909, 3.628, 1.163, 2.653, 5.308, 2.133),
    offset=9.935,
    data="nine cases of seeds 0 and 1 and the families that may tune, as many limbs, cuts and holes of seed 2, twelve "
    "stylised and pulled ones of seeds 2, 3 and 4, and 32 people of experiments.bench.characters of seed 5",
    seeds=(0, 1, 2, 3, 4, 5),
    date="2026-11-25",
)

_OF_CATEGORY = {
    "head": Calibration(
        weights=(2.069, 0.0, 2.63, 4.601, 11.993, 2.031),
        offset=18.336,
        data="three cases of 17 families of seeds 1 and 2, and four of twelve of seeds 3 and 4, of families that may tune",
        seeds=(1, 2, 3, 4),
        date="2026-11-29",
    )
}


def calibration_of(category: str) -> Calibration:
    """Calibration for fits by models of a category; that of people if the category has none of its own."""
    return _OF_CATEGORY.get(category, CALIBRATION)


@dataclass(frozen=True, kw_only=True)
class DirectCalibration:
    """The logit of a right map without a model.

    It is ``offset``, minus ``energy`` times the energy of the best fit, plus ``lead`` times its lead: the least difference
    to the energies of other fits, at most ``most``.
    """

    offset: float
    energy: float
    lead: float
    most: float
    data: str
    date: str

    def logit(self, energy: float, leads: Sequence[float]) -> float:
        """Logit for the energy of the best fit and its leads over the others."""
        return self.offset - self.energy * energy + self.lead * min([self.most, *leads])


DIRECT = DirectCalibration(
    offset=5.542,
    energy=85.2,
    lead=253.8,
    most=0.008,
    data="450 pairs of experiments.bench.any_shapes, of which 384 are right",
    date="2026-11-28",
)

# For energies that are means over both directions.
DIRECT_BOTH_WAYS = DirectCalibration(
    offset=6.761,
    energy=102.0,
    lead=270.0,
    most=0.008,
    data="176 pairs of experiments.bench.any_shapes, of which 130 are right",
    date="2026-11-28",
)
