"""Read the rows of elements of PLY and PCD files. Rows of equal length are read at once, as a structured array."""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshmatch.arrays import Int, Ints
from meshmatch.errors import InputError
from meshmatch.shapes.formats import BASE_ELEMENTS, concatenated_ranges, damaged, indices, parse_numbers
from meshmatch.shapes.input_files import check_text_size

TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8", "int64": "i8", "uint64": "u8",
}  # fmt: skip


@dataclass
class Property:
    """A property of an element; `kind` is a NumPy type code such as "f4" (for properties to be written, a PLY type)."""

    name: str
    kind: str
    count_kind: str | None = None  # type of the count of a list; None for a single value


@dataclass
class Element:
    """An element of the header: `count` rows with these properties."""

    name: str
    count: int
    properties: list[Property] = field(default_factory=list)
    role: str = ""
    """One of vertex, face and tristrips; empty for elements that are not part of a shape."""
    table: dict[str, Any] = field(default_factory=dict)
    """Its data by property; see `Body.element`."""
    bytes: slice = field(default_factory=lambda: slice(0))
    """Byte range of its rows in a binary file."""


class Body:
    """The data after the header, read one element after the other.

    A text body (``order`` is None) is first parsed into float64 numbers, and then read as binary data of that type.
    """

    def __init__(self, name: str, data: bytes, start: int, order: str | None) -> None:
        self.name, self.at, self.order, self.text = name, start, order or "=", order is None
        self.data: Any = data
        self.max_items = 3 * (BASE_ELEMENTS + len(data) // (24 if self.text else 12))  # limit for items of lists
        if self.text:
            check_text_size(name, data)
            self.data, self.at = parse_numbers(name, data[start:]).view(np.uint8).data, 0

    def element(self, element: Element) -> dict[str, Any]:
        """Read all rows of an element.

        Returns, by property, its values; for lists, the items of all lists (integers unless declared as floats) and the
        size of each list.
        """
        kinds = [self._dtype(p.count_kind or p.kind) for p in element.properties]
        self._check(element, self.at + element.count * sum(kind.itemsize for kind in kinds))
        start = self.at
        table = self._read_equal_rows(element) if element.count else None
        table = table if table is not None else self._read_row_by_row(element)
        element.bytes = slice(start, self.at)
        return table

    def rows_left(self, element: Element) -> int:
        """Number of complete rows, of an element without lists, that fit into the remaining data."""
        row = sum(self._dtype(p.kind).itemsize for p in element.properties)
        return (len(self.data) - self.at) // row if row else 0

    def _check(self, element: Element, end: int) -> None:
        if element.count < 0 or end > len(self.data):
            raise damaged(self.name, f"fewer {element.name} rows than the {element.count} that its header promises")

    def _dtype(self, kind: str) -> np.dtype[Any]:
        return np.dtype("f8" if self.text else self.order + kind)

    def _read_equal_rows(self, element: Element) -> dict[str, Any] | None:
        """Read rows that are all as long as the first one, as a structured array without copying; None if they differ."""
        fields: list[Any] = []
        at = self.at
        for k, p in enumerate(element.properties):
            size = 1
            if p.count_kind:
                size = self._count(at, p.count_kind)
                at += self._dtype(p.count_kind).itemsize
                fields.append((f"n{k}", self._dtype(p.count_kind)))
            at += size * self._dtype(p.kind).itemsize
            if at > len(self.data):
                return None
            fields.append((f"v{k}", self._dtype(p.kind), (size,) if p.count_kind else ()))
        end = self.at + (at - self.at) * element.count
        if end > len(self.data):
            return None
        rows = np.frombuffer(self.data, np.dtype(fields), element.count, self.at)
        out: dict[str, Any] = {}
        for k, p in enumerate(element.properties):
            out[p.name] = rows[f"v{k}"]
            if p.count_kind:
                sizes = rows[f"n{k}"]
                if (sizes != sizes[0]).any() or sizes[0] < 0:
                    return None
                self._check_corners(rows[f"v{k}"].size)
                items = rows[f"v{k}"].ravel()
                out[p.name] = items if p.kind[0] == "f" else indices(self.name, items), indices(self.name, sizes)
        self.at = end
        return out

    def _read_row_by_row(self, element: Element) -> dict[str, Any]:
        """Read rows one by one, whose lists may differ in length."""
        offsets = [array("q") for _ in element.properties]
        if element.count * len(offsets) > self.max_items:
            raise self._too_many(element.count)
        sizes = [self._dtype(p.kind).itemsize for p in element.properties]
        steps = list(zip(element.properties, offsets, sizes, strict=True))
        at = self.at
        for _ in range(element.count):
            for p, offsets_of_property, item_size in steps:
                offsets_of_property.append(at)
                kind = p.count_kind
                at += self._dtype(kind).itemsize + self._count(at, kind) * item_size if kind else item_size
            self._check(element, at)
        self.at = at
        out: dict[str, Any] = {}
        for p, offsets_of_property, item_size in steps:
            starts = np.frombuffer(offsets_of_property, np.int64)
            if p.count_kind:
                counts = np.maximum(indices(self.name, self._gather(starts, p.count_kind)), 0)
                self._check_corners(int(counts.sum()))
                items = concatenated_ranges(starts + self._dtype(p.count_kind).itemsize, counts, item_size)
                found = self._gather(items, p.kind)
                out[p.name] = found if p.kind[0] == "f" else indices(self.name, found), counts
            else:
                out[p.name] = self._gather(starts, p.kind)
        return out

    def _check_corners(self, count: int) -> None:
        if count > self.max_items:
            raise self._too_many(count)

    def _too_many(self, count: int) -> InputError:
        message = f"{self.name} has lists of {count:,} numbers, of {self.max_items:,} at most for its size"
        return InputError(message, "triangulate and decimate it, or export it as .glb")

    def _count(self, at: int, kind: str) -> int:
        """Size of the list at an offset; 0 beyond the end, and if it is negative or not a number."""
        if kind == "u1" and not self.text:  # by far the most frequent type
            return int(self.data[at]) if at < len(self.data) else 0
        if at + self._dtype(kind).itemsize > len(self.data):
            return 0
        value = np.frombuffer(self.data, self._dtype(kind), 1, at)[0]
        return int(value) if 0 < value < 2**53 else 0

    def _gather(self, starts: Int[Ints, " N"], kind: str) -> NDArray[Any]:
        """Read one value at each byte offset."""
        dtype = self._dtype(kind)
        raw = np.frombuffer(self.data, np.uint8)[starts[:, None] + np.arange(dtype.itemsize)]
        return np.ascontiguousarray(raw).view(dtype)[:, 0]
