"""Read and write Geomview OFF files in text form."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from meshmatch.arrays import Floats, Ints
from meshmatch.errors import InputError, warn
from meshmatch.shapes import formats
from meshmatch.shapes.formats import NO_FACES, Raw, columns, damaged, parse_numbers, words_per_line
from meshmatch.shapes.formats.polygons import triangles_of
from meshmatch.shapes.input_files import check_text_size
from meshmatch.shapes.shape import Shape

_HEADER = re.compile(rb"\s*((?:ST)?C?N?)OFF\b|\s*((?:ST)?C?N?)OFF(?=\d)")
_COUNTS = re.compile(rb"\s*(\d{1,15})\s+(\d{1,15})(?!\d)(?:[ \t]+\d+)?")


def read(path: Path, data: bytes) -> Raw:
    """Read vertices, faces and the colors of vertices, or else of faces; normals are skipped."""
    name = path.name
    check_text_size(name, data)
    text = formats.without_comments(data).replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    header = _HEADER.match(text)
    if not header:
        raise InputError(f"{name} is not an off file: it does not begin with 'OFF'", formats.WRONG_SUFFIX)
    kind = header.group(1) or header.group(2) or b""
    body = text[header.end() :]
    if body.lstrip()[:6] == b"BINARY":
        raise InputError(f"{name} is a binary off file", "convert it to ply")
    counts_match = _COUNTS.match(body)
    if not counts_match:
        raise damaged(name, "the header does not say how many vertices and faces there are")
    V, F = int(counts_match.group(1)), int(counts_match.group(2))
    declaration = f"it promises {V} vertices and {F} faces, but"
    body = body[counts_match.end() :]
    if len(body) < V + F:  # each row takes at least two bytes
        raise damaged(name, f"{declaration} is only {len(data)} bytes long")
    formats.check_element_count(name, len(data), V, F, text=True)
    counts = words_per_line(body)
    if len(counts) < V + F:
        raise damaged(name, f"{declaration} has only {len(counts)} lines of them")
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
    n_corners = corners.astype(np.int64)
    formats.check_element_count(name, len(data), V, max(int(n_corners.sum()) - 2 * F, 0), text=True)
    corner = formats.indices(name, faces[formats.concatenated_ranges(starts + 1, n_corners)])
    triangles = corner[triangles_of(name, verts, corner, n_corners)]
    formats.warn_if_no_triangles(name, F, triangles)
    face_colors = None if colors is not None else _face_colors(faces, starts + 1 + n_corners, sizes - 1 - n_corners)
    if face_colors is not None and len(triangles):
        warn(f"{name} has colors of faces: each vertex gets the mean of those around it")
        colors = formats.vertex_colors_from_faces(V, corner, np.repeat(face_colors, n_corners, axis=0))
    return Raw(verts, triangles, colors)


def content_beyond_triangles(name: str, data: bytes) -> list[str]:
    """Kinds of content besides triangles and their colors, in words; the file must have passed `read`."""
    text = formats.without_comments(data).replace(b"\r", b"\n")
    header = _HEADER.match(text)
    counts_match = None if header is None else _COUNTS.match(text, header.end())
    if counts_match is None:
        return []
    V, F = int(counts_match[1]), int(counts_match[2])
    rows = [line.split(None, 1)[0] for line in text[counts_match.end() :].split(b"\n") if line.strip()][V : V + F]
    return ["polygons"] * any(int(float(row)) > 3 for row in rows)


def _colors(kind: bytes, rows: Floats, widths: Ints) -> Floats | None:
    """(V, 4) vertex colors if there are columns for them, with or without a C in the header; None otherwise."""
    if len(widths) == 0:
        return None
    first = 6 if b"N" in kind else 3
    n_columns = int(widths.min()) - first - (2 if b"ST" in kind else 0)  # texture coordinates come last
    if n_columns < 3 or (b"C" not in kind and n_columns > 4):
        return None
    values = columns(rows, widths, first, first + min(n_columns, 4))
    if b"C" not in kind:
        lengths = np.linalg.norm(values, axis=1)
        if n_columns == 3 and ((values < 0).any() or (np.abs(lengths - 1) < 0.01).all()):  # normals
            return None
        if not ((values >= 0) & (values <= 255)).all():
            return None
    return formats.rgba_from_channels(values)


def _face_colors(faces: Floats, starts: Ints, widths: Ints) -> Floats | None:
    """(P, 4) colors after the corners of the faces, white for faces without; None if no face has one.

    Indices into a color map, which are single numbers, are ignored.
    """
    colored = np.isin(widths, (3, 4))
    if not colored.any():
        return None
    width = int(widths[colored].min())
    colors = np.ones((len(widths), 4))
    colors[colored] = formats.rgba_from_channels(faces[starts[colored, None] + np.arange(width)])
    return colors


def write(path: Path, shape: Shape) -> None:
    """Write a mesh or a point cloud, with positions in full precision; with colors as COFF."""
    verts = shape.verts_or_nan
    rows = verts if shape.colors is None else np.hstack([verts, shape.colors])
    lines = ["OFF" if shape.colors is None else "COFF", f"{shape.V} {shape.F} 0"]
    lines += [" ".join(map(repr, row)) for row in rows.tolist()]
    lines += [f"3 {a} {b} {c}" for a, b, c in shape.faces.tolist()]
    path.write_text("\n".join([*lines, ""]))
