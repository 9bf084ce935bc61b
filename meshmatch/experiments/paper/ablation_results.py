"""The paper's tables and claims, read off what is known of the ablation runs.

Training again from another seed moves errors by as much as many choices do, and a set has few shapes. So an order of two
errors is there only where 95 % intervals of their difference leave out 0: over seeds (Welch's, of at least two trainings
each), and over what was measured on, held-out bodies or the shapes of a set (a paired bootstrap; of shapes, not of pairs,
for a hard shape is hard in all of its pairs). A claim is *supported* if every next error is larger, *not supported* if one
is smaller, and else *not testable here*.
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
    Known,
    Run,
    View,
)
from meshmatch.experiments.runner import table

SUPPORTED, NOT_SUPPORTED, UNTESTED = "supported", "not supported", "not testable here"
_DRAWS = 4000
_UNMEASURED = "not measured"
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
"""What the paper says of errors: the runs in the order from the least error to the largest."""
_REFINED = {
    "refined with regularisers < by Chamfer alone < not at all": ("code", "chamfer", "none"),
    "of it: with regularisers < not at all": ("code", "none"),
}


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
    """Mean errors of the trainings of one choice, and by each of them the errors of every body, or of all ordered pairs of
    so many ``shapes``."""

    seeds: Sequence[float]
    each: Sequence[Sequence[float]] = ()
    shapes: int = 0


def difference(a: Sample, b: Sample, paired: bool = False) -> tuple[float, float] | None:
    """The hull of the 95 % intervals of b's error less a's, over seeds and over shapes; None where there are too few seeds.

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
    if a.each and b.each:
        off = np.mean(b.each, axis=0) - np.mean(a.each, axis=0)
        if np.ptp(off) > 0:
            ends += over_shapes(off, a.shapes) if a.shapes else over_bodies(off)
    return min(ends), max(ends)


def over_bodies(off: Floats) -> list[float]:
    """The ends of the 95 % interval of a mean of independent numbers."""
    rng = np.random.default_rng(0)
    drawn = bootstrap((off,), np.mean, n_resamples=_DRAWS, method="percentile", rng=rng).confidence_interval
    return [float(drawn.low), float(drawn.high)]


def over_shapes(off: Floats, shapes: int) -> list[float]:
    """The ends of the 95 % interval of a mean over all ordered pairs of so many shapes, which are drawn with all their
    pairs; none of a shape with itself.
    """
    between = np.zeros((shapes, shapes))
    between[~np.eye(shapes, dtype=bool)] = off
    often = np.random.default_rng(0).multinomial(shapes, [1 / shapes] * shapes, _DRAWS).astype(float)
    pairs = shapes**2 - np.square(often).sum(1)
    some = pairs > 0
    means = ((often @ between) * often).sum(1)[some] / pairs[some]
    return [float(each) for each in np.percentile(means, [2.5, 97.5])]


def rising(where: str, words: str, samples: Sequence[Sample], paired: bool = False) -> Claim:
    """Whether every next error is larger."""
    if not all(sample.seeds for sample in samples):
        return Claim(words, where, _UNMEASURED)
    numbers = tuple(float(np.mean(sample.seeds)) for sample in samples)
    found = tuple(difference(a, b, paired) for a, b in pairwise(samples))
    if any(each is not None and each[1] < 0 for each in found):
        return Claim(words, where, NOT_SUPPORTED, numbers, found)
    held = all(each is not None and each[0] > 0 for each in found)
    return Claim(words, where, SUPPORTED if held else UNTESTED, numbers, found)


def sample(known: Known, run: Run, where: str, method: str | None = None) -> Sample:
    """What is known of a run on the held-out shapes or a set."""
    records = known.records(run, where, method)
    each = [found["pair_cm"] for found in records if found.get("pair_cm")]
    shapes = 0 if where == HELD_OUT or not each else (1 + math.isqrt(1 + 4 * len(each[0]))) // 2
    return Sample([found["mean_cm"] for found in records], each, shapes)


