"""Run a transfer to many targets and record each result in a table, so that finished targets are not repeated."""

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
from meshmatch.collections.setting import FAILED
from meshmatch.collections.stores import Store
from meshmatch.collections.suffixes import Ending
from meshmatch.errors import MeshmatchError, OptionError, OutputError
from meshmatch.outputs import make_folder, replace_on_success
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.tables import write_rows

TABLE = "transfers.csv"
_COLUMNS = ("name", "file", "output", "verdict", "confidence", "seconds", "error", "made")


@dataclass(frozen=True)
class TransferRecord:
    """The result for one target: a row of ``transfers.csv``.

    Attributes
    ----------
    name
        Name of the target: its path in its folder, without the suffix.
    file
        Path of the target.
    output
        Path of the file that was written.
    verdict
        Verdict of the map; or "failed".
    confidence
        Mean confidence of the map; None if it is not known.
    seconds
        Duration of match and transfer.
    error
        The reason of a failure; else empty.
    made
        Digest of the files and options that the output was made from.
    kept
        Whether an output made from the same files and options existed already and was kept.
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
        """The cells of the table."""
        confidence = "" if self.confidence is None else f"{self.confidence:.2f}"
        seconds = "" if self.seconds is None else f"{self.seconds:.1f}"
        return [self.name, self.file, self.output, self.verdict, confidence, seconds, self.error, self.made]

    @classmethod
    def of(cls, row: Sequence[str]) -> TransferRecord:
        """Parse the cells of the table; `ValueError` if they are invalid."""
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
    companion_of: Callable[[str], Path | None] = lambda name: None,
) -> list[TransferRecord]:
    """Transfer to each target whose output is missing or was made from other files or options.

    Parameters
    ----------
    targets : files of the targets, by name
    folder : the output folder, which also gets the table
    ending : rule for the suffix of each output
    how : everything other than the target that determines the results
    transfer : function of a target's name, its file and its output; returns verdict and confidence of the map
    tell : called with the record of each target
    companion_of : gives the path of a second output for a name, None if there is none

    Returns
    -------
    list of TransferRecord
        In the order of the targets.
    """
    records, options = [], fingerprint([__version__, *how])
    with Store.of(folder).exclusive():
        rows = _read(folder / TABLE)
        _write(folder / TABLE, rows.values())
        for name, file in targets.items():
            output, companion = folder / f"{name}{ending(file)}", companion_of(name)
            made, before = _digest(f"{options}\n{_file_state(file)}"), rows.get(name)
            exists = output.exists() and (companion is None or companion.exists())
            if before is not None and exists and (before.made, before.output) == (made, str(output)):
                record = replace(before, kept=True)
            else:
                record = _run_transfer(
                    transfer, TransferRecord(name, str(file), str(output), FAILED, made=made), companion
                )
                if not _keeps_earlier(before, record):
                    rows[name] = record
                    with (folder / TABLE).open("a", encoding="utf-8", newline="") as lines:
                        csv.writer(lines, lineterminator="\n").writerow(record.row())
            records.append(record)
            tell(record)
        _write(folder / TABLE, rows.values())
    return records


def with_hint(error: MeshmatchError) -> str:
    """Format an error with its hint as one line."""
    return error.message + (f" ({error.hint})" if error.hint else "")


def _run_transfer(
    transfer: Callable[[str, Path, Path], tuple[str, float | None]], planned: TransferRecord, companion: Path | None
) -> TransferRecord:
    """Transfer to one target; a `MeshmatchError` becomes a record, so that it does not stop the others."""
    start, output = time.monotonic(), Path(planned.output)
    try:
        for path in (output, companion):
            if path is not None:
                make_folder(path.parent)
        verdict, confidence = transfer(planned.name, Path(planned.file), output)
    except MeshmatchError as error:
        return TransferRecord(planned.name, planned.file, planned.output, FAILED, error=with_hint(error))
    seconds = time.monotonic() - start
    return TransferRecord(planned.name, planned.file, planned.output, verdict, confidence, seconds, made=planned.made)


def _keeps_earlier(before: TransferRecord | None, record: TransferRecord) -> bool:
    """Whether to keep the earlier record: the new transfer failed, and the earlier output, under another path, exists."""
    if before is None or before.verdict == FAILED or record.verdict != FAILED:
        return False
    return before.output != record.output and Path(before.output).exists()


def _read(path: Path) -> dict[str, TransferRecord]:
    """Read the table of an earlier run, by name; `OutputError` if the file is something else."""
    if not path.exists():
        return {}
    found = {}
    try:
        with path.open(encoding="utf-8", newline="") as file:
            lines = csv.reader(file)
            if tuple(next(lines, ())) != _COLUMNS:
                raise ValueError
            for line in lines:
                if len(line) == len(_COLUMNS):  # a shorter line was cut off when the run was killed
                    found[line[0]] = TransferRecord.of(line)
    except (OSError, ValueError, csv.Error) as error:
        raise OutputError(f"{path} is no table of transfers", "choose another folder") from error
    return found


def _write(path: Path, rows: Iterable[TransferRecord]) -> None:
    """Write the table atomically."""
    with replace_on_success(path) as temporary:
        write_rows(temporary, _COLUMNS, (each.row() for each in rows))


def fingerprint(value: object) -> str:
    """A string that changes with the value of an option, including the size and time of files that it names.

    For values that cannot be compared it is random, so different each time.
    """
    if isinstance(value, str | Path):
        state = ""
        with suppress(OSError, ValueError):  # not a valid path
            state = _file_state(Path(value))
        return f"{value!r} {state}"
    if value is None or isinstance(value, bool | int | float | complex | np.generic):
        return repr(value)
    if isinstance(value, np.ndarray) and value.dtype != object:
        return f"{value.dtype} {value.shape} {_digest(np.ascontiguousarray(value).tobytes())}"
    if isinstance(value, Mapping):
        return str([(str(key), fingerprint(value[key])) for key in sorted(value, key=str)])
    if isinstance(value, list | tuple):
        return str([fingerprint(each) for each in value])
    if isinstance(value, Shape):
        return f"{value.hash} {fingerprint(value.colors)}"
    return _fingerprint_object(value)


def _fingerprint_object(value: object) -> str:
    """`fingerprint` for collections, matchers, dataclasses, sparse matrices and methods of collections."""
    word = type(value).__name__
    if isinstance(value, Collection):
        return f"{word} {fingerprint(value.store.location)}"
    if isinstance(value, Matcher):
        card = None
        with suppress(OptionError):
            card = value.model.card
        return f"{value!r} {fingerprint(value.config)} {fingerprint(card)}"
    if is_dataclass(value) and not isinstance(value, type):
        return f"{word} {fingerprint({each.name: getattr(value, each.name) for each in fields(value)})}"
    if hasattr(value, "tocsr"):
        rows = value.tocsr()
        return f"{rows.shape} {fingerprint([rows.data, rows.indices, rows.indptr])}"
    if isinstance(owner := getattr(value, "__self__", None), Collection):  # such as the method maps_between
        return f"{word} {fingerprint(owner)}"
    return os.urandom(16).hex()


def _file_state(path: Path) -> str:
    """Path, size and modification time of a file, or of all files in a folder; changes if any of them does."""
    found = sorted(path.rglob("*")) if path.is_dir() else [path]
    states = [(each, each.stat()) for each in found if each.is_file()]
    return " ".join(f"{each} {state.st_size} {state.st_mtime_ns}" for each, state in states)


def _digest(what: str | bytes) -> str:
    """Digest of text or bytes, as 32 hex digits."""
    data = what.encode(errors="surrogatepass") if isinstance(what, str) else what
    return hashlib.blake2b(data, digest_size=16).hexdigest()
