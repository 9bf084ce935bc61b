"""The text of an OBJ file with other positions: groups, polygons, texture coordinates, comments and order stay."""

from __future__ import annotations

import re
from itertools import count

import numpy as np

from meshmatch.arrays import Float, Floats, Ints
from meshmatch.errors import InputError
from meshmatch.geometry.triangles import unit
from meshmatch.shapes.formats import columns, numbers, words_per_line
from meshmatch.shapes.formats.obj import entries_and_faces, from_one, joined_lines, vertices_of_corners

_GAP = rb"[ \t]++"
_WORD = rb"\S++"
_NUMBERS = {
    word: re.compile(
        rb"^([ \t]*+" + word + _GAP + rb")" + _WORD + rb"(" + _GAP + rb")" + _WORD + rb"(" + _GAP + rb")" + _WORD,
        re.MULTILINE,
    )
    for word in (b"v", b"vn")
}
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
    normals = columns(numbers(name, text), counts, 0, 3)
    vertex_lines = entries_and_faces(name, data, b"v")[1]
    vertices = vertices_of_corners(name, faces, sizes, vertex_lines, face_lines)
    third: Ints = from_one(
        name,
        "normal",
        numbers(name, _UP_TO_NORMAL.sub(b"", _WITHOUT_NORMAL.sub(b"0", faces))),
        lines,
        np.repeat(face_lines, sizes),
    )
    used = np.flatnonzero(third > 0)
    which = third[used] - 1
    turned = np.full(normals.shape, np.nan)
    turned[which] = 0.0
    np.add.at(turned, which, np.einsum("nij,nj->ni", turns[vertices[used]], normals[which]))
    return unit(turned)
