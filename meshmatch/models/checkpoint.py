"""Save and load network weights as compact safetensors files, with strict checks.

Only the matrices of linear layers (``*.weight``, two or more axes) are compressed: they are nearly all of
a model. An ``int8`` matrix is stored with one float32 scale per row, ``name.scale``: q = round(w / scale),
scale = max |w| / 127; the error is at most half a scale. With ``float16`` the error is at most 2^-11 of each value.
Biases, norms and buffers (nodes, basis points, shape functions, running variances) stay float32: they are
small, and properties such as partition of unity must hold exactly.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from meshmatch.errors import ModelError, OptionError
from meshmatch.models.tensor_file import TensorInfo, read_header
from meshmatch.outputs import replace_on_success

Storage = Literal["float32", "float16", "int8"]
STORAGES: tuple[Storage, ...] = get_args(Storage)
SCALE = ".scale"
_KEY, _FORMAT = "meshmatch", "weights 1"
_MIN_COLUMNS = 64  # in matrices with fewer columns, scales would take as much space as they save


def save_weights(state: Mapping[str, Any], path: str | Path, *, storage: str = "float16") -> str:
    """Write a state dict and return the sha256 of the file (64 hex digits). Equal states give equal files.

    Values are arrays, or torch tensors on any device. "int8" quantises the matrices of linear layers with at least 64
    columns, and stores other matrices as float16. `ModelError` if a tensor is not finite, `OptionError` if the storage is
    unknown, `OutputError` if the file cannot be written.
    """
    if storage not in STORAGES:
        raise OptionError(f"unknown storage {storage!r}", f"choose one of {', '.join(STORAGES)}")
    arrays: dict[str, np.ndarray] = {}
    for name in sorted(state):
        array = state[name]
        array = np.array(array.numpy(force=True) if hasattr(array, "numpy") else array, order="C")
        if floating := array.dtype.kind == "f":
            array = array.astype(np.float32)
            if not np.isfinite(array).all():
                raise ModelError(f"weight {name} is not finite", "the training diverged: use an earlier checkpoint")
        if name.endswith(SCALE) and name.removesuffix(SCALE) in state:
            raise ModelError(f"{name} is reserved for the scale of {name.removesuffix(SCALE)}")
        if storage == "float32" or not (name.endswith("weight") and floating and array.ndim > 1):
            arrays[name] = array
        elif storage == "int8" and array.ndim == 2 and array.shape[1] >= _MIN_COLUMNS:
            scale = np.abs(array).max(axis=1) / np.float32(127.0)
            scale = np.where(scale > 0, scale, np.float32(1))  # rows of zeros
            arrays[name] = np.clip(np.round(array / scale[:, None]), -127, 127).astype(np.int8)
            arrays[name + SCALE] = scale
        else:
            with np.errstate(over="ignore"):
                half = array.astype(np.float16)
            arrays[name] = half if np.isfinite(half).all() else array
    with replace_on_success(path) as temporary:
        save_file(arrays, temporary, {_KEY: _FORMAT})
        with temporary.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()


def load_weights(path: str | Path, expected: Mapping[str, tuple[int, ...]]) -> dict[str, np.ndarray]:
    """Read what `save_weights` wrote; floating-point tensors become float32.

    ``expected`` are the names and shapes of the tensors. `ModelError` if the file is missing or damaged, or its tensors are
    not those expected.
    """
    path = Path(path)
    held = read_header(path)
    _check_tensors(path, held, expected)
    try:
        with safe_open(str(path), framework="numpy") as file:
            if (file.metadata() or {}).get(_KEY) != _FORMAT:
                raise _mismatch(path, "it is not a weights file of meshmatch")
            arrays = {name: file.get_tensor(name) for name in held}
    except (SafetensorError, OSError) as error:
        raise ModelError(f"{path} is damaged", "fetch or make it again") from error
    found: dict[str, np.ndarray] = {}
    for name in expected:
        array = arrays[name]
        with np.errstate(invalid="ignore", over="ignore"):  # values that are not finite are refused below
            if array.dtype == np.int8:
                array = array.astype(np.float32) * arrays[name + SCALE][:, None]
            elif array.dtype.kind == "f":
                array = array.astype(np.float32)
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise _mismatch(path, f"{name} is not finite")
        found[name] = array
    return found


def _check_tensors(path: Path, held: Mapping[str, TensorInfo], expected: Mapping[str, tuple[int, ...]]) -> None:
    """Raise `ModelError` unless the names, shapes and scales in a file are those of the expected tensors."""
    scales = {name for name in held if name.endswith(SCALE) and name.removesuffix(SCALE) in held}
    names = held.keys() - scales
    for word, wrong in (("missing", sorted(expected.keys() - names)), ("unexpected", sorted(names - expected.keys()))):
        if wrong:
            more = f" and {len(wrong) - 4} more" if len(wrong) > 4 else ""
            raise _mismatch(path, f"{word} {', '.join(wrong[:4])}{more}")
    for name, shape in expected.items():
        if held[name].shape != tuple(shape):
            raise _mismatch(path, f"{name} has shape {held[name].shape}, not {tuple(shape)}")
        scaled = name + SCALE in scales
        fits = scaled and len(shape) == 2 and held[name + SCALE] == TensorInfo("F32", (shape[0],))
        if (held[name].dtype == "I8" or scaled) and not (held[name].dtype == "I8" and fits):
            raise _mismatch(path, f"the scale of {name} is missing or does not fit it")


def _mismatch(path: Path, reason: str) -> ModelError:
    hint = "the card and the weights are of different models"
    return ModelError(f"{path} does not fit its model card: {reason}", hint)
