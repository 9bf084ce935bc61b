"""A PLY file with other numbers at its vertices or faces: polygons, other properties and elements, and comments stay."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import repeat
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshmatch.arrays import Float, Floats, Ints
from meshmatch.errors import warn
from meshmatch.shapes.formats import damaged, runs
from meshmatch.shapes.formats.ply import CHANNELS, END, KINDS, Columns, Content, color_properties, corners_of, parsed
from meshmatch.shapes.formats.ply_rows import TYPES, Element, Property
from meshmatch.shapes.formats.polygons import of_most_triangles
from meshmatch.shapes.input_files import read_bytes
from meshmatch.shapes.shape import Shape

# Positions, normals and texture coordinates.
_OF_SURFACES = {*"xyzstuv", "nx", "ny", "nz", "texture_u", "texture_v", "texnumber"}
_NAMED = re.compile(rb"comment label -?\d+(?: |$)")


@dataclass(frozen=True, eq=False)
class PlyFile:
    """A ply to be written with other numbers.

    Attributes
    ----------
    name : of the file, for words
    data : its bytes
    content : what `ply.parsed` makes of them
    """

    name: str
    data: bytes
    content: Content

    @classmethod
    def parsed(cls, name: str, data: bytes) -> PlyFile:
        """From its bytes."""
        return cls(name, data, parsed(name, data))

    @classmethod
    def of(cls, file: Path | None, shape: Shape, faces: bool = False, moved: bool = False) -> PlyFile | None:
        """The file that a shape was read from, perhaps to be ``moved``.

        None where it came from elsewhere, where the file is another one by now, or its text does not have a row on each
        line, and where ``faces`` need rows and the file has strips or several kinds of faces.
        """
        if file is None or file.suffix.lower() != ".ply" or not file.is_file():
            return None
        found = cls.parsed(file.name, read_bytes(file))
        content = found.content
        places = np.stack([content.vertices.table[axis].astype(np.float64) for axis in "xyz"], axis=1)
        same = len(places) == shape.V and (moved or np.array_equal(places, shape.verts_or_nan, equal_nan=True))
        if faces:
            rows = len(content.faces) == 1 and not content.strips
            same &= rows and int(np.maximum(corners_of(file.name, content.faces[0])[1] - 2, 0).sum()) == shape.F
        return found if same and (content.order or found._lines is not None) else None

    @property
    def beyond_triangles(self) -> list[str]:
        """What the file has besides triangles and their colors, in words."""
        content = self.content
        named, polygons = [p.name for p in content.vertices.properties], False
        for element in content.faces:
            named += [p.name for p in element.properties if not p.count_kind]
            polygons |= bool((corners_of(self.name, element)[1] > 3).any())
        colors = {p.name for element in (content.vertices, *content.faces) for p in color_properties(element)}
        others = [each for each in dict.fromkeys(named) if each not in colors | _OF_SURFACES]
        return ["polygons"] * polygons + [f"property {each}" for each in others]

    def with_positions(self, verts: Float[Floats, "V 3"], turns: Float[Floats, "V 3 3"]) -> bytes:
        """Its bytes when vertices have moved; normals turn by the rotation around each vertex."""
        normals = [f"n{axis}" for axis in "xyz"]
        table = self.content.vertices.table
        columns = dict(zip("xyz", verts.T, strict=True))
        if set(normals) <= set(table):
            before = np.stack([table[each].astype(np.float64) for each in normals], axis=1)
            columns |= zip(normals, np.einsum("vij,vj->iv", turns, before), strict=True)
        return self._edited(columns, {}, ())

    def with_columns(self, vertex: Columns, face: Columns, comments: Sequence[str] = ()) -> bytes:
        """Its bytes with further properties.

        Parameters
        ----------
        vertex
            Arrays (V,) by the name of a property; what has that name already is replaced, which is said but of colors.
        face
            Arrays (F,) for its triangles as `ply.read` makes them: a polygon has what most of its triangles have, by the
            first of the arrays. None of a file with strips, whose triangles have no rows.
        comments
            Go into its header, where comments on labels make room for them.
        """
        content = self.content
        if face:
            face = of_most_triangles(face, corners_of(self.name, content.faces[0])[1])
        for element, columns in ((content.vertices, vertex), *((each, face) for each in content.faces)):
            colored = {p.name for p in color_properties(element)} | set(CHANNELS)
            again = [p.name for p in element.properties if p.name in columns and p.name not in colored]
            if again:
                warn(f"{self.name} has {', '.join(again)} of each {element.name} already, which is replaced")
        return self._edited(vertex, face, comments)

    def _edited(self, vertex: Columns, face: Columns, comments: Sequence[str]) -> bytes:
        content = self.content
        columns = {id(content.vertices): vertex} | {id(each): face for each in content.faces}
        colored = CHANNELS[0] in {*vertex, *face}
        plans = [_Plan.of(each, columns.get(id(each), {}), colored) for each in content.elements]
        head = _head(self.data[: self._head.start()], plans, comments, "label" in {*vertex, *face})
        rows = self._texts(plans) if content.order is None else self._bytes(plans, content.order)
        return head + b"".join(rows)

    @property
    def _head(self) -> re.Match[bytes]:
        """Where it ends."""
        found = END.search(self.data)
        assert found is not None
        return found

    @cached_property
    def _lines(self) -> list[list[bytes]] | None:
        """Of a text the lines of each element, and last those behind; None if they are not one row each."""
        lines = [line for line in _split(self.data[self._head.end() :]) if line.strip()]
        found, at = list[list[bytes]](), 0
        for element in self.content.elements:
            rows = lines[at : at + element.count * bool(element.properties)]
            at += len(rows)
            if element.table and element.count:
                words = np.full(element.count, len(element.properties))
                for p in element.properties:
                    words += element.table[p.name][1] if p.count_kind else 0
                if [len(row.split()) for row in rows] != words.tolist():
                    return None
            found.append(rows)
        return [*found, lines[at:]]

    def _texts(self, plans: Sequence[_Plan]) -> Iterator[bytes]:
        """The lines of a text."""
        if self._lines is None:
            raise damaged(self.name, "its lines are not one row each")
        for plan, rows in zip([*plans, None], self._lines, strict=True):
            yield from (row + b"\n" for row in (_changed(plan, rows) if plan and plan.changes else rows))

    def _bytes(self, plans: Sequence[_Plan], order: str) -> Iterator[bytes]:
        """The rows of a binary file; what lies behind the last element that changes is not looked at."""
        at = self._head.end()
        last = max((k for k, plan in enumerate(plans) if plan.changes), default=-1)
        for plan in plans[: last + 1]:
            if plan.element.properties:
                yield _packed(plan, order) if plan.changes else self.data[plan.element.bytes]
                at = plan.element.bytes.stop
        yield self.data[at:]


@dataclass(frozen=True, eq=False)
class _Plan:
    """What becomes of an element: which of its properties go, and the columns that it gets."""

    element: Element
    gone: frozenset[str]
    columns: Columns

    @classmethod
    def of(cls, element: Element, columns: Columns, colored: bool) -> _Plan:
        """A property whose kind can hold its new numbers keeps its place; what else has its name goes, and so do earlier
        colors where there are new ones.
        """
        colors = {p.name for p in color_properties(element)} if colored and element.role else set[str]()
        gone = {p.name for p in element.properties if p.name in columns and not _holds(p, columns[p.name])}
        return cls(element, frozenset(gone | (colors - set(columns))), columns)

    @property
    def changes(self) -> bool:
        return bool(self.gone or self.columns)

    @property
    def kept(self) -> list[Property]:
        return [p for p in self.element.properties if p.name not in self.gone]

    @property
    def added(self) -> list[Property]:
        """Properties behind those that are kept."""
        there = {p.name for p in self.kept}
        kinds = {label: KINDS.get(values.dtype.name, "double") for label, values in self.columns.items()}
        return [Property(label, kind) for label, kind in kinds.items() if label not in there]


def _holds(p: Property, values: NDArray[Any]) -> bool:
    """Whether a property can take new numbers."""
    if p.count_kind or (p.name in CHANNELS and p.kind != "u1"):
        return False
    return bool(np.can_cast(values.dtype, p.kind, "same_kind" if p.kind[0] == "f" else "safe"))


def _head(head: bytes, plans: Sequence[_Plan], comments: Sequence[str], labeled: bool) -> bytes:
    lines, waiting = [], iter(plans)
    plan: _Plan | None = None
    for line in _split(head.rstrip()):
        words = line.split()
        if words[:1] == [b"element"] and len(words) > 2:
            lines += _declared(plan)
            plan = next(waiting)
        named = words[4 if words[1:2] == [b"list"] else 2].decode("latin-1") if words[:1] == [b"property"] else ""
        if not (plan and named in plan.gone) and not (labeled and _NAMED.match(line)):
            lines.append(line)
        if words[:1] == [b"format"]:
            lines += [f"comment {' '.join(comment.split())}".encode() for comment in comments]
    return b"\n".join([*lines, *_declared(plan), b"end_header\n"])


def _split(text: bytes) -> list[bytes]:
    return text.replace(b"\r\n", b"\n").replace(b"\r", b"\n").split(b"\n")


def _declared(plan: _Plan | None) -> list[bytes]:
    return [f"property {p.kind} {p.name}".encode() for p in plan.added] if plan else []


def _changed(plan: _Plan, rows: Sequence[bytes]) -> Iterator[bytes]:
    texts = {name: values.astype(np.bytes_).tolist() for name, values in plan.columns.items()}
    added = zip(*(texts[p.name] for p in plan.added), strict=True) if plan.added else repeat(())
    if len(plan.added) == len(plan.columns) and not plan.gone:
        yield from (b" ".join((row.strip(), *more)) for row, more in zip(rows, added, strict=False))
        return
    for k, (row, more) in enumerate(zip(rows, added, strict=False)):
        words, at, out = row.split(), 0, list[bytes]()
        for p in plan.element.properties:
            size = 1 + int(float(words[at])) if p.count_kind else 1
            if p.name not in plan.gone:
                out += [texts[p.name][k]] if p.name in texts else words[at : at + size]
            at += size
        yield b" ".join((*out, *more))


def _packed(plan: _Plan, order: str) -> bytes:
    """Rows of an element whose lists may differ in length: each property's bytes are put where they belong."""
    N, parts = plan.element.count, list[tuple[NDArray[np.uint8], Ints]]()

    def put(values: NDArray[Any], kind: str, sizes: Ints | int = 1) -> None:
        dtype = np.dtype(order + kind)
        parts.append((values.astype(dtype).view(np.uint8).reshape(-1), np.broadcast_to(sizes, N) * dtype.itemsize))

    for p in plan.kept:
        if p.count_kind:
            items, sizes = plan.element.table[p.name]
            put(sizes, p.count_kind)
            put(items, p.kind, sizes)
        else:
            put(plan.columns.get(p.name, plan.element.table[p.name]), p.kind)
    for p in plan.added:
        put(plan.columns[p.name], TYPES[p.kind])
    lengths = np.stack([each for _, each in parts])
    ends = np.cumsum(lengths.sum(axis=0))
    begins = np.cumsum(lengths, axis=0) - lengths + (ends - lengths.sum(axis=0))
    out = np.empty(int(lengths.sum()), np.uint8)
    for (values, sizes), begin in zip(parts, begins, strict=True):
        out[runs(begin, sizes)] = values
    return out.tobytes()
