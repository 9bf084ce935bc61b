"""Add arrays to a .vtp file; everything else in it is kept, byte for byte."""

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
from meshmatch.shapes.formats.polygons import majority_of_triangles
from meshmatch.shapes.formats.vtk import Arrays, to_vtk_types, xml_comment
from meshmatch.shapes.formats.vtk_xml import APPENDED, Surface, array_names, format_array, read_surface
from meshmatch.shapes.input_files import read_bytes
from meshmatch.shapes.shape import Shape

_GROUPS = (b"PointData", b"CellData")
_LABEL_COMMENT = re.compile(rb"<!-- label -?\d+(?: .*?)?-->\s*", re.DOTALL)
# XML tokens other than text: comments, CDATA sections, processing instructions, and tags with their attributes.
_TOKEN = re.compile(
    rb"<!--.*?-->|<!\[CDATA\[.*?\]\]>|<\?.*?\?>"
    rb"|<(?P<ends>/?)(?P<tag>[\w:.-]+)(?P<attributes>(?:\s+[\w:.-]+\s*=\s*(?:\"[^\"]*\"|'[^']*'))*)\s*(?P<empty>/?)>",
    re.DOTALL,
)
_NAME = re.compile(rb"\sName\s*=\s*(?:\"([^\"]*)\"|'([^']*)')")


@dataclass(frozen=True, eq=False)
class VtpFile:
    """A .vtp file that can be rewritten with further arrays.

    Attributes
    ----------
    name
        Name of the file, for messages.
    data
        Its bytes.
    surface
        Its points and polygons; None if it has several pieces.
    """

    name: str
    data: bytes
    surface: Surface | None

    @classmethod
    def parsed(cls, name: str, data: bytes) -> VtpFile:
        """Parse the bytes of a file."""
        return cls(name, data, read_surface(name, data))

    @classmethod
    def of(cls, file: Path | None, shape: Shape, faces: bool = False) -> VtpFile | None:
        """Return the file that a shape was read from, or None if it cannot be edited for the shape.

        That is, if it is not a vtp file of one piece; if its vertices are no longer those of the shape; or if ``faces`` are
        to get arrays, but the file has other cells than polygons, or another number of triangles.
        """
        if file is None or file.suffix.lower() != ".vtp" or not file.is_file():
            return None
        candidate = cls.parsed(file.name, read_bytes(file))
        surface = candidate.surface
        if surface is None or not np.array_equal(surface.verts, shape.verts_or_nan, equal_nan=True):
            return None
        if faces and (surface.sizes is None or int(np.maximum(surface.sizes - 2, 0).sum()) != shape.F):
            return None
        return candidate

    @property
    def arrays(self) -> list[str]:
        """Names of its point and cell arrays, without colors and normals."""
        return array_names(self.name, self.data)

    @property
    def content_beyond_triangles(self) -> list[str]:
        """Kinds of content besides triangles and their colors, in words."""
        sizes = None if self.surface is None else self.surface.sizes
        polygons = sizes is not None and bool((sizes > 3).any())
        return ["polygons"] * polygons + [f"array {each}" for each in self.arrays]

    def with_arrays(self, of_points: Arrays, of_faces: Arrays, comments: Iterable[str] = ()) -> bytes:
        """Return its bytes with further arrays.

        Existing arrays of the same name are replaced, with a warning unless they are colors.

        Parameters
        ----------
        of_points
            Arrays (V,) or (V, D) by name.
        of_faces
            Arrays (F,) or (F, D) for the triangles of `vtk_xml.read`; polygons get the values of `majority_of_triangles`.
        comments
            Comments before the root element. If an array is called "label", they replace earlier comments on labels.
        """
        if of_faces and self.surface is not None and self.surface.sizes is not None:
            of_faces = majority_of_triangles(of_faces, self.surface.sizes)
        begin = APPENDED.search(self.data)
        head, rest = (self.data, b"") if begin is None else (self.data[: begin.start()], self.data[begin.start() :])
        for group, arrays in zip(_GROUPS, (of_points, of_faces), strict=True):
            if arrays:
                head = _add_arrays(self.name, head, group, dict(to_vtk_types(arrays)))
        at = _Offsets.of(head).root
        prolog = _LABEL_COMMENT.sub(b"", head[:at]) if "label" in {*of_points, *of_faces} else head[:at]
        new_comments = "".join(f"{xml_comment(each)}\n" for each in comments).encode("ascii", "xmlcharrefreplace")
        return prolog + new_comments + head[at:] + rest


