"""Numbers of each vertex, from files and to files.

=====  ========================================================================
.npy   (V,) or (V, D) float64
.csv   a row per vertex: the vertex, then a column per number, with their names
.ply   the shape, with a property per number (written only)
=====  ========================================================================

Colours go into shape files: .ply, .obj, .off, .glb.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from meshmatch.arrays import Float, Floats
from meshmatch.errors import InputError, OptionError
from meshmatch.maps.table_files import check_numbered, check_suffix, read_by_suffix, read_rows, write_npy, write_rows
from meshmatch.shapes.array_files import read_npy
from meshmatch.shapes.shape import Shape

VALUE_SUFFIXES = (".npy", ".csv", ".ply")
_HINT = "one row of numbers for each vertex of the source, in the order of its file: .npy or .csv"
# Properties that a ply has already.
_RESERVED = {"x", "y", "z", "red", "green", "blue", "alpha", "r", "g", "b", "a"}


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
    readers = {".npy": _read_npy, ".csv": _read_csv, ".txt": _read_csv}
    found = read_by_suffix(path, readers, "values", _HINT)
    name, rows = Path(path).name, len(found.numbers)
    if rows != shape.V:
        raise InputError(f"{name} has {rows} rows, but {shape.name or 'the source'} has {shape.V} vertices", _HINT)
    if found.numbers.size == 0:
        raise InputError(f"{name} has no columns", _HINT)
    return found


def _read_npy(path: Path) -> Values:
    array = read_npy(path)
    if array.dtype.kind not in "fiub" or array.ndim not in (1, 2):
        raise InputError(f"it holds an array of {array.shape} {array.dtype}, not numbers")
    return Values(array.astype(np.float64))


def _read_csv(path: Path) -> Values:
    rows = read_rows(path)
    if not rows:
        raise InputError(f"{path.name} is empty")
    names: tuple[str, ...] = ()
    if not all(_is_number(cell) for cell in rows[0]):
        names, rows = tuple(rows[0]), rows[1:]
    widths = {len(row) for row in rows} | ({len(names)} if names else set())
    if len(widths) > 1:
        raise InputError(f"it has rows of {min(widths)} and of {max(widths)} cells")
    table = np.array([[float(cell or "nan") for cell in row] for row in rows])
    table = table.reshape(len(rows), widths.pop() if widths else 0)
    if names and names[0].lower() == "vertex":
        check_numbered(table[:, 0])
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
        The suffix is not one of `VALUE_SUFFIXES`.
    """
    suffix, numbers = check_values_suffix(path), values.numbers
    if suffix == ".npy":
        write_npy(path, numbers)
        return
    table = numbers if numbers.ndim == 2 else numbers[:, None]
    columns = table.shape[1]
    names = values.names or (("value",) if columns == 1 else tuple(f"value_{k}" for k in range(columns)))
    if suffix == ".csv":
        write_rows(path, ["vertex", *names], ([k, *row] for k, row in enumerate(table.tolist())))
        return
    from meshmatch.shapes.formats import ply

    ply.write(path, shape, vertex=dict(zip(_ply_names(names), table.T, strict=True)))


def check_values_suffix(path: Path) -> str:
    """The suffix, if it is one of `VALUE_SUFFIXES`; `OptionError` otherwise."""
    return check_suffix(path, VALUE_SUFFIXES, "values")


def _ply_names(names: tuple[str, ...]) -> list[str]:
    """Names as a ply header can hold them: no spaces, no duplicates, none that a ply uses already."""
    taken: list[str] = []
    for name in names:
        word = "".join(c if c.isascii() and (c.isalnum() or c == "_") else "_" for c in name) or "value"
        while word in taken or word in _RESERVED:
            word += "_"
        taken.append(word)
    return taken


def parse_blank(text: str, columns: int) -> Float[Floats, " D"]:
    """The values to write where nothing is known, from the user's text: a number, numbers, or #rrggbb.

    Raises
    ------
    OptionError
        Any other text, or not as many numbers as there are columns.
    """
    try:
        if text.startswith("#"):
            # int() also reads "+f" and "0x", which are no colours
            digits = text[1:] if len(text) == 7 and text[1:].isalnum() else ""
            numbers = [int(digits[k : k + 2], 16) / 255 for k in (0, 2, 4)]
        else:
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
