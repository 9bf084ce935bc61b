"""Output files, checked before the work begins."""

import os
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from meshmatch.errors import OptionError
from meshmatch.outputs import replace_on_success


def check_outputs(
    inputs: Iterable[Path | None], *outputs: Path | None, picture: Path | None = None, chart: Path | None = None
) -> None:
    """Refuse, before the work, what could not be written after it. What is None is not wanted.

    `OptionError` if the picture is no PNG, the chart of an unknown kind, or anything would replace an input or another
    output; `OutputError` if picture or chart cannot be written. (Other outputs are claimed while the work is done.)
    """
    check_chart(chart)
    if picture is not None and picture.suffix.lower() != ".png":
        raise OptionError(f"{picture.name}: a picture is a PNG", "end the name in .png")
    taken = {os.path.realpath(path): "is an input of this command" for path in inputs if path is not None}
    for path in (*outputs, chart, picture):
        if path is None:
            continue
        real = os.path.realpath(path)  # Path.resolve refuses links that lead in a circle
        if real in taken:
            raise OptionError(f"cannot write {path}: it {taken[real]}", "choose another name for the output")
        taken[real] = "is an output of this command already"
    for path in (chart, picture):
        check_writable(path)


def check_chart(path: Path | None) -> None:
    """Refuse a chart that is not .png, .svg or .pdf, or that cannot be drawn (`OptionError`)."""
    if path is not None:
        from meshmatch.render import charts

        charts.check_chart(path)


def check_writable(path: Path | None) -> None:
    """Refuse a file that cannot be written (`OutputError`), long before it is."""
    if path is not None:
        with suppress(_Enough), replace_on_success(path):
            raise _Enough


class _Enough(Exception):
    """The file can be made."""
