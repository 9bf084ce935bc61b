"""A .vtp file with further arrays: everything else in it stays, byte for byte."""

from __future__ import annotations

import html
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshmatch.errors import warn
from meshmatch.shapes.formats.ply_edit import most_frequent, none_of
from meshmatch.shapes.formats.vtk import Arrays, comment_of, plain
from meshmatch.shapes.formats.vtk_xml import APPENDED, arrays_of, element_like, surface_of
from meshmatch.shapes.input_files import read_bytes
from meshmatch.shapes.shape import Shape

_GROUPS = (b"PointData", b"CellData")
_NAMED = re.compile(rb"<!-- label -?\d+(?: .*?)?-->\s*", re.DOTALL)
# What XML consists of, besides text: comments and the like, and tags with their attributes.
_TOKEN = re.compile(
    rb"<!--.*?-->|<!\[CDATA\[.*?\]\]>|<\?.*?\?>"
    rb"|<(?P<ends>/?)(?P<tag>[\w:.-]+)(?P<attributes>(?:\s+[\w:.-]+\s*=\s*(?:\"[^\"]*\"|'[^']*'))*)\s*(?P<empty>/?)>",
    re.DOTALL,
)
_NAME = re.compile(rb"\sName\s*=\s*(?:\"([^\"]*)\"|'([^']*)')")


def with_arrays(name: str, data: bytes, of_points: Arrays, of_faces: Arrays, comments: Iterable[str] = ()) -> bytes:
    """The bytes of a file with further arrays; what has the name of one is replaced, which is said but of colors.

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
        Go in front of everything but the XML declaration, where those on labels make room for them.
    """
    found = surface_of(name, data)
    if of_faces and found is not None and found.sizes is not None:
        chosen = most_frequent(next(iter(of_faces.values())), np.maximum(found.sizes - 2, 0))
        of_faces = {label: np.append(each, none_of(each), axis=0)[chosen] for label, each in of_faces.items()}
    begin = APPENDED.search(data)
    head, rest = (data, b"") if begin is None else (data[: begin.start()], data[begin.start() :])
    for group, arrays in zip(_GROUPS, (of_points, of_faces), strict=True):
        if arrays:
            head = _with(name, head, group, dict(plain(arrays)))
    at = _Places.of(head).root
    before = _NAMED.sub(b"", head[:at]) if "label" in {*of_points, *of_faces} else head[:at]
    told = "".join(f"{comment_of(each)}\n" for each in comments).encode("ascii", "xmlcharrefreplace")
    return before + told + head[at:] + rest


def data_of(file: Path | None, shape: Shape, faces: bool = False) -> bytes | None:
    """The bytes of the .vtp that a shape was read from; None where it came from elsewhere, is another one by now, or is in
    pieces, and where ``faces`` need rows of their own and the file has other cells than polygons.
    """
    if file is None or file.suffix.lower() != ".vtp" or not file.is_file():
        return None
    data = read_bytes(file)
    found = surface_of(file.name, data)
    if found is None or not np.array_equal(found.verts, shape.verts_or_nan, equal_nan=True):
        return None
    if faces and (found.sizes is None or int(np.maximum(found.sizes - 2, 0).sum()) != shape.F):
        return None
    return data


def beyond_triangles(name: str, data: bytes) -> list[str]:
    """What a file has besides triangles and their colors, in words."""
    found = surface_of(name, data)
    polygons = found is not None and found.sizes is not None and bool((found.sizes > 3).any())
    return ["polygons"] * polygons + [f"array {each}" for each in arrays_of(name, data)]


@dataclass
class _Places:
    """Where the first piece has its data: of the root and behind the tag of the piece; of each group where its tag begins
    and ends, where the tag that closes it begins, and its arrays with their names.
    """

    root: int = -1
    piece: int = -1
    groups: dict[bytes, tuple[int, int, int]] = field(default_factory=dict)
    arrays: dict[bytes, list[tuple[int, int, str]]] = field(default_factory=dict)

    @classmethod
    def of(cls, head: bytes) -> _Places:
        found, open_ = cls(), list[tuple[bytes, int, int, str]]()
        for token in _TOKEN.finditer(head):
            tag = token["tag"]
            if tag is None:
                continue
            if not token["ends"]:
                name = _NAME.search(token["attributes"])
                said = "" if name is None else html.unescape((name[1] or name[2] or b"").decode("utf-8", "replace"))
                open_.append((tag, token.start(), token.end(), said))
                if len(open_) == 1 and found.root < 0:
                    found.root = token.start()
                if len(open_) == 3 and tag == b"Piece" and found.piece < 0:
                    found.piece = token.end()
            if token["ends"] or token["empty"]:
                if not open_:
                    break
                own, begin, behind, said = open_.pop()
                if len(open_) == 3 and own in _GROUPS and own not in found.groups:
                    found.groups[own] = begin, behind, behind if token["empty"] else token.start()
                if len(open_) == 4 and open_[-1][0] in _GROUPS and own == b"DataArray":
                    found.arrays.setdefault(open_[-1][0], []).append((begin, token.end(), said))
        return found


def _with(name: str, head: bytes, group: bytes, arrays: dict[str, NDArray[Any]]) -> bytes:
    places = _Places.of(head)
    for begin, end, said in reversed(places.arrays.get(group, [])):
        if said in arrays:
            head = head[:begin] + head[end:]
            if arrays[said].dtype != np.uint8:
                warn(f"{name} has an array {said} already, which is replaced")
    places = _Places.of(head)
    # the first colors are those that readers show
    colors, others = (
        "".join(element_like(head, label, each) for label, each in arrays.items() if (each.dtype == np.uint8) == first)
        for first in (True, False)
    )
    first, last = (each.encode("ascii", "xmlcharrefreplace") for each in (colors, others))
    if group not in places.groups:
        at = places.piece
        return head[:at] + b"\n<%b>\n%b%b</%b>" % (group, first, last, group) + head[at:]
    begin, behind, closing = places.groups[group]
    if closing == behind and head[behind - 2 : behind] == b"/>":
        opened = head[begin : behind - 2].rstrip() + b">"
        return head[:begin] + opened + b"\n%b%b</%b>" % (first, last, group) + head[behind:]
    inside = head[behind:closing].rstrip()
    return head[:behind] + b"\n" * bool(first) + first.rstrip() + inside + b"\n" + last + head[closing:]
