"""The table of a transfer to many targets: what became of each, and what need not be done again."""

from __future__ import annotations

import csv
import hashlib
import os
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path

import numpy as np

from meshmatch import __version__
from meshmatch.api.matcher import Matcher
from meshmatch.collections.collection import Collection
from meshmatch.collections.endings import Ending
from meshmatch.collections.setting import FAILED
from meshmatch.collections.stores import Store
from meshmatch.errors import MeshmatchError, OptionError, OutputError
from meshmatch.outputs import make_folder, replace_on_success
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.tables import write_rows

TABLE = "transfers.csv"
_COLUMNS = ("name", "file", "output", "verdict", "confidence", "seconds", "error", "made")


@dataclass(frozen=True)
class TransferRecord:
    """What became of one target: a row of ``transfers.csv``.

    Attributes
    ----------
    name
        Of the target: its path in its folder, without the suffix.
    file
        Its path.
    output
        Path of what was written.
    verdict
        Of the map; or "failed".
    confidence
        Mean confidence of the map; None where that is not known.
    seconds
        Time of match and transfer.
    error
        Why it failed.
    made
        Digest of the files and choices that the output was made of.
    kept
        Whether the output was there already, made of the same files and choices.
    """

    name: str
    file: str
    output: str
    verdict: str
    confidence: float | None = None
    seconds: float | None = None
    error: str = ""
    made: str = ""
    kept: bool = False

    def row(self) -> list[str]:
        """As text of the table."""
        confidence = "" if self.confidence is None else f"{self.confidence:.2f}"
        seconds = "" if self.seconds is None else f"{self.seconds:.1f}"
        return [self.name, self.file, self.output, self.verdict, confidence, seconds, self.error, self.made]

    @classmethod
    def of(cls, row: Sequence[str]) -> TransferRecord:
        """From text of the table; `ValueError` where it is none."""
        name, file, output, verdict, confidence, seconds, error, made = row
        known, took = (float(each) if each else None for each in (confidence, seconds))
        return cls(name, file, output, verdict, known, took, error, made)


def transfer_each(
    targets: Mapping[str, Path],
    folder: Path,
    ending: Ending,
    how: Sequence[object],
    transfer: Callable[[str, Path, Path], tuple[str, float | None]],
    tell: Callable[[TransferRecord], None],
    beside: Callable[[str], Path | None] = lambda name: None,
) -> list[TransferRecord]:
    """Transfer to each target, unless its output, and what is written ``beside`` it, is there and made of the same. ``how``
    is all that decides about results but the target; ``transfer`` gets name, file and output of a target, and gives the
    map's verdict and confidence.
    """
    told, tokens = [], token_of([__version__, *how])
    with Store.of(folder).exclusive():
        rows = _read(folder / TABLE)
        _write(folder / TABLE, rows.values())
        for name, file in targets.items():
            output, more = folder / f"{name}{ending(file)}", beside(name)
            made, before = _digest(f"{tokens}\n{_state(file)}"), rows.get(name)
            there = output.exists() and (more is None or more.exists())
            if before is not None and there and (before.made, before.output) == (made, str(output)):
                record = replace(before, kept=True)
            else:
                record = _transferred(transfer, TransferRecord(name, str(file), str(output), FAILED, made=made), more)
                if not _outlives(before, record):
                    rows[name] = record
                    with (folder / TABLE).open("a", encoding="utf-8", newline="") as lines:
                        csv.writer(lines, lineterminator="\n").writerow(record.row())
            told.append(record)
            tell(record)
        _write(folder / TABLE, rows.values())
    return told


def words_of(error: MeshmatchError) -> str:
    """In one line."""
    return error.message + (f" ({error.hint})" if error.hint else "")


