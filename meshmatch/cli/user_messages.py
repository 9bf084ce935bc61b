"""Output of the commands: messages on stderr, data on stdout; and messages and JSON about fits and maps."""

from __future__ import annotations

import json
import math
import os
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import meshmatch
from meshmatch.errors import OutputError, PoorFit, visible
from meshmatch.models.registry import NO_MODEL
from meshmatch.outputs import plain_text
from meshmatch.progress import ProgressCallback

if TYPE_CHECKING:
    import rich.console

Json = dict[str, Any]
"""One JSON object; paths become strings."""
_HINT = "is it the model's category? try --up and --front, or --try-harder, or leave out --strict to see the result"
_MAX_PARTS = 1000  # numbers of parts in the output of --json
_LOG_INTERVAL = 10.0  # seconds between progress messages if stderr is no terminal


@dataclass(frozen=True)
class Console:
    """Messages on stderr; with ``quiet``, only warnings and errors."""

    quiet: bool = False
    _open: list[tuple[rich.console.Console, ProgressCallback]] = field(default_factory=list)

    def say(self, *lines: str) -> None:
        """Print messages, unless quiet."""
        if not self.quiet:
            for text in lines:
                self._line("", text)

    def warn(self, text: str) -> None:
        """Print a warning, even if quiet."""
        self._line("warning", text)

    def problem(self, label: str, message: str, hint: str = "") -> None:
        """Print a problem with its label, such as "error", and a hint on what to do, even if quiet."""
        self._line(label, message)
        if hint:
            self._line("hint", hint)

    @contextmanager
    def progress(self) -> Iterator[ProgressCallback]:
        """Show a progress bar for each shape inside the block; in a log, print a line every ten seconds instead."""
        if self._open:  # an enclosing block shows bars already
            yield self._open[0][1]
            return
        console = _terminal()
        if self.quiet or not console.is_terminal:
            yield (lambda stage, name, share: None) if self.quiet else self._log_progress()
            return
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

        name, stage_column = (TextColumn(f"{{task.{text}}}", markup=False) for text in ("description", "fields[what]"))
        with Progress(name, BarColumn(), stage_column, TimeElapsedColumn(), console=console, transient=True) as bars:
            rows: dict[str, Any] = {}

            def report(stage: str, name: str, share: float) -> None:
                if name not in rows:
                    rows[name] = bars.add_task(visible(name), total=1.0, what=stage)
                bars.update(rows[name], completed=share, what=stage)

            self._open.append((console, report))
            try:
                yield report
            finally:
                self._open.clear()

    def _log_progress(self) -> ProgressCallback:
        began = last = time.monotonic()
        lock = threading.Lock()

        def report(stage: str, name: str, share: float) -> None:
            nonlocal last
            with lock:
                now = time.monotonic()
                if now - last < _LOG_INTERVAL:
                    return
                last = now
            self.say(f"{name}: {stage}, {100 * share:.0f} % ({now - began:.0f} s)")

        return report

    def _line(self, label: str, text: str) -> None:
        from rich.text import Text

        color = {"error": "bold red", "warning": "bold yellow", "hint": "dim"}.get(label, "bold")
        line = Text(f"{label}: ", style=color) if label else Text()
        console = self._open[0][0] if self._open else _terminal()  # above the bars
        console.print(
            line.append(visible(plain_text(text)).replace("\n", " "), style="default"), soft_wrap=True, highlight=False
        )


def _terminal() -> rich.console.Console:
    from rich.console import Console as Terminal

    return Terminal(stderr=True)  # a new one each time, since stderr may have been redirected


def json_number(value: float) -> float | None:
    """The number, or None for nan, which JSON does not have."""
    return None if math.isnan(value) else float(value)


def print_json(record: Json) -> None:
    """Print one JSON object on one line of stdout."""
    line = json.dumps(record, ensure_ascii=False, default=str)
    try:
        line.encode(_encoding())
        plain = visible(line) == line
    except UnicodeEncodeError:  # stdout cannot encode it, or a file's name is not UTF-8
        plain = False
    if not plain:
        line = json.dumps(record, default=str)
    print_text(line + "\n")


def print_rows(rows: Sequence[Sequence[str]]) -> None:
    """Print a table on stdout with aligned columns."""
    rows = [[cell.replace("\n", " ") for cell in row] for row in rows]
    widths = [max(len(cell) for cell in column) for column in zip(*rows, strict=True)]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in rows]
    print_text("".join(line.rstrip() + "\n" for line in lines))


