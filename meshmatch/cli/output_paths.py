"""Output files, claimed before the work begins."""

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from meshmatch.errors import OptionError
from meshmatch.outputs import replace_on_success


@contextmanager
def claimed(path: Path | None) -> Iterator[Path | None]:
    """`replace_on_success` for an output that may not be wanted."""
    if path is None:
        yield None
        return
    with replace_on_success(path) as temporary:
        yield temporary


def check_distinct(outputs: Iterable[Path | None], inputs: Iterable[Path | None]) -> None:
    """Refuse an output that would replace an input, or another output (`OptionError`)."""
    taken = {os.path.realpath(path): "is an input of this command" for path in inputs if path is not None}
    for path in outputs:
        if path is None:
            continue
        real = os.path.realpath(path)  # Path.resolve refuses links that lead in a circle
        if real in taken:
            raise OptionError(f"cannot write {path}: it {taken[real]}", "choose another name for the output")
        taken[real] = "is an output of this command already"


def check_png(path: Path | None) -> None:
    """Refuse a picture that is not a PNG (`OptionError`)."""
    if path is not None and path.suffix.lower() != ".png":
        raise OptionError(f"{path.name}: a picture is a PNG", "end the name in .png")


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
