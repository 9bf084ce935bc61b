"""A .vtp file with further arrays: everything else in it stays, byte for byte."""

from __future__ import annotations

import html
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshmatch.errors import warn
from meshmatch.shapes.formats.ply_edit import most_frequent
from meshmatch.shapes.formats.vtk import Arrays, comment_of, plain
from meshmatch.shapes.formats.vtk_xml import TYPES, arrays_of, surface_of
from meshmatch.shapes.input_files import read_bytes
from meshmatch.shapes.shape import Shape

_NAMES = {np.dtype(kind).str[1:]: name for name, kind in TYPES.items()}
_ARRAY = rb"<DataArray\b[^>]*\bName=\"%b\"[^>]*?(?:/>|>.*?</DataArray>)\s*"


def with_arrays(name: str, data: bytes, of_points: Arrays, of_faces: Arrays, comments: Iterable[str] = ()) -> bytes:
    """The bytes of a file with further arrays, as text; what has the name of one is replaced, which is said but of colors.

    Parameters
    ----------
    name
        Of the file, for words.
    data
        What `data_of` gave.
    of_points
        Arrays (V,) or (V, D) by name.
    of_faces
        Arrays (F,) or (F, D) for its triangles as `vtk_xml.read` makes them: a polygon has what most of its triangles have,
        by the first of the arrays.
    comments
        Go in front of everything but the XML declaration.
    """
    found = surface_of(name, data)
    if of_faces and found is not None and found[1] is not None:
        sizes = found[1]
        chosen = most_frequent(next(iter(of_faces.values())), np.maximum(sizes - 2, 0))
        of_faces = {label: np.append(each, each[:1] * 0, axis=0)[chosen] for label, each in of_faces.items()}
    end = data.find(b"<AppendedData")
    head, rest = (data, b"") if end < 0 else (data[:end], data[end:])
    for group, arrays in ((b"PointData", of_points), (b"CellData", of_faces)):
        if arrays:
            head = _with(name, head, group, dict(plain(arrays)))
    begin = head.find(b"<VTKFile")
    return head[:begin] + "".join(f"{comment_of(each)}\n" for each in comments).encode() + head[begin:] + rest


def data_of(file: Path | None, shape: Shape, faces: bool = False) -> bytes | None:
    """The bytes of the .vtp that a shape was read from; None where it came from elsewhere, has other vertices by now, or is
    in pieces, or where ``faces`` need rows of their own and the file has other cells than polygons.
    """
    if file is None or file.suffix.lower() != ".vtp":
        return None
    data = read_bytes(file)
    found = surface_of(file.name, data)
    if found is None or found[0] != shape.V or (faces and found[1] is None):
        return None
    return data


def beyond_triangles(name: str, data: bytes) -> list[str]:
    """What a file has besides triangles and their colors, in words."""
    found = surface_of(name, data)
    polygons = found is not None and found[1] is not None and bool((found[1] > 3).any())
    return ["polygons"] * polygons + [f"array {each}" for each in arrays_of(name, data)]


def _with(name: str, head: bytes, group: bytes, arrays: dict[str, NDArray[Any]]) -> bytes:
    found = re.search(rb"<%b\b[^>]*?(/?)>" % group, head)
    if found is None:
        piece = re.search(rb"<Piece\b[^>]*>", head)
        assert piece is not None
        begin = end = piece.end()
        before, inside, after = b"\n<%b>\n" % group, b"", b"</%b>\n" % group
    else:
        begin = found.start()
        end = found.end() if found[1] else head.index(b"</%b>" % group, found.end())
        before, after = found[0].rstrip(b"/>").rstrip() + b">\n", b"</%b>" % group if found[1] else b""
        inside = b"" if found[1] else head[found.end() : end].lstrip()
    for label in arrays:
        left = re.sub(_ARRAY % re.escape(html.escape(label).encode()), b"", inside, flags=re.DOTALL)
        if left != inside and arrays[label].dtype != np.uint8:
            warn(f"{name} has an array {label} already, which is replaced")
        inside = left
    # the first colors are those that readers show
    colors, others = (
        "".join(_text(label, each) for label, each in arrays.items() if (each.dtype == np.uint8) == first).encode()
        for first in (True, False)
    )
    inside = inside.rstrip() + b"\n" * bool(inside)
    return head[:begin] + before + colors + inside + others + after + head[end:]


def _text(name: str, values: NDArray[Any]) -> str:
    kind = _NAMES[values.dtype.str[1:]]
    numbers = " ".join(values.astype(str).ravel().tolist())
    return (
        f'<DataArray type="{kind}" Name="{html.escape(name)}" NumberOfComponents="{values.shape[1]}" format="ascii">'
        f"{numbers}</DataArray>\n"
    )
