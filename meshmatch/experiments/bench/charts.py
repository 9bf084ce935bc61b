"""Charts of experiments: horizontal bars in groups or stacked, and lines with bands over axes that may be logarithmic.

Every ``draw_`` function chooses the format and raises as those of `meshmatch.render.charts` do.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from meshmatch.errors import OptionError
from meshmatch.render.charts import COLORS, pen, saved, short

_INK, _BAR = "#34363c", "#9cc3e0"  # the first as in the style


@dataclass(frozen=True)
class Line:
    """A line of a chart: places ``x``, values ``y`` of 0 or more, and half the height of the band around each value
    (``spread``; empty: no band).
    """

    x: Sequence[float]
    y: Sequence[float]
    spread: Sequence[float] = ()


@dataclass(frozen=True)
class Chart:
    """Lines by name over one horizontal axis, whose ``xlabel`` says what it measures, with its unit.

    ``ticks`` are the labelled places (chosen automatically if empty). On a logarithmic axis (``log``) a place of 0 is
    drawn at the left end.
    """

    xlabel: str
    lines: Mapping[str, Line]
    ticks: Sequence[float] = ()
    log: bool = False


@dataclass(frozen=True)
class Bar:
    """A horizontal bar: its name, its length (0 or more), words behind it, whether it is emphasized, and a second
    number (``mark``), drawn as a tick across it.
    """

    name: str
    value: float
    words: str = ""
    strong: bool = False
    mark: float | None = None


def draw_lines(charts: Sequence[Chart], path: str | Path, ylabel: str) -> None:
    """Draw charts side by side over one vertical axis that starts at 0; a name has one color in all of them."""
    pens = {name: pen(k) for k, name in enumerate(dict.fromkeys(n for c in charts for n in c.lines))}
    if not 1 <= len(pens) <= len(COLORS):
        raise OptionError(f"a chart needs 1 to {len(COLORS)} lines, not {len(pens)}")
    for log, line in ((chart.log, line) for chart in charts for line in chart.lines.values()):
        numbers = np.array([*line.x, *line.y, *line.spread], float)
        if not len(line.x) or len(line.x) != len(line.y) or len(line.spread) not in (0, len(line.x)):
            raise OptionError("a line needs as many values as places, and at least one")
        lowest = min([*line.y, *line.spread, *(line.x if log else ())])
        if not np.isfinite(numbers).all() or lowest < 0:
            raise OptionError("a line needs values of 0 or more, and on a logarithmic axis places too")
    with saved(path, max(6.4, 3.2 * len(charts)), 3.6) as figure:
        row = figure.subplots(1, len(charts), sharey=True, squeeze=False)[0]
        for axes, chart in zip(row, charts, strict=True):
            _draw_chart(axes, chart, pens)
        row[0].set_ylabel(short(ylabel))
        row[0].set_ylim(bottom=0)
        handles = {str(line.get_label()): line for axes in row for line in axes.lines if line.get_gid() == "named"}
        columns = max(1, min(len(handles), 88 // (6 + max(map(len, handles)))))
        figure.legend(handles=list(handles.values()), loc="outside upper left", ncols=columns)


def _draw_chart(axes: Any, chart: Chart, pens: Mapping[str, Mapping[str, Any]]) -> None:
    places = np.array([x for line in chart.lines.values() for x in line.x])
    if chart.log:
        positive = places[places > 0]
        smallest = float(positive.min()) if len(positive) else 1.0
        if (places == 0).any():  # linear from 0 to the smallest
            axes.set_xscale("symlog", linthresh=smallest, linscale=0.4)
        else:
            axes.set_xscale("log")
    if len(chart.ticks):
        axes.set_xticks(chart.ticks, [f"{tick:g}" for tick in chart.ticks])
        axes.set_xticks([], minor=True)  # which a logarithmic axis shorter than a decade would name too
    axes.set_xlabel(short(chart.xlabel))
    for name, line in chart.lines.items():
        axes.plot(line.x, line.y, marker="o", clip_on=False, gid="named", label=short(name, 40), **pens[name])
        if len(line.spread):
            low, high = np.maximum(np.subtract(line.y, line.spread), 0), np.add(line.y, line.spread)
            axes.fill_between(line.x, low, high, color=pens[name]["color"], alpha=0.18, linewidth=0)


def draw_bars(groups: Mapping[str, Sequence[Bar]], path: str | Path, axis: str, limit: float | None = None) -> None:
    """Draw groups of horizontal bars, all on one axis from 0.

    Parameters
    ----------
    groups
        Title: its bars, from top to bottom. A group without bars is left out.
    axis
        What the lengths are, with their unit.
    limit
        Right end of the axis; a longer bar is drawn broken off there. By default the largest number.
    """
    groups = {title: bars for title, bars in groups.items() if bars}
    bars = [bar for bars in groups.values() for bar in bars]
    if not bars:
        raise OptionError("there are no bars to draw")
    numbers = [number for bar in bars for number in (bar.value, bar.mark) if number is not None]
    if not np.isfinite(numbers).all() or min(numbers) < 0:
        raise OptionError("a bar needs a number of 0 or more")
    end = (max(numbers) or 1.0) if limit is None else limit
    if not (np.isfinite(end) and end > 0):
        raise OptionError(f"an axis cannot end at {end:g}")
    with saved(path, 7.2, 0.6 + 0.42 * len(groups) + 0.24 * len(bars)) as figure:
        heights = [len(group) for group in groups.values()]
        column = figure.subplots(len(groups), sharex=True, squeeze=False, height_ratios=heights)[:, 0]
        for axes, (title, group) in zip(column, groups.items(), strict=True):
            _draw_group(axes, group, end)
            axes.set_title(short(title, 44))
            axes.spines["bottom"].set_visible(False)
            axes.tick_params(length=0)
            axes.grid(visible=False, axis="y")
        column[-1].set(xlim=(0, end), xlabel=short(axis, 72))


def _draw_group(axes: Any, bars: Sequence[Bar], end: float) -> None:
    rows = range(len(bars))
    lengths = [min(bar.value, end) for bar in bars]
    axes.barh(rows, lengths, height=0.68, color=[COLORS[0] if bar.strong else _BAR for bar in bars])
    axes.set_yticks(rows, [short(bar.name, 36) for bar in bars], color=_INK)
    axes.set_ylim(len(bars) - 0.4, -0.6)
    for row, bar in enumerate(bars):
        reach = min(bar.value, end)
        if bar.value > end:
            for back in (0.015, 0.03):
                slash = ((1 - back - 0.004) * end, (1 - back + 0.004) * end)
                axes.plot(slash, (row + 0.36, row - 0.36), color="white", linewidth=2)
        elif bar.mark is not None:
            axes.plot([min(bar.mark, end)] * 2, (row - 0.34, row + 0.34), color=_INK, linewidth=1.4)
            reach = max(reach, min(bar.mark, end))
        offset: dict[str, Any] = {"xytext": (5, 0), "textcoords": "offset points", "va": "center"}
        axes.annotate(short(bar.words, 28), (reach, row), annotation_clip=False, **offset)


def draw_stack(parts: Mapping[str, float], path: str | Path, axis: str, form: str = "g") -> None:
    """Draw one horizontal bar of parts end to end, with a legend of their names and lengths.

    Parameters
    ----------
    parts
        Name: length (0 or more), from left to right.
    axis
        What the lengths are, with their unit.
    form
        Format of the lengths in the legend.
    """
    lengths = np.array([*parts.values()], float)
    if not (np.isfinite(lengths).all() and (lengths >= 0).all() and lengths.sum() > 0):
        raise OptionError("a stacked bar needs lengths of 0 or more, and one above 0")
    with saved(path, 7.2, 1.25 + 0.22 * np.ceil(len(parts) / 3)) as figure:
        axes = figure.subplots()
        lefts = np.cumsum(lengths) - lengths
        for number, (name, length) in enumerate(parts.items()):
            rounds, color = divmod(number, len(COLORS) - 1)
            label = f"{short(name, 30)}  {length:{form}}"
            axes.barh(0, length, left=lefts[number], color="white")  # no grid behind what is paler in later rounds
            axes.barh(0, length, left=lefts[number], color=COLORS[color], alpha=0.5**rounds, ec="white", label=label)
        axes.set(xlim=(0, lengths.sum()), xlabel=short(axis, 72), yticks=[])
        axes.grid(visible=False, axis="y")
        figure.legend(loc="outside upper left", ncols=3)
