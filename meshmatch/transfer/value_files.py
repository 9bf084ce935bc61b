"""Numbers of each vertex, from files and to files.

=====  ========================================================================
.npy   (V,) or (V, D) float64
.csv   a row per vertex: the vertex, then a column per number, with their names
.ply   the shape, with a property per number (written only)
=====  ========================================================================

Colours go into shape files: .ply, .obj, .off, .glb.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from meshmatch.arrays import Floats
from meshmatch.errors import InputError, OptionError
from meshmatch.shapes.array_files import read_npy
from meshmatch.shapes.paths import existing
from meshmatch.shapes.shape import Shape

_HINT = "one row of numbers for each vertex of the source, in the order of its file: .npy or .csv"


@dataclass(frozen=True, eq=False)
class Values:
    """Numbers (V,) or (V, D) of each vertex, and a name for each column (may be empty)."""

    numbers: Floats
    names: tuple[str, ...] = ()


def load_values(path: str | Path, shape: Shape) -> Values:
    """Read numbers of the vertices of `shape`.

    Raises
    ------
    InputError
        The file is missing or damaged, holds no numbers, or not one row for each vertex.
    """
    path = existing(Path(path), _HINT)
    suffix = path.suffix.lower()
    if suffix == ".npy":
        array = read_npy(path)
        if array.dtype.kind not in "fiub" or array.ndim not in (1, 2):
            raise InputError(f"{path.name} holds an array of {array.shape} {array.dtype}, not numbers", _HINT)
        found = Values(array.astype(np.float64))
    elif suffix in (".csv", ".txt"):
        found = _read_csv(path)
    else:
        raise InputError(f"{path.name}: values are not read from '{suffix}' files", _HINT)
    rows = len(found.numbers)
    if rows != shape.V:
        raise InputError(
            f"{path.name} has {rows} rows, but {shape.name or 'the source'} has {shape.V} vertices", _HINT
        )
    if found.numbers.size == 0:
        raise InputError(f"{path.name} has no columns", _HINT)
    return found


def _read_csv(path: Path) -> Values:
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            rows = [row for row in csv.reader(file) if row]
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path.name} is not a csv file: {error}", _HINT) from error
    if not rows:
        raise InputError(f"{path.name} is empty", _HINT)
    names: tuple[str, ...] = ()
    if not all(_is_number(cell) for cell in rows[0]):
        names, rows = tuple(cell.strip() for cell in rows[0]), rows[1:]
    widths = {len(row) for row in rows} | ({len(names)} if names else set())
    if len(widths) > 1:
        raise InputError(f"{path.name} has rows of {min(widths)} and of {max(widths)} cells", _HINT)
    try:
        table = np.array([[float(cell) if cell.strip() else np.nan for cell in row] for row in rows])
    except ValueError as error:
        raise InputError(f"{path.name}: {error}", _HINT) from error
    table = table.reshape(len(rows), widths.pop() if widths else 0)
    if names and names[0].lower() == "vertex":
        if not np.array_equal(table[:, 0], np.arange(len(table))):
            raise InputError(f"{path.name}: its rows are not the vertices 0, 1, 2, ... in order", "sort it")
        names, table = names[1:], table[:, 1:]
    return Values(table[:, 0] if table.shape[1] == 1 else table, names)


def _is_number(cell: str) -> bool:
    try:
        float(cell or "nan")
    except ValueError:
        return False
    return True


def save_values(path: Path, values: Values, shape: Shape) -> None:
    """Write numbers of the vertices of `shape`; see the module for the formats.

    Raises
    ------
    OptionError
        The suffix is none of .npy, .csv and .ply.
    """
    check_values_suffix(path)
    suffix, numbers = path.suffix.lower(), values.numbers
    if suffix == ".npy":
        with path.open("wb") as file:
            np.save(file, numbers, allow_pickle=False)
        return
    table = numbers if numbers.ndim == 2 else numbers[:, None]
    names = values.names or _names(table.shape[1])
    if suffix == ".csv":
        with path.open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(["vertex", *names])
            writer.writerows([k, *row] for k, row in enumerate(table.tolist()))
        return
    from meshmatch.shapes.formats import ply

    ply.write(path, shape, vertex=dict(zip(_words(names), table.T, strict=True)))


def check_values_suffix(path: Path) -> None:
    """Refuse a suffix that cannot hold numbers (`OptionError`)."""
    if path.suffix.lower() not in (".npy", ".csv", ".ply"):
        raise OptionError(
            f"{path.name}: values cannot be kept as '{path.suffix or 'a file without a suffix'}'",
            "end the name in .npy, .csv or .ply",
        )


def _names(count: int) -> tuple[str, ...]:
    return ("value",) if count == 1 else tuple(f"value_{k}" for k in range(count))


def _words(names: tuple[str, ...]) -> list[str]:
    """Names as a ply header can hold them: no spaces, none twice, none that means something else."""
    taken: list[str] = []
    for name in names:
        word = "".join(c if c.isascii() and (c.isalnum() or c == "_") else "_" for c in name) or "value"
        while word in taken or word in ("x", "y", "z", "red", "green", "blue", "alpha", "r", "g", "b", "a"):
            word += "_"
        taken.append(word)
    return taken


def parse_blank(text: str, columns: int) -> NDArray[np.float64]:
    """What stands where nothing is known, from the words of the user: a number, numbers, or #rrggbb.

    Raises
    ------
    OptionError
        It is neither, or not as many numbers as there are columns.
    """
    if text.startswith("#"):
        numbers = [int(text[k : k + 2], 16) / 255 for k in (1, 3, 5)] if _is_hex(text) else []
        numbers += [1.0] if columns == 4 and numbers else []
    else:
        try:
            numbers = [float(word) for word in text.replace(",", " ").split()]
        except ValueError:
            numbers = []
    if len(numbers) == 3 and columns == 4:
        numbers.append(1.0)
    if len(numbers) == 1:
        return np.full(columns, numbers[0])
    if len(numbers) != columns:
        raise OptionError(
            f"--blank {text}: {columns} number{'s are' if columns > 1 else ' is'} needed",
            "such as nan, 0, 0.5,0.5,0.5 or #808080",
        )
    return np.array(numbers)


def _is_hex(text: str) -> bool:
    return len(text) == 7 and all(c in "0123456789abcdefABCDEF" for c in text[1:])
