"""Charts with matplotlib (extra ``plots``) as PNG, SVG or PDF; the same numbers give the same bytes.

Every ``draw_`` function chooses the format by the suffix of ``path``. It raises `OptionError` for another suffix, if
matplotlib is missing, and for numbers that cannot be drawn; `OutputError` if the file cannot be written.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any
from unicodedata import category

import numpy as np

from meshmatch.arrays import Floats, UInts8
from meshmatch.errors import OptionError
from meshmatch.maps.evaluate import CM, Errors, ErrorUnit
from meshmatch.outputs import replace_on_success
from meshmatch.render import scales

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's palette, which color-blind readers can tell apart.
COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")
_DASHES = ("-", "--", ":")  # one for each pass through the colors
_GREY, _GRID = "#70747c", "#e6e7ea"  # as in the style file
# Metadata with dates and versions that must be left out of each format.
_METADATA: dict[str, dict[str, None]] = {
    ".png": {"Software": None},
    ".svg": {"Date": None, "Creator": None},
    ".pdf": {"CreationDate": None, "Creator": None, "Producer": None},
}
_MAX_TERMS, _MAX_BARS, _MAX_GROUPS = 12, 20, 14
_END_SIZE = 58.0  # points: longest side of the largest picture at the end of an axis
_MIN_FLATNESS = 0.75  # smallest height over width of a chart whose dots lie along a line
_MARKERS = "os^Dv"  # one for each pass through the colors
_STYLE = Path(__file__).with_name("charts.mplstyle")


def check_chart(path: str | Path) -> None:
    """Raise `OptionError` for a file name that is not .png, .svg or .pdf, or if matplotlib is missing."""
    if Path(path).suffix.lower() not in _METADATA:
        raise OptionError(f"{Path(path).name}: unsupported chart format", "end the name in .png, .svg or .pdf")
    if find_spec("matplotlib") is None:
        raise OptionError("charts need matplotlib", "pip install 'meshmatch[plots]'")


def draw_curves(curves: Mapping[str, Errors], path: str | Path, limit: float = 20.0, *, unit: ErrorUnit = CM) -> None:
    """Draw cumulative error curves: the share of points (vertical) with at most this error, up to ``limit`` in ``unit``."""
    if not curves or not limit > 0:
        raise OptionError("a curve needs errors and a positive limit")
    factor = unit.factor
    with saved_figure(path, 6.0, 4.0) as figure:
        axes = figure.subplots()
        at = np.linspace(0.0, limit, 801)
        for number, (name, errors) in enumerate(curves.items()):
            mean, median = errors.mean * factor, errors.median * factor
            label = f"{short(name)}: mean {mean:.3g}, median {median:.3g}"
            axes.plot(at, 100 * errors.curve(at / factor), label=label, **pen(number))
        axes.set(xlim=(0, limit), ylim=(0, 101), xlabel=f"geodesic error ({unit.words})", ylabel="share of points")
        axes.yaxis.set_major_formatter("{x:.0f} %")
        axes.legend(loc="lower right", frameon=True, edgecolor=_GRID, framealpha=0.92)


def draw_lines(
    lines: Mapping[str, tuple[Sequence[float], Sequence[float]]],
    path: str | Path,
    xlabel: str,
    ylabel: str,
    marks: Mapping[float, str],
) -> None:
    """Draw lines by name: x, and y of 0 or more. ``marks`` are named vertical lines at some x."""
    with saved_figure(path, 6.4, 3.6) as figure:
        axes = figure.subplots()
        _draw_lines(axes, lines, 40)
        _draw_marks(axes, marks, np.concatenate([x for x, _ in lines.values()]))
        axes.set(xlabel=short(xlabel), ylabel=short(ylabel))
        figure.legend(loc="outside upper left", ncols=max(1, min(len(lines), 88 // (6 + max(map(len, lines))))))


def draw_panels(
    charts: Mapping[str, tuple[str, Mapping[str, tuple[Sequence[float], Sequence[float]]]]],
    path: str | Path,
    xlabel: str,
) -> None:
    """Draw charts side by side. Each has a title, a label of its vertical axis, and lines by name: x, and y of 0 or more."""
    with saved_figure(path, 3.4 * len(charts), 3.2) as figure:
        row = figure.subplots(1, len(charts), squeeze=False)[0]
        for axes, (title, (ylabel, lines)) in zip(row, charts.items(), strict=True):
            _draw_lines(axes, lines, 30)
            axes.set(xlabel=short(xlabel), ylabel=short(ylabel), title=short(title, 40))
            axes.locator_params(axis="x", nbins=6, integer=True)
            if len(lines) > 1:
                axes.legend(loc="best")


def draw_histogram(
    path: str | Path, values: Sequence[float], xlabel: str, ylabel: str, marks: Mapping[float, str]
) -> None:
    """Draw a histogram of numbers of 0 or more, with a tick for each. ``marks`` are named vertical lines."""
    with saved_figure(path, 6.4, 3.2) as figure:
        axes = figure.subplots()
        axes.hist(values, bins="auto", range=(0, max(values)), color=COLORS[0], alpha=0.75, edgecolor="white")
        axes.plot(values, [0] * len(values), "|", color=COLORS[-1], markersize=9, alpha=0.5, clip_on=False)
        _draw_marks(axes, marks, np.asarray(values))
        axes.set(xlabel=short(xlabel), ylabel=short(ylabel), xlim=(0, None))
        axes.locator_params(axis="y", nbins=6, integer=True)


@dataclass(frozen=True, eq=False)
class Dots:
    """Coordinates (N,) of dots in a chart, labels of its axes, and names of some of the dots.

    ``ends`` are named pictures (H, W, 4), at one scale, for the low and the high end of the first axis, then of the second.
    """

    x: Sequence[float]
    y: Sequence[float]
    xlabel: str
    ylabel: str
    names: Mapping[int, str] = field(default_factory=dict)
    ends: Sequence[tuple[str, UInts8]] = ()


def draw_scree(path: str | Path, shares: Sequence[float], most: int) -> None:
    """Draw the shares of the variance that modes explain, and those of the broken-stick model: a stick that breaks into
    ``most`` pieces at random. Modes above it explain more than chance.
    """
    count = min(len(shares), _MAX_BARS)
    sticks = np.cumsum(1 / np.arange(most, 0, -1))[::-1] / most
    with saved_figure(path, 4.8, 3.2) as figure:
        axes = figure.subplots()
        axes.bar(range(1, count + 1), 100 * np.array(shares[:count]), color=COLORS[0], label="modes")
        known = sticks[:count]
        axes.plot(range(1, len(known) + 1), 100 * known, "o-", color=COLORS[1], label="broken stick")
        axes.set(xlabel="mode", ylabel="share of the variance", xlim=(0.3, count + 0.7))
        axes.yaxis.set_major_formatter("{x:.0f} %")
        axes.locator_params(axis="x", integer=True)
        axes.legend(loc="upper right")


def draw_dots(
    path: str | Path, charts: Sequence[Dots], groups: Sequence[str], *, hulls: bool, grouped_by: str = ""
) -> None:
    """Draw charts of dots side by side, each dot in the color of its group ("" for none), with the convex hull of each
    group, or its regression line. ``grouped_by`` is the title of the groups in the legend.
    """
    known = sorted({group for group in groups if group})
    members = {group: np.flatnonzero(np.array(groups) == group) for group in [*known, *([""] if "" in groups else [])]}
    room = _END_SIZE / 72 if any(dots.ends for dots in charts) else 0.0
    flat = max((_flatness(dots) for dots in charts), default=1.0) if hulls else 1.0
    with saved_figure(path, (4.2 + room) * len(charts) + 1.2, 3.8 * flat + 1.6 * room) as figure:
        row = figure.subplots(1, len(charts), squeeze=False)[0]
        for axes, dots in zip(row, charts, strict=True):
            points = np.column_stack([dots.x, dots.y])
            for number, (group, rows) in enumerate(members.items()):
                rounds, color = divmod(number, len(COLORS))
                ink = COLORS[color] if group or not known else _GREY
                marker = _MARKERS[rounds % len(_MARKERS)]
                about: dict[str, Any] = {"color": ink, "markersize": 5, "alpha": 0.85}
                axes.plot(*points[rows].T, marker, label=short(group, 24) or "others", **about)
                outline = _outline(points[rows]) if hulls else _regression(points[rows])
                if outline is not None and (group or not known):
                    axes.plot(*outline.T, color=ink, linewidth=1.1)
                    if hulls:
                        axes.fill(*outline.T, color=ink, alpha=0.12, linewidth=0)
            low, high = points.min(axis=0), points.max(axis=0)
            span = np.full(2, (high - low).max()) if hulls else high - low
            named: list[Floats] = []
            for number, name in dots.names.items():
                at = (points[number] - low) / np.maximum(span, 1e-300)
                below = any(np.abs(at - other).max() < 0.08 for other in named)  # keeps neighbouring names apart
                named.append(at)
                about = {"textcoords": "offset points", "color": _GREY, "fontsize": 7.5}
                about |= {"ha": "right" if at[0] > 0.5 else "left"}
                axes.annotate(short(name, 24), points[number], (-4 if at[0] > 0.5 else 4, -11 if below else 4), **about)
            axes.set(xlabel=short(dots.xlabel), ylabel=short(dots.ylabel))
            if dots.ends:  # pictures are next to the labels
                axes.xaxis.label.set_size(8.5)
                axes.yaxis.label.set_size(8.5)
            _draw_ends(axes, dots.ends)
            if hulls:  # both axes have the same scale
                reach = 0.55 * float((high - low).max()) or 1.0
                middle, height = (low + high) / 2, flat * reach
                axes.set(xlim=middle[0] + [-reach, reach], ylim=middle[1] + [-height, height], box_aspect=flat)
        if len(members) > 1:
            handles, labels = row[0].get_legend_handles_labels()
            shown = handles[:_MAX_GROUPS], labels[:_MAX_GROUPS]
            figure.legend(*shown, loc="outside right upper", title=short(grouped_by, 24) or None)


def _flatness(dots: Dots) -> float:
    """Height over width, at most 1, of a chart whose axes have the same scale."""
    across, up = float(np.ptp(dots.x)), float(np.ptp(dots.y))
    return min(1.0, max(_MIN_FLATNESS, up / across)) if across > 0 else 1.0


def _draw_ends(axes: Axes, ends: Sequence[tuple[str, UInts8]]) -> None:
    """Draw pictures at the ends of both axes, outside of them, next to the axis labels."""
    from matplotlib.offsetbox import AnnotationBbox, OffsetImage, TextArea, VPacker

    most = max((max(picture.shape[:2]) for _, picture in ends), default=1)
    for number, (name, picture) in enumerate(ends):
        second, high = divmod(number, 2)
        image = OffsetImage(picture, zoom=_END_SIZE / most)
        words = TextArea(short(name, 24), textprops={"color": _GREY, "fontsize": 7.5})
        box = VPacker(children=[image, words], align="center", pad=0, sep=2)
        # Next to the axis label, so that the numbers at the axis keep the room that they need.
        across: Any = ((1, high), (axes.yaxis.label, "axes fraction"), (1, high))
        along: Any = ((high, 1), ("axes fraction", axes.xaxis.label), (high, 1))
        place, coordinates, alignment = across if second else along
        axes.add_artist(AnnotationBbox(box, place, xycoords=coordinates, box_alignment=alignment, frameon=False, pad=0))


def _outline(points: Floats) -> Floats | None:
    """The convex hull of points (N, 2), as a closed line; None if it has no area."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        corners = ConvexHull(points).vertices
    except (QhullError, ValueError):  # a point, or a line
        return None
    return np.asarray(points[[*corners, corners[0]]])