def claims(known: Known, sets: Sequence[str]) -> list[Claim]:
    """All claims, on the held-out shapes and each set; 300 nodes of radius 0.2 beside the best of the other grid points."""
    found = []
    for where in (HELD_OUT, *sets):
        asked = {words: [sample(known, run, where) for run in runs] for words, runs in CLAIMS}
        others = [each for run in GRID if run != BASE and (each := sample(known, run, where)).seeds]
        best = min(others, key=lambda each: float(np.mean(each.seeds)), default=Sample(()))
        asked["300 nodes of radius 0.2 are the best of the grid"] = [sample(known, BASE, where), best]
        if where != HELD_OUT:
            for words, hows in _REFINED.items():
                found.append(rising(where, words, [sample(known, BASE, where, how) for how in hows], paired=True))
        found += [rising(where, words, samples) for words, samples in asked.items()]
    return found


def claims_table(found: Sequence[Claim]) -> Table:
    """Each claim that was measured in a row, its verdicts on the held-out shapes and each set, with the intervals."""
    rows: dict[str, dict[str, str]] = {}
    for claim in (each for each in found if each.verdict != _UNMEASURED):
        known = "; ".join("one seed" if each is None else f"{each[0]:.2f} to {each[1]:.2f}" for each in claim.intervals)
        rows.setdefault(claim.words, {"claim": claim.words})[claim.where] = f"{claim.verdict} ({known})"
    columns = {"claim": "claim", **{claim.where: claim.where for claim in found}}
    return table("What the paper claims", list(rows.values()), columns)


def number(values: Sequence[float]) -> str:
    """A mean, and the standard deviation of several seeds; a dash for what was not measured."""
    if not values:
        return "-"
    words = f"{fmean(values):.2f}"
    return words if len(values) == 1 else f"{words} ± {stdev(values):.2f}"


def percent(values: Sequence[float]) -> str:
    """A mean share in percent; a dash for what was not measured."""
    return f"{fmean(values):.0%}" if values else "-"


def errors_table(view: View, known: Known, sets: Sequence[str], budget: str) -> Table:
    """Steps, held-out error, mean and median on each set beside the paper's mean."""
    columns = {head: head for head in view.heads}
    columns |= {"steps": "steps:>", "held out": "held out:>"}
    for name in sets:
        columns |= {name: f"{name}:>", f"{name} median": f"{name} median:>", f"{name} over 15": f"{name} over 15:>"}
        if name in PAPER_SETS and any(row.paper for row in view.rows):
            columns[f"{name} paper"] = f"{name} paper:.1f"
    rows = []
    for each in view.rows:
        run, record = each.run, known.trained.get(each.run, {})
        words = [word.format(rule=known.rule(run)) for word in each.words]
        row: dict[str, Any] = dict(zip(view.heads, words, strict=True))
        rows.append(row)
        if "skipped" in record:
            row["steps"] = "cannot be"
            continue
        row |= {"steps": record.get("steps", "-"), "held out": number(known.error(run, HELD_OUT))}
        for name in sets:
            row[name] = number(known.error(run, name, each.method))
            row[f"{name} median"] = number(known.error(run, name, each.method, "median_cm"))
            row[f"{name} over 15"] = percent(known.error(run, name, each.method, "share_over_15cm"))
            if each.paper is not None and name in PAPER_SETS:
                row[f"{name} paper"] = each.paper[PAPER_SETS.index(name)]
    return table(f"{view.title}, errors in cm: {budget}", rows, columns)


def cost_table(known: Known) -> Table:
    """Table 4's other half: the cost of a training iteration."""
    rows = []
    for row in VIEWS["table4"].rows:
        constraint, field = row.words
        time, paper = known.times.get(row.run.name), PAPER_MS[field][constraint]
        if time is None:
            continue
        reference, cost = cost_of(known, "mls", constraint), cost_of(known, field, constraint)
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


def cost_of(known: Known, field: str, constraint: str) -> float | None:
    """Milliseconds of an iteration: of the processor, which other work disturbs least; on a GPU on the clock."""
    time = known.times.get(replace(BASE, field=field, constraint=constraint).name)  # type: ignore[arg-type]
    return None if time is None else float(time["cpu_ms" if time["device"] == "cpu" else "ms"])


def tables(known: Known, views: Sequence[str], sets: Sequence[str], budget: str) -> list[Table]:
    """The tables of some views; of table 4 what there is."""
    found = []
    for name in views:
        view = VIEWS[name]
        if name != "table4" or any(run in known.trained for run in view.runs):
            found.append(errors_table(view, known, sets, budget))
        if name == "table4" and known.times:
            found.append(cost_table(known))
    return found
