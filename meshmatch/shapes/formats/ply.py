"""Stanford PLY, text and binary of either byte order, and points of PCL's PCD: rows of equal length are read at once."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from meshmatch.arrays import Floats, Ints
from meshmatch.errors import InputError
from meshmatch.shapes.formats import NO_FACES, NO_MESH, WRONG_SUFFIX, Raw, check_places, damaged
from meshmatch.shapes.formats.ply_rows import TYPES, Body, Element, Property
from meshmatch.shapes.formats.polygons import triangles_of
from meshmatch.shapes.shape import Shape

_MOST_LINES = 4096  # of a header that declare something
_FACE_LISTS = ("vertex_indices", "vertex_index")
_END = re.compile(rb"(?<=[\r\n])end_header[ \t]*(?:\r\n|[\r\n]|\Z)")
_DATA = re.compile(rb"^DATA[ \t]+(ascii|binary)[ \t]*\r?\n", re.MULTILINE)
_CHANNELS = ("red", "green", "blue", "alpha")
Columns: TypeAlias = Mapping[str, NDArray[Any]]
_NONE: Columns = MappingProxyType({})
_NUMBERS = ("x", "y", "z", *_CHANNELS, "r", "g", "b", "a")


def read(path: Path, data: bytes) -> Raw:
    """Vertices, faces (polygons or strips) and vertex colors."""
    name = path.name
    order, elements, start = _header(name, data)
    known = [element.name for element in elements]
    if "vertex" not in known:
        raise InputError(f"{name}: the header declares no vertices", NO_MESH)
    wanted = [k for k, element in enumerate(elements) if element.name in ("vertex", "face", "tristrips")]
    promised = sum(element.count for element in elements if element.name in ("vertex", "face") and element.properties)
    if promised < len(data):  # else it is told as damage, below
        check_places(name, len(data), promised, text=order is None)
    body = Body(name, data, start, order)
    places, faces, polygons, colors = [], NO_FACES, None, None
    for element in elements[: max(wanted) + 1]:
        if not element.properties:
            continue  # rows of nothing, however many
        _check_kinds(name, element)
        table = body.element(element)
        if element.name == "vertex":
            places = [table[axis].astype(np.float64) for axis in "xyz" if axis in table]
            colors = _colors(table, {p.name: p.kind for p in element.properties})
            if len(places) < 3:
                break
        elif element.name == "face":
            polygons = next((table[key] for key in _FACE_LISTS if key in table), polygons)
        elif element.name == "tristrips":
            faces = _strips(table[element.properties[0].name][0])
    if len(places) < 3:
        raise InputError(f"{name}: the vertices have no x, y and z", NO_MESH)
    verts = np.stack(places, axis=1)
    if polygons is not None:
        faces = polygons[0][triangles_of(name, verts, *polygons)]
    return Raw(verts, faces, colors)


def read_pcd(path: Path, data: bytes) -> Raw:
    """Points with the colours that a field rgb or rgba packs into four bytes; not compressed ones."""
    name, start, colors = path.name, _DATA.search(data), None
    if not start:
        raise InputError(f"{name} is not a pcd file of text or plain binary points", "write it uncompressed, or as ply")
    lines = data[: start.start()].decode("latin-1").splitlines()
    head = {line.split()[0]: line.split()[1:] for line in lines if line.strip()}
    try:
        points = Element("vertex", int(head["POINTS"][0]))
        counts = head.get("COUNT", ["1"] * len(head["FIELDS"]))
        for label, kind, size, count in zip(head["FIELDS"], head["TYPE"], head["SIZE"], counts, strict=True):
            known = TYPES[{"F": "float", "I": "int", "U": "uint"}[kind] + str(8 * int(size))]
            points.properties += [Property(label, known)] * min(int(count), len(data))
        check_places(name, len(data), points.count)
        table = Body(name, data, start.end(), None if start[1] == b"ascii" else "<").element(points)
        verts = np.stack([table[axis].astype(np.float64) for axis in "xyz"], axis=1)
    except (KeyError, ValueError, IndexError) as error:
        raise damaged(name, "its header makes no sense, or names no x, y and z") from error
    for p in points.properties:
        if p.name in ("rgb", "rgba"):  # of a float its bits count, not its value
            packed = table[p.name].astype(p.kind[0] + "4").view(np.uint32)[:, None]
            colors = np.insert((packed >> np.array([16, 8, 0], np.uint32) & 255) / 255.0, 3, 1.0, axis=1)
    return Raw(verts, NO_FACES, colors)


def write(
    path: Path, shape: Shape, vertex: Columns = _NONE, face: Columns = _NONE, comments: Sequence[str] = ()
) -> None:
    """Binary little-endian; positions as float where that loses nothing, else double; `comments` go into the header.

    `vertex` and `face` are further properties, arrays (V,) or (F,) by name: uint8, int32, or else double. Names are
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
        table |= zip(_CHANNELS, np.rint(np.clip(shape.colors.T, 0, 1) * 255).astype(np.uint8), strict=True)
    body = _rows(table | dict(vertex), shape.V, [(axis, kind) for axis in "xyz"], header)
    if not shape.is_cloud:
        header += [f"element face {shape.F}", "property list uchar int vertex_indices"]
        lists = {"n": np.full(shape.F, 3), "corners": shape.faces}
        body += _rows(lists | dict(face), shape.F, [("n", "u1"), ("corners", "<i4", (3,))], header)
    path.write_bytes("\n".join([*header, "end_header\n"]).encode() + body)


