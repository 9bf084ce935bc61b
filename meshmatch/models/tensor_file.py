"""Inspect safetensors files by their headers; safetensors itself checks that the header matches the file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import NamedTuple

from meshmatch.errors import ModelError

MAX_BYTES = 500_000_000
"""Larger files are refused."""
_MAX_HEADER = 1_000_000  # bytes


class TensorInfo(NamedTuple):
    """Type and shape of one tensor in a file."""

    dtype: str
    shape: tuple[int, ...]


def read_header(path: str | Path) -> dict[str, TensorInfo]:
    """Read the header of a safetensors file: types and shapes of its tensors by name.

    `ModelError` if it is missing, not a regular file, larger than `MAX_BYTES`, or the header does not match the contents.
    """
    from safetensors import SafetensorError, safe_open

    path = Path(path)
    try:
        if not path.is_file():
            raise ModelError(f"cannot read {path}: there is no such file", "is the model complete?")
        if (size := path.stat().st_size) > MAX_BYTES:
            raise OSError(f"it has {size:,} bytes; at most {MAX_BYTES:,} are allowed")
        with safe_open(str(path), "numpy") as file:
            slices = {name: file.get_slice(name) for name in file.keys()}  # noqa: SIM118 (it is no dictionary)
            return {name: TensorInfo(s.get_dtype(), tuple(s.get_shape())) for name, s in slices.items()}
    except (SafetensorError, OSError) as error:
        raise ModelError(f"{path} is damaged: {str(error)[:200]}", "fetch or make it again") from error


def is_whole(path: Path) -> bool:
    """Whether a safetensors file exists with the length that its header requires; a quick check without NumPy."""
    try:
        if not path.is_file():
            return False
        size = path.stat().st_size
        with path.open("rb") as file:
            length = int.from_bytes(file.read(8), "little")
            if not 0 < length <= min(size - 8, _MAX_HEADER):
                return False
            header = json.loads(file.read(length))
        ends = [tensor["data_offsets"][1] for name, tensor in header.items() if name != "__metadata__"]
        return bool(size == 8 + length + max(ends, default=0))
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
        return False
