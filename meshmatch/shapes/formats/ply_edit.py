"""Edit a PLY file: replace or add properties of vertices and faces, and keep everything else.

Polygons, other properties and elements, and comments are kept.
"""

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
from meshmatch.shapes.formats import COORDINATES, concatenated_ranges, damaged, ply_appearance
from meshmatch.shapes.formats.ply import CHANNELS, END, KINDS, Columns, Content, color_properties, corners_of, parsed
from meshmatch.shapes.formats.ply_rows import TYPES, Element, Property
from meshmatch.shapes.formats.polygons import majority_of_triangles
from meshmatch.shapes.input_files import read_bytes
from meshmatch.shapes.shape import Shape

# Positions, normals and texture coordinates; other properties are reported as beyond triangles.
_SURFACE_PROPERTIES = {*"xyzstuv", "nx", "ny", "nz", "texture_u", "texture_v", "texnumber"}
_LABEL_COMMENT = re.compile(rb"comment label -?\d+(?: |$)")


@dataclass(frozen=True, eq=False)
class PlyFile:
    """A ply file that can be rewritten with other properties.

    Attributes
    ----------
    name
        Name of the file, for messages.
    data
        Its bytes.
    content
        Its content, as parsed by `ply.parsed`.
    """

    name: str
    data: bytes
    content: Content

    @classmethod
    def parsed(cls, name: str, data: bytes) -> PlyFile:
        """Parse the bytes of a file."""
        return cls(name, data, parsed(name, data))

    @classmethod
    def of(cls, file: Path | None, shape: Shape, faces: bool = False, moved: bool = False) -> PlyFile | None:
        """Return the file that a shape was read from, or None if it cannot be edited for the shape.

        That is, if it is not a ply file; if its vertices are no longer those of the shape (with ``moved``, only their
        number must agree); if it is text without exactly one row per line; or if ``faces`` are to get properties, but the
        file has strips, several face elements, or another number of triangles.
        """
        if file is None or file.suffix.lower() != ".ply" or not file.is_file():
            return None
        candidate = cls.parsed(file.name, read_bytes(file))
        content = candidate.content
        positions = np.stack([content.vertices.table[axis].astype(np.float64) for axis in "xyz"], axis=1)
        matches = len(positions) == shape.V and (moved or np.array_equal(positions, shape.verts_or_nan, equal_nan=True))
        if faces:
            has_face_rows = len(content.faces) == 1 and not content.strips
            matches &= (
                has_face_rows and int(np.maximum(corners_of(file.name, content.faces[0])[1] - 2, 0).sum()) == shape.F
            )
        return candidate if matches and (content.order or candidate._lines is not None) else None

    @property
    def content_beyond_triangles(self) -> list[str]:
        """Kinds of content besides triangles and their colors, in words."""
        content = self.content
        names, polygons = [p.name for p in content.vertices.properties], False
        for element in content.faces:
            names += [p.name for p in element.properties if not p.count_kind]
            polygons |= bool((corners_of(self.name, element)[1] > 3).any())
        colors = {p.name for element in (content.vertices, *content.faces) for p in color_properties(element)}
        others = [each for each in dict.fromkeys(names) if each not in colors | _SURFACE_PROPERTIES]
        coordinates = [COORDINATES] * ply_appearance.has_coordinates(content)
        return ["polygons"] * polygons + coordinates + [f"property {each}" for each in others]

    def with_positions(self, verts: Float[Floats, "V 3"], turns: Float[Floats, "V 3 3"]) -> bytes:
        """Return its bytes with new vertex positions, and normals rotated by the rotation at each vertex."""
        normals = [f"n{axis}" for axis in "xyz"]
        table = self.content.vertices.table
        columns = dict(zip("xyz", verts.T, strict=True))
        if set(normals) <= set(table):
            before = np.stack([table[each].astype(np.float64) for each in normals], axis=1)
            columns |= zip(normals, np.einsum("vij,vj->iv", turns, before), strict=True)
        return self._rewrite(columns, {}, ())

    def with_columns(self, vertex: Columns, face: Columns, comments: Sequence[str] = ()) -> bytes:
        """Return its bytes with further properties.

        Parameters
        ----------
        vertex
            Arrays (V,) by name of property. Existing properties of the same name are replaced, with a warning unless they
            are colors.
        face
            Arrays (F,) for the triangles of `ply.read`; polygons get the values of `majority_of_triangles`. Must be empty
            for a file with strips, whose triangles have no rows.
        comments
            Comments for its header. If a property is called "label", they replace earlier comments on labels.
        """
        content = self.content
        if face:
            face = majority_of_triangles(face, corners_of(self.name, content.faces[0])[1])
        for element, columns in ((content.vertices, vertex), *((each, face) for each in content.faces)):
            colored = {p.name for p in color_properties(element)} | set(CHANNELS)
            existing = [p.name for p in element.properties if p.name in columns and p.name not in colored]
            if existing:
                warn(f"{self.name} has {', '.join(existing)} of each {element.name} already, which is replaced")
        return self._rewrite(vertex, face, comments)

    def _rewrite(self, vertex: Columns, face: Columns, comments: Sequence[str]) -> bytes:
        content = self.content
        columns = {id(content.vertices): vertex} | {id(each): face for each in content.faces}
        colored = CHANNELS[0] in {*vertex, *face}
        plans = [_Plan.of(each, columns.get(id(each), {}), colored) for each in content.elements]
        head = _rewrite_header(self.data[: self._header_end.start()], plans, comments, "label" in {*vertex, *face})
        rows = self._text_rows(plans) if content.order is None else self._binary_rows(plans, content.order)
        return head + b"".join(rows)

    @property
    def _header_end(self) -> re.Match[bytes]:
        """Match of the end of the header."""
        found = END.search(self.data)
        assert found is not None
        return found

    @cached_property
    def _lines(self) -> list[list[bytes]] | None:
        """Lines of each element of a text file, followed by the remaining lines; None unless each line is one row."""
        lines = [line for line in _split(self.data[self._header_end.end() :]) if line.strip()]
        found, first = list[list[bytes]](), 0
        for element in self.content.elements:
            rows = lines[first : first + element.count * bool(element.properties)]
            first += len(rows)
            if element.table and element.count:
                n_words = np.full(element.count, len(element.properties))
                for p in element.properties:
                    n_words += element.table[p.name][1] if p.count_kind else 0
                if [len(row.split()) for row in rows] != n_words.tolist():
                    return None
            found.append(rows)
        return [*found, lines[first:]]

    def _text_rows(self, plans: Sequence[_Plan]) -> Iterator[bytes]:
        """Yield the edited lines of a text file."""
        if self._lines is None:
            raise damaged(self.name, "its lines are not one row each")
        for plan, rows in zip([*plans, None], self._lines, strict=True):
            yield from (row + b"\n" for row in (_changed(plan, rows) if plan and plan.changes else rows))

    def _binary_rows(self, plans: Sequence[_Plan], order: str) -> Iterator[bytes]:
        """Yield the edited elements of a binary file; data after the last changed element is copied unread."""
        at = self._header_end.end()
        last = max((k for k, plan in enumerate(plans) if plan.changes), default=-1)
        for plan in plans[: last + 1]:
            if plan.element.properties:
                yield _packed(plan, order) if plan.changes else self.data[plan.element.bytes]
                at = plan.element.bytes.stop
        yield self.data[at:]


