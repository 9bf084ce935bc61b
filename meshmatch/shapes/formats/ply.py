"""Stanford PLY, text and binary of either byte order, and points of PCL's PCD: rows of equal length are read at once."""

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
    colors_of_faces,
    damaged,
    indices,
    strips,
    warn_if_no_triangles,
)
from meshmatch.shapes.formats.ply_rows import TYPES, Body, Element, Property
from meshmatch.shapes.formats.polygons import triangles_of
from meshmatch.shapes.shape import Shape

_MOST_LINES = 4096  # of a header that declare something
_FACE_LISTS = ("vertexindices", "vertexindex", "vertexindexes", "vertices")  # without "_", in lower case
_FACE_HINT = "export its faces as 'property list uchar int vertex_indices'"
_NAMES = {
    "vertex": ("vertices", "point", "points"),
    "face": ("faces", "triangle", "triangles", "polygon", "polygons", "facet", "facets", "cell", "cells"),
    "tristrips": ("tristrip", "tri_strips", "tri_strip", "triangle_strips", "triangle_strip"),
}
END = re.compile(rb"(?<=[\r\n])end_header[ \t]*(?:\r\n|[\r\n]|\Z)")
_DATA = re.compile(rb"^DATA[ \t]+(ascii|binary)[ \t]*\r?\n", re.MULTILINE)
CHANNELS = ("red", "green", "blue", "alpha")
_PREFIXES = ("", "diffuse_", "color_", "vertex_", "vertex_color_", "face_", "face_color_", "ambient_")
KINDS = {"uint8": "uchar", "int32": "int", "float32": "float"}
"""How arrays are written that are no doubles."""
Columns: TypeAlias = Mapping[str, NDArray[Any]]
_NONE: Columns = MappingProxyType({})
_NUMBERS = ("x", "y", "z", *CHANNELS, "r", "g", "b", "a")


@dataclass(frozen=True)
class Content:
    """What a ply file holds: its vertices, its polygons or strips, and the comments of its header."""

    comments: list[str]
    vertices: Element
    faces: list[Element]
    strips: list[Element]
    unread: list[Element]  # others whose lists look like those of faces
    elements: list[Element]  # all of the header
    order: str | None  # of bytes; None for text


def read(path: Path, data: bytes) -> Raw:
    """Vertices, faces (polygons or strips) and colors of vertices, or else of faces."""
    name = path.name
    content = parsed(name, data)
    verts = np.stack([content.vertices.table[axis].astype(np.float64) for axis in "xyz"], axis=1)
    colors = _colors(content.vertices)
    lists = [corners_of(name, each) for each in content.faces]
    faces = [corners[triangles_of(name, verts, corners, sizes)] for corners, sizes in lists]
    faces += [faces_of(*corners_of(name, each)) for each in content.strips]
    joined = np.concatenate([NO_FACES, *faces])
    for other in content.unread:
        warn(f"{name}: its {other.count} {other.name} are not read; faces should be an element face")
    warn_if_no_triangles(name, sum(element.count for element in [*content.faces, *content.strips]), joined)
    for (corners, sizes), element in zip(lists, content.faces, strict=True) if colors is None else ():
        painted = _colors(element)
        if painted is not None and len(painted):
            colors = colors_of_faces(len(verts), corners, np.repeat(painted, sizes, axis=0))
            warn(f"{name} has a color for each face: each vertex gets the mean of the faces around it")
            break
    return Raw(verts, joined, colors)


def parsed(name: str, data: bytes) -> Content:
    """The elements of a file that make a shape; `InputError` where there are no positions, or the file is damaged."""
    order, elements, start, comments = _header(name, data)
    _give_roles(elements)
    vertices = next((element for element in elements if element.role == "vertex"), None)
    if vertices is None:
        raise InputError(f"{name}: the header declares no vertices", NO_MESH)
    promised = sum(each.count for each in elements if each.role in ("vertex", "face") and each.properties)
    if promised < len(data):  # else it is told as damage, below
        check_element_count(name, len(data), promised, text=order is None)
    body = Body(name, data, start, order)
    last = max(k for k, element in enumerate(elements) if element.role)
    for element in elements[: last + 1]:
        if element.properties:  # else rows of nothing, however many
            _check_kinds(name, element)
            element.table = body.element(element)
        if element is vertices and not set("xyz") <= set(element.table):
            raise InputError(f"{name}: the vertices have no x, y and z", NO_MESH)
    some = [element for element in elements if element.count and element.properties]
    faces, strips, others = ([each for each in some if each.role == role] for role in ("face", "tristrips", ""))
    unread = [element for element in others if any(p.count_kind and _is_usual(p) for p in element.properties)]
    return Content(comments, vertices, faces, strips, unread, elements, order)