def _regression(points: Floats) -> Floats | None:
    """Both ends of the regression line; None if there is none."""
    x = points[:, 0]
    if len(points) < 3 or not np.ptp(x) > 0:
        return None
    slope, start = np.polyfit(x, points[:, 1], 1)
    ends = np.array([x.min(), x.max()])
    return np.column_stack([ends, slope * ends + start])


def draw_losses(
    path: str | Path, steps: Sequence[int], terms: Mapping[str, Sequence[float]], validation: Mapping[int, float]
) -> None:
    """Draw the losses of a training over its steps (N,) on logarithmic axes.

    The upper, larger chart has the validation error (on held-out shapes, at some steps) and the training error, or the total
    where there is none; the lower has the other terms. ``terms`` are (N,) values by name; values that are not positive and
    finite are left out.
    """
    known = {name: list(zip(steps, values, strict=True)) for name, values in list(terms.items())[:_MAX_TERMS]}
    known["validation"] = sorted(validation.items())
    positive = {name: [point for point in points if 0 < point[1] < np.inf] for name, points in known.items()}
    lines = {name: np.array(points, float).T for name, points in positive.items() if points}
    if not lines:
        raise OptionError("the training has no losses to draw", "train for more steps")
    main = next((name for name in ("error", "error_corrected", "error_code") if name in lines), "total")
    large = [name for name in ("validation", main) if name in lines]
    groups = [group for group in (large, [name for name in lines if name not in large]) if group]
    pens = {name: pen(k) for k, name in enumerate(name for group in groups for name in group)}
    with saved_figure(path, 6.4, 3.4 + 1.6 * (len(groups) - 1)) as figure:
        from matplotlib.ticker import LogLocator

        column = figure.subplots(len(groups), sharex=True, squeeze=False, height_ratios=(2, 1)[: len(groups)])[:, 0]
        for axes, group in zip(column, groups, strict=True):
            for name in group:
                above = name == "validation"
                weight = {"linewidth": 1.9 if above else 1.2, "zorder": 3 if above else 2}
                dot = "o" if above or len(lines[name][0]) == 1 else ""
                axes.plot(*lines[name], marker=dot, label=short(name, 24), **pens[name], **weight)
            axes.set_yscale("log")
            # Plain numbers as ticks, also between powers of ten where these are few.
            low, high = np.log10(axes.get_ylim())
            between = (1.0, 2.0, 5.0) if high - low < 2 else (1.0, 3.0) if high - low < 4 else (1.0,)
            axes.yaxis.set_major_locator(LogLocator(subs=between, numticks=12))
            axes.minorticks_off()
            axes.yaxis.set_major_formatter(lambda value, _: f"{value:.3g}")
            axes.legend(loc="upper left", bbox_to_anchor=(1, 1), fontsize=9.5 if len(group) < 6 else 6.5)
        column[0].set_ylabel("loss" if main == "total" else "error")
        if len(groups) == 2:
            column[1].set_ylabel("terms of the loss")
        column[-1].set_xlabel("step")
        column[-1].xaxis.set_major_formatter("{x:,.0f}")


