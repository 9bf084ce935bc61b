"""Read and write STL files, text and binary: triangles that share no vertices.

Some programs leave the triangle count of a binary file at 0 or -1, append other data to the triangles, or omit the last
line of a text file. The reader accepts all complete triangles, and warns about such defects.
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
from meshmatch.shapes.input_files import check_text_size
from meshmatch.shapes.shape import Shape

_HEADER_BYTES, _ROW_BYTES = 84, 50  # bytes
_ROW_TYPE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_NAMES = re.compile(rb"^[ \t]*((?:end)?solid)\b[^\n]*?(?=\bfacet[ \t]+normal\b|$)", re.MULTILINE)
_KEYWORDS = re.compile(rb"\b(?=(?:vertex|facet|endloop|endfacet|endsolid)\b)")
_END = re.compile(rb"(?:^|\bendfacet)[ \t]*endsolid\b", re.MULTILINE)
_MIN_MAGNITUDE, _MAX_MAGNITUDE = 1e-30, 1e30
_MAX_DISTANCE = 100.0
"""Maximum distance of triangles beyond the declared count from the counted ones, relative to the size of these."""
_MAX_ROUNDING = 1e-5
"""Displacement of vertices by rounding to 32 bits that causes a warning, relative to the size of the shape."""


def read(path: Path, data: bytes) -> Raw:
    """Read all triangles in file order, of several solids one after the other; each corner becomes a separate vertex."""
    if data[:3] == b"\xef\xbb\xbf" and len(data) != _HEADER_BYTES + _ROW_BYTES * _declared_count(data):
        data = data[3:]
    # Some binary files begin with "solid" like text files, so this is not used to distinguish them.
    text = len(data) != _HEADER_BYTES + _ROW_BYTES * _declared_count(data) and b"\0" not in data[:4096]
    verts = _text(path.name, data) if text else _binary(path.name, data)
    return Raw(verts, np.arange(len(verts)).reshape(-1, 3))


def _declared_count(data: bytes) -> int:
    """Triangle count in the header of a binary file."""
    return int.from_bytes(data[_HEADER_BYTES - 4 : _HEADER_BYTES], "little")


def _binary(name: str, data: bytes) -> Float[Floats, "V 3"]:
    n_available, n_declared = max(len(data) - _HEADER_BYTES, 0) // _ROW_BYTES, _declared_count(data)
    check_element_count(name, len(data), 0, 4 * n_available)
    if not n_available:
        raise damaged(name, "none of its triangles is whole, or it is not an stl file")
    corners = np.frombuffer(data, _ROW_TYPE, n_available, _HEADER_BYTES)["corners"].astype(np.float64)
    if len(data) == _HEADER_BYTES + _ROW_BYTES * n_declared:
        return corners.reshape(-1, 3)
    count = n_available
    if 0 < n_declared < n_available or (n_declared == n_available and n_declared):
        count = n_declared
        # The declared count may be too low: plausible triangles after it are read as well.
        low, high = (edge(corners[:count], axis=(0, 1)) for edge in (np.nanmin, np.nanmax))
        center, extent = (low + high) / 2, float((high - low).max())
        is_plausible = _plausible(corners[count:]) & (
            np.abs(corners[count:] - center).max(axis=(1, 2)) <= _MAX_DISTANCE * extent
        )
        count += len(is_plausible) if is_plausible.all() else int(np.argmin(is_plausible))
    elif _plausible(corners).mean() < 0.9:
        raise damaged(name, f"its triangles are not the {n_declared} that it promises, or it is not an stl file")
    rest = len(data) - _HEADER_BYTES - _ROW_BYTES * count
    if count != n_declared:
        warn(f"{name} promises {n_declared} triangles, but holds {count}: these are read")
    elif rest:
        warn(f"{name} holds {rest} bytes behind its {count} triangles, which are not read")
    return corners[:count].reshape(-1, 3)


def _plausible(corners: Float[Floats, "F 3 3"]) -> Bools:
    """Mask of plausible triangles, as opposed to other data: coordinates of ordinary magnitude, and a nonzero area."""
    size = np.abs(corners)
    is_ordinary = ((size == 0) | ((size > _MIN_MAGNITUDE) & (size < _MAX_MAGNITUDE))).all(axis=(1, 2))
    out = np.zeros(len(corners), bool)
    flat = corners[is_ordinary].reshape(-1, 3)
    out[is_ordinary] = triangle_vectors(flat, np.arange(len(flat)).reshape(-1, 3)).any(axis=1)
    return out


def _text(name: str, data: bytes) -> Float[Floats, "V 3"]:
    check_text_size(name, data)
    text = _NAMES.sub(rb"\1", data.replace(b"\r", b"\n").lower())
    check_element_count(name, len(data), text.count(b"vertex") * 4 // 3, text=True)
    if b"vertex" not in text:
        raise InputError(f"{name} holds no triangles, or it is not an stl file", WRONG_SUFFIX)
    if text.count(b"vertex") != len(lines_starting_with(text, b"vertex")[0][1]):  # several on a line
        text = _KEYWORDS.sub(b"\n", text)
    has_end = bool(_END.search(text))
    if not has_end:  # the last number may be truncated
        text = text[: text.rfind(b"\n") + 1]
    (vertices, vertex_lines), (_, facet_lines) = lines_starting_with(text, b"vertex", b"facet")
    counts = words_per_line(vertices)
    if len(counts) != len(vertex_lines) or (counts != 3).any():
        raise damaged(name, "its triangles cannot be read: a vertex has other than 3 coordinates")
    sizes = np.bincount(np.searchsorted(facet_lines, vertex_lines), minlength=len(facet_lines) + 1)
    sizes = sizes[sizes > 0]
    if len(sizes) and sizes[-1] < 3:
        sizes = sizes[:-1]
    if (sizes < 3).any():
        raise damaged(name, "its triangles cannot be read: one of them has fewer than 3 vertices")
    if len(sizes) == 0:
        raise damaged(name, "none of its triangles is whole")
    if not has_end:
        warn(f"{name} has no end: it may be cut short; {len(sizes)} whole triangles are read")
    verts = parse_numbers(name, vertices).reshape(-1, 3)
    return np.asarray(verts[fan(np.arange(int(sizes.sum())), sizes)]).reshape(-1, 3)


def write(path: Path, shape: Shape) -> None:
    """Write a binary file of 32-bit floats, with a warning if rounding moves vertices visibly."""
    corners = shape.verts[shape.faces]
    rows = np.zeros(shape.F, _ROW_TYPE)
    rows["corners"] = as_float32(corners, ".stl")
    lengths = np.linalg.norm(shape.face_vectors, axis=1)
    rows["normal"] = shape.face_vectors / np.where(lengths > 0, lengths, 1.0)[:, None]
    displacement = float(np.abs(rows["corners"] - corners).max())
    if displacement > _MAX_ROUNDING * shape.diagonal:
        where = "this far from the origin its vertices move by up to"
        warn(
            f"an stl file has 32-bit numbers: {where} {displacement:.2g}; ply, obj, off and glb files keep them in place"
        )
    path.write_bytes(
        b"meshmatch".ljust(_HEADER_BYTES - 4, b"\0") + np.array([shape.F], "<u4").tobytes() + rows.tobytes()
    )
