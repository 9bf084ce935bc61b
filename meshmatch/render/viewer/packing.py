"""Arrays in a page: one compressed run of bytes as base64, and a table of what lies where in it."""

from __future__ import annotations

import base64
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from meshmatch.arrays import Floats

_KINDS = {"u1": "Uint8Array", "i1": "Int8Array", "u2": "Uint16Array", "u4": "Uint32Array", "f4": "Float32Array"}


def pack(arrays: Mapping[str, NDArray[Any]]) -> tuple[list[dict[str, Any]], str]:
    """A table ``[{name, kind, start, length}]`` and the text that holds the arrays.

    Little-endian, each array at a multiple of 4 bytes, zlib (RFC 1950), base64. The kind is the name of
    JavaScript's typed array; the start is in bytes and the length in numbers.
    """
    table, parts, start = [], [], 0
    for name, array in arrays.items():
        code = array.dtype.kind + str(array.dtype.itemsize)
        data = np.ascontiguousarray(array, dtype="<" + code).tobytes()
        table.append({"name": name, "kind": _KINDS[code], "start": start, "length": int(array.size)})
        parts += [data, bytes(-len(data) % 4)]
        start += len(data) + len(parts[-1])
    return table, base64.b64encode(zlib.compress(b"".join(parts), 6)).decode("ascii")


def to_bytes(values: ArrayLike) -> NDArray[np.uint8]:
    """0..1 as 0..255."""
    return np.round(255 * np.clip(np.asarray(values, np.float64), 0.0, 1.0)).astype(np.uint8)


def to_signed_bytes(values: Floats) -> NDArray[np.int8]:
    """-1..1 as -127..127."""
    return np.round(127 * np.clip(values, -1.0, 1.0)).astype(np.int8)


def to_shorts(values: Floats) -> NDArray[np.uint16]:
    """0..1 as 0..65535."""
    return np.round(65535 * np.clip(values, 0.0, 1.0)).astype(np.uint16)


def small_integers(values: NDArray[np.int64]) -> NDArray[Any]:
    """Whole numbers from 0 in 16 bits if they fit (65535 itself means something else to WebGL), else in 32."""
    return values.astype(np.uint16 if len(values) == 0 or values.max() < 65535 else np.uint32)
