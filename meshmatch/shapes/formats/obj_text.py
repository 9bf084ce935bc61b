"""The text of an OBJ file with other positions, or other texture coordinates and materials: groups, polygons, comments and
order stay.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.errors import InputError
from meshmatch.geometry.triangles import unit
from meshmatch.shapes.formats import columns, lines_starting_with, parse_numbers, without_comments, words_per_line
from meshmatch.shapes.formats.obj import SLASH_APART, entries_and_faces, from_one, joined_lines, vertices_of_corners
from meshmatch.shapes.formats.polygons import triangles_of

_GAP = rb"[ \t]++"
_WORD = rb"\S++"
_NUMBERS = {
    word: re.compile(
        rb"^([ \t]*+" + word + _GAP + rb")" + _WORD + rb"(" + _GAP + rb")" + _WORD + rb"(" + _GAP + rb")" + _WORD,
        re.MULTILINE,
    )
    for word in (b"v", b"vn")
}
_FACES = (b"f", b"fo")
_VERTEX = re.compile(rb"^([ \t]*+v" + 3 * (_GAP + rb"[^\s#]++") + rb")[^\n#]*", re.MULTILINE)
_WITHOUT_NORMAL = re.compile(rb"(?<!\S)[^\s/]++(?:/[^\s/]*+)?+/?+(?=\s|\Z)")
_UP_TO_NORMAL = re.compile(rb"[^\s/]++/[^\s/]*+/")


def with_positions(
    name: str, data: bytes, verts: Float[Floats, "V 3"], turns: Float[Floats, "V 3 3"] | None = None
) -> bytes:
    """The bytes of an obj whose vertices have moved.

    Parameters
    ----------
    name
        Of the file, for errors.
    data
        What `obj.read` made V vertices of. Lines that go on in the next one are joined.
    verts
        Where the vertices are now; a line whose row is not finite stays.
    turns
        The rotation around each vertex, which the normals (``vn``) follow, so that hard edges stay hard. Without it,
        they stay.

    Returns
    -------
    bytes
        The same text, but for three numbers in each ``v`` line, and in each ``vn`` line that a face uses.

    Raises
    ------
    InputError
        The text does not have V lines of vertices.
    """
    joined = joined_lines(data)
    if joined.replace(b"\n", b"") != data.replace(b"\r", b"").replace(b"\n", b"") or b"\n" not in data:
        data = joined  # lines that go on, or that end in a lone carriage return
    moved = _replaced(data, b"v", verts, "%.12g")
    if moved is None:
        raise InputError(f"cannot tell the vertices of {name} apart", "export it again, one 'v' line for each")
    if turns is None or b"vn" not in data:
        return moved
    normals = _turned_normals(name, joined, turns)
    return _replaced(moved, b"vn", normals, "%.6g") or moved


@dataclass(frozen=True, eq=False)
class Polygons:
    """The faces of an obj as its text has them, and the corners of their triangles among all corners, (F, 3)."""

    sizes: Int[Ints, " P"]
    triangles: Int[Ints, "F 3"]

    @property
    def of_triangles(self) -> Int[Ints, " F"]:
        """The polygon that each triangle is a part of."""
        return np.repeat(np.arange(len(self.sizes)), np.maximum(self.sizes - 2, 0))


def polygons_of(name: str, data: bytes, verts: Float[Floats, "V 3"]) -> Polygons:
    """The faces of a text that `obj.read` made V vertices of."""
    _, vertex_lines, faces, sizes, face_lines = entries_and_faces(name, joined_lines(data), b"v")
    corners = vertices_of_corners(name, faces, sizes, vertex_lines, face_lines)
    return Polygons(sizes, triangles_of(name, verts, corners, sizes))


def with_material(data: bytes, library: str, material: str, uv: Float[Floats, "N 2"] | None) -> tuple[bytes, list[str]]:
    """The bytes of an obj that wears other materials, and the names of those that its faces use.

    Parameters
    ----------
    data
        The text. Lines that go on in the next one are joined.
    library
        The file of its materials, which takes the place of others.
    material
        The name of the material of faces that have none.
    uv
        Texture coordinates of each corner of its faces, v up, which take the place of others; None to leave those.
    """
    lines = joined_lines(data).split(b"\n")
    words = [line.split(None, 1)[:1] for line in lines]
    kinds = [word[0] if word else b"" for word in words]
    faces = [k for old in _FACES for k, kind in enumerate(kinds) if kind == old]  # as readers count them
    before: list[bytes] = []
    if uv is not None:
        unique, index = np.unique(uv.astype("<f4"), axis=0, return_inverse=True)
        before = [b"vt %.9g %.9g" % (u, v) for u, v in unique.tolist()]
        numbers = iter((index.reshape(-1) + 1).tolist())
        for k in faces:
            lines[k] = _laid(lines[k], numbers)
    named = [k for k, kind in enumerate(kinds) if kind == b"usemtl"]
    names = dict.fromkeys(lines[k].split(None, 1)[-1].strip().decode("utf-8", "surrogateescape") for k in named)
    first = min(faces, default=len(lines))
    if min(named, default=first) >= first:
        before.append(b"usemtl " + material.encode("utf-8", "surrogateescape"))
        names[material] = None
    gone = (b"mtllib",) if uv is None else (b"mtllib", b"vt")
    kept = [line for line, kind in zip(lines[:first], kinds, strict=False) if kind not in gone]
    rest = [line for line, kind in zip(lines[first:], kinds[first:], strict=True) if kind not in gone]
    head = b"mtllib " + library.encode("utf-8", "surrogateescape")
    return b"\n".join([head, *kept, *before, *rest]), list(names)


def with_colors(name: str, data: bytes, colors: Float[Floats, "V 4"]) -> bytes:
    """The bytes of an obj with other colors of its vertices (sRGB, 0..1), behind their positions."""
    number = count()

    def painted(found: re.Match[bytes]) -> bytes:
        k = next(number)
        return found[0] if k >= len(colors) else b"%b %.6g %.6g %.6g" % (found[1], *rows[k])

    rows = colors[:, :3].tolist()
    text = _VERTEX.sub(painted, joined_lines(data))
    if next(number) != len(colors):
        raise InputError(f"cannot tell the vertices of {name} apart", "export it again, one 'v' line for each")
    return text


def beyond_triangles(name: str, data: bytes) -> list[str]:
    """What a text has besides the triangles of one mesh and its material, in words."""
    data = joined_lines(data)
    normals, _, sizes = entries_and_faces(name, data, b"vn")[1:4]
    groups, objects, materials = lines_starting_with(without_comments(data), b"g", b"o", b"usemtl")
    there = {
        "polygons": bool(len(sizes)) and int(sizes.max()) > 3,
        "groups": len(groups[1]) + len(objects[1]) > 1,
        "materials": len({name.strip() for name in materials[0].split(b"\n")} - {b""}) > 1,
        "normals": len(normals) > 0,
    }
    return [word for word, known in there.items() if known]


def _laid(line: bytes, pairs: Iterator[int]) -> bytes:
    """A line of a face with other numbers of texture coordinates."""
    line, sharp, comment = line.partition(b"#")
    word, *corners = SLASH_APART.sub(rb"\1", line.strip()).split()
    out = [word]
    for corner in corners:
        vertex, _, rest = corner.partition(b"/")
        normal = rest.partition(b"/")[2]
        out.append(b"%b/%d/%b" % (vertex, next(pairs), normal) if normal else b"%b/%d" % (vertex, next(pairs)))
    return b" ".join(out) + (b" " + sharp + comment if sharp else b"")


def _replaced(data: bytes, word: bytes, rows: Floats, form: str) -> bytes | None:
    """The text with other numbers in the lines of a word, or None if there is not a line for each row."""
    line = form.encode().join([rb"%b", rb"%b", rb"%b", rb""])
    kept: list[bool] = np.asarray(np.isfinite(rows).all(axis=1)).tolist()
    values, number = rows.tolist(), count()

    def moved(found: re.Match[bytes]) -> bytes:
        k = next(number)
        if k >= len(values) or not kept[k]:
            return found[0]
        (x, y, z), (start, first, second) = values[k], found.groups()
        return line % (start, x, first, y, second, z)

    text = _NUMBERS[word].sub(moved, data)
    return text if next(number) == len(values) else None


def _turned_normals(name: str, data: bytes, turns: Float[Floats, "V 3 3"]) -> Float[Floats, "N 3"]:
    """The normals of a text, each turned as the vertices are whose corners have it; NaN where no corner has."""
    text, lines, faces, sizes, face_lines = entries_and_faces(name, data, b"vn")
    counts = words_per_line(text)
    if len(counts) < len(lines) or (len(counts) and counts.min() < 3):
        return np.empty((0, 3))
    normals = columns(parse_numbers(name, text), counts, 0, 3)
    vertex_lines = entries_and_faces(name, data, b"v")[1]
    vertices = vertices_of_corners(name, faces, sizes, vertex_lines, face_lines)
    third: Ints = from_one(
        name,
        "normal",
        parse_numbers(name, _UP_TO_NORMAL.sub(b"", _WITHOUT_NORMAL.sub(b"0", faces))),
        lines,
        np.repeat(face_lines, sizes),
    )
    used = np.flatnonzero(third > 0)
    which = third[used] - 1
    turned = np.full(normals.shape, np.nan)
    turned[which] = 0.0
    np.add.at(turned, which, np.einsum("nij,nj->ni", turns[vertices[used]], normals[which]))
    return unit(turned)
