"""How the verbs speak: words for people on stderr, data on stdout."""

import json
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from meshmatch.errors import OutputError
from meshmatch.outputs import plain_text

if TYPE_CHECKING:
    import rich.console

# What is going on, on which shape, and which share (0..1) of it is done.
Report = Callable[[str, str, float], None]


@dataclass(frozen=True)
class Console:
    """Words on stderr. With ``quiet`` only warnings and errors are heard."""

    quiet: bool = False

    def say(self, text: str) -> None:
        """A line about what was done."""
        if not self.quiet:
            self._line("", text)

    def warn(self, text: str) -> None:
        """A line that nobody should miss."""
        self._line("warning", text)

    def trouble(self, what: str, message: str, hint: str = "") -> None:
        """What went wrong, in a line, and what to do about it."""
        self._line(what, message)
        if hint:
            self._line("hint", hint)

    @contextmanager
    def progress(self) -> Iterator[Report]:
        """A bar for each shape, drawn while the block runs and gone afterwards; nothing if nobody watches."""
        console = _terminal()
        if self.quiet or not console.is_terminal:
            yield lambda what, name, share: None
            return
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

        columns = (
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            TextColumn("{task.fields[what]}", markup=False),
            TimeElapsedColumn(),
        )
        with Progress(*columns, console=console, transient=True) as bars:
            rows: dict[str, Any] = {}

            def report(what: str, name: str, share: float) -> None:
                if name not in rows:
                    rows[name] = bars.add_task(name, total=1.0, what=what)
                bars.update(rows[name], completed=share, what=what)

            yield report

    def _line(self, label: str, text: str) -> None:
        from rich.text import Text

        color = {"error": "bold red", "warning": "bold yellow", "hint": "dim"}.get(label, "bold")
        words = Text(f"{label}: ", style=color) if label else Text()
        _terminal().print(words.append(plain_text(text), style="default"), soft_wrap=True, highlight=False)


def _terminal() -> "rich.console.Console":
    from rich.console import Console as Terminal

    return Terminal(stderr=True)  # made anew: it then follows a stderr that was redirected since


def print_json(record: Mapping[str, Any]) -> None:
    """One JSON object on one line of stdout."""
    line = json.dumps(record, ensure_ascii=False)
    try:
        line.encode(_coding())
    except UnicodeEncodeError:  # a terminal without these letters, or a file's name that is not UTF-8
        line = json.dumps(record)
    print_text(line + "\n")


def print_rows(rows: Sequence[Sequence[str]]) -> None:
    """Text on stdout, one row a line, columns flush."""
    widths = [max(len(cell) for cell in column) for column in zip(*rows, strict=True)]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in rows]
    print_text("".join(line.rstrip() + "\n" for line in lines))


def print_text(text: str) -> None:
    """Text on stdout; letters that it cannot show as their numbers.

    Raises
    ------
    OutputError
        Stdout is closed, or the disk behind it is full.
    """
    coding = _coding()
    try:
        if sys.stdout is None:
            raise OSError(9, "it is closed")
        sys.stdout.write(text.encode(coding, "backslashreplace").decode(coding))
        sys.stdout.flush()
    except BrokenPipeError:
        raise  # whoever read it has read enough
    except OSError as error:
        raise OutputError(f"cannot write to stdout: {error.strerror}", "is the disk full?") from error


def _coding() -> str:
    return getattr(sys.stdout, "encoding", None) or "utf-8"
