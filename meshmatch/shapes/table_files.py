"""What the files of maps and of values on shapes share: the choice by suffix, tables of text, errors in one line; and
lists of known vertices: pairs of two shapes (landmarks, a partial truth), or points of one.

The text of such a list has one pair, or one vertex, a line: numbers separated by spaces, tabs, commas or semicolons;
``#`` begins a comment; a first line of words is taken for a header. ``.npy`` files hold the same as an array of whole
numbers. Vertices are counted from 0, in the order of the shape's file.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from meshmatch.arrays import Int, Ints
from meshmatch.errors import InputError, MeshmatchError, OptionError
from meshmatch.outputs import as_path, plain_text
from meshmatch.shapes.input_files import existing, read_npy
from meshmatch.shapes.text_tables import DECIMAL_COMMA, number, read_table, whole

T = TypeVar("T")
_PAIRS = "one pair a line: a vertex of the source, then a vertex of the target, counted from 0"
_POINTS = "one vertex a line, counted from 0"
# What a damaged file raises in the readers of the standard library and NumPy.
_DAMAGE = (ValueError, TypeError, LookupError, ArithmeticError, RecursionError, EOFError, StopIteration, csv.Error)


def check_suffix(path: str | Path, suffixes: Iterable[str], what: str) -> str:
    """The suffix in small letters, if it is one of `suffixes`; `OptionError` otherwise. Ask before long work."""
    path = as_path(path)
    suffix = path.suffix.lower()
    if suffix not in suffixes:
        given = f"'{suffix}'" if suffix else "a name without a suffix"
        unknown = f"{path.name}: {given} is not a format for {what}"
        raise OptionError(unknown, f"end the name in one of {' '.join(suffixes)}")
    return suffix


def read_by_suffix(path: str | Path, readers: Mapping[str, Callable[[Path], T]], what: str, hint: str) -> T:
    """What the reader for the file's suffix makes of it; `InputError` where there is none, or the file is missing, empty
    or damaged.

    The file's name comes first in the message. A reader's own errors keep their kind and words, and get `hint` where
    they have none.
    """
    path = existing(as_path(path), hint)
    suffix = path.suffix.lower()
    if suffix not in readers:
        raise InputError(f"{path.name}: {what} are not read from '{suffix}' files", f"choose {', '.join(readers)}")
    try:
        return readers[suffix](path)
    except MeshmatchError as error:
        words = error.message if error.message.startswith(path.name) else f"{path.name}: {error.message}"
        raise type(error)(words, error.hint or hint) from error
    except _DAMAGE as error:
        raise InputError(f"{path.name} does not hold {what} that can be read: {error}", hint) from error


def is_numbered(numbers: ArrayLike | Sequence[str]) -> bool:
    """Whether the rows are numbered 0, 1, 2, ...: by numbers, or by cells of a table that hold them."""
    try:
        rows = np.array([number(each) if isinstance(each, str) else each for each in np.asarray(numbers).tolist()])
    except ValueError:
        return False
    return np.array_equal(rows, np.arange(len(rows)))


def check_numbered(numbers: ArrayLike | Sequence[str]) -> None:
    """`InputError` if the rows are not numbered 0, 1, 2, ..."""
    if not is_numbered(numbers):
        from_one = is_numbered(["0", *map(str, np.asarray(numbers).tolist())])
        hint = "it counts from 1: subtract 1" if from_one else "sort it, one row for each"
        raise InputError("its rows are not 0, 1, 2, ... in order", hint)


def write_rows(path: Path, header: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """A csv file; floats are written with the fewest digits that read back as the same number."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(rows)


def write_json(path: Path, record: Mapping[str, Any], indent: int | None = None) -> None:
    """A JSON file, in letters where every file can hold them."""
    text = json.dumps(record, ensure_ascii=False, allow_nan=False, indent=indent)
    path.write_text(plain_text(text) + "\n", encoding="utf-8")


def write_npy(path: Path, array: np.ndarray) -> None:
    """An npy file. Through an open file: given a path such as a.NPY, NumPy writes a.NPY.npy."""
    with path.open("wb") as file:
        np.save(file, array, allow_pickle=False)


def write_npz(path: Path, arrays: Mapping[str, Any]) -> None:
    """A compressed npz file; see `write_npy`."""
    with path.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **{name: np.asarray(value) for name, value in arrays.items()})


def short_floats(values: np.ndarray) -> list[Any]:
    """float32 numbers as the floats with the fewest digits that read back as the same float32."""
    return list(values.astype(np.float32).astype(np.str_).astype(np.float64).tolist())


def load_pairs(path: str | Path) -> tuple[Int[Ints, " N"], Int[Ints, " N"]]:
    """Read pairs: vertices of the source, and the same N points on the target; `InputError` as `load_points`."""
    first, second = _vertices(Path(path), 2, _PAIRS).T.copy()
    return first, second


def load_points(path: str | Path) -> Int[Ints, " N"]:
    """Read a list of vertices of one shape; `InputError` if the file is missing or empty, or is none."""
    return _vertices(Path(path), 1, _POINTS)[:, 0].copy()


def _vertices(path: Path, columns: int, hint: str) -> Ints:
    """(N, columns) numbers of vertices."""
    suffix = path.suffix.lower()
    read = read_npy if suffix == ".npy" else lambda path: read_table(path, comments="ends", whole=True).numbers()[1]
    rows = read_by_suffix(path, {suffix: lambda path: whole(read(path))}, "vertices", hint)
    if rows.ndim == 1 and columns == 1:
        rows = rows[:, None]
    if rows.size == 0:
        raise InputError(f"{path.name} holds no vertex", hint)
    if rows.ndim != 2 or rows.shape[1] != columns:
        shape = " x ".join(str(n) for n in rows.shape)
        comma = f"; {DECIMAL_COMMA}" if columns == 1 and rows.shape[1:] == (2,) else ""
        raise InputError(f"{path.name} has {shape} numbers, not {columns} a line", hint + comma)
    if rows.min() < 0:
        raise InputError(f"{path.name} names vertex {int(rows.min())}", hint)
    return rows
