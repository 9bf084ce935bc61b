"""Skin weights from files and to files: npz and json with the same names, and the skins of glb and gltf.

=======  =========================================================================================
format   ``meshmatch skin weights 1``
names    (J,) text: the joints (bones)
joints   (V, N) int32: joints of each vertex, by their place in `names`; the heaviest first
weights  (V, N) float32: how much of each; a row sums to 1, unused places hold joint 0 and weight 0
=======  =========================================================================================

N is the most that any vertex has. Also read: `weights` (V, J) without `joints`, one column for each joint.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import csr_array

from meshmatch.errors import InputError, OptionError
from meshmatch.outputs import plain_text
from meshmatch.shapes.array_files import read_npz
from meshmatch.shapes.paths import existing
from meshmatch.shapes.shape import Shape

_FORMAT = "meshmatch skin weights 1"
_KEYS = ("format", "names", "joints", "weights")
_HINT = "arrays 'joints' (V, N) and 'weights' (V, N), or 'weights' (V, J) alone; 'names' (J,)"
_SLACK = 1e-3


@dataclass(frozen=True, eq=False)
class SkinWeights:
    """How much each joint moves each vertex.

    Parameters
    ----------
    matrix : (V, J) sparse
        Not negative. Rows sum to 1, or to 0 for a vertex that nothing moves.
    names : (J,) tuple of str
    """

    matrix: csr_array
    names: tuple[str, ...]


def load_weights(path: str | Path, shape: Shape) -> SkinWeights:
    """Read skin weights of the vertices of `shape`, from .npz, .json, .glb or .gltf.

    Raises
    ------
    InputError
        The file is missing or damaged, holds no weights, or not those of `shape`.
    """
    path = existing(Path(path), _HINT)
    suffix = path.suffix.lower()
    if suffix in (".glb", ".gltf"):
        from meshmatch.shapes.formats.gltf_skin import read_skin

        skin = read_skin(path, path.read_bytes())
        matrix = csr_array((skin.weight, (skin.vertex, skin.joint)), shape=(skin.V, len(skin.names)))
        return _checked(path.name, matrix, skin.names, shape)
    if suffix == ".npz":
        record: dict[str, Any] = dict(read_npz(path, _KEYS))
    elif suffix == ".json":
        record = _read_json(path)
    else:
        raise InputError(
            f"{path.name}: skin weights are not read from '{suffix}' files", "choose .npz, .json or .glb"
        )
    if "weights" not in record:
        raise InputError(f"{path.name}: there is no 'weights' in it", _HINT)
    return _from_record(path.name, record, shape)


def _read_json(path: Path) -> dict[str, Any]:
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path.name} is not JSON: {error}", _HINT) from error
    if not isinstance(record, dict):
        raise InputError(f"{path.name} holds no object with 'weights'", _HINT)
    return {key: record[key] for key in _KEYS if key in record}


def _from_record(name: str, record: dict[str, Any], shape: Shape) -> SkinWeights:
    weights = _table(name, "weights", record["weights"], np.float64)
    if "names" in record:
        names = tuple(plain_text(str(word)) for word in np.ravel(np.asarray(record["names"], np.str_)))
    else:
        count = weights.shape[1] if "joints" not in record else int(np.max(record["joints"], initial=-1)) + 1
        names = tuple(f"joint {k}" for k in range(max(min(count, 1 << 20), 1)))
    if "joints" in record:
        joints = _table(name, "joints", record["joints"], np.int64)
        if joints.shape != weights.shape:
            raise InputError(
                f"{name}: 'joints' is an array of {joints.shape}, but 'weights' of {weights.shape}", _HINT
            )
        used = weights != 0
        if used.any() and not 0 <= joints[used].min() <= joints[used].max() < len(names):
            raise InputError(
                f"{name} names joint {joints[used].max()}, but there are {len(names)}", "they count from 0"
            )
        row, column = np.nonzero(used)
        entries = weights[row, column], (row, joints[row, column])
        matrix = csr_array(entries, shape=(len(weights), len(names)))
    else:
        if weights.shape[1] != len(names):
            raise InputError(f"{name} has {weights.shape[1]} columns for {len(names)} names", _HINT)
        matrix = csr_array(weights)
    return _checked(name, matrix, names, shape)


def _table(name: str, key: str, values: ArrayLike, kind: type) -> np.ndarray:
    try:
        array = np.asarray(values)
        if array.ndim != 2 or array.dtype.kind not in "iuf" or not np.isfinite(array).all():
            raise ValueError(f"an array of {array.shape} {array.dtype}")
        if kind is np.int64 and (array != np.round(array)).any():
            raise ValueError("its numbers are not whole")
    except ValueError as error:
        raise InputError(f"{name}: '{key}' is no table of numbers: {error}", _HINT) from error
    return array.astype(kind)


def _checked(name: str, matrix: csr_array, names: tuple[str, ...], shape: Shape) -> SkinWeights:
    if matrix.shape[0] != shape.V:
        raise InputError(
            f"{name} has weights of {matrix.shape[0]} vertices, but {shape.name or 'the source'} has {shape.V}",
            "one row is needed for each vertex of the source, in the order of its file",
        )
    matrix.sum_duplicates()
    if matrix.nnz and matrix.data.min() < 0:
        raise InputError(
            f"{name}: a weight is negative ({matrix.data.min():g})", "weights are shares from 0 to 1"
        )
    total = np.asarray(matrix.sum(axis=1)).ravel()
    if not (total > 0).any():
        raise InputError(f"{name}: all weights are 0", "is it the right file?")
    scale = np.where(total > 0, 1.0 / np.where(total > 0, total, 1.0), 0.0)
    matrix = csr_array(matrix * scale[:, None])
    matrix.eliminate_zeros()
    return SkinWeights(matrix, names)


def check_weights_suffix(path: Path) -> None:
    """Refuse a suffix that cannot hold skin weights (`OptionError`)."""
    if path.suffix.lower() not in (".npz", ".json"):
        raise OptionError(
            f"{path.name}: skin weights cannot be kept as '{path.suffix or 'a file without a suffix'}'",
            "end the name in .npz or .json",
        )


def save_weights(path: Path, weights: SkinWeights) -> None:
    """Write skin weights; see the module for the format.

    Raises
    ------
    OptionError
        The suffix is neither .npz nor .json.
    """
    check_weights_suffix(path)
    matrix = csr_array(weights.matrix)
    V = matrix.shape[0]
    rows = np.repeat(np.arange(V), np.diff(matrix.indptr))
    order = np.lexsort((matrix.indices, -matrix.data, rows))
    place = np.arange(len(order)) - matrix.indptr[rows[order]]
    N = int(np.diff(matrix.indptr).max(initial=1))
    joints, shares = np.zeros((V, N), np.int32), np.zeros((V, N), np.float32)
    joints[rows[order], place] = matrix.indices[order]
    shares[rows[order], place] = matrix.data[order]
    if path.suffix.lower() == ".npz":
        record = {
            "format": np.array(_FORMAT),
            "names": np.array(weights.names, np.str_),
            "joints": joints,
            "weights": shares,
        }
        with path.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **record)
        return
    words = {
        "format": _FORMAT,
        "names": list(weights.names),
        "joints": joints.tolist(),
        "weights": shares.astype(np.str_).astype(np.float64).tolist(),  # the shortest text of each
    }
    path.write_text(json.dumps(words, ensure_ascii=False) + "\n", encoding="utf-8")
