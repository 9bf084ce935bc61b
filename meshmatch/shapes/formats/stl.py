"""STL, text and binary: triangles that share no vertices.

Programs leave the number of triangles in a binary file at 0 or -1, write others' data behind the triangles, or forget the
last line of a text. As many whole triangles are read as there are, and whatever was not as it should be is said.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from meshmatch.arrays import Bools, Float, Floats
from meshmatch.errors import InputError, warn
from meshmatch.geometry.triangles import triangle_vectors
from meshmatch.shapes.formats import (
    WRONG_SUFFIX,
    Raw,
    as_float32,
    check_element_count,
    damaged,
    fan,
    lines_starting_with,
    parse_numbers,
    words_per_line,
)
from meshmatch.shapes.input_files import check_text
from meshmatch.shapes.shape import Shape

_HEADER, _ROW = 84, 50  # bytes
_ROWS = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_NAMES = re.compile(rb"^[ \t]*((?:end)?solid)\b[^\n]*?(?=\bfacet[ \t]+normal\b|$)", re.MULTILINE)
_WORDS = re.compile(rb"\b(?=(?:vertex|facet|endloop|endfacet|endsolid)\b)")
_END = re.compile(rb"(?:^|\bendfacet)[ \t]*endsolid\b", re.MULTILINE)
_SMALLEST, _LARGEST = 1e-30, 1e30
_REACH = 100.0
"""How far from the triangles that are counted, in their size, others may be that are not."""
_VISIBLE = 1e-5
"""Share of the size by which 32-bit floats may move a vertex without a word."""


def read(path: Path, data: bytes) -> Raw:
    """Every corner of a triangle is a vertex of its own, in the file's order; several solids one after the other."""
    if data[:3] == b"\xef\xbb\xbf" and len(data) != _HEADER + _ROW * _promised(data):
        data = data[3:]
    # What a text begins with, some binary files have in their header.
    text = len(data) != _HEADER + _ROW * _promised(data) and b"\0" not in data[:4096]
    verts = _text(path.name, data) if text else _binary(path.name, data)
    return Raw(verts, np.arange(len(verts)).reshape(-1, 3))


def _promised(data: bytes) -> int:
    """How many triangles the header of a binary file counts."""
    return int.from_bytes(data[_HEADER - 4 : _HEADER], "little")


def _binary(name: str, data: bytes) -> Float[Floats, "V 3"]:
    held, promised = max(len(data) - _HEADER, 0) // _ROW, _promised(data)
    check_element_count(name, len(data), 0, 4 * held)
    if not held:
        raise damaged(name, "none of its triangles is whole, or it is not an stl file")
    corners = np.frombuffer(data, _ROWS, held, _HEADER)["corners"].astype(np.float64)
    if len(data) == _HEADER + _ROW * promised:
        return corners.reshape(-1, 3)
    count = held
    if 0 < promised < held or (promised == held and promised):
        count = promised
        low, high = (edge(corners[:count], axis=(0, 1)) for edge in (np.nanmin, np.nanmax))
        middle, reach = (low + high) / 2, float((high - low).max())
        alike = _likely(corners[count:]) & (np.abs(corners[count:] - middle).max(axis=(1, 2)) <= _REACH * reach)
        count += len(alike) if alike.all() else int(np.argmin(alike))  # a count that was too low
    elif _likely(corners).mean() < 0.9:
        raise damaged(name, f"its triangles are not the {promised} that it promises, or it is not an stl file")
    rest = len(data) - _HEADER - _ROW * count
    if count != promised:
        warn(f"{name} promises {promised} triangles, but holds {count}: these are read")
    elif rest:
        warn(f"{name} holds {rest} bytes behind its {count} triangles, which are not read")
    return corners[:count].reshape(-1, 3)


def _likely(corners: Float[Floats, "F 3 3"]) -> Bools:
    """Which triangles are some, and no other data: of usual numbers, with an area."""
    size = np.abs(corners)
    usual = ((size == 0) | ((size > _SMALLEST) & (size < _LARGEST))).all(axis=(1, 2))
    out = np.zeros(len(corners), bool)
    flat = corners[usual].reshape(-1, 3)
    out[usual] = triangle_vectors(flat, np.arange(len(flat)).reshape(-1, 3)).any(axis=1)
    return out


def _text(name: str, data: bytes) -> Float[Floats, "V 3"]:
    check_text(name, data)
    text = _NAMES.sub(rb"\1", data.replace(b"\r", b"\n").lower())
    check_element_count(name, len(data), text.count(b"vertex") * 4 // 3, text=True)
    if b"vertex" not in text:
        raise InputError(f"{name} holds no triangles, or it is not an stl file", WRONG_SUFFIX)
    if text.count(b"vertex") != len(lines_starting_with(text, b"vertex")[0][1]):  # several on a line
        text = _WORDS.sub(b"\n", text)
    ended = bool(_END.search(text))
    if not ended:  # the last number may be cut short
        text = text[: text.rfind(b"\n") + 1]
    (vertices, where), (_, begins) = lines_starting_with(text, b"vertex", b"facet")
    counts = words_per_line(vertices)
    if len(counts) != len(where) or (counts != 3).any():
        raise damaged(name, "its triangles cannot be read: a vertex has other than 3 coordinates")
    sizes = np.bincount(np.searchsorted(begins, where), minlength=len(begins) + 1)
    sizes = sizes[sizes > 0]
    if len(sizes) and sizes[-1] < 3:
        sizes = sizes[:-1]
    if (sizes < 3).any():
        raise damaged(name, "its triangles cannot be read: one of them has fewer than 3 vertices")
    if len(sizes) == 0:
        raise damaged(name, "none of its triangles is whole")
    if not ended:
        warn(f"{name} has no end: it may be cut short; {len(sizes)} whole triangles are read")
    verts = parse_numbers(name, vertices).reshape(-1, 3)
    return np.asarray(verts[fan(np.arange(int(sizes.sum())), sizes)]).reshape(-1, 3)


def write(path: Path, shape: Shape) -> None:
    """Binary, 32-bit floats; with a warning where these move vertices by what can be seen."""
    corners = shape.verts[shape.faces]
    rows = np.zeros(shape.F, _ROWS)
    rows["corners"] = as_float32(corners, ".stl")
    lengths = np.linalg.norm(shape.face_vectors, axis=1)
    rows["normal"] = shape.face_vectors / np.where(lengths > 0, lengths, 1.0)[:, None]
    moved = float(np.abs(rows["corners"] - corners).max())
    if moved > _VISIBLE * shape.diagonal:
        far = "this far from the origin its vertices move by up to"
        warn(f"an stl file has 32-bit numbers: {far} {moved:.2g}; ply, obj, off and glb files keep them in place")
    path.write_bytes(b"meshmatch".ljust(_HEADER - 4, b"\0") + np.array([shape.F], "<u4").tobytes() + rows.tobytes())
