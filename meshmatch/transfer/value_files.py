"""Reading and writing of numbers and colors per vertex: "Data on a shape" in docs/formats.md.

Colors are interpolated in linear light; those of a `Shape` are sRGB, whatever its file has.
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
from meshmatch.shapes.colors import srgb_to_linear_alpha
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
_MAX_ROUNDING = 1e-7  # relative; a larger difference of a 32-bit number, or any of a whole number, is worth a warning
_HINT = "one row of numbers for each of its vertices, in the order of its file: .npy, .csv or .vtp"
# Names that properties of a ply already have.
_RESERVED = {"x", "y", "z", "red", "green", "blue", "alpha", "r", "g", "b", "a"}


@dataclass(frozen=True, eq=False)
class Values:
    """Numbers (V,) or (V, D) per vertex, and the names of the columns (may be empty)."""

    numbers: Floats
    names: tuple[str, ...] = ()


def load_values(path: str | Path, shape: Shape) -> Values:
    """Read numbers of the vertices of `shape`; `InputError` unless there is one row for each."""
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
    """All point arrays, such as those of ParaView and 3D Slicer; vectors become a column per component."""
    arrays = vtk_xml.point_arrays(path)
    if not arrays:
        raise InputError(f"{path.name} has no numbers at its points")
    columns = {name: values.reshape(len(values), -1).astype(np.float64) for name, values in arrays.items()}
    names = [f"{n}_{k}" if len(v.T) > 1 else n for n, v in columns.items() for k in range(len(v.T))]
    table = np.column_stack(list(columns.values()))
    return Values(table[:, 0] if len(names) == 1 else table, tuple(names))


def _read_text(path: Path, count: int) -> Values:
    """The numbers of a text table with one row for each of `count` vertices."""
    table = read_table(path)
    names, numbers = table.numbers()
    if not names and len(numbers) == count + 1 and _is_pandas_header(numbers[0]):
        names, numbers = ("", *map(str, range(numbers.shape[1] - 1))), numbers[1:]  # the header of a pandas file
    if not names and numbers.size == 0:
        raise InputError(f"{path.name} is empty")
    if len(numbers) == count:
        table.check_unambiguous()
    if names and names[0].lower() == "vertex":
        tables.check_numbered(numbers[:, 0])
        names, numbers = names[1:], numbers[:, 1:]
    elif len(names) > 1 and names[0] in ("", "Unnamed: 0") and _is_row_number(numbers[:, 0]):
        names, numbers = names[1:], numbers[:, 1:]
    return Values(numbers[:, 0] if numbers.shape[1] == 1 else numbers, names)


def _is_pandas_header(row: Floats) -> bool:
    """Whether a row is pandas' default header: an empty cell, then column numbers from 0."""
    return bool(np.isnan(row[0])) and len(row) > 1 and np.array_equal(row[1:], np.arange(len(row) - 1))


def _is_row_number(column: Floats) -> bool:
    """Whether a column counts the rows, from 0 as pandas does or from 1 as R does."""
    return any(np.array_equal(column, np.arange(len(column)) + first) for first in (0, 1))