@dataclass(frozen=True, eq=False)
class _Plan:
    """Changes of an element: names of properties to remove, and new columns."""

    element: Element
    removed: frozenset[str]
    columns: Columns

    @classmethod
    def of(cls, element: Element, columns: Columns, colored: bool) -> _Plan:
        """Plan the changes of an element for new columns.

        A property whose type can represent the new values is overwritten in place; otherwise it is removed and the new one
        appended. Existing colors are removed if the file gets new ones (``colored``).
        """
        colors = {p.name for p in color_properties(element)} if colored and element.role else set[str]()
        removed = {p.name for p in element.properties if p.name in columns and not _can_hold(p, columns[p.name])}
        return cls(element, frozenset(removed | (colors - set(columns))), columns)

    @property
    def changes(self) -> bool:
        """Whether the element changes at all."""
        return bool(self.removed or self.columns)

    @property
    def kept(self) -> list[Property]:
        """Properties that stay, with old or new values."""
        return [p for p in self.element.properties if p.name not in self.removed]

    @property
    def added(self) -> list[Property]:
        """New properties, which are appended to those that are kept."""
        kept_names = {p.name for p in self.kept}
        kinds = {name: KINDS.get(values.dtype.name, "double") for name, values in self.columns.items()}
        return [Property(name, kind) for name, kind in kinds.items() if name not in kept_names]


