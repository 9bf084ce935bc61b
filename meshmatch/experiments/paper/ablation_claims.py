"""What the paper claims, and whether the ablation runs carry it.

Training again from another seed moves errors by as much as many choices do, and six shapes are a small sample. An order
of two errors is therefore said to be there only where it is carried

- by seeds: the 95 % interval of the difference of their means (Welch's, of at least two trainings each) leaves out 0;
- by what was measured on too: so does the 95 % interval of a paired bootstrap over a set's pairs, or over held-out bodies.

Verdicts tell the hull of both intervals of each difference.

Refinements of the same networks are compared seed by seed; a single network by its pairs alone. Costs, which are medians
of many iterations side by side, are compared as they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from statistics import fmean
from typing import Literal

import numpy as np
from scipy.stats import t as student

from meshmatch.arrays import Float, Floats
from meshmatch.experiments.paper.ablation_results import cost_of
from meshmatch.experiments.paper.ablation_views import BASE, CLAIMS, GRID, HELD_OUT, TABLE4, Known, Run
from meshmatch.fields.shape_functions import FIELDS, has_nodes

Outcome = Literal["holds", "does not hold", "not told apart", "not measured"]
_RESAMPLES, _LEVEL = 4000, 0.95


@dataclass(frozen=True)
class Claim:
    """A statement, the numbers that it is about from the one that should be least to the largest, and what became of it.

    ``where`` is empty, a set, or "held out"; ``intervals`` are of every difference of neighbours, None where there is none.
    """

    words: str
    numbers: tuple[float, ...]
    outcome: Outcome
    where: str = ""
    intervals: tuple[tuple[float, float] | None, ...] = ()

    @property
    def verdict(self) -> str:
        """What became of it, in words."""
        if self.outcome == "not measured":
            return self.outcome
        numbers = ", ".join(f"{value:.2f}" for value in self.numbers)
        if known := [f"{low:+.2f} to {high:+.2f}" for low, high in filter(None, self.intervals)]:
            numbers += f"; differences {', '.join(known)}"
        return f"{'DOES NOT HOLD' if self.outcome == 'does not hold' else self.outcome} ({numbers})"


@dataclass(frozen=True, eq=False)
class Sample:
    """Mean errors of the trainings of one choice; the error of every pair, or body, by each of them (or none)."""

    seeds: Sequence[float]
    pairs: Sequence[Sequence[float]] = ()

    @property
    def mean(self) -> float:
        """Over seeds."""
        return fmean(self.seeds)


def seeds_interval(a: Sequence[float], b: Sequence[float], paired: bool) -> tuple[float, float] | None:
    """95 % interval of the mean of b less that of a; None where there are too few to say."""
    if paired:
        if len(a) < 2:
            return None
        off = np.subtract(b, a)
        middle, error, free = float(off.mean()), float(off.std(ddof=1) / np.sqrt(len(off))), float(len(off) - 1)
    else:
        if min(len(a), len(b)) < 2:
            return None
        parts = [float(np.var(each, ddof=1)) / len(each) for each in (a, b)]
        middle, error = fmean(b) - fmean(a), float(np.sqrt(sum(parts)))
        weight = sum(part**2 / (len(each) - 1) for part, each in zip(parts, (a, b), strict=True))
        free = sum(parts) ** 2 / weight if weight else float(len(a) + len(b) - 2)
    reach = float(student.ppf((1 + _LEVEL) / 2, free)) * error
    return middle - reach, middle + reach


def pairs_interval(a: Float[Floats, " P"], b: Float[Floats, " P"]) -> tuple[float, float]:
    """95 % interval of the mean of b less that of a, by resampling pairs (or bodies)."""
    off = b - a
    draws = np.random.default_rng(0).integers(0, len(off), (_RESAMPLES, len(off)))
    low, high = np.quantile(off[draws].mean(1), [(1 - _LEVEL) / 2, (1 + _LEVEL) / 2])
    return float(low), float(high)


def difference(a: Sample, b: Sample, paired: bool = False) -> tuple[float, float] | None:
    """The hull of the 95 % intervals of b's error less a's, by seeds and by pairs; None where there are too few seeds."""
    intervals = [seeds_interval(a.seeds, b.seeds, paired)]
    if a.pairs and b.pairs:
        intervals.append(pairs_interval(np.mean(a.pairs, axis=0), np.mean(b.pairs, axis=0)))
        if intervals[0] is None and paired:
            intervals = intervals[1:]
    known = [each for each in intervals if each is not None]
    if len(known) < len(intervals):
        return None
    return min(low for low, _ in known), max(high for _, high in known)


def order(a: Sample, b: Sample, paired: bool = False) -> int:
    """1 if b's error is carried to be larger than a's, -1 if it is to be smaller, 0 if neither is."""
    found = difference(a, b, paired)
    return 0 if found is None or np.sign(found[0]) != np.sign(found[1]) else int(np.sign(found[0]))


def rising(where: str, words: str, samples: Sequence[Sample], paired: bool = False) -> Claim:
    """Holds if every next error is carried to be larger, does not if one is carried to be smaller."""
    numbers = tuple(sample.mean for sample in samples if sample.seeds)
    if len(numbers) < len(samples):
        return Claim(words, numbers, "not measured", where)
    signs = [order(a, b, paired) for a, b in pairwise(samples)]
    outcome: Outcome = (
        "does not hold" if -1 in signs else "holds" if all(sign == 1 for sign in signs) else "not told apart"
    )
    return Claim(words, numbers, outcome, where, tuple(difference(a, b, paired) for a, b in pairwise(samples)))


def sample(known: Known, run: Run, where: str) -> Sample:
    """What is known of a run on the held-out shapes or a set."""
    return Sample(known.error(run, where), known.pairs(run, where))


def claims(known: Known, sets: Sequence[str]) -> list[Claim]:
    """All claims, on the held-out shapes and each set."""
    found = _costs(known)
    for where in (HELD_OUT, *sets):
        for words, runs in CLAIMS:
            found.append(rising(where, words, [sample(known, run, where) for run in runs]))
        found.append(_best_of_grid(known, where))
        if where != HELD_OUT:
            found.append(_refinements(known, where))
    return found


def _refinements(known: Known, where: str) -> Claim:
    hows = ("code", "chamfer", "none")
    alike = [  # what is measured once is not compared
        run
        for run in known.trained
        if replace(run, seed=BASE.seed) == BASE and all((run, where, how) in known.errors for how in hows)
    ]
    samples = []
    for how in hows:
        records = [known.errors[run, where, how] for run in alike]
        pairs = [record["pair_cm"] for record in records if record.get("pair_cm")]
        samples.append(Sample([record["mean_cm"] for record in records], pairs))
    return rising(where, "refined with regularisers < by Chamfer alone < not at all", samples, paired=True)


def _costs(known: Known) -> list[Claim]:
    """What constraints cost: factors of the milliseconds of an iteration."""
    factor: dict[str, float] = {}
    full = {field: cost_of(known, field, TABLE4[-1]) for field in FIELDS}
    for field in FIELDS:
        plain, dear = cost_of(known, field, TABLE4[0]), full[field]
        if plain and dear:
            factor[field] = dear / plain
    found = []
    for field in (field for field in FIELDS if has_nodes(field)):
        words = f"an iteration of {field} takes at most 2 times as long with vol+arap+Z"
        there = (factor[field],) if field in factor else ()
        found.append(_plain(words, there, there[0] <= 2 if there else None))
    both = tuple(factor[field] for field in ("mls", "pointwise") if field in factor)
    words = "vol+arap+Z slows an iteration of mls by less than one of pointwise"
    found.append(_plain(words, both, both[0] < both[1] if len(both) == 2 else None))
    dear_ones = tuple(cost for cost in (full["mls"], full["pointwise"]) if cost)
    words = "with vol+arap+Z an iteration of pointwise takes at least 3 times as long as one of mls"
    return [*found, _plain(words, dear_ones, dear_ones[1] > 3 * dear_ones[0] if len(dear_ones) == 2 else None)]


def _plain(words: str, numbers: tuple[float, ...], holds: bool | None) -> Claim:
    return Claim(words, numbers, "not measured" if holds is None else "holds" if holds else "does not hold")


def _best_of_grid(known: Known, where: str) -> Claim:
    """The base against the best of the others, which has been chosen: in its favour."""
    there = {run: found for run in GRID if (found := sample(known, run, where)).seeds}
    words = "300 nodes of radius 0.2 are the best of the grid"
    if BASE not in there or len(there) < 2:
        return Claim(words, (), "not measured", where)
    best = min((found for run, found in there.items() if run != BASE), key=lambda found: found.mean)
    return rising(where, words, [there[BASE], best])