def _transferred(
    transfer: Callable[[str, Path, Path], tuple[str, float | None]], begun: TransferRecord, beside: Path | None
) -> TransferRecord:
    """What became of one target; that a transfer fails stops no other."""
    began, output = time.monotonic(), Path(begun.output)
    try:
        for path in (output, beside):
            if path is not None:
                make_folder(path.parent)
        verdict, confidence = transfer(begun.name, Path(begun.file), output)
    except MeshmatchError as error:
        return TransferRecord(begun.name, begun.file, begun.output, FAILED, error=words_of(error))
    seconds = time.monotonic() - began
    return TransferRecord(begun.name, begun.file, begun.output, verdict, confidence, seconds, made=begun.made)


def _outlives(before: TransferRecord | None, record: TransferRecord) -> bool:
    """Whether what was written before, as another file, is still there, and nothing new is."""
    if before is None or before.verdict == FAILED or record.verdict != FAILED:
        return False
    return before.output != record.output and Path(before.output).exists()


def _read(path: Path) -> dict[str, TransferRecord]:
    """The rows of a table that a run before wrote; `OutputError` if it is something else."""
    if not path.exists():
        return {}
    found = {}
    try:
        with path.open(encoding="utf-8", newline="") as file:
            lines = csv.reader(file)
            if tuple(next(lines, ())) != _COLUMNS:
                raise ValueError
            for line in lines:
                if len(line) == len(_COLUMNS):  # another one was being written when the run was stopped
                    found[line[0]] = TransferRecord.of(line)
    except (OSError, ValueError, csv.Error) as error:
        raise OutputError(f"{path} is no table of transfers", "choose another folder") from error
    return found


def _write(path: Path, rows: Iterable[TransferRecord]) -> None:
    with replace_on_success(path) as temporary:
        write_rows(temporary, _COLUMNS, (each.row() for each in rows))


def token_of(value: object) -> str:
    """A text that tells choices apart: values, and the state of the files that they name. Of what cannot be compared it is
    another one each time.
    """
    if isinstance(value, str | Path):
        state = ""
        with suppress(OSError, ValueError):  # no path at all
            state = _state(Path(value))
        return f"{value!r} {state}"
    if value is None or isinstance(value, bool | int | float | complex | np.generic):
        return repr(value)
    if isinstance(value, np.ndarray) and value.dtype != object:
        return f"{value.dtype} {value.shape} {_digest(np.ascontiguousarray(value).tobytes())}"
    if isinstance(value, Mapping):
        return str([(str(key), token_of(value[key])) for key in sorted(value, key=str)])
    if isinstance(value, list | tuple):
        return str([token_of(each) for each in value])
    if isinstance(value, Shape):
        return f"{value.hash} {token_of(value.colors)}"
    return _token_of_object(value)


def _token_of_object(value: object) -> str:
    word = type(value).__name__
    if isinstance(value, Collection):
        return f"{word} {token_of(value.store.location)}"
    if isinstance(value, Matcher):
        card = None
        with suppress(OptionError):
            card = value.model.card
        return f"{value!r} {token_of(value.config)} {token_of(card)}"
    if is_dataclass(value) and not isinstance(value, type):
        return f"{word} {token_of({each.name: getattr(value, each.name) for each in fields(value)})}"
    if hasattr(value, "tocsr"):
        rows = value.tocsr()
        return f"{rows.shape} {token_of([rows.data, rows.indices, rows.indptr])}"
    if isinstance(owner := getattr(value, "__self__", None), Collection):  # its maps_between
        return f"{word} {token_of(owner)}"
    return os.urandom(16).hex()


def _state(path: Path) -> str:
    """What tells whether a file, or one in a folder, has changed."""
    found = sorted(path.rglob("*")) if path.is_dir() else [path]
    states = [(each, each.stat()) for each in found if each.is_file()]
    return " ".join(f"{each} {state.st_size} {state.st_mtime_ns}" for each, state in states)


def _digest(what: str | bytes) -> str:
    data = what.encode(errors="surrogatepass") if isinstance(what, str) else what
    return hashlib.blake2b(data, digest_size=16).hexdigest()