def _can_hold(p: Property, values: NDArray[Any]) -> bool:
    """Whether the type of a property can represent new values."""
    if p.count_kind or (p.name in CHANNELS and p.kind != "u1"):
        return False
    return bool(np.can_cast(values.dtype, p.kind, "same_kind" if p.kind[0] == "f" else "safe"))


def _rewrite_header(head: bytes, plans: Sequence[_Plan], comments: Sequence[str], labeled: bool) -> bytes:
    """Rewrite the header; comments on labels are removed if ``labeled``, and new comments added."""
    lines, waiting = [], iter(plans)
    plan: _Plan | None = None
    for line in _split(head.rstrip()):
        words = line.split()
        if words[:1] == [b"element"] and len(words) > 2:
            lines += _declared(plan)
            plan = next(waiting)
        property_name = (
            words[4 if words[1:2] == [b"list"] else 2].decode("latin-1") if words[:1] == [b"property"] else ""
        )
        if not (plan and property_name in plan.removed) and not (labeled and _LABEL_COMMENT.match(line)):
            lines.append(line)
        if words[:1] == [b"format"]:
            lines += [f"comment {' '.join(comment.split())}".encode() for comment in comments]
    return b"\n".join([*lines, *_declared(plan), b"end_header\n"])


def _split(text: bytes) -> list[bytes]:
    """Split text at line ends of any kind."""
    return text.replace(b"\r\n", b"\n").replace(b"\r", b"\n").split(b"\n")


def _declared(plan: _Plan | None) -> list[bytes]:
    """Header lines that declare the added properties."""
    return [f"property {p.kind} {p.name}".encode() for p in plan.added] if plan else []


def _changed(plan: _Plan, rows: Sequence[bytes]) -> Iterator[bytes]:
    """Yield the rows of a text element with its changes."""
    texts = {name: values.astype(np.bytes_).tolist() for name, values in plan.columns.items()}
    added = zip(*(texts[p.name] for p in plan.added), strict=True) if plan.added else repeat(())
    if len(plan.added) == len(plan.columns) and not plan.removed:
        yield from (b" ".join((row.strip(), *more)) for row, more in zip(rows, added, strict=False))
        return
    for k, (row, more) in enumerate(zip(rows, added, strict=False)):
        words, at, out = row.split(), 0, list[bytes]()
        for p in plan.element.properties:
            size = 1 + int(float(words[at])) if p.count_kind else 1
            if p.name not in plan.removed:
                out += [texts[p.name][k]] if p.name in texts else words[at : at + size]
            at += size
        yield b" ".join((*out, *more))


def _packed(plan: _Plan, order: str) -> bytes:
    """Pack the rows of a changed element; rows may differ in length, since lists may."""
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
        out[concatenated_ranges(begin, sizes)] = values
    return out.tobytes()
