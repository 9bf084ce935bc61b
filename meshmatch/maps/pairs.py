"""Known points: pairs of vertices of two shapes (landmarks, a partial truth), and lists of vertices of one.

Text files hold one pair, or one vertex, a line: numbers separated by spaces, tabs, commas or semicolons; ``#`` begins a
comment; a first line of words is taken for a header. ``.npy`` files hold the same as an integer array. Vertices are
counted from 0, in the order of the shape's file.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from meshmatch.arrays import Int, Ints
from meshmatch.errors import InputError
from meshmatch.shapes.input_files import read_npy

_PAIRS = "one pair a line: a vertex of the source, then a vertex of the target, counted from 0"
_POINTS = "one vertex a line, counted from 0"


def load_pairs(path: str | Path) -> tuple[Int[Ints, " N"], Int[Ints, " N"]]:
    """Read pairs: vertices of the source, and the same N points on the target.

    `InputError` if the file is missing or empty, or is not a table of two columns of vertices.
    """
    first, second = _table(Path(path), 2, _PAIRS).T.copy()
    return first, second


def load_points(path: str | Path) -> Int[Ints, " N"]:
    """Read a list of vertices of one shape; `InputError` if the file is missing or empty, or is none."""
    return _table(Path(path), 1, _POINTS)[:, 0].copy()


def _table(path: Path, columns: int, hint: str) -> Ints:
    if not path.is_file():
        raise InputError(f"there is no file {path}", hint)
    try:
        rows = read_npy(path) if path.suffix.lower() == ".npy" else _from_text(path)
        if rows.dtype.kind not in "iu":
            raise ValueError("its numbers are not whole")
    except (ValueError, OSError, EOFError) as error:
        raise InputError(f"{path.name} is not a list of vertices: {error}", hint) from error
    rows = rows.astype(np.int64)
    if rows.ndim == 1 and columns == 1:
        rows = rows[:, None]
    if rows.size == 0:
        raise InputError(f"{path.name} holds no vertex", hint)
    if rows.ndim != 2 or rows.shape[1] != columns:
        shape = " x ".join(str(n) for n in rows.shape)
        raise InputError(f"{path.name} has {shape} numbers, not {columns} a line", hint)
    if rows.min() < 0:
        raise InputError(f"{path.name} names vertex {int(rows.min())}", hint)
    return rows


def _from_text(path: Path) -> Ints:
    rows: list[list[int]] = []
    words_allowed = True
    for number, line in enumerate(path.read_text(encoding="utf-8-sig").splitlines(), 1):
        cells = line.partition("#")[0].replace(",", " ").replace(";", " ").split()
        if not cells:
            continue
        try:
            rows.append([int(cell) for cell in cells])
        except ValueError:
            if not words_allowed:
                raise ValueError(f"line {number} is {line.strip()[:40]!r}") from None
        words_allowed = False
        if rows and len(rows[-1]) != len(rows[0]):
            raise ValueError(f"line {number} has {len(rows[-1])} numbers, the first has {len(rows[0])}")
    try:
        return np.array(rows, np.int64)
    except OverflowError:
        raise ValueError("a number is too large to be a vertex") from None
