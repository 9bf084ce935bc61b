"""A model's weights as they are computed with, in a file of the user's cache folder that processes share.

In its own file a model's matrices have 8 bits. Expanded to float32 they are four times as large, and each process would
hold them for itself. So they are kept once more, and mapped read-only: all processes see the same memory. There is one
such file for each name of the registry. Whoever finds it missing, damaged or of other weights replaces it; where that
cannot be done, a process has its weights to itself.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from meshmatch.errors import OutputError
from meshmatch.outputs import home_folder, make_folder, replace_on_success

_LAYOUT = "meshmatch weights 1"  # another number wherever the same weights would give other bytes
_HEAD, _STEP = 256, 64  # bytes before the first tensor, and at multiples of how many each of them begins


def shared_file(name: str) -> Path:
    """The file of a model of the registry."""
    return home_folder("cache") / "weights" / f"{name}.float32"


def shared_weights(
    name: str, sha256: str, shapes: Mapping[str, tuple[int, ...]], expand: Callable[[], dict[str, np.ndarray]]
) -> dict[str, np.ndarray]:
    """What ``expand()`` gives, mapped and read-only where possible, for the weights with a hash that was checked."""
    path = shared_file(name)
    key = hashlib.sha256(f"{sha256} {sorted(shapes.items())}".encode()).hexdigest()
    found = _mapped(path, key, shapes)
    if found is not None:
        return found
    weights = expand()
    if any(weights[each].dtype != _dtype(each) for each in shapes):
        return weights
    places, size = _places(shapes)
    raw = np.zeros(size, np.uint8)
    for each, place in places.items():
        raw[place] = np.frombuffer(weights[each].tobytes(), np.uint8)
    raw[:_HEAD] = np.frombuffer(_head(key, raw[_HEAD:]), np.uint8)
    try:
        make_folder(path.parent)
        with replace_on_success(path) as temporary:
            temporary.write_bytes(raw.data)
    except (OSError, OutputError):
        return weights
    found = _mapped(path, key, shapes)
    return weights if found is None else found


def _mapped(path: Path, key: str, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, np.ndarray] | None:
    try:
        raw = np.asarray(np.memmap(path, np.uint8, "r"))
    except (OSError, ValueError):  # missing, or empty
        return None
    places, size = _places(shapes)
    if len(raw) != size or raw[:_HEAD].tobytes() != _head(key, raw[_HEAD:]):
        return None
    return {name: raw[places[name]].view(_dtype(name)).reshape(shape) for name, shape in shapes.items()}


def _places(shapes: Mapping[str, tuple[int, ...]]) -> tuple[dict[str, slice], int]:
    """Where each tensor lies in the file, and how long that is."""
    places, end = {}, _HEAD
    for name in sorted(shapes):
        size = math.prod(shapes[name]) * _dtype(name).itemsize
        places[name] = slice(end, end + size)
        end += -(-size // _STEP) * _STEP
    return places, end


def _dtype(name: str) -> np.dtype:
    return np.dtype(np.int64 if name.endswith(".num_batches_tracked") else np.float32)


def _head(key: str, content: np.ndarray) -> bytes:
    """What the file begins with; it says the sum of the rest, which takes a tenth of the time of expanding it."""
    return f"{_LAYOUT} {key} {content.view(np.uint64).sum():016x}".encode().ljust(_HEAD, b"\0")
