"""Reading and writing of skin weights per vertex: "Data on a shape" in docs/formats.md."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import csr_array, issparse

from meshmatch.arrays import ShortRepr
from meshmatch.errors import InputError
from meshmatch.outputs import plain_text
from meshmatch.shapes import tables
from meshmatch.shapes.input_files import read_bytes, read_json, read_npz
from meshmatch.shapes.shape import LARGEST, Shape
from meshmatch.transfer.attributes import joint_table

WEIGHT_SUFFIXES = (".npz", ".json")
check_weights_suffix = partial(tables.check_suffix, suffixes=WEIGHT_SUFFIXES, what="skin weights")
_WEIGHTS_FORMAT = "meshmatch skin weights 1"
_WEIGHTS_HINT = "arrays 'joints' (V, N) and 'weights' (V, N), or 'weights' (V, J) alone; 'names' (J,)"
_MAX_JOINTS = 1 << 20


@dataclass(frozen=True, eq=False, repr=False)
class SkinWeights(ShortRepr):
    """The influence of each joint on each vertex."""

    matrix: csr_array  # (V, J), not negative; rows sum to 1, or to 0 for a vertex that no joint moves
    names: tuple[str, ...]  # names of the J joints


def load_weights(path: str | Path, shape: Shape) -> SkinWeights:
    """Skin weights of the vertices of `shape`, from .npz, .json or a skin (.glb); `InputError` if they do not fit it."""
    from meshmatch.shapes.formats.gltf import SUFFIXES
    from meshmatch.shapes.formats.gltf_attributes import read_skin

    readers = {
        ".npz": lambda path: _from_record(read_npz(path, ("format", "names", "joints", "weights"))),
        ".json": lambda path: _from_record(read_json(path)),
        **dict.fromkeys(SUFFIXES, lambda path: read_skin(path, read_bytes(path))),
    }
    matrix, names = tables.read_by_suffix(path, readers, "skin weights", _WEIGHTS_HINT)
    return SkinWeights(_normalized(Path(path).name, matrix, shape), names)


def weights_of(matrix: csr_array | ArrayLike, shape: Shape) -> SkinWeights:
    """Skin weights of the vertices of `shape` from a dense or sparse (V, J) array of numbers that are not negative, else
    `InputError`; joints are named by number.
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
    """A (V, N) array of finite numbers; integers if `kind` is an integer type."""
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
    """Check that weights (V, J) fit `shape`, and scale rows to sum to 1."""
    if matrix.shape[0] != shape.V:
        problem = f"{name} has weights of {matrix.shape[0]} vertices, but {shape.name or 'the source'} has {shape.V}"
        raise InputError(problem, "one row is needed for each vertex of the source, in the order of its file")
    if matrix.nnz and not np.abs(matrix.data).max() < LARGEST:
        raise InputError(f"{name}: a weight is too large ({matrix.data.max():g})", "weights are shares from 0 to 1")
    matrix.sum_duplicates()
    if matrix.nnz and matrix.data.min() < 0:
        raise InputError(f"{name}: a weight is negative ({matrix.data.min():g})", "weights are shares from 0 to 1")
    total = np.asarray(matrix.sum(axis=1)).ravel()
    positive = total > 1 / LARGEST
    if not positive.any():
        raise InputError(f"{name}: all weights are 0", "is it the right file?")
    scale = np.where(positive, 1.0 / np.where(positive, total, 1.0), 0.0)
    matrix = csr_array(matrix * scale[:, None])
    matrix.eliminate_zeros()
    return matrix


def save_weights(path: Path, weights: SkinWeights) -> None:
    """Write skin weights; `OptionError` if the suffix is not one of `WEIGHT_SUFFIXES`."""
    suffix = check_weights_suffix(path)
    joints, shares = joint_table(weights.matrix)
    if suffix == ".npz":
        names = np.array(weights.names, np.str_)
        tables.write_npz(path, {"format": _WEIGHTS_FORMAT, "names": names, "joints": joints, "weights": shares})
    else:
        record = {"format": _WEIGHTS_FORMAT, "names": weights.names, "joints": joints.tolist()}
        tables.write_json(path, record | {"weights": tables.short_floats(shares)})
