"""Tables of the ablation runs, and tests of the paper's claims.

Training with another seed changes errors as much as many of the choices, and sets have few shapes. The order of two errors
is therefore significant only if the 95 % intervals of their difference exclude 0, both over seeds (Welch's t-test, at least
two trainings each) and over the data, held-out bodies or the shapes of a set (paired bootstrap; over shapes, not pairs, as
a difficult shape is difficult in all of its pairs). A claim is *supported* if every error is significantly larger than the
one before it, *not supported* if one is significantly smaller, and otherwise *not testable here*.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from statistics import fmean, stdev
from typing import Any

import numpy as np
from rich.table import Table
from scipy.stats import bootstrap, ttest_ind, ttest_rel

from meshmatch.arrays import Floats
from meshmatch.experiments.paper.ablation_views import (
    BASE,
    CODED,
    GRID,
    HELD_OUT,
    PAPER_MS,
    PAPER_SETS,
    TABLE4,
    VIEWS,
    Measurements,
    Run,
    View,
)
from meshmatch.experiments.runner import table

SUPPORTED, NOT_SUPPORTED, UNTESTED = "supported", "not supported", "not testable here"
_DRAWS = 4000
_NOT_MEASURED = "not measured"
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
        (f"with {words}: ours < 3D-CODED", (replace(BASE, **few), replace(CODED, **few)))  # type: ignore[arg-type]
        for words, few in (("250 shapes", {"shapes": 250}), ("50 supervised points", {"supervised": 50}))
    ),
)
"""Claims of the paper: the runs in order of increasing error."""
_REFINED = {
    "refined with regularisers < by Chamfer alone < not at all": ("code", "chamfer", "none"),
    "of it: with regularisers < not at all": ("code", "none"),
}


@dataclass(frozen=True)
class Claim:
    """A claim, the set on which it was tested, and the verdict.

    ``numbers`` are mean errors in the claimed order of increase; ``intervals`` are those of the differences of successive
    errors, None if there are too few seeds.
    """

    words: str
    where: str
    verdict: str
    numbers: tuple[float, ...] = ()
    intervals: tuple[tuple[float, float] | None, ...] = ()


@dataclass(frozen=True, eq=False)
class Sample:
    """Errors of one choice: the mean error of each training (``seeds``), and for ``each`` training the errors of all bodies
    or, if ``shapes`` is not 0, of all ordered pairs of that number of shapes."""

    seeds: Sequence[float]
    each: Sequence[Sequence[float]] = ()
    shapes: int = 0


def difference(a: Sample, b: Sample, paired: bool = False) -> tuple[float, float] | None:
    """Hull of the 95 % intervals of b's error minus a's, over seeds and over the data; None if there are too few seeds.

    ``paired`` if both are errors of the same networks.
    """
    if min(len(a.seeds), len(b.seeds)) < 2:
        return None
    no_variance = np.ptp(np.subtract(a.seeds, b.seeds)) == 0 if paired else np.ptp(a.seeds) == np.ptp(b.seeds) == 0
    if no_variance:
        ends = [float(np.mean(b.seeds) - np.mean(a.seeds))] * 2
    else:
        test = ttest_rel(b.seeds, a.seeds) if paired else ttest_ind(b.seeds, a.seeds, equal_var=False)
        over_seeds = test.confidence_interval(0.95)
        ends = [float(over_seeds.low), float(over_seeds.high)]
    if a.each and b.each:
        change = np.mean(b.each, axis=0) - np.mean(a.each, axis=0)
        if np.ptp(change) > 0:
            ends += shapes_interval(change, a.shapes) if a.shapes else bodies_interval(change)
    return min(ends), max(ends)


def bodies_interval(differences: Floats) -> list[float]:
    """95 % interval of the mean of independent numbers, by bootstrap."""
    rng = np.random.default_rng(0)
    interval = bootstrap((differences,), np.mean, n_resamples=_DRAWS, method="percentile", rng=rng).confidence_interval
    return [float(interval.low), float(interval.high)]


def shapes_interval(differences: Floats, shapes: int) -> list[float]:
    """95 % interval of the mean over all ordered pairs of different shapes, by a bootstrap that draws shapes with all of
    their pairs.
    """
    matrix = np.zeros((shapes, shapes))
    matrix[~np.eye(shapes, dtype=bool)] = differences
    counts = np.random.default_rng(0).multinomial(shapes, [1 / shapes] * shapes, _DRAWS).astype(float)
    n_pairs = shapes**2 - np.square(counts).sum(1)
    valid = n_pairs > 0
    means = ((counts @ matrix) * counts).sum(1)[valid] / n_pairs[valid]
    return [float(each) for each in np.percentile(means, [2.5, 97.5])]


def check_increase(where: str, words: str, samples: Sequence[Sample], paired: bool = False) -> Claim:
    """Test whether every error is larger than the one before it."""
    if not all(sample.seeds for sample in samples):
        return Claim(words, where, _NOT_MEASURED)
    numbers = tuple(float(np.mean(sample.seeds)) for sample in samples)
    intervals = tuple(difference(a, b, paired) for a, b in pairwise(samples))
    if any(each is not None and each[1] < 0 for each in intervals):
        return Claim(words, where, NOT_SUPPORTED, numbers, intervals)
    all_larger = all(each is not None and each[0] > 0 for each in intervals)
    return Claim(words, where, SUPPORTED if all_larger else UNTESTED, numbers, intervals)


def sample(measured: Measurements, run: Run, where: str, method: str | None = None) -> Sample:
    """Errors of a run on the held-out shapes or on a set."""
    records = measured.records(run, where, method)
    each = [record["pair_cm"] for record in records if record.get("pair_cm")]
    shapes = 0 if where == HELD_OUT or not each else (1 + math.isqrt(1 + 4 * len(each[0]))) // 2
    return Sample([record["mean_cm"] for record in records], each, shapes)


def claims(measured: Measurements, sets: Sequence[str]) -> list[Claim]:
    """Test all claims on the held-out shapes and each set.

    300 nodes of radius 0.2 are compared with the best other grid point.
    """
    found_claims = []
    for where in (HELD_OUT, *sets):
        samples_by_claim = {claim_text: [sample(measured, run, where) for run in runs] for claim_text, runs in CLAIMS}
        others = [each for run in GRID if run != BASE and (each := sample(measured, run, where)).seeds]
        best = min(others, key=lambda each: float(np.mean(each.seeds)), default=Sample(()))
        samples_by_claim["300 nodes of radius 0.2 are the best of the grid"] = [sample(measured, BASE, where), best]
        if where != HELD_OUT:
            for claim_text, hows in _REFINED.items():
                found_claims.append(
                    check_increase(where, claim_text, [sample(measured, BASE, where, how) for how in hows], paired=True)
                )
        found_claims += [check_increase(where, claim_text, samples) for claim_text, samples in samples_by_claim.items()]
    return found_claims


def claims_table(claims: Sequence[Claim]) -> Table:
    """Table with a row for each tested claim: its verdicts on the held-out shapes and each set, with intervals."""
    rows: dict[str, dict[str, str]] = {}
    for claim in (each for each in claims if each.verdict != _NOT_MEASURED):
        intervals = "; ".join(
            "one seed" if each is None else f"{each[0]:.2f} to {each[1]:.2f}" for each in claim.intervals
        )
        rows.setdefault(claim.words, {"claim": claim.words})[claim.where] = f"{claim.verdict} ({intervals})"
    columns = {"claim": "claim", **{claim.where: claim.where for claim in claims}}
    return table("What the paper claims", list(rows.values()), columns)


def number(values: Sequence[float]) -> str:
    """Format the mean, and the standard deviation over several seeds; a dash if there are no values."""
    if not values:
        return "-"
    text = f"{fmean(values):.2f}"
    return text if len(values) == 1 else f"{text} ± {stdev(values):.2f}"


def percent(values: Sequence[float]) -> str:
    """Format a mean share in percent; a dash if there are no values."""
    return f"{fmean(values):.0%}" if values else "-"


def errors_table(view: View, measured: Measurements, sets: Sequence[str], budget: str) -> Table:
    """Table of a view: steps, held-out error, and for each set mean and median error and the paper's mean."""
    columns = {head: head for head in view.heads}
    columns |= {"steps": "steps:>", "held out": "held out:>"}
    for name in sets:
        columns |= {name: f"{name}:>", f"{name} median": f"{name} median:>", f"{name} over 15": f"{name} over 15:>"}
        if name in PAPER_SETS and any(row.paper for row in view.rows):
            columns[f"{name} paper"] = f"{name} paper:.1f"
    rows = []
    for each in view.rows:
        run, record = each.run, measured.trained.get(each.run, {})
        labels = [word.format(rule=measured.rule(run)) for word in each.words]
        row: dict[str, Any] = dict(zip(view.heads, labels, strict=True))
        rows.append(row)
        if "skipped" in record:
            row["steps"] = "cannot be"
            continue
        row |= {"steps": record.get("steps", "-"), "held out": number(measured.error(run, HELD_OUT))}
        for name in sets:
            row[name] = number(measured.error(run, name, each.method))
            row[f"{name} median"] = number(measured.error(run, name, each.method, "median_cm"))
            row[f"{name} over 15"] = percent(measured.error(run, name, each.method, "share_over_15cm"))
            if each.paper is not None and name in PAPER_SETS:
                row[f"{name} paper"] = each.paper[PAPER_SETS.index(name)]
    return table(f"{view.title}, errors in cm: {budget}", rows, columns)


