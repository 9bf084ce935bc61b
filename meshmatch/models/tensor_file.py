"""What a safetensors file holds, told by its header; safetensors itself checks that header and file belong together."""

from __future__ import annotations

import json
from pathlib import Path
from typing import NamedTuple

from meshmatch.errors import ModelError

MAX_BYTES = 500_000_000
"""A larger file is refused."""
_MAX_HEADER = 1_000_000  # bytes


class TensorInfo(NamedTuple):
    """Of one tensor in a file."""

    dtype: str
    shape: tuple[int, ...]


def read_header(path: str | Path) -> dict[str, TensorInfo]:
    """The tensors of a safetensors file; nothing else of it is read.

    `ModelError` if it is missing, not a regular file, larger than `MAX_BYTES`, or its header and its bytes do not match.
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
    """Whether a safetensors file is there, and as long as its header says; quickly, and without NumPy."""
    try:
        if not path.is_file():
            return False
        size = path.stat().st_size
        with path.open("rb") as file:
            length = int.from_bytes(file.read(8), "little")
            if not 0 < length <= min(size - 8, _MAX_HEADER):
                return False
            words = json.loads(file.read(length))
        ends = [tensor["data_offsets"][1] for name, tensor in words.items() if name != "__metadata__"]
        return bool(size == 8 + length + max(ends, default=0))
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
        return False
