"""STL, binary and text. It has no shared vertices: every corner of every triangle is a vertex of its own."""

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from meshmatch.errors import InputError
from meshmatch.shapes.formats import Raw, damaged
from meshmatch.shapes.formats.text import numbers
from meshmatch.shapes.shape import Shape

_ROW = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def read(path: Path, data: bytes) -> Raw:
    """3 F vertices, three for each triangle, in the file's order."""
    name = path.name
    said = int.from_bytes(data[80:84], "little") if len(data) >= 84 else -1
    whole = said >= 0 and len(data) >= 84 + said * _ROW.itemsize
    if data.lstrip()[:5].lower() == b"solid" and b"facet" in data[:2048] and len(data) != 84 + said * 50:
        return _text(name, data)
    if said < 0:
        raise InputError(f"{name} is not an stl file: it is too short", "does the suffix fit the content?")
    if not whole:
        raise damaged(
            name, f"it promises {said} triangles, but holds only {(len(data) - 84) // _ROW.itemsize}"
        )
    rows = np.frombuffer(data, _ROW, said, 84)
    return _corners(rows["corners"].reshape(-1, 3).astype(np.float64))


def write(path: Path, shape: Shape) -> None:
    """Binary, 32-bit floats."""
    rows = np.zeros(shape.F, _ROW)
    rows["normal"] = shape.face_normals
    rows["corners"] = shape.verts[shape.faces]
    header = b"meshmatch".ljust(80) + shape.F.to_bytes(4, "little")
    path.write_bytes(header + rows.tobytes())


def _text(name: str, data: bytes) -> Raw:
    words = re.findall(rb"vertex\s+(\S+\s+\S+\s+\S+)", data)
    if not words or len(words) % 3 or data.count(b"endfacet") * 3 != len(words):
        raise damaged(name, "it ends in the middle of a triangle" if words else "it has no triangles")
    return _corners(numbers(name, b" ".join(words)).reshape(-1, 3))


def _corners(verts: NDArray[np.float64]) -> Raw:
    return Raw(verts, np.arange(len(verts)).reshape(-1, 3))