def _give_roles(elements: Sequence[Element]) -> None:
    """Say of each element what it is, by its usual name, or, where there is none of that, by one that it has elsewhere; of
    several kinds of vertices the first are meant.
    """
    usual, seen = {element.name for element in elements}, set[str]()
    for element in elements:
        role = next((role for role, others in _NAMES.items() if element.name.lower() in (role, *others)), "")
        if (element.name == role or role not in usual) and not (role == "vertex" and role in seen):
            element.role = role
            seen.add(role)


def _is_usual(listed: Property) -> bool:
    """Whether a list is called as those of the corners of faces are."""
    return listed.name.lower().replace("_", "") in _FACE_LISTS


def corners_of(name: str, element: Element) -> tuple[Ints, Ints]:
    """Vertices of polygons or strips, one after the other, and how many each has: the list with a usual name, or else
    the only list of whole numbers. `InputError` where no list is that, for faces must not be lost without a word.
    """
    lists = [p for p in element.properties if p.count_kind]
    usual = [p for p in lists if _is_usual(p)]
    whole = [p for p in lists if p.kind[0] != "f"]
    chosen = next((few for few in (usual, whole) if len(few) == 1), usual[:1])
    if not chosen:
        which = "none of its lists is" if not whole else "it cannot be told which of its lists is"
        raise InputError(f"{name}: {which} that of the vertices of each {element.name}", _FACE_HINT)
    items, sizes = element.table[chosen[0].name]
    return indices(name, items), sizes


def read_pcd(path: Path, data: bytes) -> Raw:
    """Points with the colours that a field rgb or rgba packs into four bytes; not compressed ones."""
    name, start, colors = path.name, _DATA.search(data), None
    if not start:
        raise InputError(f"{name} is not a pcd file of text or plain binary points", "write it uncompressed, or as ply")
    lines = data[: start.start()].removeprefix(b"\xef\xbb\xbf").decode("latin-1").splitlines()
    head = {line.split()[0]: line.split()[1:] for line in lines if line.strip()}
    try:
        counts = head.get("COUNT", ["1"] * len(head["FIELDS"]))
        points = Element("vertex", 0)
        for label, kind, size, count in zip(head["FIELDS"], head["TYPE"], head["SIZE"], counts, strict=True):
            known = TYPES[{"F": "float", "I": "int", "U": "uint"}[kind] + str(8 * int(size))]
            points.properties += [Property(label.lower(), known)] * min(int(count), _MOST_LINES)
            if len(points.properties) > _MOST_LINES:
                raise damaged(name, f"its header declares over {_MOST_LINES} numbers for each point")
        grid = int(head["WIDTH"][0]) * int(head["HEIGHT"][0]) if "WIDTH" in head and "HEIGHT" in head else 0
        promised = int(head["POINTS"][0]) if "POINTS" in head else grid
        body = Body(name, data, start.end(), None if start[1] == b"ascii" else "<")
        held = body.rows_left(points)
        points.count = held if held and (promised <= 0 or promised > held or grid == held) else promised
        check_element_count(name, len(data), points.count)
        points.table = body.element(points)
        verts = np.stack([points.table[axis].astype(np.float64) for axis in "xyz"], axis=1)
    except (KeyError, ValueError, IndexError) as error:
        raise damaged(name, "its header makes no sense, or names no x, y and z") from error
    if points.count != promised:
        warn(f"{name} promises {promised} points, but holds {points.count}: these are read")
    elif held > points.count:
        warn(f"{name} holds more than its {points.count} points, which is not read")
    for p in points.properties:
        if p.name in ("rgb", "rgba"):
            colors = _unpacked(points, p)
    return Raw(verts, NO_FACES, colors)


def _unpacked(element: Element, p: Property) -> Floats:
    """(N, 4) opaque colors from numbers that hold red, green and blue in a byte each: of a float its bits count."""
    packed = element.table[p.name].astype(p.kind[0] + "4").view(np.uint32)[:, None]
    return np.insert((packed >> np.array([16, 8, 0], np.uint32) & 255) / 255.0, 3, 1.0, axis=1)


