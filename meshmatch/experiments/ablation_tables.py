"""The paper's tables 4 to 7, and the numbers of its figures 8 to 10, read off cells."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from statistics import fmean

from rich.box import SIMPLE_HEAD
from rich.table import Table

from meshmatch.experiments.ablation_cells import GRID, POSES, SHAPES, SUPERVISED, TABLE4, Known
from meshmatch.experiments.cells import BASE, Cell
from meshmatch.fields.choice import FIELDS
from meshmatch.templates.nodes import STRATEGIES

PAPER_MS = {
    "pointwise": {"none": 32.0, "vol+arap": 250.4, "vol+arap+Z": 4098.3},
    "rbf": {"none": 8.0, "vol+arap": 8.2, "vol+arap+Z": 12.6},
    "mls": {"none": 7.8, "vol+arap": 8.0, "vol+arap+Z": 12.1},
}
"""Milliseconds of an iteration in the paper's table 4, on an A100."""

# The paper's errors in cm on SHREC'19 and SCAPE PC+N.
_PAPER4 = {
    "pointwise": {"none": (7.4, 13.7), "vol+arap": (7.1, 12.6), "vol+arap+Z": (9.1, 14.8)},
    "rbf": {"none": (8.5, 9.9), "vol+arap": (8.0, 9.1), "vol+arap+Z": (8.1, 9.3)},
    "mls": {"none": (7.7, 9.8), "vol+arap": (5.2, 7.0), "vol+arap+Z": (4.8, 6.6)},
}
_PAPER5 = {"none": (7.7, 9.8), "arap": (6.9, 10.2), "vol": (7.3, 8.7), "vol+arap": (5.2, 7.0)}
_PAPER5_TEST = {"none": (7.9, 12.5), "chamfer": (5.0, 6.7), "code": (4.8, 6.6)}
_PAPER6 = dict(
    zip(
        GRID,
        (
            (6.8, 8.2),
            (4.8, 6.6),
            (5.4, 7.6),
            (5.4, 7.0),
            (6.4, 8.7),
            (6.5, 8.8),
            (6.2, 9.8),
            (6.5, 9.6),
            (6.5, 10.1),
        ),
        strict=True,
    )
)
_PAPER7 = {
    ("parts", "T"): (4.8, 6.6), ("parts", "A"): (5.1, 7.4),
    ("spectral", "T"): (4.8, 6.6), ("spectral", "A"): (5.1, 7.3),
    ("geodesic", "T"): (5.0, 6.9), ("geodesic", "A"): (5.2, 7.4),
    ("uniform", "T"): (5.1, 6.9), ("uniform", "A"): (5.9, 9.5),
}  # fmt: skip
_PAPER_SETS = ("shrec19", "scape-pcn")
TEST_WORDS = {"none": "no refinement", "chamfer": "Chamfer alone", "code": "Chamfer, volume, arap"}


@dataclass(frozen=True)
class Row:
    """A row: words, the cell, the paper's errors on `_PAPER_SETS`, and the refinement."""

    words: tuple[str, ...]
    cell: Cell
    paper: tuple[float, float] | None = None
    method: str = "code"


def number(values: Sequence[float]) -> str:
    """A mean, and half of what several seeds lie apart; a dash for what was not measured."""
    if not values:
        return "-"
    words = f"{fmean(values):.2f}"
    return words if len(values) == 1 else f"{words} ± {(max(values) - min(values)) / 2:.2f}"


def drawn(
    title: str, heads: Sequence[str], rows: Sequence[Row], known: Known, sets: Sequence[str], nodes: bool
) -> Table:
    """A table: steps, held-out error, mean and median on each set beside the paper's mean, and after refining nodes."""
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD)
    printed = any(row.paper is not None for row in rows)
    for head in heads:
        table.add_column(head, no_wrap=True)
    for head in ("steps", "held out"):
        table.add_column(head, justify="right")
    for name in sets:
        table.add_column(name, justify="right", no_wrap=True)
        table.add_column("median", justify="right")
        if name in _PAPER_SETS and printed:
            table.add_column("paper", justify="right", style="dim")
        if nodes:
            table.add_column("nodes", justify="right")
    for row in rows:
        record = known.trained.get(row.cell, {})
        cells = [*row.words]
        if "skipped" in record:
            table.add_row(*cells, "cannot be", "")
            continue
        cells += [str(record.get("steps", "-")), number(known.error(row.cell, "held out"))]
        for name in sets:
            cells += [
                number(known.error(row.cell, name, row.method, what)) for what in ("mean_cm", "median_cm")
            ]
            if name in _PAPER_SETS and printed:
                cells.append("" if row.paper is None else f"{row.paper[_PAPER_SETS.index(name)]:.1f}")
            if nodes:
                cells.append(number(known.error(row.cell, name, "nodes")))
        table.add_row(*cells)
    return table


