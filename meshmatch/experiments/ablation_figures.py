"""The paper's figures 6, 8, 9 and 10, and its tables as bars, drawn from what is known of cells."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import fmean

import numpy as np

from meshmatch.experiments.ablation_cells import GRID, POSES, SHAPES, SUPERVISED, TABLE4, Known
from meshmatch.experiments.ablation_tables import number
from meshmatch.experiments.cells import BASE, Cell
from meshmatch.fields.choice import FIELDS
from meshmatch.outputs import make_folder
from meshmatch.render.charts import Bar, Chart, Line, draw_bars, draw_lines
from meshmatch.templates.nodes import STRATEGIES

HELD_OUT = "held out"
_FIELD_WORDS = {
    "mls": "moving least squares",
    "rbf": "radial basis functions",
    "pointwise": "network at every point",
}
_AXIS = "mean error, cm (1.9 square metres of skin)"


def draw_views(known: Known, views: Sequence[str], sets: Sequence[str], folder: Path) -> list[Path]:
    """Draw the views of which something is known; the files that were written."""
    written = []
    for view in views:
        path = folder / f"{view.replace('table', 'table-').replace('figure', 'figure-')}.png"
        if _DRAWERS[view](known, sets, path):
            written.append(path)
    return written


def _bars(known: Known, sets: Sequence[str], path: Path, cells: Sequence[tuple[str, Cell]]) -> bool:
    """Bars of cells in a group for each set; those of the base in the strong colour."""
    groups = {}
    for where in (HELD_OUT, *sets):
        bars = []
        for words, cell in cells:
            errors = known.error(cell, where)
            if errors:
                bars.append(Bar(words, fmean(errors), f"{number(errors)} cm", cell == BASE))
        groups[_words(where)] = bars
    if not any(groups.values()):
        return False
    make_folder(path.parent)
    draw_bars(groups, path, _AXIS)
    return True


def _words(where: str) -> str:
    return (
        "held-out bodies, the network alone" if where == HELD_OUT else f"{where}, after the search over codes"
    )


def _table4(known: Known, sets: Sequence[str], path: Path) -> bool:
    cells = [
        (f"{_FIELD_WORDS[field]}, {each}", replace(BASE, field=field, constraint=each))
        for each in TABLE4
        for field in FIELDS
    ]
    return _bars(known, sets, path, cells)


def _table5(known: Known, sets: Sequence[str], path: Path) -> bool:
    constraints = ("none", "arap", "vol", "vol+arap", "vol+arap+Z")
    return _bars(known, sets, path, [(each, replace(BASE, constraint=each)) for each in constraints])


def _table6(known: Known, sets: Sequence[str], path: Path) -> bool:
    cells = [(f"{K} nodes, radius {r:g}", replace(BASE, nodes=K, radius=r)) for K, r in GRID]
    cells.append(("300 nodes, radius 0.2, cubic kernel", replace(BASE, kernel="cubic")))
    return _bars(known, sets, path, cells)


def _table7(known: Known, sets: Sequence[str], path: Path) -> bool:
    cells = [
        (f"{how}, template {pose}", replace(BASE, strategy=how, pose=pose))
        for how in STRATEGIES
        for pose in POSES[:2]
    ]
    return _bars(known, sets, path, cells)


def _figure8(known: Known, sets: Sequence[str], path: Path) -> bool:
    return _bars(known, sets, path, [(f"template {pose}", replace(BASE, pose=pose)) for pose in POSES])


def _against(
    known: Known, sets: Sequence[str], path: Path, across: str, cells: Sequence[tuple[float, Cell]]
) -> bool:
    """A line for the held-out bodies and each set."""
    lines = {}
    for where in (HELD_OUT, *sets):
        there = [(at, known.error(cell, where)) for at, cell in cells]
        there = [(at, errors) for at, errors in there if errors]
        if there:
            half = tuple((max(errors) - min(errors)) / 2 for _, errors in there)
            middle = tuple(fmean(errors) for _, errors in there)
            lines[where] = Line(tuple(at for at, _ in there), middle, half)
    if not lines:
        return False
    make_folder(path.parent)
    draw_lines([Chart(across, lines, tuple(at for at, _ in cells), True)], path, _AXIS)
    return True


def _figure9(known: Known, sets: Sequence[str], path: Path) -> bool:
    cells = [(float(count), replace(BASE, shapes=count)) for count in SHAPES]
    return _against(known, sets, path, "training shapes", cells)


def _figure10(known: Known, sets: Sequence[str], path: Path) -> bool:
    cells = [(float(count), replace(BASE, supervised=count)) for count in SUPERVISED]
    return _against(known, sets, path, "supervised points of a shape", cells)


def _figure6(known: Known, sets: Sequence[str], path: Path) -> bool:
    """Error against steps, and against seconds; bars are the standard error over the bodies."""
    if known.descent is None:
        return False
    steps, seconds = {}, {}
    for name, line in known.descent["lines"].items():
        errors = np.array(line["errors_cm"])
        middle = tuple(errors.mean(1).tolist())
        off = tuple((errors.std(1) / np.sqrt(errors.shape[1])).tolist())
        steps[name] = Line(tuple(float(each) for each in line["steps"]), middle, off)
        seconds[name] = Line(tuple(line["seconds"][:1] and (0.0, *line["seconds"][1:])), middle, off)
    most = max(max(series.x) for series in seconds.values())
    least = min(x for series in seconds.values() for x in series.x if x > 0)
    ticks = [10.0**power for power in range(-3, 4) if 0.5 * least <= 10.0**power <= 2 * most]
    panels = [
        Chart("steps of refinement", steps, (0, 1, 3, 10, 30, 100, 300), True),
        Chart("seconds of refinement of a body (processor)", seconds, (0.0, *ticks), True),
    ]
    make_folder(path.parent)
    draw_lines(panels, path, _AXIS)
    return True


_DRAWERS: dict[str, Callable[[Known, Sequence[str], Path], bool]] = {
    "table4": _table4,
    "table5": _table5,
    "table6": _table6,
    "table7": _table7,
    "figure6": _figure6,
    "figure8": _figure8,
    "figure9": _figure9,
    "figure10": _figure10,
}
