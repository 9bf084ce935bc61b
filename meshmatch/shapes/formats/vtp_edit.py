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
from meshmatch.shapes.formats.polygons import of_most_triangles
from meshmatch.shapes.formats.vtk import Arrays, comment_of, plain
from meshmatch.shapes.formats.vtk_xml import APPENDED, Surface, arrays_of, element_like, surface_of
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


@dataclass(frozen=True, eq=False)
class VtpFile:
    """A .vtp to be written with further arrays.

    Attributes
    ----------
    name : of the file, for words
    data : its bytes
    surface : points and polygons; None where it has several pieces
    """

    name: str
    data: bytes
    surface: Surface | None

    @classmethod
    def parsed(cls, name: str, data: bytes) -> VtpFile:
        """From its bytes."""
        return cls(name, data, surface_of(name, data))

    @classmethod
    def of(cls, file: Path | None, shape: Shape, faces: bool = False) -> VtpFile | None:
        """The file that a shape was read from; None where it came from elsewhere, is another one by now, or is in pieces,
        and where ``faces`` need rows of their own and the file has other cells than polygons.
        """
        if file is None or file.suffix.lower() != ".vtp" or not file.is_file():
            return None
        found = cls.parsed(file.name, read_bytes(file))
        surface = found.surface
        if surface is None or not np.array_equal(surface.verts, shape.verts_or_nan, equal_nan=True):
            return None
        if faces and (surface.sizes is None or int(np.maximum(surface.sizes - 2, 0).sum()) != shape.F):
            return None
        return found

    @property
    def arrays(self) -> list[str]:
        """The names of arrays of points and cells that are no colors or normals."""
        return arrays_of(self.name, self.data)

    @property
    def beyond_triangles(self) -> list[str]:
        """What the file has besides triangles and their colors, in words."""
        sizes = None if self.surface is None else self.surface.sizes
        polygons = sizes is not None and bool((sizes > 3).any())
        return ["polygons"] * polygons + [f"array {each}" for each in self.arrays]

    def with_arrays(self, of_points: Arrays, of_faces: Arrays, comments: Iterable[str] = ()) -> bytes:
        """Its bytes with further arrays; what has the name of one is replaced, which is said but of colors.

        Parameters
        ----------
        of_points
            Arrays (V,) or (V, D) by name.
        of_faces
            Arrays (F,) or (F, D) for its triangles as `vtk_xml.read` makes them: a polygon has what most of its triangles
            have, by the first of the arrays.
        comments
            Go in front of everything but the XML declaration, where those on labels make room for them.
        """
        if of_faces and self.surface is not None and self.surface.sizes is not None:
            of_faces = of_most_triangles(of_faces, self.surface.sizes)
        begin = APPENDED.search(self.data)
        head, rest = (self.data, b"") if begin is None else (self.data[: begin.start()], self.data[begin.start() :])
        for group, arrays in zip(_GROUPS, (of_points, of_faces), strict=True):
            if arrays:
                head = _with(self.name, head, group, dict(plain(arrays)))
        at = _Places.of(head).root
        before = _NAMED.sub(b"", head[:at]) if "label" in {*of_points, *of_faces} else head[:at]
        told = "".join(f"{comment_of(each)}\n" for each in comments).encode("ascii", "xmlcharrefreplace")
        return before + told + head[at:] + rest


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
                if len(open_) == 3 and tag == b"Piece":
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
