"""Numbers and colors of each vertex, from files and to files: "Data on a shape" in docs/formats.md.

Colors are mixed as light; a `Shape` has them as screens show them (sRGB), whatever its file has.
"""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from meshmatch.arrays import Float, Floats
from meshmatch.errors import InputError, OptionError, warn
from meshmatch.shapes import tables
from meshmatch.shapes.colors import light
from meshmatch.shapes.dressed_files import save_colored
from meshmatch.shapes.formats import ply, vtk, vtk_xml
from meshmatch.shapes.formats.ply_edit import PlyFile
from meshmatch.shapes.formats.vtp_edit import VtpFile
from meshmatch.shapes.input_files import read_npy
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.tables import read_table

VALUE_SUFFIXES = (".npy", ".csv", ".ply", ".vtp", ".vtk")
_COLOR_SUFFIXES = (".ply", ".glb", ".vrm", ".obj", ".off", ".vtp", ".vtk", ".npy", ".csv")
check_values_suffix = partial(tables.check_suffix, suffixes=VALUE_SUFFIXES, what="values")
check_color_suffix = partial(tables.check_suffix, suffixes=_COLOR_SUFFIXES, what="vertex colors")
_VISIBLE = 1e-7  # share of a number, unless it is whole, that a 32-bit one may differ by
_HINT = "one row of numbers for each vertex of the source, in the order of its file: .npy, .csv or .vtp"
# Properties that a ply has already.
_RESERVED = {"x", "y", "z", "red", "green", "blue", "alpha", "r", "g", "b", "a"}


@dataclass(frozen=True, eq=False)
class Values:
    """Numbers (V,) or (V, D) of each vertex, and a name for each column (may be empty)."""

    numbers: Floats
    names: tuple[str, ...] = ()


def load_values(path: str | Path, shape: Shape) -> Values:
    """Read numbers of the vertices of `shape`; `InputError` if there is not one row for each."""
    readers = {".npy": _read_npy} | dict.fromkeys((".csv", ".txt"), lambda path: _read_text(path, shape.V))
    readers |= dict.fromkeys(vtk_xml.SUFFIXES, _read_arrays)
    found: Values = tables.read_by_suffix(path, readers, "values", _HINT)
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


def _read_arrays(path: Path) -> Values:
    """All arrays of the points, such as those of ParaView and 3D Slicer; of vectors a column for each number."""
    arrays = vtk_xml.point_arrays(path)
    if not arrays:
        raise InputError(f"{path.name} has no numbers at its points")
    columns = {name: values.reshape(len(values), -1).astype(np.float64) for name, values in arrays.items()}
    names = [f"{n}_{k}" if len(v.T) > 1 else n for n, v in columns.items() for k in range(len(v.T))]
    table = np.column_stack(list(columns.values()))
    return Values(table[:, 0] if len(names) == 1 else table, tuple(names))


def _read_text(path: Path, count: int) -> Values:
    """The numbers of a table of text, one row for each of `count` vertices."""
    table = read_table(path)
    names, numbers = table.numbers()
    if not names and len(numbers) == count + 1 and _counts_columns(numbers[0]):
        names, numbers = ("", *map(str, range(numbers.shape[1] - 1))), numbers[1:]  # as pandas names columns
    if not names and numbers.size == 0:
        raise InputError(f"{path.name} is empty")
    if len(numbers) == count:
        table.check_no_doubt()
    if names and names[0].lower() == "vertex":
        tables.check_numbered(numbers[:, 0])
        names, numbers = names[1:], numbers[:, 1:]
    elif len(names) > 1 and names[0] in ("", "Unnamed: 0") and _is_row_number(numbers[:, 0]):
        names, numbers = names[1:], numbers[:, 1:]
    return Values(numbers[:, 0] if numbers.shape[1] == 1 else numbers, names)


def _counts_columns(row: Floats) -> bool:
    return bool(np.isnan(row[0])) and len(row) > 1 and np.array_equal(row[1:], np.arange(len(row) - 1))


def _is_row_number(column: Floats) -> bool:
    """Whether a column without a name counts the rows, from 0 as pandas or from 1 as R."""
    return any(np.array_equal(column, np.arange(len(column)) + first) for first in (0, 1))


