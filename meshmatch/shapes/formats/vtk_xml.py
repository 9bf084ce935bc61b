"""Read VTK's XML files of surfaces (.vtp, .vtu), as written by ParaView, 3D Slicer and PyVista.

Arrays may be text, base64, or raw bytes at the end of the file; binary ones may be in blocks compressed by zlib or lzma. No
more data is decompressed than the size of the file can plausibly need.
"""

from __future__ import annotations

import base64
import binascii
import html
import lzma
import re
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.errors import InputError
from meshmatch.shapes.formats import (
    BASE_ELEMENTS,
    WRONG_SUFFIX,
    Raw,
    check_element_count,
    concatenate_colors,
    damaged,
    parse_numbers,
    rgba_from_channels,
)
from meshmatch.shapes.formats.vtk_cells import Cells, build_raw
from meshmatch.shapes.input_files import read_bytes

SUFFIXES = (".vtp", ".vtu")

TYPES = {
    **{f"Float{8 * n}": f"f{n}" for n in (4, 8)},
    **{f"{word}{8 * n}": f"{letter}{n}" for word, letter in (("Int", "i"), ("UInt", "u")) for n in (1, 2, 4, 8)},
}
_UNPACK: dict[str, Callable[[], Any]] = {
    "vtkZLibDataCompressor": zlib.decompressobj,
    "vtkLZMADataCompressor": lzma.LZMADecompressor,
}
_PACK: dict[str, Callable[[bytes], bytes]] = {"": lambda data: data, "vtkZLibDataCompressor": zlib.compress}
APPENDED = re.compile(rb"<AppendedData\b([^>]{0,200})>\s*_")


def read(path: Path, data: bytes) -> Raw:
    """Read the points and faces of all pieces, and colors where a piece has a point array of three or four bytes."""
    return _File(path.name, data).raw()


@dataclass(frozen=True, eq=False)
class Surface:
    """Points of a PolyData with one piece, and corner counts of its polygons; None if it has other cells, or no polygons."""

    verts: Float[Floats, "V 3"]
    sizes: Int[Ints, " P"] | None


def read_surface(name: str, data: bytes) -> Surface | None:
    """Read the points and polygon sizes of a file; None if it has several pieces, or is not PolyData."""
    file = _File(name, data)
    pieces = file.root.findall("./*/Piece")
    if len(pieces) != 1 or file.root.get("type") != "PolyData":
        return None
    file._reset_budget()
    points = file.named(pieces[0], "Points", None)
    if points is None or points.size % 3:
        return None
    verts, polygons = points.reshape(-1, 3).astype(np.float64), _count(name, pieces[0], "NumberOfPolys")
    if any(_count(name, pieces[0], f"NumberOf{what}") for what in ("Verts", "Lines", "Strips")) or not polygons:
        return Surface(verts, None)
    ends = file.named(pieces[0], "Polys", "offsets")
    return None if ends is None else Surface(verts, np.diff(np.concatenate([[0], ends.astype(np.int64)])))


def format_array(head: bytes, name: str, values: NDArray[Any]) -> str:
    """Format an array (V, D) as an XML element, with the byte order and compressor that the file header `head` declares."""
    begin = re.search(rb"<VTKFile\b[^>]*>", head)
    attributes = {} if begin is None else ElementTree.fromstring(begin[0].rstrip(b"/>") + b"/>").attrib
    byte_order = ">" if attributes.get("byte_order") == "BigEndian" else "<"
    header = np.dtype(byte_order + ("u8" if attributes.get("header_type") == "UInt64" else "u4"))
    code = values.dtype.str[1:]
    raw = values.astype(np.dtype(byte_order + code)).tobytes()
    kind = next(word for word, each in TYPES.items() if each == code)
    start_tag = f'<DataArray type="{kind}" Name="{html.escape(name)}" NumberOfComponents="{values.shape[1]}" format='
    pack = _PACK.get(attributes.get("compressor", ""))
    if pack is None:
        return f'{start_tag}"ascii">{" ".join(values.astype(str).ravel().tolist())}</DataArray>\n'
    packed = pack(raw)
    sizes = [len(raw)] if packed is raw else [1, len(raw), 0, len(packed)]
    encoded_header = np.array(sizes, header).tobytes()
    encoded = (
        base64.b64encode(encoded_header + raw)
        if packed is raw
        else base64.b64encode(encoded_header) + base64.b64encode(packed)
    )
    return f'{start_tag}"binary">{encoded.decode()}</DataArray>\n'