def cost_table(measured: Measurements) -> Table:
    """Second half of table 4: the cost of a training iteration."""
    rows = []
    for row in VIEWS["table4"].rows:
        constraint, field = row.words
        time, paper = measured.times.get(row.run.name), PAPER_MS[field][constraint]
        if time is None:
            continue
        reference, cost = cost_of(measured, "mls", constraint), cost_of(measured, field, constraint)
        rows.append(
            {
                **{"constraint": constraint, "field": field, **time},
                "slow": cost / reference if reference and cost else None,
                **{"paper": paper, "paper_slow": paper / PAPER_MS["mls"][constraint]},
            }
        )
    columns = {"constraint": "constraint", "field": "field", "CPU ms": "cpu_ms:.1f", "ms": "ms:.1f"}
    columns |= {"times mls": "slow:.1f", "paper's ms": "paper:.1f", "paper's times": "paper_slow:.1f"}
    return table("Table 4, cost of a training iteration", rows, columns)


def cost_of(measured: Measurements, field: str, constraint: str) -> float | None:
    """Milliseconds of an iteration: CPU time, which is least affected by other load; wall time on a GPU."""
    time = measured.times.get(replace(BASE, field=field, constraint=constraint).name)  # type: ignore[arg-type]
    return None if time is None else float(time["cpu_ms" if time["device"] == "cpu" else "ms"])


def tables(measured: Measurements, views: Sequence[str], sets: Sequence[str], budget: str) -> list[Table]:
    """Tables of the given views; of table 4 only the halves that were measured."""
    result = []
    for name in views:
        view = VIEWS[name]
        if name != "table4" or any(run in measured.trained for run in view.runs):
            result.append(errors_table(view, measured, sets, budget))
        if name == "table4" and measured.times:
            result.append(cost_table(measured))
    return result
