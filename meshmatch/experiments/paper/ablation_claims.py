"""What the paper claims of errors, and whether the ablation runs carry it.

Training again from another seed moves errors by as much as many choices do, and six shapes are a small sample. So an order
of two errors is there only where 95 % intervals of their difference leave out 0: over seeds (Welch's, of at least two
trainings each), and over what was measured on, the pairs of a set or held-out bodies (a paired bootstrap). A claim is
*supported* if every next error is larger, *not supported* if one is smaller, and else *not testable at this length*.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.stats import bootstrap, ttest_ind, ttest_rel

from meshmatch.experiments.paper.ablation_views import BASE, CODED, GRID, HELD_OUT, TABLE4, TRANSMATCH, Known, Run

SUPPORTED, NOT_SUPPORTED, UNTESTED = "supported", "not supported", "not testable at this length"
CLAIMS: tuple[tuple[str, tuple[Run, ...]], ...] = (
    (
        "with vol+arap+Z: mls < rbf < pointwise",
        tuple(replace(BASE, field=each) for each in ("mls", "rbf", "pointwise")),
    ),
    ("of it: mls < pointwise", (BASE, replace(BASE, field="pointwise"))),
    ("without constraints: pointwise < mls", (CODED, replace(BASE, constraint="none"))),
    ("mls: vol+arap+Z < vol+arap < none", tuple(replace(BASE, constraint=each) for each in reversed(TABLE4))),
    ("mls: both regularisers < none", (replace(BASE, constraint="vol+arap"), replace(BASE, constraint="none"))),
    (
        "pointwise: vol+arap < vol+arap+Z (Z does not pay)",
        tuple(replace(BASE, field="pointwise", constraint=each) for each in TABLE4[1:]),
    ),
    ("nodes by parts < uniform nodes (T)", (BASE, replace(BASE, strategy="uniform"))),
    ("nodes by parts < uniform nodes (A)", (replace(BASE, pose="A"), replace(BASE, strategy="uniform", pose="A"))),
    ("template pose T < I", (BASE, replace(BASE, pose="I"))),
    (
        "more shapes are better: 2000 < 1000 < 500 < 250",
        tuple(replace(BASE, shapes=count) for count in (2000, 1000, 500, 250)),
    ),
    ("1000 supervised points < 50", (BASE, replace(BASE, supervised=50))),
    *(
        (f"with {words}: ours < {rival}", (replace(BASE, **few), replace(other, **few)))  # type: ignore[arg-type]
        for rival, other in (("3D-CODED", CODED), ("TransMatch", TRANSMATCH))
        for words, few in (("250 shapes", {"shapes": 250}), ("50 supervised points", {"supervised": 50}))
    ),
)
"""What the paper says of errors: the runs in the order from the least error to the largest."""


@dataclass(frozen=True)
class Claim:
    """A statement, where it was looked at, mean errors from the one that should be least to the largest, and what became
    of it; an interval for every difference of neighbours, None where there are too few seeds."""

    words: str
    where: str
    verdict: str
    numbers: tuple[float, ...] = ()
    intervals: tuple[tuple[float, float] | None, ...] = ()


@dataclass(frozen=True, eq=False)
class Sample:
    """Mean errors of the trainings of one choice, and the errors of every pair, or body, by each of them."""

    seeds: Sequence[float]
    pairs: Sequence[Sequence[float]] = ()


def difference(a: Sample, b: Sample, paired: bool = False) -> tuple[float, float] | None:
    """The hull of the 95 % intervals of b's error less a's, over seeds and over pairs; None where there are too few seeds.

    ``paired``: both are of the same networks.
    """
    if min(len(a.seeds), len(b.seeds)) < 2:
        return None
    still = np.ptp(np.subtract(a.seeds, b.seeds)) == 0 if paired else np.ptp(a.seeds) == np.ptp(b.seeds) == 0
    if still:
        ends = [float(np.mean(b.seeds) - np.mean(a.seeds))] * 2
    else:
        test = ttest_rel(b.seeds, a.seeds) if paired else ttest_ind(b.seeds, a.seeds, equal_var=False)
        over_seeds = test.confidence_interval(0.95)
        ends = [float(over_seeds.low), float(over_seeds.high)]
    if a.pairs and b.pairs:
        off = np.mean(b.pairs, axis=0) - np.mean(a.pairs, axis=0)
        if np.ptp(off) > 0:
            rng = np.random.default_rng(0)
            drawn = bootstrap((off,), np.mean, n_resamples=4000, method="percentile", rng=rng).confidence_interval
            ends += [float(drawn.low), float(drawn.high)]
    return min(ends), max(ends)


def rising(where: str, words: str, samples: Sequence[Sample], paired: bool = False) -> Claim:
    """Whether every next error is larger."""
    if not all(sample.seeds for sample in samples):
        return Claim(words, where, "not measured")
    numbers = tuple(float(np.mean(sample.seeds)) for sample in samples)
    found = tuple(difference(a, b, paired) for a, b in pairwise(samples))
    if any(each is not None and each[1] < 0 for each in found):
        return Claim(words, where, NOT_SUPPORTED, numbers, found)
    held = all(each is not None and each[0] > 0 for each in found)
    return Claim(words, where, SUPPORTED if held else UNTESTED, numbers, found)


def sample(known: Known, run: Run, where: str, method: str | None = None) -> Sample:
    """What is known of a run on the held-out shapes or a set."""
    records = known.records(run, where, method)
    return Sample([each["mean_cm"] for each in records], [each["pair_cm"] for each in records if each.get("pair_cm")])


def claims(known: Known, sets: Sequence[str]) -> list[Claim]:
    """All claims, on the held-out shapes and each set; 300 nodes of radius 0.2 beside the best of the other grid points."""
    found = []
    for where in (HELD_OUT, *sets):
        asked = {words: [sample(known, run, where) for run in runs] for words, runs in CLAIMS}
        others = [each for run in GRID if run != BASE and (each := sample(known, run, where)).seeds]
        best = min(others, key=lambda each: float(np.mean(each.seeds)), default=Sample(()))
        asked["300 nodes of radius 0.2 are the best of the grid"] = [sample(known, BASE, where), best]
        if where != HELD_OUT:
            hows = ("code", "chamfer", "none")
            words = "refined with regularisers < by Chamfer alone < not at all"
            found.append(rising(where, words, [sample(known, BASE, where, how) for how in hows], paired=True))
        found += [rising(where, words, samples) for words, samples in asked.items()]
    return found
