"""Stanford PLY, text and binary of either byte order."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshmatch.errors import InputError
from meshmatch.shapes.formats import NO_FACES, Raw, damaged, fan
from meshmatch.shapes.formats.text import numbers
from meshmatch.shapes.shape import Shape

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8", "int64": "i8", "uint64": "u8",
}  # fmt: skip
_FACE_LISTS = ("vertex_indices", "vertex_index")
_PROMISE = "fewer {0.name} rows than the {0.count} that its header promises"


@dataclass
class _Property:
    name: str
    kind: str
    count_kind: str | None = None  # set for a list


@dataclass
class _Column:
    values: NDArray[Any]
    kind: str  # as the header says; a text file's values are floats all the same


@dataclass
class _Element:
    name: str
    count: int
    properties: list[_Property] = field(default_factory=list)


def read(path: Path, data: bytes) -> Raw:
    """Vertices, faces and vertex colours of a ply file."""
    name = path.name
    order, elements, start = _header(name, data)
    known = [element.name for element in elements]
    if "vertex" not in known:
        raise InputError(f"{name}: the header names no vertices", "is it a mesh or a point cloud at all?")
    wanted = [k for k, element in enumerate(elements) if element.name in ("vertex", "face", "tristrips")]
    stream = _Text(name, data[start:]) if order is None else _Binary(name, data, start, order)
    verts, faces, colors = None, NO_FACES, None
    for element in elements[: max(wanted) + 1]:
        if not element.properties:
            continue  # rows of nothing, however many
        stream.check(element)
        table = stream.element(element)
        if element.name == "vertex":
            if not {"x", "y", "z"} <= set(table):
                raise InputError(
                    f"{name}: the vertices have no x, y and z", "is it a mesh or a point cloud at all?"
                )
            verts = np.stack([table[axis].values.astype(np.float64) for axis in "xyz"], axis=1)
            colors = _colors(table)
        elif element.name == "face":
            lists = next((table[key] for key in _FACE_LISTS if key in table), None)
            if lists is not None:
                faces = fan(*lists)
        elif element.name == "tristrips" and element.properties:
            faces = _strips(table[element.properties[0].name][0])
    assert verts is not None
    return Raw(verts, faces, colors)


def write(path: Path, shape: Shape) -> None:
    """Binary little-endian; positions as float where that loses nothing, else double."""
    verts = shape.verts
    single = bool((verts.astype(np.float32) == verts).all())
    real, kind = ("float", "<f4") if single else ("double", "<f8")
    fields = [("x", kind), ("y", kind), ("z", kind)]
    header = ["ply", "format binary_little_endian 1.0", "comment meshmatch", f"element vertex {shape.V}"]
    header += [f"property {real} {axis}" for axis in "xyz"]
    if shape.colors is not None:
        fields += [(channel, "u1") for channel in ("red", "green", "blue", "alpha")]
        header += [f"property uchar {channel}" for channel in ("red", "green", "blue", "alpha")]
    table = np.zeros(shape.V, dtype=fields)
    for axis, values in zip("xyz", verts.T, strict=True):
        table[axis] = values if shape.invalid is None else np.where(shape.invalid, np.nan, values)
    if shape.colors is not None:
        for channel, values in zip(("red", "green", "blue", "alpha"), shape.colors.T, strict=True):
            table[channel] = np.rint(np.clip(values, 0, 1) * 255)
    chunks = [table.tobytes()]
    if not shape.is_cloud:
        header += [f"element face {shape.F}", "property list uchar int vertex_indices"]
        rows = np.empty(shape.F, dtype=[("n", "u1"), ("corners", "<i4", 3)])
        rows["n"] = 3
        rows["corners"] = shape.faces
        chunks.append(rows.tobytes())
    path.write_bytes("\n".join([*header, "end_header\n"]).encode() + b"".join(chunks))


def _header(name: str, data: bytes) -> tuple[str | None, list[_Element], int]:
    """Byte order (None: text), elements, and where the body starts."""
    if data[:3] != b"ply" or data[3:4] not in (b"\n", b"\r", b" "):
        raise InputError(
            f"{name} is not a ply file: it does not begin with 'ply'", "does the suffix fit the content?"
        )
    mark = data.find(b"end_header")
    if mark < 0:
        raise damaged(name, "the header has no end")
    start = mark + len(b"end_header")
    while data[start : start + 1] in (b" ", b"\t"):
        start += 1
    start += 2 if data[start : start + 2] == b"\r\n" else 1
    order: str | None = ""
    elements: list[_Element] = []
    try:
        for line in data[:mark].decode("latin-1").replace("\r\n", "\n").replace("\r", "\n").split("\n"):
            match line.split():
                case ["format", kind, *_]:
                    order = {"ascii": None, "binary_little_endian": "<", "binary_big_endian": ">"}[kind]
                case ["element", element, count, *_]:
                    elements.append(_Element(element, int(count)))
                case ["property", "list", count_kind, kind, label, *_] if _TYPES[count_kind][0] != "f":
                    elements[-1].properties.append(_Property(label, _TYPES[kind], _TYPES[count_kind]))
                case ["property", kind, label, *_]:
                    elements[-1].properties.append(_Property(label, _TYPES[kind]))
    except (KeyError, ValueError, IndexError) as error:
        raise damaged(name, f"the header line {line.strip()[:60]!r} makes no sense") from error
    if order == "":
        raise damaged(name, "the header names no format")
    return order, elements, start


class _Text:
    """The body of a text file as one stream of numbers."""

    def __init__(self, name: str, body: bytes) -> None:
        self.name, self.values, self.at = name, numbers(name, body), 0

    def check(self, element: _Element) -> None:
        if element.count < 0 or self.at + element.count * len(element.properties) > len(self.values):
            raise damaged(self.name, _PROMISE.format(element))

    def element(self, element: _Element) -> dict[str, Any]:
        table = self._uniform(element)
        return table if table is not None else self._walk(element)

    def _uniform(self, element: _Element) -> dict[str, Any] | None:
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
                out[p.name] = _Column(rows[:, k], p.kind)
                continue
            if size < 0 or (rows[:, k] != size).any():
                return None
            lists = _indices(self.name, rows[:, k + 1 : k + 1 + size]).ravel()
            out[p.name] = lists, np.full(element.count, size, np.int64)
        self.at += element.count * width
        return out

    def _walk(self, element: _Element) -> dict[str, Any]:
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
                out[p.name] = _Column(self.values[starts], p.kind)
                continue
            sizes = np.maximum(_indices(self.name, self.values[starts]), 0)
            out[p.name] = _indices(self.name, self.values[_ranges(starts + 1, sizes)]), sizes
        return out

    def _value(self, at: int) -> float:
        """The number at a place; -1 behind the end or for one that is not finite."""
        value = float(self.values[at]) if at < len(self.values) else -1.0
        return value if abs(value) < 2**53 else -1.0


class _Binary:
    """The body of a binary file."""

    def __init__(self, name: str, data: bytes, start: int, order: str) -> None:
        self.name, self.data, self.at, self.order = name, data, start, order

    def check(self, element: _Element) -> None:
        row = sum(np.dtype(p.count_kind or p.kind).itemsize for p in element.properties)
        if element.count < 0 or self.at + element.count * row > len(self.data):
            raise damaged(self.name, _PROMISE.format(element))

    def element(self, element: _Element) -> dict[str, Any]:
        if element.count == 0:
            nothing = np.empty(0, np.int64)
            return {
                p.name: (nothing, nothing) if p.count_kind else _Column(nothing, p.kind)
                for p in element.properties
            }
        table = self._uniform(element)
        return table if table is not None else self._walk(element)

    def _uniform(self, element: _Element) -> dict[str, Any] | None:
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
                out[p.name] = _Column(rows[f"v{k}"], p.kind)
                continue
            sizes = rows[f"n{k}"]
            if (sizes != sizes[0]).any():
                return None
            out[p.name] = _indices(self.name, rows[f"v{k}"]).ravel(), sizes.astype(np.int64)
        self.at = at + (at - self.at) * (element.count - 1)
        return out

    def _walk(self, element: _Element) -> dict[str, Any]:
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
                out[p.name] = _Column(self._gather(starts, p.kind), p.kind)
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


def _strips(lists: NDArray[np.int64]) -> NDArray[np.int64]:
    """Triangles of strips, -1 between two strips; every second triangle of a strip is turned round."""
    a, b, c = lists[:-2], lists[1:-1], lists[2:]
    place = np.arange(len(lists))
    begin = np.maximum.accumulate(np.where(lists < 0, place + 1, 0))[: len(a)]
    odd = (place[: len(a)] - begin) % 2 == 1
    faces = np.stack([np.where(odd, b, a), np.where(odd, a, b), c], axis=1)
    return faces[(a >= 0) & (b >= 0) & (c >= 0)]


def _colors(table: dict[str, Any]) -> NDArray[np.float64] | None:
    names = next((n for n in (("red", "green", "blue"), ("r", "g", "b")) if set(n) <= set(table)), None)
    if names is None:
        return None
    alpha = next((a for a in ("alpha", "a") if a in table), None)
    channels = [table[c] for c in names] + ([table[alpha]] if alpha else [])
    out = np.ones((len(channels[0].values), 4))
    for k, channel in enumerate(channels):
        values = channel.values.astype(np.float64)
        largest = {"u2": 65535.0}.get(channel.kind, 255.0)
        if channel.kind[0] == "f" and not (values > 1).any():
            largest = 1.0
        out[:, k] = np.clip(np.nan_to_num(values) / largest, 0.0, 1.0)
    return out
