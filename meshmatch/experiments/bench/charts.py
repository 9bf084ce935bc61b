"""Charts of experiments: lines with bands over axes that may be logarithmic; and pictures above each other."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from meshmatch.errors import OptionError
from meshmatch.outputs import replace_on_success
from meshmatch.render.charts import COLORS, pen, saved
from meshmatch.render.figures import Panel
from meshmatch.render.picture import Look, render_shapes
from meshmatch.render.scales import short

_WIDEST = 1400  # pixels of a picture


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


def draw_lines(charts: Sequence[Chart], path: str | Path, ylabel: str) -> None:
    """Draw charts side by side over one vertical axis that starts at 0; a name has one color in all of them.

    Formats and errors are those of `meshmatch.render.charts`.
    """
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


def stacked(rows: Sequence[tuple[Sequence[Panel], Look]], path: Path) -> None:
    """Rows of panels above each other in one picture, as wide as the widest."""
    with tempfile.TemporaryDirectory() as folder:
        images = []
        for number, (panels, look) in enumerate(rows):
            part = Path(folder) / f"{number}.png"
            render_shapes(panels, part, look)
            with Image.open(part) as drawn:
                images.append(drawn.convert("RGB"))
    width = max(image.width for image in images)
    whole = Image.new("RGB", (width, sum(image.height for image in images)), (255, 255, 255))
    top = 0
    for image in images:
        whole.paste(image, ((width - image.width) // 2, top))
        top += image.height
    if width > _WIDEST:
        whole = whole.resize((_WIDEST, round(whole.height * _WIDEST / width)), Image.Resampling.LANCZOS)
    with replace_on_success(path) as temporary:
        whole.save(temporary, format="PNG", compress_level=9)
