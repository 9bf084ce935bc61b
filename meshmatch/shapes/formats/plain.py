"""The plain formats: Geomview OFF (text), STL, and points as xyz text or NumPy arrays."""

from __future__ import annotations

import logging
import re
from io import BytesIO
from pathlib import Path

import numpy as np

from meshmatch.errors import InputError
from meshmatch.shapes import formats
from meshmatch.shapes.formats import NO_FACES, Raw, columns, damaged, numbers, words_per_line
from meshmatch.shapes.input_files import check_text, read_npy
from meshmatch.shapes.shape import Shape

_HEADER = re.compile(rb"\s*((?:ST)?C?N?)OFF\b|\s*((?:ST)?C?N?)OFF(?=\d)")


def read_off(path: Path, data: bytes) -> Raw:
    """With or without colors and normals."""
    name = path.name
    check_text(name, data)
    text = formats.without_comments(data).replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    header = _HEADER.match(text)
    if not header:
        raise InputError(f"{name} is not an off file: it does not begin with 'OFF'", formats.WRONG_SUFFIX)
    kind = header.group(1) or header.group(2) or b""
    body = text[header.end() :]
    if body.lstrip()[:6] == b"BINARY":
        raise InputError(f"{name} is a binary off file", "convert it to ply")
    head = re.match(rb"\s*(\d{1,15})\s+(\d{1,15})(?!\d)(?:[ \t]+\d+)?", body)
    if not head:
        raise damaged(name, "the header does not say how many vertices and faces there are")
    V, F = int(head.group(1)), int(head.group(2))
    promise = f"it promises {V} vertices and {F} faces, but"
    body = body[head.end() :]
    if len(body) < V + F:  # a row takes two bytes and more
        raise damaged(name, f"{promise} is only {len(data)} bytes long")
    formats.check_places(name, len(data), V, F, text=True)
    counts = words_per_line(body)
    if len(counts) < V + F:
        raise damaged(name, f"{promise} has only {len(counts)} lines of them")
    widths, sizes = counts[:V], counts[V : V + F]
    if V and widths.min() < 3:
        raise damaged(name, "a vertex has fewer than 3 coordinates")
    rows, faces = np.split(numbers(name, body), [widths.sum()])
    at = 6 if b"N" in kind else 3
    colors = None
    if b"C" in kind and V and widths.min() >= at + 3:
        colors = formats.painted(columns(rows, widths, at, min(at + 4, int(widths.min()))))
    verts = columns(rows, widths, 0, 3) if V else np.empty((0, 3))
    if F == 0:
        return Raw(verts, NO_FACES, colors)
    starts = np.cumsum(sizes) - sizes
    corners = faces[starts]
    if not ((corners >= 0) & (corners < sizes)).all():
        raise damaged(name, "a face has fewer corners than it says")
    many = corners.astype(np.int64)
    formats.check_places(name, len(data), V, max(int(many.sum()) - 2 * F, 0), text=True)
    return Raw(verts, formats.fan(formats.indices(name, faces[formats.runs(starts + 1, many)]), many), colors)


def write_off(path: Path, shape: Shape) -> None:
    """Positions with every digit that they have; colors as COFF."""
    verts = shape.verts_or_nan
    rows = verts if shape.colors is None else np.hstack([verts, shape.colors])
    lines = ["OFF" if shape.colors is None else "COFF", f"{shape.V} {shape.F} 0"]
    lines += [" ".join(map(repr, row)) for row in rows.tolist()]
    lines += [f"3 {a} {b} {c}" for a, b, c in shape.faces.tolist()]
    path.write_text("\n".join([*lines, ""]))


def read_stl(path: Path, data: bytes) -> Raw:
    """Every corner of a triangle is a vertex of its own, in the file's order; several solids one after the other."""
    from trimesh.exchange.stl import load_stl  # 0.7 s to import: only where it is needed

    if data[:5].lower() == b"solid":  # text, unless the size is just that of a binary file
        check_text(path.name, data)
        formats.check_places(path.name, len(data), data.count(b"vertex") * 4 // 3, text=True)
    else:
        formats.check_places(path.name, len(data), 0, len(data) // 50 * 4)
    logging.getLogger("trimesh").addHandler(logging.NullHandler())  # or it prints tracebacks of damaged files
    try:
        found = load_stl(BytesIO(data))
        solids = found["geometry"].values() if "geometry" in found else [found]
        verts = np.concatenate([np.asarray(one["vertices"], np.float64)[one["faces"]] for one in solids])
    except Exception as error:  # of whatever kind: trimesh has no class for damaged files
        raise damaged(path.name, "its triangles cannot be read, or it is not an stl file") from error
    verts = verts.reshape(-1, 3)
    return Raw(verts, np.arange(len(verts)).reshape(-1, 3))


def write_stl(path: Path, shape: Shape) -> None:
    """Binary, 32-bit floats."""
    from trimesh.exchange.stl import export_stl

    path.write_bytes(export_stl(shape.to_trimesh()))


def read_xyz(path: Path, data: bytes) -> Raw:
    """x y z at the start of each line, split by space, comma or semicolon; further columns are ignored."""
    name = path.name
    if b"\0" in data[:4096]:
        raise InputError(f"{name} is not a text file of points", formats.WRONG_SUFFIX)
    check_text(name, data)
    text = formats.without_comments(data.translate(bytes.maketrans(b",;\r", b"  \n")))
    counts = words_per_line(text)
    formats.check_places(name, len(data), len(counts), text=True)
    if len(counts) > 1 and counts[0] == 1 and text.split(None, 1)[0] == str(len(counts) - 1).encode():
        text, counts = text.split(None, 1)[1], counts[1:]  # a first line with the number of points
    if len(counts) == 0:
        raise InputError(f"{name} holds no points", "each line should be: x y z")
    if counts.min() < 3:
        short = int(np.flatnonzero(counts < 3)[0])
        raise damaged(name, f"point {short} has only {int(counts[short])} of 3 coordinates")
    return Raw(columns(numbers(name, text), counts, 0, 3), NO_FACES)


def write_xyz(path: Path, shape: Shape) -> None:
    """A line for each point, with every digit that it has."""
    path.write_text("".join(f"{x!r} {y!r} {z!r}\n" for x, y, z in shape.verts_or_nan.tolist()))


def read_points(path: Path, data: bytes) -> Raw:
    """An npy array (N, 3) of points, or (N, 6) with normals, which are ignored."""
    array = read_npy(path)
    if array.dtype.kind not in "fiu":
        raise InputError(f"{path.name} does not hold an array of numbers", "save points as an (N, 3) array")
    if array.ndim != 2 or array.shape[1] not in (3, 6):
        hint = "points are an array of (N, 3), or (N, 6)"
        raise InputError(f"{path.name} holds an array of {array.shape}, not a point cloud", hint)
    formats.check_places(path.name, len(data), len(array))
    return Raw(np.array(array[:, :3], np.float64), NO_FACES)


def write_points(path: Path, shape: Shape) -> None:
    """An npy array (N, 3) of float64."""
    with path.open("wb") as file:
        np.save(file, shape.verts_or_nan, allow_pickle=False)
