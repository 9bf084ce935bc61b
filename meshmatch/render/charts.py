"""Charts by matplotlib (extra ``plots``) as PNG, SVG or PDF: the same numbers give the same bytes.

Every ``draw_`` function chooses the format by the suffix of ``path``. It raises `OptionError` for another suffix, where
matplotlib is missing and for numbers that cannot be drawn, and `OutputError` where the file cannot be written.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from meshmatch.errors import OptionError
from meshmatch.maps.evaluate import CM_PER_UNIT, Errors
from meshmatch.outputs import replace_on_success
from meshmatch.render.lettering import readable

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's colors, which color-blind readers can tell apart.
COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")
_DASHES = ("-", "--", ":")  # one for each round through the colors
_INK, _GREY, _GRID, _BAR = "#34363c", "#70747c", "#e6e7ea", "#9cc3e0"  # the first three as in the style
# The dates and versions that a format would record, left out.
_METADATA: dict[str, dict[str, None]] = {
    ".png": {"Software": None},
    ".svg": {"Date": None, "Creator": None},
    ".pdf": {"CreationDate": None, "Creator": None, "Producer": None},
}
_MOST_TERMS = 12
_STYLE = Path(__file__).with_name("charts.mplstyle")
# What the error axis counts: units in one sqrt(area), the unit's name, the words under the axis.
_UNITS = {
    "cm": (CM_PER_UNIT, "cm", "geodesic error (cm, target scaled to 1.9 m² of skin)"),
    "x100": (100.0, "x 0.01", "geodesic error (0.01 of the square root of the target's area)"),
}


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
    drawn at the left end. ``marks`` are places with a name: vertical lines.
    """

    xlabel: str
    lines: Mapping[str, Line]
    ticks: Sequence[float] = ()
    log: bool = False
    marks: Mapping[float, str] = field(default_factory=dict)


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


def check_chart(path: str | Path) -> None:
    """Refuse a file name that is not .png, .svg or .pdf, or a missing matplotlib (`OptionError`)."""
    if Path(path).suffix.lower() not in _METADATA:
        raise OptionError(f"{Path(path).name}: unsupported chart format", "end the name in .png, .svg or .pdf")
    if find_spec("matplotlib") is None:
        raise OptionError("charts need matplotlib", "pip install 'meshmatch[plots]'")


def draw_curves(
    curves: Mapping[str, Errors], path: str | Path, limit: float = 20.0, *, unit: Literal["cm", "x100"] = "cm"
) -> None:
    """Draw cumulative error curves, at least one: the share of points (vertical) with at most this error.

    ``limit`` is the right end of the axis in ``unit``: centimeters on a target scaled to 1.9 m² (a person's skin), or
    hundredths of sqrt(area).
    """
    if not curves or not limit > 0 or unit not in _UNITS:
        raise OptionError(f"a curve needs errors, a positive limit and a unit of {', '.join(_UNITS)}")
    factor, short, xlabel = _UNITS[unit]
    with _saved(path, 6.0, 4.0) as figure:
        axes = figure.subplots()
        at = np.linspace(0.0, limit, 801)
        for number, (name, errors) in enumerate(curves.items()):
            mean, median = errors.mean * factor, errors.median * factor
            label = f"{_short(name)}: mean {mean:.2f} {short}, median {median:.2f} {short}"
            axes.plot(at, 100 * errors.curve(at / factor), label=label, **_pen(number))
        axes.set(xlim=(0, limit), ylim=(0, 101), xlabel=xlabel, ylabel="share of points")
        axes.yaxis.set_major_formatter("{x:.0f} %")
        axes.legend(loc="lower right", frameon=True, edgecolor=_GRID, framealpha=0.92)