def save_values(path: Path, values: Values, shape: Shape, file: Path | None = None) -> bool:
    """Write numbers of the vertices of `shape`; a .ply or .vtp ``file`` that it was read from keeps all its other data.

    Returns whether other data could be kept. `OptionError` if the suffix is not one of `VALUE_SUFFIXES`.
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
        point_arrays = vtk_xml.point_arrays(file) if suffix == ".vtp" and as_vtp is None else {}
        unique_names = _make_unique(
            [name or "value" for name in names], set(point_arrays if as_vtp is None else as_vtp.arrays)
        )
        arrays = dict(zip(unique_names, table.T, strict=True))
        if as_vtp is not None:
            path.write_bytes(as_vtp.with_arrays(arrays, {}))
        else:
            (vtk.write_vtp if suffix == ".vtp" else vtk.write_vtk)(path, shape, {**point_arrays, **arrays})
        return as_vtp is not None
    else:
        safe_names = ["".join(c if c.isascii() and (c.isalnum() or c == "_") else "_" for c in name) for name in names]
        unique_names = _make_unique([word or "value" for word in safe_names], _RESERVED)
        with np.errstate(over="ignore"):  # 32 bits, which more programs read; VTK, and so ParaView, reads no 64-bit ply
            written = table.astype(np.float32)
            difference = np.abs(written - table)
        whole = (table == np.rint(table)) & (np.abs(table) < 2**53)
        if (difference > np.where(whole, 0.0, _MAX_ROUNDING * np.abs(table))).any():
            warn(f"{path.name} has 32-bit numbers, which change some of these; .csv, .npy and .vtp keep them")
        columns, as_ply = dict(zip(unique_names, written.T, strict=True)), PlyFile.of(file, shape)
        if as_ply is not None:
            path.write_bytes(as_ply.with_columns(columns, {}))
        else:
            ply.write(path, shape, vertex=columns)
        return as_ply is not None
    return True


def _make_unique(names: list[str], taken: set[str]) -> list[str]:
    """Make names different from each other and from those taken: a second a becomes a_, a third a_2."""
    unique: list[str] = []
    used, times = set(taken), Counter[str]()
    for name in names:
        own = name
        while own in used:
            times[name] += 1
            own = f"{name}_" if times[name] == 1 else f"{name}_{times[name]}"
        used.add(own)
        unique.append(own)
    return unique


def parse_blank(text: str, columns: int) -> Float[Floats, " D"]:
    """Numbers of a user's text: one for all columns, one for each, or #rrggbb; `OptionError` if it is none of these."""
    numbers: list[float] = []
    try:
        if re.fullmatch("#[0-9a-fA-F]{6}", text):
            numbers = [byte / 255 for byte in bytes.fromhex(text[1:])]
        elif text.isascii() and "_" not in text:  # float() also accepts other digits and underscores
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


def linear_colors(shape: Shape, colors: ArrayLike | None = None) -> Float[Floats, "V 4"]:
    """Linear colors and alpha of the vertices of a shape: of its own colors (`InputError` if it has none), or of given sRGB
    ones (V, 3 or 4).
    """
    if colors is None:
        if shape.colors is None:
            problem = f"{shape.name or 'the source'} has no vertex colors"
            raise InputError(
                problem, "transfer its texture (transfer-texture), or other numbers (--values; transfer_values)"
            )
        return srgb_to_linear_alpha(shape.colors)
    table = check_colors(np.asarray(colors, np.float64))
    if len(table) != shape.V or table.ndim != 2:
        raise InputError(f"colors must be an array of ({shape.V}, 3 or 4), not {table.shape}")
    return srgb_to_linear_alpha(np.column_stack([table, np.ones(len(table))])[:, :4])


def check_colors(colors: Float[Floats, "*N C"]) -> Float[Floats, "*N C"]:
    """The same colors; `OptionError` unless they are 3 or 4 numbers within 0..1."""
    if colors.ndim == 0 or colors.shape[-1] not in (3, 4) or not ((colors >= 0) & (colors <= 1)).all():
        hint = "such as 0.5,0.5,0.5 or #808080"
        raise OptionError("a color has 3 or 4 numbers within 0..1: red, green, blue and alpha", hint)
    return colors


def parse_color(text: str | None) -> tuple[float, float, float, float] | None:
    """The sRGB color and alpha (0..1) of a text such as #808080; `OptionError` if it is not a color."""
    if text is None:
        return None
    red, green, blue, alpha = check_colors(parse_blank(text, 4)).tolist()
    return red, green, blue, alpha


def save_colors(
    path: Path,
    shape: Shape,
    colors: Float[Floats, "V 4"],
    file: Path | None = None,
    turn: Float[Floats, "3 3"] | None = None,
) -> bool:
    """Write `shape` with sRGB vertex colors; or the colors alone (.npy, .csv).

    `file`, `turn` and the return value are as in `save_colored`.
    """
    if check_color_suffix(path) in (".npy", ".csv"):
        return save_values(path, Values(colors, ("red", "green", "blue", "alpha")), shape)
    painted = Shape(shape.verts, shape.faces, shape.name, colors, shape.invalid)
    return save_colored(path, painted, file, np.eye(3) if turn is None else turn)