def array_names(name: str, data: bytes) -> list[str]:
    """Names of the point and cell arrays of a file, without colors and normals."""
    root = _File(name, data).root
    found = [each for group in ("PointData", "CellData") for each in root.findall(f"./*/Piece/{group}/DataArray")]
    not_colors = [
        each for each in found if each.get("type") != "UInt8" or each.get("NumberOfComponents") not in ("3", "4")
    ]
    return [label for label in dict.fromkeys(str(each.get("Name")) for each in not_colors) if label != "Normals"]


def point_arrays(path: Path | None) -> dict[str, NDArray[Any]]:
    """Read the point arrays of a file, (V,) or (V, D), by name; without colors.

    Of several pieces, only arrays that all of them have are read. Empty for files of other formats.
    """
    if path is None or path.suffix.lower() not in SUFFIXES:
        return {}
    return _File(path.name, read_bytes(path)).point_arrays()


class _File:
    """A parsed XML file; arrays are decoded on demand."""

    def __init__(self, name: str, data: bytes) -> None:
        self.name, self.size, self.appended, self.encoding = name, len(data), b"", b""
        begin = data.find(b"<AppendedData")
        found = APPENDED.match(data, begin) if begin >= 0 else None
        if found:
            self.appended, self.encoding = data[found.end() :], found[1]
            data = data[: found.start()] + b"</VTKFile>"
        if b"\0" in data[:200] or b"<!DOCTYPE" in data or b"<!ENTITY" in data:  # also as UTF-16
            raise InputError(f"{name} has a document type or another encoding than a VTK file has", WRONG_SUFFIX)
        if re.search(rb"""<\?xml[^>]{0,200}encoding=["'](?!(?i:utf-8|us-ascii|ascii|iso-8859-1)["'])""", data[:400]):
            raise InputError(f"{name} has another encoding than a VTK file has", "save it as UTF-8")
        try:
            self.root = ElementTree.fromstring(data)
        except (ElementTree.ParseError, ValueError, LookupError) as error:
            raise damaged(name, f"it is not XML ({error})") from None
        if self.root.tag != "VTKFile" or self.root.get("type") not in ("PolyData", "UnstructuredGrid"):
            kind = str(self.root.get("type") or self.root.tag)[:40]
            hint = "save a surface: PolyData (.vtp) or UnstructuredGrid (.vtu)"
            raise InputError(f"{name} holds {kind}, not a surface", hint)
        self.order = ">" if self.root.get("byte_order") == "BigEndian" else "<"
        self.header = np.dtype(self.order + ("u8" if self.root.get("header_type") == "UInt64" else "u4"))
        self.compressor = str(self.root.get("compressor") or "")
        self._reset_budget()

    def raw(self) -> Raw:
        pieces = self.root.findall("./*/Piece")
        counts = [_count(self.name, piece, "NumberOfPoints") for piece in pieces]
        faces = sum(
            _count(self.name, piece, f"NumberOf{what}") for piece in pieces for what in ("Polys", "Strips", "Cells")
        )
        check_element_count(self.name, self.size, sum(counts), faces)
        self.points, self.triangles = sum(counts), 0
        verts, colors, cells, first = [np.zeros((0, 3))], [], [], 0
        for piece, count in zip(pieces, counts, strict=True):
            points = self.named(piece, "Points", None)
            if points is None or points.size != 3 * count:
                raise damaged(self.name, f"a piece has other than the {count} points that it promises")
            verts.append(points.reshape(-1, 3).astype(np.float64))
            colors.append(self._colors(piece, count))
            cells += [each.moved(first, count) for each in self._cells(piece)]
            first += count
        vertex_colors = concatenate_colors(colors, counts) if pieces else None
        return build_raw(self.name, self.size, np.concatenate(verts), cells, vertex_colors)

    def point_arrays(self) -> dict[str, NDArray[Any]]:
        parts = [self._piece_point_arrays(piece) for piece in self.root.findall("./*/Piece")]
        names = [name for name in parts[0] if all(name in part for part in parts)] if parts else []
        widths = {name: {part[name].shape[1:] for part in parts} for name in names}
        return {name: np.concatenate([part[name] for part in parts]) for name in names if len(widths[name]) == 1}

    def _piece_point_arrays(self, piece: ElementTree.Element) -> dict[str, NDArray[Any]]:
        """Point arrays of one piece by name, without colors."""
        arrays, count = {}, _count(self.name, piece, "NumberOfPoints")
        for element in piece.findall("./PointData/DataArray"):
            components = element.get("NumberOfComponents", "1")
            width = int(components) if re.fullmatch("[1-9][0-9]{0,3}", components) else 1
            if element.get("type") in TYPES and not (element.get("type") == "UInt8" and width in (3, 4)):
                self._reset_budget()
                values = self._array(element)
                if values.size == count * width:
                    arrays[element.get("Name", "value")] = values.reshape(count, width) if width > 1 else values
        return arrays

    def _reset_budget(self) -> None:
        """Reset the number of bytes that may be decompressed from now on."""
        self.budget = 64 * (BASE_ELEMENTS + self.size // 12)

    def _cells(self, piece: ElementTree.Element) -> list[Cells]:
        found = []
        for group, kind in (("Polys", 7), ("Strips", 6), ("Cells", None)):
            n_cells = _count(self.name, piece, f"NumberOf{group}")
            if not n_cells:
                continue
            corners = self.named(piece, group, "connectivity")
            ends = self.named(piece, group, "offsets")
            if corners is None or ends is None or len(ends) != n_cells:
                raise damaged(self.name, f"a piece has other than the {n_cells} cells that it promises")
            kinds = self.named(piece, group, "types") if kind is None else np.full(len(ends), kind)
            if kinds is None or len(kinds) != len(ends):
                raise damaged(self.name, "the types of its cells are missing or incomplete")
            sizes = np.diff(np.concatenate([[0], ends.astype(np.int64)]))
            self.triangles += max(int(sizes.sum()) - 2 * n_cells, 0)
            check_element_count(self.name, self.size, self.points, self.triangles)
            corners = corners[: max(int(sizes.sum()), 0)]
            found.append(Cells(corners.astype(np.int64), sizes, kinds.astype(np.int64)))
        return found

    def _colors(self, piece: ElementTree.Element, count: int) -> Floats | None:
        for element in piece.findall("./PointData/DataArray"):
            channels = element.get("NumberOfComponents")
            if element.get("type") == "UInt8" and channels in ("3", "4"):
                found = self._array(element)
                if found.size == count * int(channels):
                    return rgba_from_channels(found.reshape(count, -1) / 255.0)
        return None

    def named(self, piece: ElementTree.Element, group: str, name: str | None) -> NDArray[Any] | None:
        """Read the array with a name (the first one for None) from a group of a piece; None if there is none."""
        for element in piece.findall(f"./{group}/DataArray"):
            if name is None or element.get("Name") == name:
                return self._array(element)
        return None

    def _array(self, element: ElementTree.Element) -> NDArray[Any]:
        """Decode a DataArray element."""
        type_code = TYPES.get(str(element.get("type")))
        if type_code is None:
            raise damaged(self.name, f"numbers of the unknown type {str(element.get('type'))[:40]}")
        form, text = element.get("format", "ascii"), (element.text or "").strip().encode()
        if form == "ascii":
            return parse_numbers(self.name, text)
        try:
            if form == "appended":
                at = int(str(element.get("offset")))
                if not 0 <= at < len(self.appended):
                    raise ValueError("an offset beyond the end")
                data = self._raw(at) if b"raw" in self.encoding else self._base64(memoryview(self.appended)[at:])
            else:
                data = self._base64(text)
            return np.frombuffer(data, np.dtype(self.order + type_code))
        except (ValueError, IndexError, OverflowError, binascii.Error, zlib.error, lzma.LZMAError, EOFError) as error:
            raise damaged(self.name, f"numbers cannot be read ({error})") from None

    def _raw(self, at: int) -> bytes:
        """Decode an appended raw array, with its header, at an offset."""
        width = self.header.itemsize
        first = self._read_header(self.appended[at : at + width], 1)
        if not self.compressor:
            count = self._spend(int(first[0]))
            return self._check_length(self.appended[at + width : at + width + count], count)
        head = self._read_header(self.appended[at : at + self._header_size(int(first[0]))], 3 + int(first[0]))
        at += len(head) * width
        return self._decompress(head, self.appended[at : at + int(head[3:].sum())])

    def _base64(self, text: bytes | memoryview) -> bytes:
        """Decode a base64 array with its header, which may be encoded separately."""
        width = self.header.itemsize
        first = base64.b64decode(text[: _base64_length(width)])
        count = int(self._read_header(first[:width], 1)[0])
        if not self.compressor:
            if len(first) == width:  # padded: the header is encoded separately
                begin, skip = _base64_length(width), 0
            else:
                begin, skip = 0, width
            letters = text[begin : begin + _base64_length(skip + self._spend(count))]
            return self._check_length(base64.b64decode(letters)[skip:][:count], count)
        size = self._header_size(count)
        head = self._read_header(base64.b64decode(text[: _base64_length(size)])[:size], 3 + count)
        begin = _base64_length(size)
        return self._decompress(head, base64.b64decode(text[begin : begin + _base64_length(int(head[3:].sum()))]))

    def _header_size(self, blocks: int) -> int:
        if blocks > self.size:
            raise ValueError("more blocks than bytes")
        return (3 + blocks) * self.header.itemsize

    def _read_header(self, data: bytes, count: int) -> Ints:
        found = np.frombuffer(data, self.header, count).astype(np.int64)
        if (found < 0).any():
            raise ValueError("a length below 0")
        return found

    def _spend(self, count: int) -> int:
        """Return `count` after subtracting it from the bytes that may be decompressed; `ValueError` if it exceeds them."""
        self.budget -= count
        if self.budget < 0:
            raise ValueError("more than points and faces can need")
        return count

    def _check_length(self, data: bytes, count: int) -> bytes:
        if len(data) < count:
            raise ValueError("they end too early")
        return data

    def _decompress(self, header_values: Ints, data: bytes) -> bytes:
        """Decompress blocks.

        `header_values` has their number, their size, the size of the last one (0 if it is full), and their compressed sizes.
        """
        blocks, size, last = (int(each) for each in header_values[:3])
        sizes = np.full(blocks, size)
        if blocks and last:
            sizes[-1] = last
        self._spend(int(sizes.sum()))
        if self.compressor not in _UNPACK:
            raise InputError(
                f"{self.name} is compressed by {self.compressor[:40]}", "save it with zlib, or uncompressed"
            )
        out, at = [], 0
        for packed, length in zip(header_values[3:].tolist(), sizes.tolist(), strict=True):
            block = _UNPACK[self.compressor]().decompress(data[at : at + packed], length)
            out.append(self._check_length(block, length))
            at += packed
        return b"".join(out)


def _base64_length(count: int) -> int:
    """Length in base64 of a number of bytes."""
    return 4 * -(-count // 3)


def _count(name: str, piece: ElementTree.Element, key: str) -> int:
    found = str(piece.get(key, "0")).strip()
    if not (found.isascii() and found.isdigit() and len(found) < 12):
        raise damaged(name, f"{key} is not a number")
    return int(found)