def draw_lines(charts: Sequence[Chart], path: str | Path, ylabel: str) -> None:
    """Draw charts side by side over one vertical axis that starts at 0; a name has one color in all of them."""
    pens = {name: _pen(k) for k, name in enumerate(dict.fromkeys(n for c in charts for n in c.lines))}
    if not 1 <= len(pens) <= len(COLORS):
        raise OptionError(f"a chart needs 1 to {len(COLORS)} lines, not {len(pens)}")
    for log, line in ((chart.log, line) for chart in charts for line in chart.lines.values()):
        numbers = np.array([*line.x, *line.y, *line.spread], float)
        if not len(line.x) or len(line.x) != len(line.y) or len(line.spread) not in (0, len(line.x)):
            raise OptionError("a line needs as many values as places, and at least one")
        lowest = min([*line.y, *line.spread, *(line.x if log else ())])
        if not np.isfinite(numbers).all() or lowest < 0:
            raise OptionError("a line needs values of 0 or more, and on a logarithmic axis places too")
    with _saved(path, 6.4, 3.6) as figure:
        row = figure.subplots(1, len(charts), sharey=True, squeeze=False)[0]
        for axes, chart in zip(row, charts, strict=True):
            _draw_chart(axes, chart, pens)
        row[0].set_ylabel(_short(ylabel))
        row[0].set_ylim(bottom=0)
        handles = {str(line.get_label()): line for axes in row for line in axes.lines if line.get_gid() == "named"}
        columns = max(1, min(len(handles), 88 // (6 + max(map(len, handles)))))
        figure.legend(handles=list(handles.values()), loc="outside upper left", ncols=columns)


def _draw_chart(axes: Axes, chart: Chart, pens: Mapping[str, Mapping[str, Any]]) -> None:
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
    axes.set_xlabel(_short(chart.xlabel))
    for name, line in chart.lines.items():
        axes.plot(line.x, line.y, marker="o", clip_on=False, gid="named", label=_short(name, 40), **pens[name])
        if len(line.spread):
            low, high = np.maximum(np.subtract(line.y, line.spread), 0), np.add(line.y, line.spread)
            axes.fill_between(line.x, low, high, color=pens[name]["color"], alpha=0.18, linewidth=0)
    for place, name in chart.marks.items():
        axes.axvline(place, color=_GREY, linewidth=0.9, zorder=1)
        # Names at the sides stay inside the chart.
        share = (place - places.min()) / max(float(np.ptp(places)), 1e-9)
        side = "left" if share < 0.2 else "right" if share > 0.8 else "center"
        offset: dict[str, Any] = {"xytext": (0, 4), "textcoords": "offset points"}
        axes.annotate(_short(name, 30), (place, 1), xycoords=("data", "axes fraction"), ha=side, color=_GREY, **offset)


def draw_losses(
    path: str | Path, steps: Sequence[int], terms: Mapping[str, Sequence[float]], validation: Mapping[int, float]
) -> None:
    """Draw the losses of a training over its steps on logarithmic axes: the total and the validation error large, the
    other terms small below.

    Parameters
    ----------
    steps
        (N,) increasing.
    terms
        Name: (N,) values. What is not positive or not finite is left out.
    validation
        Step: the error on held-out shapes; drawn as dots joined by a line.
    """
    lines = {name: _positive(steps, values) for name, values in list(terms.items())[:_MOST_TERMS]}
    lines["validation"] = _positive(sorted(validation), [validation[step] for step in sorted(validation)])
    lines = {name: line for name, line in lines.items() if len(line[0])}
    if not lines:
        raise OptionError("the training has no losses to draw", "train for more steps")
    large = [name for name in ("validation", "total") if name in lines]
    groups = [group for group in (large, [name for name in lines if name not in large]) if group]
    pens = {name: _pen(k) for k, name in enumerate(name for group in groups for name in group)}
    with _saved(path, 6.4, 3.4 + 1.6 * (len(groups) - 1)) as figure:
        column = figure.subplots(len(groups), sharex=True, squeeze=False, height_ratios=(2, 1)[: len(groups)])[:, 0]
        for axes, group in zip(column, groups, strict=True):
            for name in group:
                above = name == "validation"
                pen = pens[name] | {"linewidth": 1.9 if above else 1.2, "zorder": 3 if above else 2}
                dot = "o" if above or len(lines[name][0]) == 1 else ""
                axes.plot(*lines[name], marker=dot, label=_short(name, 24), **pen)
            axes.set_yscale("log")
            _label_few_decades(axes)
            axes.legend(loc="upper left", bbox_to_anchor=(1, 1), fontsize=9.5 if len(group) < 6 else 6.5)
        column[0].set_ylabel("loss")
        if len(groups) == 2:
            column[1].set_ylabel("terms of the loss")
        column[-1].set_xlabel("step")
        column[-1].xaxis.set_major_formatter("{x:,.0f}")


def _positive(x: Sequence[float], y: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    at, values = np.asarray(x, float), np.asarray(y, float)
    kept = np.isfinite(values) & (values > 0)
    return at[kept], values[kept]


def _label_few_decades(axes: Axes) -> None:
    """Plain numbers on a logarithmic axis, also between its powers of ten where they are few."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    low, high = np.log10(axes.get_ylim())
    between = (1.0, 2.0, 5.0) if high - low < 2 else (1.0, 3.0) if high - low < 4 else (1.0,)
    axes.yaxis.set_major_locator(LogLocator(subs=between, numticks=12))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.3g}"))


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
    with _saved(path, 7.2, 0.6 + 0.42 * len(groups) + 0.24 * len(bars)) as figure:
        heights = [len(group) for group in groups.values()]
        column = figure.subplots(len(groups), sharex=True, squeeze=False, height_ratios=heights)[:, 0]
        for axes, (title, group) in zip(column, groups.items(), strict=True):
            _draw_group(axes, group, end)
            axes.set_title(_short(title, 44))
            axes.spines["bottom"].set_visible(False)
            axes.tick_params(length=0)
            axes.grid(visible=False, axis="y")
        column[-1].set(xlim=(0, end), xlabel=_short(axis, 72))


def _draw_group(axes: Axes, bars: Sequence[Bar], end: float) -> None:
    rows = range(len(bars))
    lengths = [min(bar.value, end) for bar in bars]
    axes.barh(rows, lengths, height=0.68, color=[COLORS[0] if bar.strong else _BAR for bar in bars])
    axes.set_yticks(rows, [_short(bar.name, 36) for bar in bars], color=_INK)
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
        axes.annotate(_short(bar.words, 28), (reach, row), annotation_clip=False, **offset)


@contextmanager
def _saved(path: str | Path, width: float, height: float) -> Iterator[Figure]:
    """An empty figure (inches), which is written to ``path`` when the block ends well.

    Styles are set for the block alone, over matplotlib's own defaults, whatever the user's matplotlibrc says.
    """
    check_chart(path)
    import matplotlib
    from matplotlib.figure import Figure

    suffix = Path(path).suffix.lower()
    with matplotlib.rc_context(), replace_on_success(path) as temporary:
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(matplotlib.rc_params_from_file(_STYLE, use_default_template=False))
        figure = Figure((width, height), layout="constrained")
        yield figure
        figure.savefig(temporary, format=suffix[1:], metadata=_METADATA[suffix])


def _pen(number: int) -> dict[str, Any]:
    rounds, color = divmod(number, len(COLORS))
    return {"color": COLORS[color], "linestyle": _DASHES[rounds % len(_DASHES)]}


def _short(text: str, most: int = 60) -> str:
    """The text on one line in letters that a font has, cut in the middle if it is too long."""
    text = readable(text)
    return text if len(text) <= most else f"{text[: most // 2]}…{text[-(most // 2 - 1) :]}"
