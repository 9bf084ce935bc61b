"""The tables behind a ply header: rows of numbers and lists, read all at once where rows are equally long."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshmatch.shapes.formats import damaged
from meshmatch.shapes.formats.text import numbers

_PROMISE = "fewer {0.name} rows than the {0.count} that its header promises"


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


class TextBody:
    """The body of a text file as one stream of numbers."""

    def __init__(self, name: str, body: bytes) -> None:
        self.name, self.values, self.at = name, numbers(name, body), 0

    def check(self, element: Element) -> None:
        if element.count < 0 or self.at + element.count * len(element.properties) > len(self.values):
            raise damaged(self.name, _PROMISE.format(element))

    def element(self, element: Element) -> dict[str, Any]:
        table = self._uniform(element)
        return table if table is not None else self._walk(element)

    def _uniform(self, element: Element) -> dict[str, Any] | None:
        """All rows as long as the first one, at once."""
        places, width = [], 0
        for p in element.properties:
            size = int(self._value(self.at + width)) if p.count_kind and element.count else 0
            places.append((p, width, size))
            width += 1 + max(size, 0)
        if self.at + element.count * width > len(self.values):
            return None
        rows = self.values[self.at : self.at + element.count * width].reshape(element.count, width)
        out: dict[str, Any] = {}
        for p, k, size in places:
            if not p.count_kind:
                out[p.name] = Column(rows[:, k], p.kind)
                continue
            if size < 0 or (rows[:, k] != size).any():
                return None
            lists = _indices(self.name, rows[:, k + 1 : k + 1 + size]).ravel()
            out[p.name] = lists, np.full(element.count, size, np.int64)
        self.at += element.count * width
        return out

    def _walk(self, element: Element) -> dict[str, Any]:
        positions: dict[str, list[int]] = {p.name: [] for p in element.properties}
        at = self.at
        for _ in range(element.count):
            for p in element.properties:
                positions[p.name].append(at)
                at += 1 + (max(int(self._value(at)), 0) if p.count_kind else 0)
            if at > len(self.values):
                raise damaged(self.name, _PROMISE.format(element))
        self.at = at
        out: dict[str, Any] = {}
        for p in element.properties:
            starts = np.array(positions[p.name], np.int64)
            if not p.count_kind:
                out[p.name] = Column(self.values[starts], p.kind)
                continue
            sizes = np.maximum(_indices(self.name, self.values[starts]), 0)
            out[p.name] = _indices(self.name, self.values[_ranges(starts + 1, sizes)]), sizes
        return out

    def _value(self, at: int) -> float:
        """The number at a place; -1 behind the end or for one that is not finite."""
        value = float(self.values[at]) if at < len(self.values) else -1.0
        return value if abs(value) < 2**53 else -1.0


class BinaryBody:
    """The body of a binary file."""

    def __init__(self, name: str, data: bytes, start: int, order: str) -> None:
        self.name, self.data, self.at, self.order = name, data, start, order

    def check(self, element: Element) -> None:
        row = sum(np.dtype(p.count_kind or p.kind).itemsize for p in element.properties)
        if element.count < 0 or self.at + element.count * row > len(self.data):
            raise damaged(self.name, _PROMISE.format(element))

    def element(self, element: Element) -> dict[str, Any]:
        if element.count == 0:
            nothing = np.empty(0, np.int64)
            return {
                p.name: (nothing, nothing) if p.count_kind else Column(nothing, p.kind)
                for p in element.properties
            }
        table = self._uniform(element)
        return table if table is not None else self._walk(element)

    def _uniform(self, element: Element) -> dict[str, Any] | None:
        """All rows as long as the first one: a structured array over the bytes, nothing copied."""
        fields: list[Any] = []
        at = self.at
        for k, p in enumerate(element.properties):
            if p.count_kind:
                size = self._count(at, p.count_kind)
                item = np.dtype(p.kind).itemsize
                at += np.dtype(p.count_kind).itemsize + size * item
                fields.append((f"n{k}", self.order + p.count_kind))
                if at > len(self.data):
                    return None
                fields.append((f"v{k}", self.order + p.kind, (size,)))
            else:
                at += np.dtype(p.kind).itemsize
                fields.append((f"v{k}", self.order + p.kind))
        if self.at + (at - self.at) * element.count > len(self.data):
            return None
        rows = np.frombuffer(self.data, np.dtype(fields), element.count, self.at)
        out: dict[str, Any] = {}
        for k, p in enumerate(element.properties):
            if not p.count_kind:
                out[p.name] = Column(rows[f"v{k}"], p.kind)
                continue
            sizes = rows[f"n{k}"]
            if (sizes != sizes[0]).any():
                return None
            out[p.name] = _indices(self.name, rows[f"v{k}"]).ravel(), sizes.astype(np.int64)
        self.at = at + (at - self.at) * (element.count - 1)
        return out

    def _walk(self, element: Element) -> dict[str, Any]:
        positions: dict[str, list[int]] = {p.name: [] for p in element.properties}
        steps = [(p, positions[p.name], np.dtype(p.kind).itemsize) for p in element.properties]
        at = self.at
        for _ in range(element.count):
            for p, where, item in steps:
                where.append(at)
                at += (
                    np.dtype(p.count_kind).itemsize + self._count(at, p.count_kind) * item
                    if p.count_kind
                    else item
                )
            if at > len(self.data):
                raise damaged(self.name, _PROMISE.format(element))
        self.at = at
        out: dict[str, Any] = {}
        for p, where, item in steps:
            starts = np.array(where, np.int64)
            if not p.count_kind:
                out[p.name] = Column(self._gather(starts, p.kind), p.kind)
                continue
            sizes = _indices(self.name, self._gather(starts, p.count_kind))
            first = starts + np.dtype(p.count_kind).itemsize
            out[p.name] = _indices(self.name, self._gather(_ranges(first, sizes, item), p.kind)), sizes
        return out

    def _count(self, at: int, kind: str) -> int:
        if kind == "u1":  # by far the most frequent
            return self.data[at] if at < len(self.data) else 0
        size = np.dtype(kind).itemsize
        value = int.from_bytes(
            self.data[at : at + size], "little" if self.order == "<" else "big", signed=kind[0] == "i"
        )
        return max(value, 0)

    def _gather(self, starts: NDArray[np.int64], kind: str) -> NDArray[Any]:
        size = np.dtype(kind).itemsize
        raw = np.frombuffer(self.data, np.uint8)[starts[:, None] + np.arange(size)]
        return np.ascontiguousarray(raw).view(self.order + kind)[:, 0]


def _ranges(starts: NDArray[np.int64], sizes: NDArray[np.int64], item: int = 1) -> NDArray[np.int64]:
    """start, start + item, ... (size of them) for each row, one after the other."""
    within = np.arange(sizes.sum()) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    return np.repeat(starts, sizes) + within * item


def _indices(name: str, values: NDArray[Any]) -> NDArray[np.int64]:
    """Whole numbers, or an error: floats are what text files are read as."""
    if values.dtype.kind == "f" and not (np.abs(values) < 2**53).all():
        raise damaged(name, "a face names a vertex that is not a number")
    return values.astype(np.int64)