@dataclass
class _Offsets:
    """Byte offsets in a file, for adding arrays to its first piece.

    Attributes
    ----------
    root
        Start of the root element.
    piece
        End of the start tag of the first piece.
    groups
        Start and end of the start tag of each group, and start of its end tag.
    arrays
        Start, end and name of each array, by group.
    """

    root: int = -1
    piece: int = -1
    groups: dict[bytes, tuple[int, int, int]] = field(default_factory=dict)
    arrays: dict[bytes, list[tuple[int, int, str]]] = field(default_factory=dict)

    @classmethod
    def of(cls, head: bytes) -> _Offsets:
        offsets, open_ = cls(), list[tuple[bytes, int, int, str]]()
        for token in _TOKEN.finditer(head):
            tag = token["tag"]
            if tag is None:
                continue
            if not token["ends"]:
                name = _NAME.search(token["attributes"])
                array_name = (
                    "" if name is None else html.unescape((name[1] or name[2] or b"").decode("utf-8", "replace"))
                )
                open_.append((tag, token.start(), token.end(), array_name))
                if len(open_) == 1 and offsets.root < 0:
                    offsets.root = token.start()
                if len(open_) == 3 and tag == b"Piece":
                    offsets.piece = token.end()
            if token["ends"] or token["empty"]:
                if not open_:
                    break
                closed, begin, tag_end, array_name = open_.pop()
                if len(open_) == 3 and closed in _GROUPS and closed not in offsets.groups:
                    offsets.groups[closed] = begin, tag_end, tag_end if token["empty"] else token.start()
                if len(open_) == 4 and open_[-1][0] in _GROUPS and closed == b"DataArray":
                    offsets.arrays.setdefault(open_[-1][0], []).append((begin, token.end(), array_name))
        return offsets


def _add_arrays(name: str, head: bytes, group: bytes, arrays: dict[str, NDArray[Any]]) -> bytes:
    """Add arrays to a group of the first piece, replacing those of the same name."""
    offsets = _Offsets.of(head)
    for begin, end, array_name in reversed(offsets.arrays.get(group, [])):
        if array_name in arrays:
            head = head[:begin] + head[end:]
            if arrays[array_name].dtype != np.uint8:
                warn(f"{name} has an array {array_name} already, which is replaced")
    offsets = _Offsets.of(head)
    # readers show the first array of colors, so new colors come first
    colors, others = (
        "".join(format_array(head, label, each) for label, each in arrays.items() if (each.dtype == np.uint8) == first)
        for first in (True, False)
    )
    first, last = (each.encode("ascii", "xmlcharrefreplace") for each in (colors, others))
    if group not in offsets.groups:
        at = offsets.piece
        return head[:at] + b"\n<%b>\n%b%b</%b>" % (group, first, last, group) + head[at:]
    begin, tag_end, closing = offsets.groups[group]
    if closing == tag_end and head[tag_end - 2 : tag_end] == b"/>":
        opened = head[begin : tag_end - 2].rstrip() + b">"
        return head[:begin] + opened + b"\n%b%b</%b>" % (first, last, group) + head[tag_end:]
    inside = head[tag_end:closing].rstrip()
    return head[:tag_end] + b"\n" * bool(first) + first.rstrip() + inside + b"\n" + last + head[closing:]
