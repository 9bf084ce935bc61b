"""How a benchmark speaks: a table for people, and the circumstances that belong to every number."""

from __future__ import annotations

import datetime
import json
import os
import platform
import subprocess
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from meshmatch.errors import MeshmatchError
from meshmatch.experiments.scores import SetScores
from meshmatch.maps.evaluate import LOST_CM, SKIN_M2
from meshmatch.maps.geodesics import GEODESIC


def print_table(sets: Sequence[SetScores], worst: int = 5, console: Console | None = None) -> None:
    """Print a row for each set, and one for each kind of pair in it; then each set's worst pairs."""
    console = console or wide_console()
    table = Table(title=f"Geodesic error, cm at {SKIN_M2} m2 of skin ({GEODESIC})", title_justify="left")
    table.add_column("set")
    columns = ("pairs", "mean", "median", "median pair", f"over {LOST_CM:g} cm", "flips", "worst pair")
    for name in columns:
        table.add_column(name, justify="right")
    for whole in sets:
        for scores in (whole, *whole.groups()):
            joined, means = scores.joined, list(scores.means_cm.values())
            part = len(scores.errors) < scores.expected
            table.add_row(
                f"  {scores.group}" if scores.group else scores.bench.name,
                f"{len(means)} of {scores.expected}" if part else f"{len(means)}",
                f"{joined.mean_cm:.2f}",
                f"{joined.median_cm:.2f}",
                f"{np.median(means):.2f}",
                f"{100 * joined.share_over(LOST_CM):.2f} %",
                f"{100 * scores.flips:.1f} %",
                f"{means[0]:.2f}",
            )
    console.print(table)
    for whole in sets:
        listed = list(whole.means_cm.items())[:worst]
        words = ", ".join(f"{source} -> {target} {mean:.1f}" for (source, target), mean in listed)
        console.print(f"{whole.bench.name}, worst pairs (mean, cm): {words}", soft_wrap=True)
    if any(len(each.errors) < each.expected for each in sets):
        console.print("[yellow]Not all pairs were measured: these means are not the benchmark's.[/]")


def wide_console() -> Console:
    """Stdout for a table: a pipe has no width of its own, and rich would fold the table to 80 columns."""
    return Console(width=None if os.isatty(1) else 120, highlight=False)


def columns(title: str, left: Sequence[str], right: Sequence[str]) -> Table:
    """An empty table: columns of words, then of numbers."""
    table = Table(title=title, title_justify="left")
    for name in left:
        table.add_column(name)
    for name in right:
        table.add_column(name, justify="right")
    return table


def publish(
    benchmark: str, table: Table, record: Mapping[str, Any], *, threads: int, jobs: int = 1
) -> dict[str, Any]:
    """Print a benchmark's table and, last, its JSON line; the line's record, circumstances in it, is returned."""
    wide_console().print(table)
    whole = {"benchmark": benchmark, **circumstances(threads, jobs), **record}
    print(json.dumps(whole), flush=True)
    return whole


def status_of(work: Callable[[], object]) -> int:
    """0 when a benchmark ran; 1, with words on stderr, when the data or a choice stopped it."""
    try:
        work()
    except MeshmatchError as error:
        explain(error)
        return 1
    return 0


def explain(error: MeshmatchError) -> None:
    """Say on stderr what stopped a benchmark."""
    console = Console(stderr=True)
    console.print(f"[red]error:[/] {escape(error.message)}", highlight=False)
    if error.hint:
        console.print(f"[dim]hint:[/] {escape(error.hint)}", highlight=False)


def circumstances(threads: int, jobs: int) -> dict[str, Any]:
    """Date, commit, machine and threads, as every published number needs them."""
    return {
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "commit": commit(),
        "machine": f"{_processor()}, {os.cpu_count()} cores, {platform.system()}",
        "python": platform.python_version(),
        "threads": threads,
        "jobs": jobs,
    }


def commit(folder: Path = Path(__file__).parent) -> str:
    """Short hash of the checked-out commit, with "+" if tracked files were changed; "unknown" without git."""
    try:
        answers = [
            subprocess.run(
                ["git", *words], cwd=folder, capture_output=True, text=True, check=True
            ).stdout.strip()
            for words in (
                ["rev-parse", "--short=10", "HEAD"],
                ["status", "--porcelain", "--untracked-files=no"],
            )
        ]
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return answers[0] + ("+" if answers[1] else "")


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()
