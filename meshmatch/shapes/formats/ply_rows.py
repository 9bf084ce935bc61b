"""The rows of PLY's and PCD's elements: where all are equally long they are read at once, as they lie in the file."""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshmatch.arrays import Int, Ints
from meshmatch.errors import InputError
from meshmatch.shapes.formats import BASE_ELEMENTS, damaged, indices, parse_numbers, runs
from meshmatch.shapes.input_files import check_text

TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8", "int64": "i8", "uint64": "u8",
}  # fmt: skip


@dataclass
class Property:
    name: str
    kind: str
    count_kind: str | None = None  # set for a list


@dataclass
class Element:
    name: str
    count: int
    properties: list[Property] = field(default_factory=list)
    role: str = ""
    """One of vertex, face and tristrips; empty for what makes no shape."""
    table: dict[str, Any] = field(default_factory=dict)
    """What was read, by property; see `Body.element`."""
    bytes: slice = field(default_factory=lambda: slice(0))
    """Where in a binary file."""


class Body:
    """The bytes behind the header, read one element after the other.

    A text body (``order`` is None) becomes float64 numbers first, and is then read as a binary one of these.
    """

    def __init__(self, name: str, data: bytes, start: int, order: str | None) -> None:
        self.name, self.at, self.order, self.text = name, start, order or "=", order is None
        self.data: Any = data
        self.most = 3 * (BASE_ELEMENTS + len(data) // (24 if self.text else 12))  # corners of faces
        if self.text:
            check_text(name, data)
            self.data, self.at = parse_numbers(name, data[start:]).view(np.uint8).data, 0

    def element(self, element: Element) -> dict[str, Any]:
        """By property: its numbers, or, of lists, all their items (whole numbers unless declared as floats) and the size of
        each.
        """
        kinds = [self._dtype(p.count_kind or p.kind) for p in element.properties]
        self._check(element, self.at + element.count * sum(kind.itemsize for kind in kinds))
        begin = self.at
        table = self._equal_rows(element) if element.count else None
        table = table if table is not None else self._walk(element)
        element.bytes = slice(begin, self.at)
        return table

    def rows_left(self, element: Element) -> int:
        """How many whole rows of an element without lists there may be from here on."""
        row = sum(self._dtype(p.kind).itemsize for p in element.properties)
        return (len(self.data) - self.at) // row if row else 0

    def _check(self, element: Element, end: int) -> None:
        if element.count < 0 or end > len(self.data):
            raise damaged(self.name, f"fewer {element.name} rows than the {element.count} that its header promises")

    def _dtype(self, kind: str) -> np.dtype[Any]:
        return np.dtype("f8" if self.text else self.order + kind)

    def _equal_rows(self, element: Element) -> dict[str, Any] | None:
        """All rows as long as the first one: a structured array over the bytes, nothing copied. None if they differ."""
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

    def _walk(self, element: Element) -> dict[str, Any]:
        places = [array("q") for _ in element.properties]
        if element.count * len(places) > self.most:
            raise self._too_many(element.count)
        sizes = [self._dtype(p.kind).itemsize for p in element.properties]
        steps = list(zip(element.properties, places, sizes, strict=True))
        at = self.at
        for _ in range(element.count):
            for p, where, item in steps:
                where.append(at)
                kind = p.count_kind
                at += self._dtype(kind).itemsize + self._count(at, kind) * item if kind else item
            self._check(element, at)
        self.at = at
        out: dict[str, Any] = {}
        for p, where, item in steps:
            starts = np.frombuffer(where, np.int64)
            if p.count_kind:
                counts = np.maximum(indices(self.name, self._gather(starts, p.count_kind)), 0)
                self._check_corners(int(counts.sum()))
                items = runs(starts + self._dtype(p.count_kind).itemsize, counts, item)
                found = self._gather(items, p.kind)
                out[p.name] = found if p.kind[0] == "f" else indices(self.name, found), counts
            else:
                out[p.name] = self._gather(starts, p.kind)
        return out

    def _check_corners(self, count: int) -> None:
        if count > self.most:
            raise self._too_many(count)

    def _too_many(self, count: int) -> InputError:
        many = f"{self.name} has lists of {count:,} numbers, of {self.most:,} at most for its size"
        return InputError(many, "triangulate and decimate it, or export it as .glb")

    def _count(self, at: int, kind: str) -> int:
        """The size of the list at a place; 0 behind the end, and for one that is negative or not a number."""
        if kind == "u1" and not self.text:  # by far the most frequent
            return int(self.data[at]) if at < len(self.data) else 0
        if at + self._dtype(kind).itemsize > len(self.data):
            return 0
        value = np.frombuffer(self.data, self._dtype(kind), 1, at)[0]
        return int(value) if 0 < value < 2**53 else 0

    def _gather(self, starts: Int[Ints, " N"], kind: str) -> NDArray[Any]:
        dtype = self._dtype(kind)
        raw = np.frombuffer(self.data, np.uint8)[starts[:, None] + np.arange(dtype.itemsize)]
        return np.ascontiguousarray(raw).view(dtype)[:, 0]