def write(
    path: Path, shape: Shape, vertex: Columns = _NONE, face: Columns = _NONE, comments: Sequence[str] = ()
) -> None:
    """Binary little-endian; positions as float where that loses nothing, else double; `comments` go into the header.

    `vertex` and `face` are further properties, arrays (V,) or (F,) by name, of a kind in `KINDS`, or else double. Names are
    words of ASCII letters, digits and "_".
    """
    with np.errstate(over="ignore"):  # what is too large for a float is not equal to it
        single = bool((shape.verts.astype(np.float32) == shape.verts).all())
    header = ["ply", "format binary_little_endian 1.0", "comment meshmatch"]
    header += [f"comment {' '.join(comment.split())}" for comment in comments]
    header += [f"element vertex {shape.V}"]
    kind, word = ("<f4", "float") if single else ("<f8", "double")
    header += [f"property {word} {axis}" for axis in "xyz"]
    table: dict[str, NDArray[Any]] = dict(zip("xyz", shape.verts_or_nan.T, strict=True))
    if shape.colors is not None:
        table |= color_columns(shape.colors)
    body = _rows(table | dict(vertex), shape.V, [(axis, kind) for axis in "xyz"], header)
    if not shape.is_cloud:
        header += [f"element face {shape.F}", "property list uchar int vertex_indices"]
        lists = {"n": np.full(shape.F, 3), "corners": shape.faces}
        body += _rows(lists | dict(face), shape.F, [("n", "u1"), ("corners", "<i4", (3,))], header)
    path.write_bytes("\n".join([*header, "end_header\n"]).encode() + body)


def color_columns(colors: Float[Floats, "V 4"]) -> Columns:
    """Bytes of red, green, blue and alpha in 0..1."""
    return dict(zip(CHANNELS, np.rint(np.clip(colors.T, 0, 1) * 255).astype(np.uint8), strict=True))


def _rows(table: dict[str, NDArray[Any]], count: int, fields: list[Any], header: list[str]) -> bytes:
    """The rows of a table; its columns that have no field yet get one, and a line in the header."""
    for label in list(table)[len(fields) :]:
        word = KINDS.get(table[label].dtype.name, "double")
        fields.append((label, f"<{TYPES[word]}"))
        header.append(f"property {word} {label}")
    rows = np.empty(count, fields)
    for label, values in table.items():
        rows[label] = values
    return rows.tobytes()


def _header(name: str, data: bytes) -> tuple[str | None, list[Element], int, list[str]]:
    """Byte order (None: text), elements, where the body starts, and comments."""
    if data[:3] != b"ply" or data[3:4] not in (b"\n", b"\r", b" "):
        raise InputError(f"{name} is not a ply file: it does not begin with 'ply'", WRONG_SUFFIX)
    end = END.search(data)
    if not end:
        raise damaged(name, "the header has no end")
    if data.count(b"element", 0, end.start()) + data.count(b"property", 0, end.start()) > _MOST_LINES:
        raise damaged(name, f"its header has over {_MOST_LINES} lines")
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
    """Refuse a list where a number is needed, and the other way round."""
    for place, p in enumerate(element.properties):
        lists = {"face": p.name in ("vertex_indices", "vertex_index"), "tristrips": place == 0}.get(element.role, False)
        number = element.role == "vertex" and p.name in _NUMBERS
        if (number and p.count_kind) or (lists and not p.count_kind):
            what = "lists" if p.count_kind else "numbers"
            raise damaged(name, f"its header declares {p.name} of the element {element.name} as {what}")


def faces_of(corners: Ints, sizes: Ints) -> Ints:
    """Triangles of strips, which are a row each, or split by -1."""
    ends = corners < 0
    strip = np.repeat(np.arange(len(sizes)), sizes) + np.cumsum(ends)
    return strips(corners[~ends], np.unique(strip[~ends], return_counts=True)[1])


def _colors(element: Element) -> Floats | None:
    """(N, 4) sRGB colors and alpha of the rows of an element; None if it has none."""
    found = color_properties(element)
    if len(found) == 1:
        return _unpacked(element, found[0])
    out = np.ones((element.count, 4))
    for group in (found[:3], found[3:]):
        values = [element.table[p.name].astype(np.float64) for p in group]
        small = all(p.kind[0] == "f" for p in group) and not any((each > 1).any() for each in values)
        for p, each in zip(group, values, strict=True):
            largest = 1.0 if small else 65535.0 if p.kind == "u2" else 255.0
            out[:, found.index(p)] = np.clip(np.nan_to_num(each) / largest, 0.0, 1.0)
    return out if found else None


def color_properties(element: Element) -> list[Property]:
    """The properties that hold colors: red, green, blue and perhaps alpha; or one with all of them; or none."""
    kinds = {p.name.lower(): p for p in element.properties if not p.count_kind}
    prefix = next((p for p in _PREFIXES if all(p + channel in kinds for channel in CHANNELS[:3])), None)
    names = [f"{prefix}{channel}" for channel in CHANNELS] if prefix is not None else list("rgba")
    if not all(name in kinds for name in names[:3]):
        packed = [kinds[name] for name in ("rgb", "rgba") if name in kinds and kinds[name].kind[1:] == "4"]
        return packed[:1]
    alpha = [name for name in (names[3], "alpha", "a") if name in kinds]
    return [kinds[name] for name in names[:3] + alpha[:1]]
