"""Read legacy VTK files (.vtk) of surfaces, text and binary; write surfaces with point data as .vtk and .vtp."""

from __future__ import annotations

import base64
import html
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshmatch.arrays import Floats, Ints
from meshmatch.errors import InputError
from meshmatch.shapes.formats import WRONG_SUFFIX, Raw, check_element_count, damaged, indices, parse_numbers
from meshmatch.shapes.formats.vtk_cells import Cells, build_raw
from meshmatch.shapes.shape import Shape

Arrays = Mapping[str, NDArray[Any]]
"""Arrays (V,) or (V, D) of vertices, or of faces, by name."""

_TYPES = {
    b"char": "i1", b"unsigned_char": "u1", b"short": "i2", b"unsigned_short": "u2", b"int": "i4", b"unsigned_int": "u4",
    b"long": "i8", b"unsigned_long": "u8", b"float": "f4", b"double": "f8", b"vtkidtype": "i4", b"vtktypeint32": "i4",
    b"vtktypeint64": "i8",
}  # fmt: skip
_CELLS = {b"POLYGONS": 7, b"TRIANGLE_STRIPS": 6, b"VERTICES": 2, b"LINES": 4, b"CELLS": None}
_MAX_SECTION_LINE = 80  # an upper bound on the length of the line that begins point or cell data
_KEYWORD = re.compile(rb"\n[ \t]*[A-Z_]{5,}")
_SECTION = re.compile(
    rb"\n[ \t]*(?:POINTS|POLYGONS|TRIANGLE_STRIPS|VERTICES|LINES|CELLS|CELL_TYPES|POINT_DATA|CELL_DATA)[ \t]+\d"
)
_COLORS = re.compile(rb"\n[ \t]*COLOR_SCALARS[ \t]+\S+[ \t]+([34])[ \t]*\r?\n")
# Cells and the size of their list: count + 1 and the number of points since version 5, before that count and all numbers.
_CELL_LIST = re.compile(rb"\n[ \t]*(?:POLYGONS|CELLS)[ \t]+(\d{1,12})[ \t]+(\d{1,12})[ \t]*\r?\n(OFFSETS)?")
_ARRAY_LINE = re.compile(
    rb"\n[ \t]*(?:(?:SCALARS|VECTORS|TENSORS|GLOBAL_IDS|PEDIGREE_IDS)[ \t]+(\S+)[ \t]+[a-z_]+"
    rb"|(\S+)[ \t]+\d+[ \t]+\d+[ \t]+[a-z_]+\d*)(?:[ \t]+\d)?[ \t]*\r?\n"
)


def read(path: Path, data: bytes) -> Raw:
    """Read the points and faces of a PolyData or an unstructured grid, and the colors of its points."""
    return _File(path.name, data).raw()


def content_beyond_triangles(name: str, data: bytes) -> list[str]:
    """Kinds of content besides triangles and their colors, in words; the file must have passed `read`."""
    polygons = any(
        int(size) > 3 * (int(count) - 1) if is_version_5 else int(size) > 4 * int(count)
        for count, size, is_version_5 in _CELL_LIST.findall(data)
    )
    begin = re.search(rb"\n[ \t]*(?:POINT|CELL)_DATA[ \t]+\d", data)
    names = [] if begin is None else [a or b for a, b in _ARRAY_LINE.findall(data, begin.start())]
    return ["polygons"] * polygons + [f"array {each.decode(errors='replace')}" for each in dict.fromkeys(names)]


