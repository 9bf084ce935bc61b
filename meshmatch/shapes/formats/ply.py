"""Read and write Stanford PLY files, text and binary of either byte order; read the points of PCL's PCD files."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from meshmatch.arrays import Float, Floats, Ints
from meshmatch.errors import InputError, warn
from meshmatch.shapes.formats import (
    NO_FACES,
    NO_MESH,
    WRONG_SUFFIX,
    Raw,
    check_element_count,
    damaged,
    indices,
    strips,
    vertex_colors_from_faces,
    warn_if_no_triangles,
)
from meshmatch.shapes.formats.ply_rows import TYPES, Body, Element, Property
from meshmatch.shapes.formats.polygons import triangles_of
from meshmatch.shapes.shape import Shape

_MAX_DECLARATIONS = 4096  # elements and properties of a header
_FACE_LISTS = ("vertexindices", "vertexindex", "vertexindexes", "vertices")  # without "_", in lower case
_FACE_HINT = "export its faces as 'property list uchar int vertex_indices'"
_ALTERNATIVE_NAMES = {
    "vertex": ("vertices", "point", "points"),
    "face": ("faces", "triangle", "triangles", "polygon", "polygons", "facet", "facets", "cell", "cells"),
    "tristrips": ("tristrip", "tri_strips", "tri_strip", "triangle_strips", "triangle_strip"),
}
END = re.compile(rb"(?<=[\r\n])end_header[ \t]*(?:\r\n|[\r\n]|\Z)")
_DATA = re.compile(rb"^DATA[ \t]+(ascii|binary)[ \t]*\r?\n", re.MULTILINE)
CHANNELS = ("red", "green", "blue", "alpha")
_PREFIXES = ("", "diffuse_", "color_", "vertex_", "vertex_color_", "face_", "face_color_", "ambient_")
KINDS = {"uint8": "uchar", "int32": "int", "float32": "float"}
"""PLY types of written arrays, by NumPy type; all others are written as double."""
Columns: TypeAlias = Mapping[str, NDArray[Any]]
_NO_COLUMNS: Columns = MappingProxyType({})
_NUMBERS = ("x", "y", "z", *CHANNELS, "r", "g", "b", "a")


@dataclass(frozen=True)
class Content:
    """Content of a ply file: its vertices, polygons or strips, and the comments of its header."""

    comments: list[str]
    vertices: Element
    faces: list[Element]
    strips: list[Element]
    unread: list[Element]  # elements without a role whose lists are named like those of faces
    elements: list[Element]  # all elements that the header declares
    order: str | None  # byte order, < or >; None for text


def read(path: Path, data: bytes) -> Raw:
    """Read vertices, faces (polygons or strips), and the colors of vertices, or else of faces."""
    name = path.name
    content = parsed(name, data)
    verts = np.stack([content.vertices.table[axis].astype(np.float64) for axis in "xyz"], axis=1)
    colors = _colors(content.vertices)
    lists = [corners_of(name, each) for each in content.faces]
    faces = [corners[triangles_of(name, verts, corners, sizes)] for corners, sizes in lists]
    faces += [strip_triangles(*corners_of(name, each)) for each in content.strips]
    triangles = np.concatenate([NO_FACES, *faces])
    for skipped in content.unread:
        warn(f"{name}: its {skipped.count} {skipped.name} are not read; faces should be an element face")
    warn_if_no_triangles(name, sum(element.count for element in [*content.faces, *content.strips]), triangles)
    for (corners, sizes), element in zip(lists, content.faces, strict=True) if colors is None else ():
        face_colors = _colors(element)
        if face_colors is not None and len(face_colors):
            colors = vertex_colors_from_faces(len(verts), corners, np.repeat(face_colors, sizes, axis=0))
            warn(f"{name} has a color for each face: each vertex gets the mean of the faces around it")
            break
    return Raw(verts, triangles, colors)


def parsed(name: str, data: bytes) -> Content:
    """Parse a file up to the last element that makes a shape; `InputError` if it has no positions, or is damaged."""
    order, elements, start, comments = _header(name, data)
    _assign_roles(elements)
    vertices = next((element for element in elements if element.role == "vertex"), None)
    if vertices is None:
        raise InputError(f"{name}: the header declares no vertices", NO_MESH)
    n_declared = sum(each.count for each in elements if each.role in ("vertex", "face") and each.properties)
    if n_declared < len(data):  # otherwise `Body` reports damage
        check_element_count(name, len(data), n_declared, text=order is None)
    body = Body(name, data, start, order)
    last = max(k for k, element in enumerate(elements) if element.role)
    for element in elements[: last + 1]:
        if element.properties:  # rows without properties take no bytes
            _check_kinds(name, element)
            element.table = body.element(element)
        if element is vertices and not set("xyz") <= set(element.table):
            raise InputError(f"{name}: the vertices have no x, y and z", NO_MESH)
    nonempty = [element for element in elements if element.count and element.properties]
    faces, strips, others = ([each for each in nonempty if each.role == role] for role in ("face", "tristrips", ""))
    unread = [element for element in others if any(p.count_kind and _is_corner_list(p) for p in element.properties)]
    return Content(comments, vertices, faces, strips, unread, elements, order)


def _assign_roles(elements: Sequence[Element]) -> None:
    """Set the role of each element by its standard name, or by a known alternative if no element has the standard name.

    Of several vertex elements, only the first gets the role.
    """
    standard, assigned = {element.name for element in elements}, set[str]()
    for element in elements:
        role = next(
            (role for role, others in _ALTERNATIVE_NAMES.items() if element.name.lower() in (role, *others)), ""
        )
        if (element.name == role or role not in standard) and not (role == "vertex" and role in assigned):
            element.role = role
            assigned.add(role)


def _is_corner_list(listed: Property) -> bool:
    """Whether a list has one of the usual names for the corners of faces."""
    return listed.name.lower().replace("_", "") in _FACE_LISTS


def corners_of(name: str, element: Element) -> tuple[Ints, Ints]:
    """Return the vertices of all polygons or strips, concatenated, and the number of vertices of each.

    This is the list with a usual name, or else the only list of integers. `InputError` if there is no such list, so that
    faces are not lost silently.
    """
    lists = [p for p in element.properties if p.count_kind]
    by_name = [p for p in lists if _is_corner_list(p)]
    integer_lists = [p for p in lists if p.kind[0] != "f"]
    chosen = next((candidates for candidates in (by_name, integer_lists) if len(candidates) == 1), by_name[:1])
    if not chosen:
        which = "none of its lists has" if not integer_lists else "it is ambiguous which of its lists has"
        raise InputError(f"{name}: {which} the vertices of each {element.name}", _FACE_HINT)
    items, sizes = element.table[chosen[0].name]
    return indices(name, items), sizes


def read_pcd(path: Path, data: bytes) -> Raw:
    """Read the points of an uncompressed pcd file, with colors from a field rgb or rgba (packed into four bytes)."""
    name, start, colors = path.name, _DATA.search(data), None
    if not start:
        raise InputError(f"{name} is not a pcd file of text or plain binary points", "write it uncompressed, or as ply")
    lines = data[: start.start()].removeprefix(b"\xef\xbb\xbf").decode("latin-1").splitlines()
    header = {line.split()[0]: line.split()[1:] for line in lines if line.strip()}
    try:
        counts = header.get("COUNT", ["1"] * len(header["FIELDS"]))
        points = Element("vertex", 0)
        for label, kind, size, count in zip(header["FIELDS"], header["TYPE"], header["SIZE"], counts, strict=True):
            type_code = TYPES[{"F": "float", "I": "int", "U": "uint"}[kind] + str(8 * int(size))]
            points.properties += [Property(label.lower(), type_code)] * min(int(count), _MAX_DECLARATIONS)
            if len(points.properties) > _MAX_DECLARATIONS:
                raise damaged(name, f"its header declares over {_MAX_DECLARATIONS} numbers for each point")
        grid = int(header["WIDTH"][0]) * int(header["HEIGHT"][0]) if "WIDTH" in header and "HEIGHT" in header else 0
        n_declared = int(header["POINTS"][0]) if "POINTS" in header else grid
        body = Body(name, data, start.end(), None if start[1] == b"ascii" else "<")
        n_available = body.rows_left(points)
        points.count = (
            n_available
            if n_available and (n_declared <= 0 or n_declared > n_available or grid == n_available)
            else n_declared
        )
        check_element_count(name, len(data), points.count)
        points.table = body.element(points)
        verts = np.stack([points.table[axis].astype(np.float64) for axis in "xyz"], axis=1)
    except (KeyError, ValueError, IndexError) as error:
        raise damaged(name, "its header makes no sense, or names no x, y and z") from error
    if points.count != n_declared:
        warn(f"{name} promises {n_declared} points, but holds {points.count}: these are read")
    elif n_available > points.count:
        warn(f"{name} holds more than its {points.count} points, which is not read")
    for p in points.properties:
        if p.name in ("rgb", "rgba"):
            colors = _unpack_colors(points, p)
    return Raw(verts, NO_FACES, colors)


def _unpack_colors(element: Element, p: Property) -> Floats:
    """(N, 4) opaque colors from 32-bit numbers with a byte each for red, green and blue; floats are reinterpreted."""
    packed = element.table[p.name].astype(p.kind[0] + "4").view(np.uint32)[:, None]
    return np.insert((packed >> np.array([16, 8, 0], np.uint32) & 255) / 255.0, 3, 1.0, axis=1)


def write(
    path: Path, shape: Shape, vertex: Columns = _NO_COLUMNS, face: Columns = _NO_COLUMNS, comments: Sequence[str] = ()
) -> None:
    """Write a binary little-endian file; positions are float if that is exact, else double.

    `vertex` and `face` are further properties: arrays (V,) or (F,) by name, written in a type of `KINDS`, or else as double.
    Names consist of ASCII letters, digits and "_". `comments` go into the header.
    """
    with np.errstate(over="ignore"):  # values too large for a float compare as unequal
        is_exact = bool((shape.verts.astype(np.float32) == shape.verts).all())
    header = ["ply", "format binary_little_endian 1.0", "comment meshmatch"]
    header += [f"comment {' '.join(comment.split())}" for comment in comments]
    header += [f"element vertex {shape.V}"]
    type_code, type_name = ("<f4", "float") if is_exact else ("<f8", "double")
    header += [f"property {type_name} {axis}" for axis in "xyz"]
    table: dict[str, NDArray[Any]] = dict(zip("xyz", shape.verts_or_nan.T, strict=True))
    if shape.colors is not None:
        table |= color_columns(shape.colors)
    body = _rows(table | dict(vertex), shape.V, [(axis, type_code) for axis in "xyz"], header)
    if not shape.is_cloud:
        header += [f"element face {shape.F}", "property list uchar int vertex_indices"]
        lists = {"n": np.full(shape.F, 3), "corners": shape.faces}
        body += _rows(lists | dict(face), shape.F, [("n", "u1"), ("corners", "<i4", (3,))], header)
    path.write_bytes("\n".join([*header, "end_header\n"]).encode() + body)


def color_columns(colors: Float[Floats, "V 4"]) -> Columns:
    """8-bit columns red, green, blue and alpha, from colors in 0..1."""
    return dict(zip(CHANNELS, np.rint(np.clip(colors.T, 0, 1) * 255).astype(np.uint8), strict=True))


def _rows(table: dict[str, NDArray[Any]], count: int, fields: list[Any], header: list[str]) -> bytes:
    """Pack the columns of a table into rows; columns beyond `fields` get a field and a line in the header."""
    for label in list(table)[len(fields) :]:
        type_name = KINDS.get(table[label].dtype.name, "double")
        fields.append((label, f"<{TYPES[type_name]}"))
        header.append(f"property {type_name} {label}")
    rows = np.empty(count, fields)
    for label, values in table.items():
        rows[label] = values
    return rows.tobytes()


def _header(name: str, data: bytes) -> tuple[str | None, list[Element], int, list[str]]:
    """Parse the header: byte order (None for text), elements, offset of the body, and comments."""
    if data[:3] != b"ply" or data[3:4] not in (b"\n", b"\r", b" "):
        raise InputError(f"{name} is not a ply file: it does not begin with 'ply'", WRONG_SUFFIX)
    end = END.search(data)
    if not end:
        raise damaged(name, "the header has no end")
    if data.count(b"element", 0, end.start()) + data.count(b"property", 0, end.start()) > _MAX_DECLARATIONS:
        raise damaged(name, f"its header has over {_MAX_DECLARATIONS} lines")
    order: str | None = ""
    elements: list[Element] = []
    comments: list[str] = []
    try:
        for line in data[: end.start()].decode("latin-1").replace("\r\n", "\n").replace("\r", "\n").split("\n"):
            match line.split():
                case [("comment" | "obj_info") as word, *_]:
                    text = line.strip()[len(word) :].encode("latin-1")
                    comments.append(text.decode("utf-8", "surrogateescape").strip())
                case ["format", kind, *_]:
                    order = {"ascii": None, "binary_little_endian": "<", "binary_big_endian": ">"}[kind]
                case ["element", element, count, *_]:
                    elements.append(Element(element, int(count)))
                case ["property", "list", count_kind, kind, label, *_] if TYPES[count_kind][0] != "f":
                    elements[-1].properties.append(Property(label, TYPES[kind], TYPES[count_kind]))
                case ["property", kind, label, *_]:
                    elements[-1].properties.append(Property(label, TYPES[kind]))
    except (KeyError, ValueError, IndexError) as error:
        raise damaged(name, f"the header line {line.strip()[:60]!r} makes no sense") from error
    if order == "":
        raise damaged(name, "the header declares no format")
    for each in elements:
        if len({p.name for p in each.properties}) < len(each.properties):
            raise damaged(name, f"its header declares a property of the element {each.name} twice")
    return order, elements, end.end(), comments


def _check_kinds(name: str, element: Element) -> None:
    """Raise `InputError` if a property is a list where a number is required, or vice versa."""
    for place, p in enumerate(element.properties):
        must_be_list = {"face": p.name in ("vertex_indices", "vertex_index"), "tristrips": place == 0}.get(
            element.role, False
        )
        must_be_number = element.role == "vertex" and p.name in _NUMBERS
        if (must_be_number and p.count_kind) or (must_be_list and not p.count_kind):
            what = "lists" if p.count_kind else "numbers"
            raise damaged(name, f"its header declares {p.name} of the element {element.name} as {what}")


def strip_triangles(corners: Ints, sizes: Ints) -> Ints:
    """Triangles of strips; a row may contain several strips, separated by -1."""
    is_separator = corners < 0
    strip_of = np.repeat(np.arange(len(sizes)), sizes) + np.cumsum(is_separator)
    return strips(corners[~is_separator], np.unique(strip_of[~is_separator], return_counts=True)[1])


def _colors(element: Element) -> Floats | None:
    """(N, 4) sRGB colors and alpha of an element's rows; None if it has no colors."""
    channels = color_properties(element)
    if len(channels) == 1:
        return _unpack_colors(element, channels[0])
    out = np.ones((element.count, 4))
    for group in (channels[:3], channels[3:]):
        values = [element.table[p.name].astype(np.float64) for p in group]
        is_unit_range = all(p.kind[0] == "f" for p in group) and not any((each > 1).any() for each in values)
        for p, each in zip(group, values, strict=True):
            largest = 1.0 if is_unit_range else 65535.0 if p.kind == "u2" else 255.0
            out[:, channels.index(p)] = np.clip(np.nan_to_num(each) / largest, 0.0, 1.0)
    return out if channels else None


def color_properties(element: Element) -> list[Property]:
    """Color properties of an element: red, green, blue and perhaps alpha, or a single packed one; empty if none."""
    kinds = {p.name.lower(): p for p in element.properties if not p.count_kind}
    prefix = next((p for p in _PREFIXES if all(p + channel in kinds for channel in CHANNELS[:3])), None)
    names = [f"{prefix}{channel}" for channel in CHANNELS] if prefix is not None else list("rgba")
    if not all(name in kinds for name in names[:3]):
        packed = [kinds[name] for name in ("rgb", "rgba") if name in kinds and kinds[name].kind[1:] == "4"]
        return packed[:1]
    alpha = [name for name in (names[3], "alpha", "a") if name in kinds]
    return [kinds[name] for name in names[:3] + alpha[:1]]