def table4(known: Known, sets: Sequence[str], budget: str) -> list[Table]:
    """Representations: errors, then cost."""
    cells = [
        (each, field, replace(BASE, field=field, constraint=each)) for each in TABLE4 for field in FIELDS
    ]
    rows = [Row((each, field), cell, _PAPER4[field][each]) for each, field, cell in cells]
    tables = []
    if any(cell in known.trained for _, _, cell in cells):
        tables.append(
            drawn(f"Table 4, errors in cm: {budget}", ("constraint", "field"), rows, known, sets, True)
        )
    if known.times:
        cost = Table(title="Table 4, cost of a training iteration", title_justify="left", box=SIMPLE_HEAD)
        for head in ("constraint", "field"):
            cost.add_column(head)
        for head in ("CPU ms", "ms", "times mls", "paper's ms", "paper's times", "MB"):
            cost.add_column(head, justify="right")
        slow = ratios(known)
        for each, field, cell in cells:
            if cell.name not in known.times:
                continue
            time, paper = known.times[cell.name], PAPER_MS[field][each]
            memory = known.memory.get(cell.name, {}).get("megabytes")
            cost.add_row(
                *(each, field, f"{time['cpu_ms']:.1f}", f"{time['ms']:.1f}"),
                f"{slow[cell.name]:.1f}" if cell.name in slow else "",
                *(f"{paper:.1f}", f"{paper / PAPER_MS['mls'][each]:.1f}"),
                "-" if memory is None else f"{memory:.0f}",
            )
        tables.append(cost)
    return tables


def ratios(known: Known) -> dict[str, float]:
    """How many times as slow as moving least squares with the same constraints each timed cell is (see `cost_of`)."""
    slow = {}
    for constraint in TABLE4:
        reference = cost_of(known, replace(BASE, constraint=constraint))
        for field in FIELDS:
            cell = replace(BASE, field=field, constraint=constraint)
            cost = cost_of(known, cell)
            if reference and cost:
                slow[cell.name] = round(cost / reference, 2)
    return slow


def cost_of(known: Known, cell: Cell) -> float | None:
    """Milliseconds of an iteration: of the processor, which other work disturbs least; on a GPU on the clock."""
    time = known.times.get(cell.name)
    if time is None:
        return None
    return float(time["cpu_ms" if time["device"] == "cpu" else "ms"])


def table5(known: Known, sets: Sequence[str], budget: str) -> list[Table]:
    """Regularisers in training and at test time."""
    rows = [Row(("training", each), replace(BASE, constraint=each), paper) for each, paper in _PAPER5.items()]
    rows.append(Row(("training", "vol+arap+Z"), BASE, (4.8, 6.6)))
    rows += [Row(("test time", TEST_WORDS[how]), BASE, paper, how) for how, paper in _PAPER5_TEST.items()]
    return [drawn(f"Table 5, errors in cm: {budget}", ("when", "regularisers"), rows, known, sets, False)]


def table6(known: Known, sets: Sequence[str], budget: str) -> list[Table]:
    """Nodes and radius; the kernel."""
    rows = []
    for (K, r), paper in _PAPER6.items():
        cell = replace(BASE, nodes=K, radius=r)
        rows.append(Row((str(K), f"{r:g}", _rule(known, cell), "smooth"), cell, paper))
    cubic = replace(BASE, kernel="cubic")
    rows.append(Row(("300", "0.2", _rule(known, cubic), "cubic"), cubic))
    heads = ("K", "r", "nodes by", "kernel")
    return [drawn(f"Table 6, errors in cm: {budget}", heads, rows, known, sets, False)]


def table7(known: Known, sets: Sequence[str], budget: str) -> list[Table]:
    """How nodes are chosen."""
    rows = [
        Row((how, pose), replace(BASE, strategy=how, pose=pose), _PAPER7[how, pose])
        for how in STRATEGIES
        for pose in POSES[:2]
    ]
    return [drawn(f"Table 7, errors in cm: {budget}", ("nodes by", "template"), rows, known, sets, False)]


def figure8(known: Known, sets: Sequence[str], budget: str) -> list[Table]:
    """The template's pose."""
    rows = [Row((pose,), replace(BASE, pose=pose)) for pose in POSES]
    return [drawn(f"Figure 8, errors in cm: {budget}", ("template",), rows, known, sets, False)]


def figure9(known: Known, sets: Sequence[str], budget: str) -> list[Table]:
    """How many shapes there are to learn from."""
    rows = [Row((str(count),), replace(BASE, shapes=count)) for count in SHAPES]
    return [drawn(f"Figure 9, errors in cm: {budget}", ("training shapes",), rows, known, sets, False)]


def figure10(known: Known, sets: Sequence[str], budget: str) -> list[Table]:
    """On how many points the right place is told."""
    rows = [Row((str(count),), replace(BASE, supervised=count)) for count in SUPERVISED]
    return [drawn(f"Figure 10, errors in cm: {budget}", ("supervised points",), rows, known, sets, False)]


def _rule(known: Known, cell: Cell) -> str:
    return str(known.trained.get(cell, {}).get("rule", cell.strategy))


TABLES: dict[str, Callable[[Known, Sequence[str], str], list[Table]]] = {
    "table4": table4,
    "table5": table5,
    "table6": table6,
    "table7": table7,
    "figure8": figure8,
    "figure9": figure9,
    "figure10": figure10,
}
