"""How the verbs speak: words for people on stderr, data on stdout."""

import json
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from meshmatch.errors import OutputError
from meshmatch.outputs import plain_text
from meshmatch.progress import ProgressCallback

if TYPE_CHECKING:
    import rich.console

Json = dict[str, Any]
"""One JSON object; paths become strings."""
_QUIET = 10.0  # seconds without a word, where nobody watches a bar


@dataclass(frozen=True)
class Console:
    """Words on stderr. With ``quiet`` only warnings and errors are heard."""

    quiet: bool = False
    _open: list["tuple[rich.console.Console, ProgressCallback]"] = field(default_factory=list)

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
    def progress(self) -> Iterator[ProgressCallback]:
        """A bar for each shape, drawn while the block runs and gone afterwards; in a log, a line every ten seconds."""
        if self._open:  # the bars of a block around this one
            yield self._open[0][1]
            return
        console = _terminal()
        if self.quiet or not console.is_terminal:
            yield (lambda stage, name, share: None) if self.quiet else self._lines()
            return
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

        name, what = (TextColumn(f"{{task.{text}}}", markup=False) for text in ("description", "fields[what]"))
        with Progress(name, BarColumn(), what, TimeElapsedColumn(), console=console, transient=True) as bars:
            rows: dict[str, Any] = {}

            def report(stage: str, name: str, share: float) -> None:
                if name not in rows:
                    rows[name] = bars.add_task(name, total=1.0, what=stage)
                bars.update(rows[name], completed=share, what=stage)

            self._open.append((console, report))
            try:
                yield report
            finally:
                self._open.clear()

    def _lines(self) -> ProgressCallback:
        began = last = time.monotonic()
        lock = threading.Lock()

        def report(stage: str, name: str, share: float) -> None:
            nonlocal last
            with lock:
                now = time.monotonic()
                if now - last < _QUIET:
                    return
                last = now
            self.say(f"{name}: {stage}, {100 * share:.0f} % ({now - began:.0f} s)")

        return report

    def _line(self, label: str, text: str) -> None:
        from rich.text import Text

        color = {"error": "bold red", "warning": "bold yellow", "hint": "dim"}.get(label, "bold")
        words = Text(f"{label}: ", style=color) if label else Text()
        console = self._open[0][0] if self._open else _terminal()  # above the bars
        console.print(words.append(plain_text(text), style="default"), soft_wrap=True, highlight=False)


def _terminal() -> "rich.console.Console":
    from rich.console import Console as Terminal

    return Terminal(stderr=True)  # made anew: it then follows a stderr that was redirected since


def print_json(record: Json) -> None:
    """One JSON object on one line of stdout."""
    line = json.dumps(record, ensure_ascii=False, default=str)
    try:
        line.encode(_coding())
    except UnicodeEncodeError:  # a terminal without these letters, or a file's name that is not UTF-8
        line = json.dumps(record, default=str)
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
