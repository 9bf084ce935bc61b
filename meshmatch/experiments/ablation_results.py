"""The paper's tables, figures and claims, read off what is known of the ablation runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
from rich.table import Table

from meshmatch.experiments.ablation_views import (
    BASE,
    CLAIMS,
    GRID,
    HELD_OUT,
    PAPER_MS,
    PAPER_SETS,
    TABLE4,
    VIEWS,
    Known,
    View,
)
from meshmatch.experiments.charts import Bar, Chart, Line, draw_bars, draw_lines
from meshmatch.experiments.runner import table
from meshmatch.fields.shape_functions import FIELDS, has_nodes
from meshmatch.outputs import make_folder

_AXIS = "mean error, cm (1.9 square meters of skin)"


def number(values: Sequence[float]) -> str:
    """A mean, and half of what several seeds lie apart; a dash for what was not measured."""
    if not values:
        return "-"
    words = f"{fmean(values):.2f}"
    return words if len(values) == 1 else f"{words} ± {(max(values) - min(values)) / 2:.2f}"


def errors_table(view: View, known: Known, sets: Sequence[str], budget: str) -> Table:
    """Steps, held-out error, mean and median on each set beside the paper's mean, and after refining nodes."""
    columns = {head: head for head in view.heads} | {"steps": "steps:>", "held out": "held out:>"}
    for name in sets:
        columns |= {name: f"{name}:>", f"{name} median": f"{name} median:>"}
        if name in PAPER_SETS and any(row.paper for row in view.rows):
            columns[f"{name} paper"] = f"{name} paper:.1f"
        if view.nodes:
            columns[f"{name} nodes"] = f"{name} nodes:>"
    rows = []
    for each in view.rows:
        run, record = each.run, known.trained.get(each.run, {})
        words = [word.format(rule=record.get("rule", run.strategy)) for word in each.words]
        row: dict[str, Any] = dict(zip(view.heads, words, strict=True))
        rows.append(row)
        if "skipped" in record:
            row["steps"] = "cannot be"
            continue
        row |= {"steps": record.get("steps", "-"), "held out": number(known.error(run, HELD_OUT))}
        for name in sets:
            row[name] = number(known.error(run, name, each.method))
            row[f"{name} median"] = number(known.error(run, name, each.method, "median_cm"))
            row[f"{name} nodes"] = number(known.error(run, name, "nodes"))
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
                "megabytes": known.memory.get(row.run.name, {}).get("megabytes"),
            }
        )
    columns = {"constraint": "constraint", "field": "field", "CPU ms": "cpu_ms:.1f", "ms": "ms:.1f"}
    columns |= {"times mls": "slow:.1f", "paper's ms": "paper:.1f", "paper's times": "paper_slow:.1f"}
    return table("Table 4, cost of a training iteration", rows, columns | {"MB": "megabytes:.0f"})


def cost_of(known: Known, field: str, constraint: str) -> float | None:
    """Milliseconds of an iteration: of the processor, which other work disturbs least; on a GPU on the clock."""
    time = known.times.get(replace(BASE, field=field, constraint=constraint).name)  # type: ignore[arg-type]
    return None if time is None else float(time["cpu_ms" if time["device"] == "cpu" else "ms"])


def tables(known: Known, views: Sequence[str], sets: Sequence[str], budget: str) -> list[Table]:
    """The tables of some views; of table 4 what there is."""
    found = []
    for name in views:
        view = VIEWS[name]
        if view.heads and (name != "table4" or any(run in known.trained for run in view.runs)):
            found.append(errors_table(view, known, sets, budget))
        if name == "table4" and known.times:
            found.append(cost_table(known))
    return found


def draw_views(known: Known, views: Sequence[str], sets: Sequence[str], folder: Path) -> list[Path]:
    """Draw the views of which something is known; the files that were written."""
    make_folder(folder)
    written = []
    for name in views:
        path = folder / f"{name.replace('table', 'table-').replace('figure', 'figure-')}.png"
        view = VIEWS[name]
        if name == "figure6":
            drawn = _draw_descent(known, path)
        else:
            drawn = (_draw_lines if view.across else _draw_bars)(view, known, sets, path)
        if drawn:
            written.append(path)
    return written


def _draw_bars(view: View, known: Known, sets: Sequence[str], path: Path) -> bool:
    """Bars in a group for each set; those of the base in the strong color."""
    groups: dict[str, list[Bar]] = {}
    for where in (HELD_OUT, *sets):
        how = "the network alone" if where == HELD_OUT else "after the search over codes"
        for row in view.rows:
            errors = known.error(row.run, where)
            if errors and row.method == "code":
                words = ", ".join(
                    f"{head} {word.format(rule=row.run.strategy)}"
                    for head, word in zip(view.heads, row.words, strict=True)
                )
                bar = Bar(words, fmean(errors), f"{number(errors)} cm", row.run == BASE)
                groups.setdefault(f"{where}, {how}", []).append(bar)
    if groups:
        draw_bars(groups, path, _AXIS)
    return bool(groups)