def print_text(text: str) -> None:
    """Print text on stdout, escaping characters that it cannot encode; `OutputError` if it is closed or its disk is full."""
    encoding, text = _encoding(), visible(text)
    try:
        if sys.stdout is None:
            raise OSError(9, "it is closed")
        sys.stdout.write(text.encode(encoding, "backslashreplace").decode(encoding))
        sys.stdout.flush()
    except BrokenPipeError:
        raise  # the reader, such as `head`, closed the pipe
    except OSError as error:
        raise stdout_error(error) from error


def stdout_error(error: OSError) -> OutputError:
    """Make the error for a stdout that cannot be written.

    Redirect it to the null device: the interpreter would otherwise flush the buffer at exit and print its own message.
    """
    with suppress(AttributeError, OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return OutputError(f"cannot write to stdout: {error.strerror}", "is the disk full, or stdout closed?")


def _encoding() -> str:
    return getattr(sys.stdout, "encoding", None) or "utf-8"


def names_of(paths: Sequence[Path], names: Sequence[str] = ()) -> list[str]:
    """Names to show: ``names``, or those of the files; with folders where different files have the same name."""
    names = names or [path.name for path in paths]
    real: dict[str, set[str]] = {}
    for path, name in zip(paths, names, strict=True):
        real.setdefault(name, set()).add(os.path.realpath(path))
    return [name if len(real[name]) == 1 else str(path) for path, name in zip(paths, names, strict=True)]


def raise_if_poor(strict: bool, verdict: str, reasons: Sequence[str], what: str = "the fit") -> None:
    """Raise `PoorFit` for a poor fit or map, with --strict."""
    if strict and verdict == "poor":
        raise PoorFit(f"{what} is poor, nothing was written: {join_reasons(reasons)}", _HINT)


def report_verdict(console: Console, verdict: str, reasons: Sequence[str], what: str = "the fit") -> None:
    """Print a warning for a poor fit or map, and notes for a fair one."""
    if verdict == "poor":
        console.warn(f"{what} is poor: {join_reasons(reasons)}")
    elif verdict != "good":
        console.say(*(f"note: {reason}" for reason in reasons))


def join_reasons(reasons: Sequence[str]) -> str:
    """Join the reasons of a verdict in one line."""
    return "; ".join(reasons) or "no reason was given"


def describe_fit(fit: meshmatch.Fit | meshmatch.ImplicitFit) -> str:
    """Describe a fit by its verdict, and its axes if the model knows them."""
    if not isinstance(fit, meshmatch.Fit) or fit.model == NO_MODEL or not fit.axes:
        return f"{fit.verdict} fit"
    return f"{fit.verdict} fit, {fit.axes}"


def report_match(console: Console, result: meshmatch.MatchResult, names: Sequence[str]) -> None:
    """Print the notes of a match and describe both fits."""
    console.say(*result.notes)
    for name, fit in zip(names, (result.source_fit, result.target_fit), strict=True):
        console.say(f"{name}: {describe_fit(fit)}")


def fit_record(name: str, fit: meshmatch.Fit | meshmatch.ImplicitFit) -> Json:
    """Describe a fit for --json; values that are unknown for implicit models are null."""
    record: Json = {"shape": name, "verdict": fit.verdict, "reasons": fit.reasons}
    if not isinstance(fit, meshmatch.Fit):
        numbers = {key: getattr(fit, key) for key in ("residual", "missed", "invented")}
        record |= {key: None if math.isnan(value) else round(value, 4) for key, value in numbers.items()}
        return record | {"seconds": round(fit.seconds, 3), "seed": fit.seed}
    record |= {"trust": round(fit.trust, 4), "residual": float(fit.residual)}
    record |= {"left_out_parts": fit.left_out[:_MAX_PARTS]} if fit.left_out else {}
    if fit.regularity is not None:
        record["regularity"] = {name: round(value, 5) for name, value in asdict(fit.regularity).items()}
    record |= {"up": fit.up or None, "front": fit.front or None}
    return record | {"seconds": round(fit.seconds, 3), "seed": fit.seed}


def map_record(found: meshmatch.VertexMap, names: Sequence[str]) -> Json:
    """Describe a map for --json."""
    sizes = {"source_vertices": found.source_vertices, "target_vertices": found.target_vertices}
    return {"source": names[0], "target": names[1]} | sizes | {"verdict": found.verdict, "reasons": found.reasons}
