"""Lists of vertex indices of one shape, and of pairs of vertices of two shapes (landmarks, ground truth).

Text files have one pair, or one vertex, per line: numbers separated by spaces, tabs, commas or semicolons; ``#`` begins
a comment; a first line of words is a header. ``.npy`` files contain the same as an array of whole numbers. Vertices are
counted from 0, in the order of the shape's file.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from meshmatch.arrays import Int, Ints
from meshmatch.errors import InputError
from meshmatch.shapes.input_files import read_npy
from meshmatch.shapes.tables import DECIMAL_COMMA, as_whole_numbers, read_by_suffix, read_table

_PAIRS = "one pair a line of text (or .npy): a vertex of the source, then a vertex of the target, counted from 0"
_POINTS = "one vertex a line of text (or .npy), counted from 0"
_TRUTH = f"{_PAIRS}; or for each vertex of the source the target's alone"


def load_pairs(path: str | Path) -> tuple[Int[Ints, " N"], Int[Ints, " N"]]:
    """Read pairs: N vertices of the source, and of the target; `InputError` as for `load_points`."""
    first, second = _read_vertices(Path(path), (2,), _PAIRS).T.copy()
    return first, second


def load_points(path: str | Path) -> Int[Ints, " N"]:
    """Read a list of vertices of one shape; `InputError` if the file is missing, empty, or not such a list."""
    return _read_vertices(Path(path), (1,), _POINTS)[:, 0].copy()


def load_truth(path: str | Path) -> Int[Ints, "N columns"]:
    """Read pairs as `load_pairs`, in two columns, or one column with each source vertex's target vertex; -1 for none."""
    return _read_vertices(Path(path), (1, 2), _TRUTH, missing=True)


def _read_vertices(path: Path, columns: tuple[int, ...], hint: str, missing: bool = False) -> Ints:
    """(N, columns) vertex indices; if ``missing`` is allowed, -1 or nan in the file are missing vertices."""
    suffix = path.suffix.lower()
    read = read_npy if suffix == ".npy" else lambda path: read_table(path, comments="ends", whole=True).numbers()[1]

    def numbers(path: Path) -> Ints:
        values = read(path)
        return as_whole_numbers(np.nan_to_num(values, nan=-1.0) if missing and values.dtype.kind == "f" else values)

    rows = read_by_suffix(path, {suffix: numbers}, "vertices", hint)
    if rows.ndim == 1 and 1 in columns:
        rows = rows[:, None]
    if rows.size == 0:
        raise InputError(f"{path.name} holds no vertex", hint)
    if rows.ndim != 2 or rows.shape[1] not in columns:
        shape = " x ".join(str(n) for n in rows.shape)
        comma = f"; {DECIMAL_COMMA}" if columns == (1,) and rows.shape[1:] == (2,) else ""
        expected = " or ".join(str(n) for n in columns)
        raise InputError(f"{path.name} has {shape} numbers, not {expected} a line", hint + comma)
    if rows.min() < (-1 if missing else 0):
        raise InputError(f"{path.name} names vertex {int(rows.min())}", hint)
    return rows