class _File:
    """A file being read from position `at`."""

    def __init__(self, name: str, data: bytes) -> None:
        self.name, self.data, self.at = name, data, 0
        first, _, kind = (self._line() for _ in range(3))
        if not first.lower().startswith(b"# vtk datafile") or kind.upper() not in (b"ASCII", b"BINARY"):
            raise InputError(f"{name} is not a vtk file: it does not begin as one", WRONG_SUFFIX)
        self.binary = kind.upper() == b"BINARY"

    def raw(self) -> Raw:
        verts, cells, kinds = np.zeros((0, 3)), [], None
        while line := self._next():
            keyword, *rest = line.split()
            keyword = keyword.upper()
            if keyword == b"DATASET":
                if not rest or rest[0].upper() not in (b"POLYDATA", b"UNSTRUCTURED_GRID"):
                    what = b" ".join(rest)[:40].decode(errors="replace")
                    raise InputError(f"{self.name} holds {what}, not a surface", "save a surface: PolyData")
            elif keyword == b"POINTS":
                count = self._count(rest, 0)
                check_element_count(self.name, len(self.data), count, text=not self.binary)
                verts = self._array(3 * count, rest[1:]).reshape(-1, 3).astype(np.float64)
            elif keyword in _CELLS:
                check_element_count(self.name, len(self.data), len(verts), self._count(rest, 0), text=not self.binary)
                corners, sizes = self._cells(self._count(rest, 0), self._count(rest, 1))
                cells.append(Cells(corners, sizes, np.full(len(sizes), _CELLS[keyword] or 7)))
            elif keyword == b"CELL_TYPES":
                kinds = indices(self.name, self._array(self._count(rest, 0), [b"int"]))
            elif keyword == b"METADATA":
                blank = re.compile(rb"\n[ \t]*\r?\n").search(self.data, self.at)
                self.at = blank.end() if blank else len(self.data)
            elif keyword in (b"POINT_DATA", b"CELL_DATA"):
                break
            elif keyword == b"FIELD":
                found = _SECTION.search(self.data, self.at - 1)
                self.at = found.start() if found else len(self.data)
            else:
                raise damaged(self.name, f"it has {line[:40].decode(errors='replace')!r} where a section should begin")
        if kinds is not None:
            if len(cells) != 1 or len(cells[0].sizes) != len(kinds):
                raise damaged(self.name, "the types of its cells are missing or incomplete")
            cells = [Cells(cells[0].corners, cells[0].sizes, kinds)]
        return build_raw(self.name, len(self.data), verts, cells, self._colors(len(verts)))

    def _cells(self, count: int, size: int) -> tuple[Ints, Ints]:
        """Read cells: the points of all cells, concatenated, and the number of points of each."""
        before = self.at
        line = self._next().split()
        if line[:1] == [b"OFFSETS"]:  # version 5 and later
            ends = indices(self.name, self._array(count, line[1:]))
            line = self._next().split()
            if line[:1] != [b"CONNECTIVITY"]:
                raise damaged(self.name, "its cells have no points")
            if len(ends) and ends[0] != 0:
                raise damaged(self.name, "its first cell does not begin at the first number")
            return _vertex_indices(self.name, self._array(size, line[1:])), np.diff(ends)
        self.at = before
        flat = _vertex_indices(self.name, self._array(size, [b"int"]))
        starts = np.zeros(count, np.int64)
        at = 0
        for k in range(count):
            if not 0 <= at < size or flat[at] < 0:
                raise damaged(self.name, "a cell has fewer points than it says")
            starts[k] = at
            at += 1 + int(flat[at])
        if at > size:
            raise damaged(self.name, "a cell has fewer points than it says")
        is_point = np.ones(at, bool)
        is_point[starts] = False
        return flat[:at][is_point], flat[starts]

    def _colors(self, count: int) -> Floats | None:
        """Read the first COLOR_SCALARS of the points; None if there are none."""
        begin = self.data.find(b"\nPOINT_DATA", max(self.at - _MAX_SECTION_LINE, 0))  # that line was consumed already
        if begin < 0:
            return None
        end = self.data.find(b"\nCELL_DATA", begin)
        found = _COLORS.search(self.data, begin, end if end >= 0 else len(self.data))
        if found is None:
            return None
        width, self.at = int(found[1]), found.end()
        values = self._array(count * width, [b"unsigned_char"]).reshape(-1, width)
        colors = np.ones((count, 4))
        colors[:, :width] = np.clip(values / (255.0 if self.binary else 1.0), 0, 1)
        return colors

    def _array(self, count: int, kind: list[bytes]) -> NDArray[Any]:
        """Read the next `count` numbers; `kind` is their VTK type."""
        if not self.binary:
            found = _KEYWORD.search(self.data, self.at - 1)
            end = found.start() if found else len(self.data)
            values = parse_numbers(self.name, self.data[self.at : end])
            self.at = end
            if len(values) < count:
                raise damaged(self.name, f"it has {len(values)} numbers where {count} should be")
            return values[:count]
        type_code = _TYPES.get(kind[0].lower()) if kind else None
        if type_code is None:
            raise damaged(self.name, f"numbers of the unknown type {b' '.join(kind)[:40].decode(errors='replace')}")
        size = count * np.dtype(type_code).itemsize
        if self.at + size > len(self.data):
            raise damaged(self.name, f"it ends before the {count} numbers that it promises")
        self.at += size
        return np.frombuffer(self.data, f">{type_code}", count, self.at - size)

    def _count(self, words: list[bytes], which: int) -> int:
        if len(words) <= which or not (words[which].isdigit() and len(words[which]) < 12):
            raise damaged(self.name, "a section does not say how large it is")
        return int(words[which])

    def _line(self) -> bytes:
        end = self.data.find(b"\n", self.at)
        end = len(self.data) if end < 0 else end
        line, self.at = self.data[self.at : end].strip(), end + 1
        return line

    def _next(self) -> bytes:
        """Return the next line that is not blank; empty at the end."""
        while self.at < len(self.data):
            if line := self._line():
                return line
        return b""


def _vertex_indices(name: str, values: NDArray[Any]) -> Ints:
    """Convert vertex indices to integers; `InputError` for fractions."""
    integers = indices(name, values)
    if values.dtype.kind == "f" and (integers != values).any():
        raise damaged(name, "a face refers to a vertex by a number that is not an integer")
    return integers


