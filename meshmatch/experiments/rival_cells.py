"""A rival on a set: one cell of the comparison, kept as a file; all cells as a table and as a plot."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from meshmatch.experiments.bench import Matcher, run_set
from meshmatch.experiments.cell_files import keep, recall
from meshmatch.experiments.distances import default_folder
from meshmatch.experiments.protocols import BenchSet, Pair
from meshmatch.experiments.report import circumstances, wide_console
from meshmatch.maps.evaluate import LOST_CM, SKIN_M2
from meshmatch.maps.geodesics import GEODESIC
from meshmatch.render.charts import Bar, draw_bars


@dataclass(frozen=True)
class Rival:
    """One row of the comparison.

    Parameters
    ----------
    name : str
        Of its cells' files.
    label : str
        For people.
    matcher : Matcher, optional
        None where it cannot run.
    missing : str
        Why it cannot run.
    minutes : float, optional
        How long it was trained; None for a method that learns nothing.
    model : str
        What tells its weights from others.
    """

    name: str
    label: str
    matcher: Matcher | None
    missing: str = ""
    minutes: float | None = None
    model: str = ""


def measured(
    rival: Rival,
    bench: BenchSet,
    pairs: Sequence[Pair],
    folder: Path,
    *,
    jobs: int = 1,
    threads: int = 1,
    cache: Path | None = None,
    late: bool = False,
    console: Console | None = None,
) -> dict[str, Any] | None:
    """One cell: read from the folder, or measured and written there; None if it is not there and it is too late.

    Raises
    ------
    OptionError
        The folder holds this cell of other choices.
    InputError
        The file in the folder is no cell.
    """
    assert rival.matcher is not None
    path = folder / f"{bench.name}-{rival.name}.json"
    asked = {
        "rival": rival.name,
        "set": bench.name,
        "pairs": [list(pair) for pair in pairs],
        "settings": {key: str(value) for key, value in vars(rival.matcher).items()},
        "model": rival.model,
    }
    before = recall(path, asked)
    if before is not None or late:
        return before
    began = time.perf_counter()
    kept = cache or default_folder()
    run = run_set(bench, rival.matcher, pairs=pairs, cache=kept, jobs=jobs, threads=threads, console=console)
    record = run.as_dict()
    record.pop("fits")
    found = {
        **circumstances(threads, jobs),
        "of": len(bench.pairs),
        "training_minutes": rival.minutes,
        "seconds": round(time.perf_counter() - began, 1),
        "scores": record,
    }
    return keep(path, asked, found)


Cells = dict[str, dict[str, dict[str, Any]]]
"""By set, then by rival: what `measured` found, or {"skipped": why}."""


def print_cells(cells: Cells, rivals: Sequence[Rival], console: Console | None = None) -> None:
    """A row for each rival on each set, skipped ones among them."""
    console = console or wide_console()
    table = Table(
        title=f"Geodesic error, cm at {SKIN_M2} m2 of skin ({GEODESIC})",
        title_justify="left",
        box=SIMPLE_HEAD,
    )
    table.add_column("set", no_wrap=True)
    table.add_column("rival", no_wrap=True)
    for name in (
        "pairs",
        "failed",
        "mean",
        "median",
        f"over {LOST_CM:g}",
        "flips",
        "fit s",
        "pair s",
        "trained",
    ):
        table.add_column(name, justify="right", no_wrap=True)
    skipped: dict[str, list[str]] = {}
    for number, (name, row) in enumerate(cells.items()):
        if number:
            table.add_section()
        for rival in rivals:
            found = row[rival.name]
            if "skipped" in found:
                table.add_row(name, rival.label, "skipped")
                skipped.setdefault(f"{rival.label}: {found['skipped']}", []).append(name)
                continue
            scores = found["scores"]
            table.add_row(
                *(name, rival.label, f"{scores['pairs']} of {found['of']}", f"{len(scores['failed'])}"),
                *(f"{scores['mean_cm']:.2f}", f"{scores['median_cm']:.2f}"),
                *(f"{100 * scores['share_over_15cm']:.1f} %", f"{100 * scores['flips']:.0f} %"),
                *(_seconds(scores, "fit_seconds_mean"), _seconds(scores, "map_seconds_mean")),
                "" if found["training_minutes"] is None else f"{found['training_minutes']:g} min",
            )
    console.print(table)
    for words, sets in skipped.items():
        console.print(f"skipped on {', '.join(sets)}: {words}", markup=False, soft_wrap=True)
    every = [found for row in cells.values() for found in row.values() if "scores" in found]
    if any(found["scores"]["pairs"] < found["of"] for found in every):
        console.print("[yellow]Not all pairs were measured: these means are not the benchmark's.[/]")


def _seconds(scores: Mapping[str, Any], name: str) -> str:
    return f"{scores[name]:.2f}" if name in scores else ""


def draw_cells(cells: Cells, rivals: Sequence[Rival], path: Path) -> None:
    """Mean errors as bars, with medians as ticks, a group for each set; where pairs failed a bar may run off the axis."""
    groups: dict[str, list[Bar]] = {}
    for name, row in cells.items():
        shown = [(rival, row[rival.name]) for rival in rivals if "scores" in row[rival.name]]
        bars = []
        for rival, found in shown:
            scores, words = found["scores"], f"{found['scores']['mean_cm']:.1f} cm"
            words += f", {len(scores['failed'])} failed" if scores["failed"] else ""
            strong = rival.name.startswith("ours")
            bars.append(Bar(rival.label, scores["mean_cm"], words, strong, scores["median_cm"]))
        if shown:
            scores = shown[0][1]["scores"]
            groups[f"{name}: {scores['pairs']} of {shown[0][1]['of']} pairs"] = bars
    whole = [bar for bars in groups.values() for bar in bars if "failed" not in bar.words]
    longest = max((max(bar.value, bar.mark or 0.0) for bar in whole), default=0.0)
    axis = "mean geodesic error, cm (target scaled to 1.9 m² of skin); tick: median"
    draw_bars(groups, path, axis, 1.1 * longest or None)
