"""Geomview OFF, its text form."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from meshmatch.arrays import Floats, Ints
from meshmatch.errors import InputError, warn
from meshmatch.shapes import formats
from meshmatch.shapes.formats import NO_FACES, Raw, columns, damaged, parse_numbers, words_per_line
from meshmatch.shapes.formats.polygons import triangles_of
from meshmatch.shapes.input_files import check_text
from meshmatch.shapes.shape import Shape

_HEADER = re.compile(rb"\s*((?:ST)?C?N?)OFF\b|\s*((?:ST)?C?N?)OFF(?=\d)")
_COUNTS = re.compile(rb"\s*(\d{1,15})\s+(\d{1,15})(?!\d)(?:[ \t]+\d+)?")


def read(path: Path, data: bytes) -> Raw:
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
    head = _COUNTS.match(body)
    if not head:
        raise damaged(name, "the header does not say how many vertices and faces there are")
    V, F = int(head.group(1)), int(head.group(2))
    promise = f"it promises {V} vertices and {F} faces, but"
    body = body[head.end() :]
    if len(body) < V + F:  # a row takes two bytes and more
        raise damaged(name, f"{promise} is only {len(data)} bytes long")
    formats.check_element_count(name, len(data), V, F, text=True)
    counts = words_per_line(body)
    if len(counts) < V + F:
        raise damaged(name, f"{promise} has only {len(counts)} lines of them")
    widths, sizes = counts[:V], counts[V : V + F]
    if V and widths.min() < 3:
        raise damaged(name, "a vertex has fewer than 3 coordinates")
    rows, faces = np.split(parse_numbers(name, body), [widths.sum()])
    colors = _colors(kind, rows, widths)
    verts = columns(rows, widths, 0, 3) if V else np.empty((0, 3))
    if F == 0:
        return Raw(verts, NO_FACES, colors)
    starts = np.cumsum(sizes) - sizes
    corners = faces[starts]
    if not ((corners >= 0) & (corners < sizes)).all():
        raise damaged(name, "a face has fewer corners than it says")
    many = corners.astype(np.int64)
    formats.check_element_count(name, len(data), V, max(int(many.sum()) - 2 * F, 0), text=True)
    corner = formats.indices(name, faces[formats.runs(starts + 1, many)])
    triangles = corner[triangles_of(name, verts, corner, many)]
    formats.warn_if_no_triangles(name, F, triangles)
    found = None if colors is not None else _face_colors(faces, starts + 1 + many, sizes - 1 - many)
    if found is not None and len(triangles):
        warn(f"{name} has colors of faces: each vertex gets the mean of those around it")
        colors = formats.colors_of_faces(V, corner, np.repeat(found, many, axis=0))
    return Raw(verts, triangles, colors)


def beyond_triangles(name: str, data: bytes) -> list[str]:
    """What a file that could be read has besides triangles and their colors, in words."""
    text = formats.without_comments(data).replace(b"\r", b"\n")
    header = _HEADER.match(text)
    head = None if header is None else _COUNTS.match(text, header.end())
    if head is None:
        return []
    V, F = int(head[1]), int(head[2])
    rows = [line.split(None, 1)[0] for line in text[head.end() :].split(b"\n") if line.strip()][V : V + F]
    return ["polygons"] * any(int(float(row)) > 3 for row in rows)


def _colors(kind: bytes, rows: Floats, widths: Ints) -> Floats | None:
    """(V, 4) colors of the vertices, where there are columns for them; with or without a C in the header."""
    if len(widths) == 0:
        return None
    at = 6 if b"N" in kind else 3
    free = int(widths.min()) - at - (2 if b"ST" in kind else 0)  # behind them are texture coordinates
    if free < 3 or (b"C" not in kind and free > 4):
        return None
    found = columns(rows, widths, at, at + min(free, 4))
    if b"C" not in kind:
        lengths = np.linalg.norm(found, axis=1)
        if free == 3 and ((found < 0).any() or (np.abs(lengths - 1) < 0.01).all()):  # normals
            return None
        if not ((found >= 0) & (found <= 255)).all():
            return None
    return formats.painted(found)


def _face_colors(faces: Floats, starts: Ints, widths: Ints) -> Floats | None:
    """(P, 4) colors behind the corners of the faces, white for those without; an index of a color map is none."""
    colored = np.isin(widths, (3, 4))
    if not colored.any():
        return None
    width = int(widths[colored].min())
    colors = np.ones((len(widths), 4))
    colors[colored] = formats.painted(faces[starts[colored, None] + np.arange(width)])
    return colors


def write(path: Path, shape: Shape) -> None:
    """Positions with every digit that they have; colors as COFF."""
    verts = shape.verts_or_nan
    rows = verts if shape.colors is None else np.hstack([verts, shape.colors])
    lines = ["OFF" if shape.colors is None else "COFF", f"{shape.V} {shape.F} 0"]
    lines += [" ".join(map(repr, row)) for row in rows.tolist()]
    lines += [f"3 {a} {b} {c}" for a, b, c in shape.faces.tolist()]
    path.write_text("\n".join([*lines, ""]))
