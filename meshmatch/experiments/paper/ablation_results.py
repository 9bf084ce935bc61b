"""The paper's tables and figures, read off what is known of the ablation runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

import numpy as np
from rich.table import Table

from meshmatch.experiments.bench.charts import Chart, Line, draw_lines
from meshmatch.experiments.paper.ablation_views import BASE, HELD_OUT, PAPER_MS, PAPER_SETS, VIEWS, Known, View
from meshmatch.experiments.runner import table
from meshmatch.outputs import make_folder

_AXIS = "mean error, cm (1.9 square meters of skin)"


def number(values: Sequence[float]) -> str:
    """A mean, and the standard deviation of several seeds; a dash for what was not measured."""
    if not values:
        return "-"
    words = f"{fmean(values):.2f}"
    return words if len(values) == 1 else f"{words} ± {stdev(values):.2f}"


def errors_table(view: View, known: Known, sets: Sequence[str], budget: str) -> Table:
    """Steps, held-out error, mean and median on each set beside the paper's mean, and after refining nodes."""
    columns = {head: head for head in view.heads}
    columns |= {"steps": "steps:>", "held out": "held out:>"}
    for name in sets:
        columns |= {name: f"{name}:>", f"{name} median": f"{name} median:>"}
        if name in PAPER_SETS and any(row.paper for row in view.rows):
            columns[f"{name} paper"] = f"{name} paper:.1f"
        if view.nodes and any(known.error(row.run, name, "nodes") for row in view.rows):
            columns[f"{name} nodes"] = f"{name} nodes:>"
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
        if view.heads and (name != "table4" or any(run in known.trained for run in view.runs)):
            found.append(errors_table(view, known, sets, budget))
        if name == "table4" and known.times:
            found.append(cost_table(known))
    return found


def draw_views(known: Known, views: Sequence[str], sets: Sequence[str], folder: Path) -> list[Path]:
    """Draw the figures of which something is known; the files that were written."""
    make_folder(folder)
    written = []
    for name in views:
        path = folder / f"{name.replace('figure', 'figure-')}.png"
        view = VIEWS[name]
        drawn = (
            _draw_descent(known, path) if name == "figure6" else view.across and _draw_lines(view, known, sets, path)
        )
        if drawn:
            written.append(path)
    return written


def _draw_lines(view: View, known: Known, sets: Sequence[str], path: Path) -> bool:
    """A chart for the held-out bodies and each set, with a line for each method."""
    charts, ticks = [], sorted({float(row.words[0]) for row in view.rows})
    for where in (HELD_OUT, *sets):
        lines = {}
        for method in dict.fromkeys(row.words[-1] for row in view.rows):
            there = [(float(row.words[0]), known.error(row.run, where)) for row in view.rows if row.words[-1] == method]
            there = [(at, errors) for at, errors in there if errors]
            if there:
                off = [stdev(errors) if len(errors) > 1 else 0.0 for _, errors in there]
                points = [at for at, _ in there], [fmean(errors) for _, errors in there]
                lines[method] = Line(*points, off)
        if lines:
            charts.append(Chart(f"{view.heads[0]}, {where}", lines, ticks, True))
    if charts:
        draw_lines(charts, path, _AXIS)
    return bool(charts)


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
