"""Numbers, colors and skin weights of each vertex, from files and to files: "Data on a shape" in docs/formats.md.

Colors are mixed as light; a `Shape` has them as screens show them (sRGB), whatever its file has.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import csr_array, issparse

from meshmatch.arrays import Brief, Float, Floats
from meshmatch.errors import InputError, OptionError
from meshmatch.outputs import plain_text
from meshmatch.shapes import tables
from meshmatch.shapes.colors import light
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.input_files import read_bytes, read_json, read_npy, read_npz
from meshmatch.shapes.shape import LARGEST, Shape
from meshmatch.shapes.tables import read_table

VALUE_SUFFIXES = (".npy", ".csv", ".ply")
_COLOR_SUFFIXES = (".ply", ".glb", ".obj", ".off", ".npy", ".csv")
check_values_suffix = partial(tables.check_suffix, suffixes=VALUE_SUFFIXES, what="values")
check_color_suffix = partial(tables.check_suffix, suffixes=_COLOR_SUFFIXES, what="vertex colors")
_HINT = "one row of numbers for each vertex of the source, in the order of its file: .npy or .csv"
# Properties that a ply has already.
_RESERVED = {"x", "y", "z", "red", "green", "blue", "alpha", "r", "g", "b", "a"}
WEIGHT_SUFFIXES = (".npz", ".json")
check_weights_suffix = partial(tables.check_suffix, suffixes=WEIGHT_SUFFIXES, what="skin weights")
_WEIGHTS_FORMAT = "meshmatch skin weights 1"
_WEIGHTS_HINT = "arrays 'joints' (V, N) and 'weights' (V, N), or 'weights' (V, J) alone; 'names' (J,)"
_MAX_JOINTS = 1 << 20


@dataclass(frozen=True, eq=False)
class Values:
    """Numbers (V,) or (V, D) of each vertex, and a name for each column (may be empty)."""

    numbers: Floats
    names: tuple[str, ...] = ()


def load_values(path: str | Path, shape: Shape) -> Values:
    """Read numbers of the vertices of `shape`; `InputError` if there is not one row for each."""
    readers = {".npy": _read_npy} | dict.fromkeys((".csv", ".txt"), lambda path: _read_text(path, shape.V))
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


def save_values(path: Path, values: Values, shape: Shape) -> None:
    """Write numbers of the vertices of `shape`; `OptionError` if the suffix is not one of `VALUE_SUFFIXES`."""
    suffix, numbers = check_values_suffix(path), values.numbers
    table = numbers if numbers.ndim == 2 else numbers[:, None]
    columns = table.shape[1]
    names = values.names or (("value",) if columns == 1 else tuple(f"value_{k}" for k in range(columns)))
    if suffix == ".npy":
        tables.write_npy(path, numbers)
    elif suffix == ".csv":
        tables.write_rows(path, ["vertex", *names], ([k, *row] for k, row in enumerate(table.tolist())))
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
            raise InputError(problem, "give numbers with --values, or transfer its texture: meshmatch transfer-texture")
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


def save_colors(path: Path, shape: Shape, colors: Float[Floats, "V 4"]) -> None:
    """Write `shape` with vertex colors as screens show them; or the colors alone."""
    if check_color_suffix(path) in (".npy", ".csv"):
        save_values(path, Values(colors, ("red", "green", "blue", "alpha")), shape)
    else:
        save_shape(path, Shape(shape.verts, shape.faces, shape.name, colors, shape.invalid))


@dataclass(frozen=True, eq=False, repr=False)
class SkinWeights(Brief):
    """How much each joint moves each vertex."""

    matrix: csr_array  # (V, J), not negative; rows sum to 1, or to 0 for a vertex that nothing moves
    names: tuple[str, ...]  # of the joints


def load_weights(path: str | Path, shape: Shape) -> SkinWeights:
    """Skin weights of the vertices of `shape`, from .npz, .json, .glb or .gltf; `InputError` if not its own."""
    from meshmatch.shapes.formats.gltf_attributes import read_skin

    readers = {
        ".npz": lambda path: _from_record(read_npz(path, ("format", "names", "joints", "weights"))),
        ".json": lambda path: _from_record(read_json(path)),
        ".glb": lambda path: read_skin(path, read_bytes(path)),
        ".gltf": lambda path: read_skin(path, read_bytes(path)),
    }
    matrix, names = tables.read_by_suffix(path, readers, "skin weights", _WEIGHTS_HINT)
    return SkinWeights(_normalized(Path(path).name, matrix, shape), names)


def weights_of(matrix: csr_array | ArrayLike, shape: Shape) -> SkinWeights:
    """Skin weights of the vertices of `shape` from a table (V, J), dense or sparse, of numbers that are not negative
    (`InputError`); joints are named by number.
    """
    table: Any = matrix if issparse(matrix) else _table("weights", matrix, np.float64)
    sparse = csr_array(table, dtype=np.float64)
    return SkinWeights(_normalized("the array", sparse, shape), tuple(str(joint) for joint in range(sparse.shape[1])))


def _from_record(record: Any) -> tuple[csr_array, tuple[str, ...]]:
    if not isinstance(record, Mapping) or "weights" not in record:
        raise InputError("there is no 'weights' in it")
    weights = _table("weights", record["weights"], np.float64)
    joints = _table("joints", record["joints"], np.int64) if "joints" in record else None
    if "names" in record:
        names = tuple(plain_text(str(word)) for word in np.ravel(np.asarray(record["names"], np.str_)))
    else:
        count = weights.shape[1] if joints is None else int(joints.max(initial=-1)) + 1
        names = tuple(f"joint {k}" for k in range(max(min(count, _MAX_JOINTS), 1)))
    if joints is None:
        if weights.shape[1] != len(names):
            raise InputError(f"there are {weights.shape[1]} columns for {len(names)} names")
        return csr_array(weights), names
    if joints.shape != weights.shape:
        raise InputError(f"'joints' is an array of {joints.shape}, but 'weights' of {weights.shape}")
    row, column = np.nonzero(weights)
    used = joints[row, column]
    if len(used) and not 0 <= used.min() <= used.max() < len(names):
        raise InputError(f"it names joint {used.max()}, but there are {len(names)}", "they count from 0")
    return csr_array((weights[row, column], (row, used)), (len(weights), len(names))), names


def _table(key: str, values: ArrayLike, kind: type) -> np.ndarray:
    """An array (V, N) of finite numbers, whole ones where `kind` is an integer."""
    try:
        array = np.asarray(values)
        if array.ndim != 2 or array.dtype.kind not in "iuf" or not np.isfinite(array).all():
            raise ValueError(f"an array of {array.shape} {array.dtype}")
        if kind is np.int64 and (array != np.round(array)).any():
            raise ValueError("its numbers are not whole")
        if kind is np.int64 and (np.abs(array.astype(np.float64)) >= 2**53).any():
            raise ValueError("its numbers are too large")
    except ValueError as error:
        raise InputError(f"'{key}' is not a table of numbers: {error}", _WEIGHTS_HINT) from error
    return array.astype(kind)


def _normalized(name: str, matrix: csr_array, shape: Shape) -> csr_array:
    """Weights (V, J) checked to be of `shape`, and with rows that sum to 1."""
    if matrix.shape[0] != shape.V:
        problem = f"{name} has weights of {matrix.shape[0]} vertices, but {shape.name or 'the source'} has {shape.V}"
        raise InputError(problem, "one row is needed for each vertex of the source, in the order of its file")
    if matrix.nnz and not np.abs(matrix.data).max() < LARGEST:
        raise InputError(f"{name}: a weight is too large ({matrix.data.max():g})", "weights are shares from 0 to 1")
    matrix.sum_duplicates()
    if matrix.nnz and matrix.data.min() < 0:
        raise InputError(f"{name}: a weight is negative ({matrix.data.min():g})", "weights are shares from 0 to 1")
    total = np.asarray(matrix.sum(axis=1)).ravel()
    some = total > 1 / LARGEST
    if not some.any():
        raise InputError(f"{name}: all weights are 0", "is it the right file?")
    scale = np.where(some, 1.0 / np.where(some, total, 1.0), 0.0)
    matrix = csr_array(matrix * scale[:, None])
    matrix.eliminate_zeros()
    return matrix


def save_weights(path: Path, weights: SkinWeights) -> None:
    """Write skin weights; `OptionError` if the suffix is not one of `WEIGHT_SUFFIXES`."""
    suffix = check_weights_suffix(path)
    matrix = csr_array(weights.matrix)
    V = matrix.shape[0]
    rows = np.repeat(np.arange(V), np.diff(matrix.indptr))
    order = np.lexsort((matrix.indices, -matrix.data, rows))
    place = np.arange(len(order)) - matrix.indptr[rows[order]]
    N = int(np.diff(matrix.indptr).max(initial=1))
    joints, shares = np.zeros((V, N), np.int32), np.zeros((V, N), np.float32)
    joints[rows[order], place] = matrix.indices[order]
    shares[rows[order], place] = matrix.data[order]
    if suffix == ".npz":
        names = np.array(weights.names, np.str_)
        tables.write_npz(path, {"format": _WEIGHTS_FORMAT, "names": names, "joints": joints, "weights": shares})
    else:
        record = {"format": _WEIGHTS_FORMAT, "names": weights.names, "joints": joints.tolist()}
        tables.write_json(path, record | {"weights": tables.short_floats(shares)})
