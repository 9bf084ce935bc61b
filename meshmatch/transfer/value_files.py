"""Numbers and colours of each vertex, from files and to files.

=====  ========================================================================
.npy   (V,) or (V, D) float64
.csv   a row per vertex: the vertex, then a column per number, with their names
.ply   the shape, with a property per number (written only)
=====  ========================================================================

Colours go into shape files: .ply, .obj, .off, .glb. They are mixed as light; a `Shape` has them as screens show them
(sRGB), whatever its file has.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from meshmatch.arrays import Float, Floats
from meshmatch.errors import InputError, OptionError
from meshmatch.maps import table_files
from meshmatch.shapes.colors import to_linear, to_srgb
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.input_files import read_npy
from meshmatch.shapes.shape import Shape

VALUE_SUFFIXES = (".npy", ".csv", ".ply")
_COLOR_SUFFIXES = (".ply", ".glb", ".obj", ".off", ".npy", ".csv")
check_values_suffix = partial(table_files.check_suffix, suffixes=VALUE_SUFFIXES, what="values")
check_color_suffix = partial(table_files.check_suffix, suffixes=_COLOR_SUFFIXES, what="vertex colours")
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

    `InputError` if the file is missing or damaged, holds no numbers, or not one row for each vertex.
    """
    readers = {".npy": _read_npy, ".csv": _read_csv, ".txt": _read_csv}
    found = table_files.read_by_suffix(path, readers, "values", _HINT)
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
    rows = table_files.read_rows(path)
    if not rows:
        raise InputError(f"{path.name} is empty")
    names: tuple[str, ...] = ()
    try:
        _numbers(rows[:1])
    except ValueError:
        names, rows = tuple(rows[0]), rows[1:]
    widths = {len(row) for row in rows} | ({len(names)} if names else set())
    if len(widths) > 1:
        raise InputError(f"it has rows of {min(widths)} and of {max(widths)} cells")
    table = _numbers(rows).reshape(len(rows), widths.pop())
    if names and names[0].lower() == "vertex":
        table_files.check_numbered(table[:, 0])
        names, table = names[1:], table[:, 1:]
    return Values(table[:, 0] if table.shape[1] == 1 else table, names)


def _numbers(rows: list[list[str]]) -> Floats:
    return np.array([[float(cell or "nan") for cell in row] for row in rows])


def save_values(path: Path, values: Values, shape: Shape) -> None:
    """Write numbers of the vertices of `shape`; `OptionError` if the suffix is not one of `VALUE_SUFFIXES`."""
    suffix, numbers = check_values_suffix(path), values.numbers
    table = numbers if numbers.ndim == 2 else numbers[:, None]
    columns = table.shape[1]
    names = values.names or (("value",) if columns == 1 else tuple(f"value_{k}" for k in range(columns)))
    if suffix == ".npy":
        table_files.write_npy(path, numbers)
    elif suffix == ".csv":
        table_files.write_rows(path, ["vertex", *names], ([k, *row] for k, row in enumerate(table.tolist())))
    else:
        from meshmatch.shapes.formats import ply

        taken: list[str] = []  # as a header can hold them: no spaces, none twice, none that a ply uses already
        for name in names:
            word = "".join(c if c.isascii() and (c.isalnum() or c == "_") else "_" for c in name) or "value"
            while word in taken or word in _RESERVED:
                word += "_"
            taken.append(word)
        ply.write(path, shape, vertex=dict(zip(taken, table.T, strict=True)))


def parse_blank(text: str, columns: int) -> Float[Floats, " D"]:
    """The values to write where nothing is known, from the user's text: a number, numbers, or #rrggbb.

    `OptionError` for any other text, or not as many numbers as there are columns.
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


def light_of(shape: Shape, colors: ArrayLike | None = None) -> Float[Floats, "V 4"]:
    """Light of the vertices of a shape, from its own colours or from others (V, 3 or 4) as screens show them.

    `InputError` if it has no vertex colours; or not one for each vertex, within 0..1.
    """
    if colors is None:
        if shape.colors is None:
            raise InputError(
                f"{shape.name or 'the source'} has no vertex colours",
                "give numbers with --values, or transfer its texture: meshmatch transfer-texture",
            )
        return light(shape.colors)
    table = checked_colors(np.asarray(colors, np.float64))
    if len(table) != shape.V or table.ndim != 2:
        raise InputError(f"colours must be an array of ({shape.V}, 3 or 4), not {table.shape}")
    return light(np.column_stack([table, np.ones(len(table))])[:, :4])


def checked_colors(colors: Float[Floats, "*N C"]) -> Float[Floats, "*N C"]:
    """The same colours; `OptionError` where they are not 3 or 4 numbers within 0..1."""
    if colors.ndim == 0 or colors.shape[-1] not in (3, 4) or not ((colors >= 0) & (colors <= 1)).all():
        raise OptionError(
            "a colour has 3 or 4 numbers within 0..1: red, green, blue and alpha", "such as 0.5,0.5,0.5 or #808080"
        )
    return colors


def light(colors: Float[Floats, "*N C"]) -> Float[Floats, "*N C"]:
    """Light of colours (..., 3 or 4) as screens show them; alpha is left as it is."""
    return np.concatenate([to_linear(colors[..., :3]), colors[..., 3:]], axis=-1)


def seen(amounts: Float[Floats, "V 4"]) -> Float[Floats, "V 4"]:
    """Colours as screens show them (sRGB, 0..1) of light; nan is black."""
    amounts = np.clip(np.nan_to_num(amounts), 0.0, 1.0)
    return np.concatenate([to_srgb(amounts[:, :3]), amounts[:, 3:]], axis=1)


def parse_color(text: str | None) -> tuple[float, float, float, float] | None:
    """The colour and alpha (sRGB, 0..1) that a text such as #808080 means; `OptionError` if it means none."""
    if text is None:
        return None
    red, green, blue, alpha = checked_colors(parse_blank(text, 4)).tolist()
    return red, green, blue, alpha


def save_colors(path: Path, shape: Shape, colors: Float[Floats, "V 4"]) -> None:
    """Write `shape` with vertex colours as screens show them; or the colours alone."""
    if check_color_suffix(path) in (".npy", ".csv"):
        save_values(path, Values(colors, ("red", "green", "blue", "alpha")), shape)
    else:
        save_shape(path, Shape(shape.verts, shape.faces, shape.name, colors, shape.invalid))