def _draw_lines(view: View, known: Known, sets: Sequence[str], path: Path) -> bool:
    """A line for the held-out bodies and each set."""
    lines = {}
    for where in (HELD_OUT, *sets):
        there = [(float(row.words[0]), known.error(row.run, where)) for row in view.rows]
        there = [(at, errors) for at, errors in there if errors]
        if there:
            half = [(max(errors) - min(errors)) / 2 for _, errors in there]
            lines[where] = Line([at for at, _ in there], [fmean(errors) for _, errors in there], half)
    if lines:
        ticks = [float(row.words[0]) for row in view.rows]
        draw_lines([Chart(view.heads[0], lines, ticks, True)], path, _AXIS)
    return bool(lines)


def _draw_descent(known: Known, path: Path) -> bool:
    """Error against steps, and against seconds; bands are the standard error over the bodies."""
    if known.descent is None:
        return False
    steps, seconds = {}, {}
    for name, line in known.descent["lines"].items():
        errors = np.array(line["errors_cm"])
        middle, off = errors.mean(1).tolist(), (errors.std(1) / np.sqrt(errors.shape[1])).tolist()
        steps[name] = Line(line["steps"], middle, off)
        seconds[name] = Line([0.0, *line["seconds"][1:]], middle, off)
    places = [x for line in seconds.values() for x in line.x]
    least = min(x for x in places if x > 0)
    ticks = [10.0**power for power in range(-3, 4) if 0.5 * least <= 10.0**power <= 2 * max(places)]
    charts = [
        Chart("steps of refinement", steps, (0, 1, 3, 10, 30, 100, 300), True),
        Chart("seconds of refinement of a body (processor)", seconds, (0.0, *ticks), True),
    ]
    draw_lines(charts, path, _AXIS)
    return True


@dataclass(frozen=True)
class Claim:
    """A statement, the numbers that it is about from the one that should be least to the largest, and whether it holds.

    ``holds`` is None where something was not measured; ``where`` is empty, a set, or "held out".
    """

    words: str
    numbers: tuple[float, ...]
    holds: bool | None
    where: str = ""

    @property
    def verdict(self) -> str:
        """Whether it holds, in words."""
        if self.holds is None:
            return "not measured"
        numbers = ", ".join(f"{value:.2f}" for value in self.numbers)
        return f"{'holds' if self.holds else 'DOES NOT HOLD'} ({numbers})"


def claims(known: Known, sets: Sequence[str]) -> list[Claim]:
    """All claims, on the held-out shapes and each set."""
    found = _costs(known)
    for where in (HELD_OUT, *sets):
        for words, runs in CLAIMS:
            found.append(_rising(where, words, [known.error(run, where) for run in runs]))
        found.append(_best_of_grid(known, where))
        if where != HELD_OUT:
            hows = ("code", "chamfer", "none")
            alike = [  # what is measured once is not compared
                run
                for run in known.trained
                if replace(run, seed=BASE.seed) == BASE and all((run, where, how) in known.errors for how in hows)
            ]
            errors = [[known.errors[run, where, how]["mean_cm"] for run in alike] for how in hows]
            found.append(_rising(where, "refined with regularisers < by Chamfer alone < not at all", errors))
    return found


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
        found.append(Claim(words, there, there[0] <= 2 if there else None))
    both = tuple(factor[field] for field in ("mls", "pointwise") if field in factor)
    words = "vol+arap+Z slows an iteration of mls by less than one of pointwise"
    found.append(Claim(words, both, both[0] < both[1] if len(both) == 2 else None))
    dear_ones = tuple(cost for cost in (full["mls"], full["pointwise"]) if cost)
    words = "with vol+arap+Z an iteration of pointwise takes at least 3 times as long as one of mls"
    holds = dear_ones[1] > 3 * dear_ones[0] if len(dear_ones) == 2 else None
    return [*found, Claim(words, dear_ones, holds)]


def _best_of_grid(known: Known, where: str) -> Claim:
    means = {run: fmean(errors) for run in GRID if (errors := known.error(run, where))}
    words = "300 nodes of radius 0.2 are the best of the grid"
    if BASE not in means or len(means) < 2:
        return Claim(words, (), None, where)
    others = min(value for run, value in means.items() if run != BASE)
    return Claim(words, (means[BASE], others), means[BASE] <= others, where)


def _rising(where: str, words: str, errors: Sequence[Sequence[float]]) -> Claim:
    """Holds if the means rise; not measured if one lacks."""
    means = tuple(fmean(each) for each in errors if each)
    holds = all(a < b for a, b in pairwise(means)) if len(means) == len(errors) else None
    return Claim(words, means, holds, where)