def _rows(table: dict[str, NDArray[Any]], count: int, fields: list[Any], header: list[str]) -> bytes:
    """The rows of a table; its columns that have no field yet get one, and a line in the header."""
    kinds = {"uint8": ("u1", "uchar"), "int32": ("<i4", "int")}
    for label in list(table)[len(fields) :]:
        kind, word = kinds.get(table[label].dtype.name, ("<f8", "double"))
        fields.append((label, kind))
        header.append(f"property {word} {label}")
    rows = np.empty(count, fields)
    for label, values in table.items():
        rows[label] = values
    return rows.tobytes()


def _header(name: str, data: bytes) -> tuple[str | None, list[Element], int]:
    """Byte order (None: text), elements, and where the body starts."""
    if data[:3] != b"ply" or data[3:4] not in (b"\n", b"\r", b" "):
        raise InputError(f"{name} is not a ply file: it does not begin with 'ply'", WRONG_SUFFIX)
    end = _END.search(data)
    if not end:
        raise damaged(name, "the header has no end")
    if data.count(b"element", 0, end.start()) + data.count(b"property", 0, end.start()) > _MOST_LINES:
        raise damaged(name, f"its header has over {_MOST_LINES} lines")
    order: str | None = ""
    elements: list[Element] = []
    try:
        for line in data[: end.start()].decode("latin-1").replace("\r\n", "\n").replace("\r", "\n").split("\n"):
            match line.split():
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
    return order, elements, end.end()


def _check_kinds(name: str, element: Element) -> None:
    """Refuse a list where a number is needed, and the other way round."""
    for place, p in enumerate(element.properties):
        lists = {"face": p.name in _FACE_LISTS, "tristrips": place == 0}.get(element.name, False)
        number = element.name == "vertex" and p.name in _NUMBERS
        if (number and p.count_kind) or (lists and not p.count_kind):
            what = "lists" if p.count_kind else "numbers"
            raise damaged(name, f"its header declares {p.name} of the element {element.name} as {what}")


def _strips(lists: Ints) -> Ints:
    """Triangles of strips, -1 between two strips; every second triangle of a strip is turned round."""
    a, b, c = lists[:-2], lists[1:-1], lists[2:]
    place = np.arange(len(lists))
    begin = np.maximum.accumulate(np.where(lists < 0, place + 1, 0))[: len(a)]
    odd = (place[: len(a)] - begin) % 2 == 1
    faces = np.stack([np.where(odd, b, a), np.where(odd, a, b), c], axis=1)
    return faces[(a >= 0) & (b >= 0) & (c >= 0)]


def _colors(table: dict[str, Any], kinds: dict[str, str]) -> Floats | None:
    names = next((n for n in (("red", "green", "blue"), ("r", "g", "b")) if set(n) <= set(table)), None)
    if names is None:
        return None
    out = np.ones((len(table[names[0]]), 4))
    for k, name in enumerate([*names, *[a for a in ("alpha", "a") if a in table][:1]]):
        values = table[name].astype(np.float64)
        small = kinds[name][0] == "f" and not (values > 1).any()
        largest = 1.0 if small else 65535.0 if kinds[name] == "u2" else 255.0
        out[:, k] = np.clip(np.nan_to_num(values) / largest, 0.0, 1.0)
    return out
