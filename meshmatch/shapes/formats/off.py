"""Geomview OFF, the text form, with or without colours and normals."""

import re
from pathlib import Path

import numpy as np

from meshmatch.errors import InputError
from meshmatch.shapes.formats import NO_FACES, Raw, damaged, fan
from meshmatch.shapes.formats.text import columns, numbers, words_per_line
from meshmatch.shapes.shape import Shape

_HEADER = re.compile(rb"\s*((?:ST)?C?N?)OFF\b|\s*((?:ST)?C?N?)OFF(?=\d)")


def read(path: Path, data: bytes) -> Raw:
    """Vertices, faces and vertex colours of an off file."""
    name = path.name
    text = re.sub(rb"#[^\n]*", b"", data).replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    header = _HEADER.match(text)
    if not header:
        raise InputError(f"{name} is not an off file: it does not begin with 'OFF'", "does the suffix fit the content?")
    kind = header.group(1) or header.group(2) or b""
    body = text[header.end() :]
    if body.lstrip()[:6] == b"BINARY":
        raise InputError(f"{name} is a binary off file", "convert it to ply")
    head = re.match(rb"\s*(\d{1,15})\s+(\d{1,15})(?!\d)(?:[ \t]+\d+)?", body)
    if not head:
        raise damaged(name, "the header does not say how many vertices and faces there are")
    V, F = int(head.group(1)), int(head.group(2))
    body = body[head.end() :]
    if len(body) < V + F:  # a row takes two bytes and more
        raise damaged(name, f"it promises {V} vertices and {F} faces, but is only {len(data)} bytes long")
    counts = words_per_line(body)
    if len(counts) < V + F:
        raise damaged(name, f"it promises {V} vertices and {F} faces, but has only {len(counts)} lines of them")
    if V and counts[:V].min() < 3:
        raise damaged(name, "a vertex has fewer than 3 coordinates")
    values = numbers(name, body)
    words = int(counts[:V].sum())
    rows, widths = values[:words], counts[:V]
    verts = columns(rows, widths, 0, 3) if V else np.empty((0, 3))
    colors = None
    at = 6 if b"N" in kind else 3
    if b"C" in kind and V and widths.min() >= at + 3:
        channels = np.nan_to_num(columns(rows, widths, at, min(at + 4, int(widths.min()))))
        colors = np.ones((V, 4))
        colors[:, : channels.shape[1]] = np.clip(channels / (255.0 if (channels > 1).any() else 1.0), 0.0, 1.0)
    if F == 0:
        return Raw(verts, NO_FACES, colors)
    lines = counts[V : V + F]
    values = values[words : words + int(lines.sum())]
    starts = np.cumsum(lines) - lines
    sizes = values[starts]
    if not ((sizes >= 0) & (sizes < lines)).all():
        raise damaged(name, "a face has fewer corners than it says")
    sizes = sizes.astype(np.int64)
    within = np.arange(sizes.sum()) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    corners = values[np.repeat(starts + 1, sizes) + within]
    if not (np.abs(corners) < 2**53).all():
        raise damaged(name, "a face refers to a vertex that is not a number")
    return Raw(verts, fan(corners.astype(np.int64), sizes), colors)


def write(path: Path, shape: Shape) -> None:
    """Positions with every digit that they have; colours as COFF."""
    verts = shape.verts_or_nan
    rows = verts if shape.colors is None else np.hstack([verts, shape.colors])
    lines = ["OFF" if shape.colors is None else "COFF", f"{shape.V} {shape.F} 0"]
    lines += [" ".join(map(repr, row)) for row in rows.tolist()]
    lines += [f"3 {a} {b} {c}" for a, b, c in shape.faces.tolist()]
    path.write_text("\n".join([*lines, ""]))