def save_values(path: Path, values: Values, shape: Shape, file: Path | None = None) -> bool:
    """Write numbers of the vertices of `shape`; a .ply or .vtp ``file`` that it was read from keeps all else.

    Returns whether it does.

    `OptionError` if the suffix is not one of `VALUE_SUFFIXES`.
    """
    suffix, numbers = check_values_suffix(path), values.numbers
    table = numbers if numbers.ndim == 2 else numbers[:, None]
    columns = table.shape[1]
    names = values.names or (("value",) if columns == 1 else tuple(f"value_{k}" for k in range(columns)))
    if suffix == ".npy":
        tables.write_npy(path, numbers)
    elif suffix == ".csv":
        tables.write_rows(path, ["vertex", *names], ([k, *row] for k, row in enumerate(table.tolist())))
    elif suffix in (".vtp", ".vtk"):
        as_vtp = VtpFile.of(file, shape) if suffix == ".vtp" else None
        there = vtk_xml.point_arrays(file) if suffix == ".vtp" and as_vtp is None else {}
        own = _different([name or "value" for name in names], set(there if as_vtp is None else as_vtp.arrays))
        arrays = dict(zip(own, table.T, strict=True))
        if as_vtp is not None:
            path.write_bytes(as_vtp.with_arrays(arrays, {}))
        else:
            (vtk.write_vtp if suffix == ".vtp" else vtk.write_vtk)(path, shape, {**there, **arrays})
        return as_vtp is not None
    else:
        words = ["".join(c if c.isascii() and (c.isalnum() or c == "_") else "_" for c in name) for name in names]
        own = _different([word or "value" for word in words], _RESERVED)
        with np.errstate(over="ignore"):  # which more programs read; VTK, and so ParaView, reads none of a ply
            written = table.astype(np.float32)
            off = np.abs(written - table)
        whole = (table == np.rint(table)) & (np.abs(table) < 2**53)
        if (off > np.where(whole, 0.0, _VISIBLE * np.abs(table))).any():
            warn(f"{path.name} has 32-bit numbers, which change some of these; .csv, .npy and .vtp keep them")
        columns, as_ply = dict(zip(own, written.T, strict=True)), PlyFile.of(file, shape)
        if as_ply is not None:
            path.write_bytes(as_ply.with_columns(columns, {}))
        else:
            ply.write(path, shape, vertex=columns)
        return as_ply is not None
    return True


def _different(names: list[str], taken: set[str]) -> list[str]:
    """Names of which none is there twice, and none is among those taken: a second a is a_, a third a_2."""
    found: list[str] = []
    used, times = set(taken), Counter[str]()
    for name in names:
        own = name
        while own in used:
            times[name] += 1
            own = f"{name}_" if times[name] == 1 else f"{name}_{times[name]}"
        used.add(own)
        found.append(own)
    return found


def parse_blank(text: str, columns: int) -> Float[Floats, " D"]:
    """What the user's text says: a number, one for each column, or #rrggbb; `OptionError` if it says none of these."""
    numbers: list[float] = []
    try:
        if re.fullmatch("#[0-9a-fA-F]{6}", text):
            numbers = [byte / 255 for byte in bytes.fromhex(text[1:])]
        elif text.isascii() and "_" not in text:  # Python's numbers have other digits too
            numbers = [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        pass
    if len(numbers) == 3 and columns == 4:
        numbers.append(1.0)
    numbers *= columns if len(numbers) == 1 else 1
    if len(numbers) != columns:
        problem = f"--blank {text}: {columns} number{'s are' if columns > 1 else ' is'} needed"
        raise OptionError(problem, "such as nan, 0, 0.5,0.5,0.5 or #808080")
    return np.array(numbers)


def light_of(shape: Shape, colors: ArrayLike | None = None) -> Float[Floats, "V 4"]:
    """Light of the vertices of a shape, from its own colors (`InputError` if it has none) or from others (V, 3 or 4)
    as screens show them.
    """
    if colors is None:
        if shape.colors is None:
            problem = f"{shape.name or 'the source'} has no vertex colors"
            raise InputError(
                problem, "transfer its texture (transfer-texture), or other numbers (--values; transfer_values)"
            )
        return light(shape.colors)
    table = checked_colors(np.asarray(colors, np.float64))
    if len(table) != shape.V or table.ndim != 2:
        raise InputError(f"colors must be an array of ({shape.V}, 3 or 4), not {table.shape}")
    return light(np.column_stack([table, np.ones(len(table))])[:, :4])


def checked_colors(colors: Float[Floats, "*N C"]) -> Float[Floats, "*N C"]:
    """The same colors; `OptionError` where they are not 3 or 4 numbers within 0..1."""
    if colors.ndim == 0 or colors.shape[-1] not in (3, 4) or not ((colors >= 0) & (colors <= 1)).all():
        hint = "such as 0.5,0.5,0.5 or #808080"
        raise OptionError("a color has 3 or 4 numbers within 0..1: red, green, blue and alpha", hint)
    return colors


def parse_color(text: str | None) -> tuple[float, float, float, float] | None:
    """The color and alpha (sRGB, 0..1) that a text such as #808080 means; `OptionError` if it means none."""
    if text is None:
        return None
    red, green, blue, alpha = checked_colors(parse_blank(text, 4)).tolist()
    return red, green, blue, alpha


def save_colors(
    path: Path,
    shape: Shape,
    colors: Float[Floats, "V 4"],
    file: Path | None = None,
    turn: Float[Floats, "3 3"] | None = None,
) -> bool:
    """Write `shape` with vertex colors as screens show them; or the colors alone.

    `file` and `turn`, and what is returned, as in `save_colored`.
    """
    if check_color_suffix(path) in (".npy", ".csv"):
        return save_values(path, Values(colors, ("red", "green", "blue", "alpha")), shape)
    painted = Shape(shape.verts, shape.faces, shape.name, colors, shape.invalid)
    return save_colored(path, painted, file, np.eye(3) if turn is None else turn)
