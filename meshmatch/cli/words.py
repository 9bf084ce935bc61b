"""How the verbs speak: words for people on stderr, data on stdout; and what they say about shapes, fits and maps."""

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
_MOST_PARTS = 1000  # of which --json tells the numbers
_QUIET = 10.0  # seconds without a word, where nobody watches a bar


@dataclass(frozen=True)
class Console:
    """Words on stderr. With ``quiet`` only warnings and errors are heard."""

    quiet: bool = False
    _open: list[tuple[rich.console.Console, ProgressCallback]] = field(default_factory=list)

    def say(self, *lines: str) -> None:
        """What was done."""
        if not self.quiet:
            for text in lines:
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
                    rows[name] = bars.add_task(visible(name), total=1.0, what=stage)
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
        console.print(
            words.append(visible(plain_text(text)).replace("\n", " "), style="default"), soft_wrap=True, highlight=False
        )


def _terminal() -> rich.console.Console:
    from rich.console import Console as Terminal

    return Terminal(stderr=True)  # made anew: it then follows a stderr that was redirected since


def known_number(value: float) -> float | None:
    """A number as JSON has it: null for nan."""
    return None if math.isnan(value) else float(value)


def print_json(record: Json) -> None:
    """One JSON object on one line of stdout."""
    line = json.dumps(record, ensure_ascii=False, default=str)
    try:
        line.encode(_coding())
        plain = visible(line) == line
    except UnicodeEncodeError:  # a terminal without these letters, or a file's name that is not UTF-8
        plain = False
    if not plain:
        line = json.dumps(record, default=str)
    print_text(line + "\n")


def print_rows(rows: Sequence[Sequence[str]]) -> None:
    """Text on stdout, one row a line, columns flush."""
    rows = [[cell.replace("\n", " ") for cell in row] for row in rows]
    widths = [max(len(cell) for cell in column) for column in zip(*rows, strict=True)]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in rows]
    print_text("".join(line.rstrip() + "\n" for line in lines))


def print_text(text: str) -> None:
    """Text on stdout, letters that it cannot show as their numbers; `OutputError` if it is closed, or its disk full."""
    coding, text = _coding(), visible(text)
    try:
        if sys.stdout is None:
            raise OSError(9, "it is closed")
        sys.stdout.write(text.encode(coding, "backslashreplace").decode(coding))
        sys.stdout.flush()
    except BrokenPipeError:
        raise  # whoever read it has read enough
    except OSError as error:
        raise stdout_refused(error) from error


def stdout_refused(error: OSError) -> OutputError:
    """The error for a stdout that takes nothing more.

    What is still buffered goes nowhere: the interpreter would try again at its end, and say so in its own way.
    """
    with suppress(AttributeError, OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return OutputError(f"cannot write to stdout: {error.strerror}", "is the disk full, or stdout closed?")


def _coding() -> str:
    return getattr(sys.stdout, "encoding", None) or "utf-8"


def names_of(paths: Sequence[Path], names: Sequence[str] = ()) -> list[str]:
    """Names to show, those of the files if none are given; where two files have the same, with their folders."""
    names = names or [path.name for path in paths]
    real: dict[str, set[str]] = {}
    for path, name in zip(paths, names, strict=True):
        real.setdefault(name, set()).add(os.path.realpath(path))
    return [name if len(real[name]) == 1 else str(path) for path, name in zip(paths, names, strict=True)]


def refuse_poor(strict: bool, verdict: str, reasons: Sequence[str], what: str = "the fit") -> None:
    """With --strict, a poor fit or map is an error (`PoorFit`)."""
    if strict and verdict == "poor":
        raise PoorFit(f"{what} is poor, nothing was written: {why(reasons)}", _HINT)


def tell_verdict(console: Console, verdict: str, reasons: Sequence[str], what: str = "the fit") -> None:
    """A warning where it is poor, notes where it is fair."""
    if verdict == "poor":
        console.warn(f"{what} is poor: {why(reasons)}")
    elif verdict != "good":
        console.say(*(f"note: {reason}" for reason in reasons))


def why(reasons: Sequence[str]) -> str:
    """The reasons of a verdict in one line."""
    return "; ".join(reasons) or "no reason was given"


def fit_words(fit: meshmatch.Fit | meshmatch.ImplicitFit) -> str:
    """The verdict, and the axes where a model knows them."""
    if not isinstance(fit, meshmatch.Fit) or fit.model == NO_MODEL or not fit.axes:
        return f"{fit.verdict} fit"
    return f"{fit.verdict} fit, {fit.axes}"


def tell_match(console: Console, result: meshmatch.MatchResult, names: Sequence[str]) -> None:
    """What was repaired, and how both shapes were fitted."""
    console.say(*result.notes)
    for name, fit in zip(names, (result.source_fit, result.target_fit), strict=True):
        console.say(f"{name}: {fit_words(fit)}")


def fit_record(name: str, fit: meshmatch.Fit | meshmatch.ImplicitFit) -> Json:
    """A fit for --json; what an implicit model does not know is null."""
    record: Json = {"shape": name, "verdict": fit.verdict, "reasons": fit.reasons}
    if not isinstance(fit, meshmatch.Fit):
        numbers = {key: getattr(fit, key) for key in ("residual", "missed", "invented")}
        record |= {key: None if math.isnan(value) else round(value, 4) for key, value in numbers.items()}
        return record | {"seconds": round(fit.seconds, 3), "seed": fit.seed}
    record |= {"trust": round(fit.trust, 4), "residual": float(fit.residual)}
    record |= {"left_out_parts": fit.left_out[:_MOST_PARTS]} if fit.left_out else {}
    if fit.regularity is not None:
        record["regularity"] = {name: round(value, 5) for name, value in asdict(fit.regularity).items()}
    record |= {"up": fit.up or None, "front": fit.front or None}
    return record | {"seconds": round(fit.seconds, 3), "seed": fit.seed}


def map_record(found: meshmatch.VertexMap, names: Sequence[str]) -> Json:
    """A map for --json."""
    sizes = {"source_vertices": found.source_vertices, "target_vertices": found.target_vertices}
    return {"source": names[0], "target": names[1]} | sizes | {"verdict": found.verdict, "reasons": found.reasons}
