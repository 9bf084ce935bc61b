"""Stanford PLY, text and binary of either byte order."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshmatch.arrays import Floats, Ints
from meshmatch.errors import InputError
from meshmatch.shapes.formats import NO_FACES, Raw, damaged, fan
from meshmatch.shapes.formats.ply_body import Body, Element, Property
from meshmatch.shapes.shape import Shape

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8", "int64": "i8", "uint64": "u8",
}  # fmt: skip
_FACE_LISTS = ("vertex_indices", "vertex_index")
_END = re.compile(rb"(?<=[\r\n])end_header[ \t]*(?:\r\n|[\r\n]|\Z)")
_NUMBERS = ("x", "y", "z", "red", "green", "blue", "alpha", "r", "g", "b", "a")


def read(path: Path, data: bytes) -> Raw:
    """Vertices, faces and vertex colours of a ply file."""
    name = path.name
    order, elements, start = _header(name, data)
    known = [element.name for element in elements]
    if "vertex" not in known:
        raise InputError(f"{name}: the header declares no vertices", "is it a mesh or a point cloud at all?")
    wanted = [k for k, element in enumerate(elements) if element.name in ("vertex", "face", "tristrips")]
    body = Body(name, data, start, order)
    verts, faces, colors = None, NO_FACES, None
    for element in elements[: max(wanted) + 1]:
        if not element.properties:
            continue  # rows of nothing, however many
        _check_kinds(name, element)
        table = body.element(element)
        if element.name == "vertex":
            if not {"x", "y", "z"} <= set(table):
                raise InputError(f"{name}: the vertices have no x, y and z", "is it a mesh or a point cloud at all?")
            verts = np.stack([table[axis].values.astype(np.float64) for axis in "xyz"], axis=1)
            colors = _colors(table)
        elif element.name == "face":
            lists = next((table[key] for key in _FACE_LISTS if key in table), None)
            if lists is not None:
                faces = fan(*lists)
        elif element.name == "tristrips":
            faces = _strips(table[element.properties[0].name][0])
    if verts is None:
        raise InputError(f"{name}: the vertices have no x, y and z", "is it a mesh or a point cloud at all?")
    return Raw(verts, faces, colors)


def write(
    path: Path,
    shape: Shape,
    vertex: Mapping[str, NDArray[Any]] | None = None,
    face: Mapping[str, NDArray[Any]] | None = None,
    comments: Sequence[str] = (),
) -> None:
    """Binary little-endian; positions as float where that loses nothing, else double.

    Parameters
    ----------
    vertex, face : arrays (V,) or (F,) by name, optional
        Further properties: uint8, int32, or else double. Names are words of ASCII letters, digits and "_".
    comments : sequence of str
        Lines for the header.
    """
    verts = shape.verts
    with np.errstate(over="ignore"):  # what is too large for a float is not equal to it
        single = bool((verts.astype(np.float32) == verts).all())
    real, kind = ("float", "<f4") if single else ("double", "<f8")
    fields = [("x", kind), ("y", kind), ("z", kind)]
    header = ["ply", "format binary_little_endian 1.0", "comment meshmatch"]
    header += [f"comment {' '.join(comment.split())}" for comment in comments]
    header += [f"element vertex {shape.V}"]
    header += [f"property {real} {axis}" for axis in "xyz"]
    if shape.colors is not None:
        fields += [(channel, "u1") for channel in ("red", "green", "blue", "alpha")]
        header += [f"property uchar {channel}" for channel in ("red", "green", "blue", "alpha")]
    more_fields, more_header = _further(vertex)
    table = np.zeros(shape.V, dtype=fields + more_fields)
    header += more_header
    for label, values in (vertex or {}).items():
        table[label] = values
    for axis, values in zip("xyz", shape.verts_or_nan.T, strict=True):
        table[axis] = values
    if shape.colors is not None:
        for channel, values in zip(("red", "green", "blue", "alpha"), shape.colors.T, strict=True):
            table[channel] = np.rint(np.clip(values, 0, 1) * 255)
    chunks = [table.tobytes()]
    if not shape.is_cloud:
        header += [f"element face {shape.F}", "property list uchar int vertex_indices"]
        more_fields, more_header = _further(face)
        header += more_header
        rows = np.empty(shape.F, dtype=[("n", "u1"), ("corners", "<i4", (3,)), *more_fields])
        for label, values in (face or {}).items():
            rows[label] = values
        rows["n"] = 3
        rows["corners"] = shape.faces
        chunks.append(rows.tobytes())
    path.write_bytes("\n".join([*header, "end_header\n"]).encode() + b"".join(chunks))


def _further(columns: Mapping[str, NDArray[Any]] | None) -> tuple[list[Any], list[str]]:
    """Fields of a table, and lines of a header, for further properties."""
    fields, lines = [], []
    for label, values in (columns or {}).items():
        kind, word = {"uint8": ("u1", "uchar"), "int32": ("<i4", "int")}.get(values.dtype.name, ("<f8", "double"))
        fields.append((label, kind))
        lines.append(f"property {word} {label}")
    return fields, lines


def _header(name: str, data: bytes) -> tuple[str | None, list[Element], int]:
    """Byte order (None: text), elements, and where the body starts."""
    if data[:3] != b"ply" or data[3:4] not in (b"\n", b"\r", b" "):
        raise InputError(f"{name} is not a ply file: it does not begin with 'ply'", "does the suffix fit the content?")
    end = _END.search(data)
    if not end:
        raise damaged(name, "the header has no end")
    order: str | None = ""
    elements: list[Element] = []
    try:
        for line in data[: end.start()].decode("latin-1").replace("\r\n", "\n").replace("\r", "\n").split("\n"):
            match line.split():
                case ["format", kind, *_]:
                    order = {"ascii": None, "binary_little_endian": "<", "binary_big_endian": ">"}[kind]
                case ["element", element, count, *_]:
                    elements.append(Element(element, int(count)))
                case ["property", "list", count_kind, kind, label, *_] if _TYPES[count_kind][0] != "f":
                    elements[-1].properties.append(Property(label, _TYPES[kind], _TYPES[count_kind]))
                case ["property", kind, label, *_]:
                    elements[-1].properties.append(Property(label, _TYPES[kind]))
    except (KeyError, ValueError, IndexError) as error:
        raise damaged(name, f"the header line {line.strip()[:60]!r} makes no sense") from error
    if order == "":
        raise damaged(name, "the header declares no format")
    for each in elements:
        names = [p.name for p in each.properties]
        if len(set(names)) < len(names):
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


def _colors(table: dict[str, Any]) -> Floats | None:
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