def write_vtk(path: Path, shape: Shape, arrays: Arrays | None = None) -> None:
    """Write a binary PolyData of version 4.2, which all programs read."""
    cells = np.arange(shape.V)[:, None] if shape.is_cloud else shape.faces
    rows = np.concatenate([np.full((len(cells), 1), cells.shape[1]), cells], axis=1).astype(">i4")
    word = "VERTICES" if shape.is_cloud else "POLYGONS"
    parts = [
        f"# vtk DataFile Version 4.2\nmeshmatch\nBINARY\nDATASET POLYDATA\nPOINTS {shape.V} double\n".encode(),
        shape.verts_or_nan.astype(">f8").tobytes(),
        f"\n{word} {len(rows)} {rows.size}\n".encode(),
        rows.tobytes(),
        f"\nPOINT_DATA {shape.V}\n".encode(),
    ]
    if shape.colors is not None:
        parts += [b"COLOR_SCALARS Colors 4\n", bytes_of(shape.colors).tobytes(), b"\n"]
    if arrays:
        parts.append(f"FIELD FieldData {len(arrays)}\n".encode())
        for name, values in to_vtk_types(arrays):
            kind = {"f4": "float", "f8": "double", "i4": "int", "i8": "vtktypeint64", "u1": "unsigned_char"}
            words = f"{'_'.join(name.split())} {values.shape[1]} {len(values)} {kind[values.dtype.str[1:]]}\n"
            parts += [words.encode(), values.astype(values.dtype.newbyteorder(">")).tobytes(), b"\n"]
    path.write_bytes(b"".join(parts))


def write_vtp(
    path: Path, shape: Shape, arrays: Arrays | None = None, of_faces: Arrays | None = None, comments: Iterable[str] = ()
) -> None:
    """Write PolyData in XML, with numbers in base64; `arrays` are data of vertices, `of_faces` of faces."""
    cells = np.arange(shape.V)[:, None] if shape.is_cloud else shape.faces
    ends = np.arange(1, len(cells) + 1) * cells.shape[1]
    group, counts = ("Verts", (len(cells), 0)) if shape.is_cloud else ("Polys", (0, len(cells)))
    data = [] if shape.colors is None else [_element("Colors", bytes_of(shape.colors))]
    data += [_element(name, values) for name, values in to_vtk_types(arrays or {})]
    face_data = [_element(name, values) for name, values in to_vtk_types(of_faces or {})]
    lines = [
        '<?xml version="1.0"?>',
        *map(xml_comment, comments),
        '<VTKFile type="PolyData" version="1.0" byte_order="LittleEndian" header_type="UInt64">',
        f'<PolyData><Piece NumberOfPoints="{shape.V}" NumberOfVerts="{counts[0]}" NumberOfLines="0" NumberOfStrips="0" '
        f'NumberOfPolys="{counts[1]}">',
        *("<PointData>", *data, "</PointData>"),
        *(("<CellData>", *face_data, "</CellData>") if face_data else ()),
        *("<Points>", _element("Points", shape.verts_or_nan), "</Points>"),
        *(f"<{group}>", _element("connectivity", cells.ravel()), _element("offsets", ends), f"</{group}>"),
        "</Piece></PolyData></VTKFile>",
    ]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def xml_comment(text: str) -> str:
    """Format text as an XML comment."""
    text = re.sub(r"[\x00-\x08\x0b\x0c\x0e-\x1f]", " ", re.sub("-(?=-)", "- ", html.escape(text)))
    return f"<!-- {text.rstrip('-')} -->"


def _element(name: str, values: NDArray[Any]) -> str:
    """Format an array as an XML DataArray element."""
    kind = {"f4": "Float32", "f8": "Float64", "i4": "Int32", "i8": "Int64", "u1": "UInt8"}[values.dtype.str[1:]]
    width = f' NumberOfComponents="{values.shape[1]}"' if values.ndim > 1 else ""
    data = np.ascontiguousarray(values, values.dtype.newbyteorder("<")).tobytes()
    text = base64.b64encode(len(data).to_bytes(8, "little") + data).decode()
    return f'<DataArray type="{kind}" Name="{html.escape(name)}"{width} format="binary">{text}</DataArray>'


def to_vtk_types(arrays: Arrays) -> Iterable[tuple[str, NDArray[Any]]]:
    """Yield the arrays as (V, D), converted to types that VTK has."""
    for name, values in arrays.items():
        kind = values.dtype.str[1:]
        if kind not in ("f4", "f8", "i4", "i8", "u1"):
            values = values.astype("i4" if values.dtype.kind in "iub" and values.dtype.itemsize < 4 else "f8")
        yield name, values.reshape(len(values), -1)


def bytes_of(colors: Floats) -> NDArray[np.uint8]:
    """Convert colors from 0..1 to 8 bits."""
    return np.round(255 * colors).astype(np.uint8)