def _draw_lines(axes: Axes, lines: Mapping[str, tuple[Sequence[float], Sequence[float]]], longest: int) -> None:
    """Draw lines with a dot at each point; the vertical axis begins at 0."""
    for number, (name, (x, y)) in enumerate(lines.items()):
        axes.plot(x, y, marker="o", clip_on=False, label=short(name, longest), **pen(number))
    axes.set_ylim(bottom=0)


def _draw_marks(axes: Axes, marks: Mapping[float, str], places: Floats) -> None:
    """Draw named vertical lines; names stay inside the chart of these places."""
    for place, name in marks.items():
        axes.axvline(place, color=_GREY, linewidth=0.9, zorder=1)
        share = (place - places.min()) / max(float(np.ptp(places)), 1e-9)
        side = "left" if share < 0.2 else "right" if share > 0.8 else "center"
        at: dict[str, Any] = {"xycoords": ("data", "axes fraction"), "textcoords": "offset points"}
        axes.annotate(short(name, 30), (place, 1), (0, 4), ha=side, color=_GREY, **at)


def short(text: str, most: int = 60) -> str:
    """The text on one line, as by `scales.short`, in the letters of the charts' font."""
    return scales.short(text, most, _has_glyph)


@lru_cache(maxsize=4096)
def _has_glyph(letter: str) -> bool:
    from matplotlib.font_manager import FontProperties, findfont, get_font

    return (
        not category(letter).startswith("C") and get_font(findfont(FontProperties())).get_char_index(ord(letter)) != 0
    )


@contextmanager
def saved_figure(path: str | Path, width: float, height: float) -> Iterator[Figure]:
    """An empty figure (size in inches), saved when the block succeeds. Inside the block our style replaces the user's."""
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


def pen(number: int) -> dict[str, Any]:
    """Color and line style of the line with this number."""
    rounds, color = divmod(number, len(COLORS))
    return {"color": COLORS[color], "linestyle": _DASHES[rounds % len(_DASHES)]}
