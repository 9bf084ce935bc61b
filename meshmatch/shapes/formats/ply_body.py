"""The tables behind a ply header: rows of numbers and lists, read all at once where rows are equally long."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshmatch.arrays import Int, Ints
from meshmatch.shapes.formats import damaged
from meshmatch.shapes.formats.text import numbers


@dataclass
class Property:
    name: str
    kind: str
    count_kind: str | None = None  # set for a list


@dataclass
class Column:
    values: NDArray[Any]
    kind: str  # as the header says; a text file's values are floats all the same


@dataclass
class Element:
    name: str
    count: int
    properties: list[Property] = field(default_factory=list)


class Body:
    """The bytes behind the header, read one element after the other.

    A text body (``order`` is None) becomes float64 numbers first, and is then read as a binary one of these.
    """

    def __init__(self, name: str, data: bytes, start: int, order: str | None) -> None:
        self.name, self.at, self.order, self.text = name, start, order or "=", order is None
        self.data: Any = data
        if self.text:
            self.data, self.at = numbers(name, data[start:]).view(np.uint8).data, 0

    def element(self, element: Element) -> dict[str, Any]:
        """By property: a `Column` of numbers, or, of lists, all their items and the size of each.

        Raises
        ------
        InputError
            Fewer rows than promised.
        """
        kinds = [self._dtype(p.count_kind or p.kind) for p in element.properties]
        self._check(element, self.at + element.count * sum(kind.itemsize for kind in kinds))
        if element.count == 0:
            nothing = np.empty(0, np.int64)
            return {p.name: (nothing, nothing) if p.count_kind else Column(nothing, p.kind) for p in element.properties}
        table = self._equal_rows(element)
        return table if table is not None else self._walk(element)

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
            if not p.count_kind:
                out[p.name] = Column(rows[f"v{k}"], p.kind)
                continue
            sizes = rows[f"n{k}"]
            if (sizes != sizes[0]).any() or sizes[0] < 0:
                return None
            out[p.name] = self._indices(rows[f"v{k}"]).ravel(), self._indices(sizes)
        self.at = end
        return out

    def _walk(self, element: Element) -> dict[str, Any]:
        places: list[list[int]] = [[] for _ in element.properties]
        sizes = [self._dtype(p.kind).itemsize for p in element.properties]
        steps = list(zip(element.properties, places, sizes, strict=True))
        at = self.at
        for _ in range(element.count):
            for p, where, item in steps:
                where.append(at)
                if p.count_kind:
                    at += self._dtype(p.count_kind).itemsize + self._count(at, p.count_kind) * item
                else:
                    at += item
            self._check(element, at)
        self.at = at
        out: dict[str, Any] = {}
        for p, where, item in steps:
            starts = np.array(where, np.int64)
            if not p.count_kind:
                out[p.name] = Column(self._gather(starts, p.kind), p.kind)
                continue
            counts = np.maximum(self._indices(self._gather(starts, p.count_kind)), 0)
            first = np.repeat(starts + self._dtype(p.count_kind).itemsize, counts)
            within = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
            out[p.name] = self._indices(self._gather(first + within * item, p.kind)), counts
        return out

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

    def _indices(self, values: NDArray[Any]) -> Ints:
        """Whole numbers, or an error: floats are what text files are read as."""
        if values.dtype.kind == "f" and not (np.abs(values) < 2**53).all():
            raise damaged(self.name, "a face refers to a vertex that is not a number")
        return values.astype(np.int64)
