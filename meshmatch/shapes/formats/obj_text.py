"""Edit the text of an OBJ file: replace positions, colors, texture coordinates or materials.

Groups, polygons, comments and order are kept.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.errors import InputError
from meshmatch.geometry.triangles import normalized
from meshmatch.shapes.formats import (
    COORDINATES,
    columns,
    lines_starting_with,
    parse_numbers,
    without_comments,
    words_per_line,
)
from meshmatch.shapes.formats.obj import (
    SPACED_SLASH,
    entries_and_faces,
    join_lines,
    resolve_indices,
    vertices_of_corners,
)
from meshmatch.shapes.formats.polygons import triangles_of

_GAP = rb"[ \t]++"
_TOKEN = rb"\S++"
_NUMBERS = {
    word: re.compile(
        rb"^([ \t]*+" + word + _GAP + rb")" + _TOKEN + rb"(" + _GAP + rb")" + _TOKEN + rb"(" + _GAP + rb")" + _TOKEN,
        re.MULTILINE,
    )
    for word in (b"v", b"vn")
}
_FACE_KEYWORDS = (b"f", b"fo")
_VERTEX = re.compile(rb"^([ \t]*+v" + 3 * (_GAP + rb"[^\s#]++") + rb")[^\n#]*", re.MULTILINE)
_WITHOUT_NORMAL = re.compile(rb"(?<!\S)[^\s/]++(?:/[^\s/]*+)?+/?+(?=\s|\Z)")
_UP_TO_NORMAL = re.compile(rb"[^\s/]++/[^\s/]*+/")


def with_positions(
    name: str, data: bytes, verts: Float[Floats, "V 3"], turns: Float[Floats, "V 3 3"] | None = None
) -> bytes:
    """Return the bytes of an obj with new vertex positions.

    Parameters
    ----------
    name
        Name of the file, for errors.
    data
        Bytes of the file, from which `obj.read` reads V vertices. Continued lines are joined.
    verts
        New positions; lines of vertices with a row that is not finite are not changed.
    turns
        Rotation at each vertex, which is applied to the normals (``vn``), so that hard edges stay hard. Without it,
        normals are not changed.

    Returns
    -------
    bytes
        The text, with three new numbers in each ``v`` line, and in each ``vn`` line that a face uses.

    Raises
    ------
    InputError
        The text does not have V lines of vertices.
    """
    joined = join_lines(data)
    if joined.replace(b"\n", b"") != data.replace(b"\r", b"").replace(b"\n", b"") or b"\n" not in data:
        data = joined  # it has continued lines, or lines that end in a lone carriage return
    new_text = _replace_numbers(data, b"v", verts, "%.12g")
    if new_text is None:
        raise InputError(f"cannot tell the vertices of {name} apart", "export it again, one 'v' line for each")
    if turns is None or b"vn" not in data:
        return new_text
    normals = _turned_normals(name, joined, turns)
    return _replace_numbers(new_text, b"vn", normals, "%.6g") or new_text


@dataclass(frozen=True, eq=False)
class Polygons:
    """Polygons of an obj: the corner count of each, and their triangulation as indices into all corners."""

    sizes: Int[Ints, " P"]
    triangles: Int[Ints, "F 3"]

    @property
    def of_triangles(self) -> Int[Ints, " F"]:
        """Index of the polygon that each triangle belongs to."""
        return np.repeat(np.arange(len(self.sizes)), np.maximum(self.sizes - 2, 0))


def polygons_of(name: str, data: bytes, verts: Float[Floats, "V 3"]) -> Polygons:
    """Return the polygons of an obj; `verts` are its V vertices as read by `obj.read`."""
    _, vertex_lines, faces, sizes, face_lines = entries_and_faces(name, join_lines(data), b"v")
    corners = vertices_of_corners(name, faces, sizes, vertex_lines, face_lines)
    return Polygons(sizes, triangles_of(name, verts, corners, sizes))


def with_material(data: bytes, library: str, material: str, uv: Float[Floats, "N 2"] | None) -> tuple[bytes, list[str]]:
    """Return the bytes of an obj with another material library, and the names of the materials that its faces use.

    Parameters
    ----------
    data
        Bytes of the file. Continued lines are joined.
    library
        Name of the new material file, which replaces all others.
    material
        Name of the material for faces that have none.
    uv
        New texture coordinates of each face corner, v up, which replace the old ones; None to keep the old ones.
    """
    lines = join_lines(data).split(b"\n")
    words = [line.split(None, 1)[:1] for line in lines]
    keywords = [word[0] if word else b"" for word in words]
    # in the order of `entries_and_faces`
    faces = [k for old in _FACE_KEYWORDS for k, keyword in enumerate(keywords) if keyword == old]
    new_lines: list[bytes] = []
    if uv is not None:
        unique, index = np.unique(uv.astype("<f4"), axis=0, return_inverse=True)
        new_lines = [b"vt %.9g %.9g" % (u, v) for u, v in unique.tolist()]
        uv_indices = iter((index.reshape(-1) + 1).tolist())
        for k in faces:
            lines[k] = _with_uv_indices(lines[k], uv_indices)
    usemtl_lines = [k for k, keyword in enumerate(keywords) if keyword == b"usemtl"]
    names = dict.fromkeys(lines[k].split(None, 1)[-1].strip().decode("utf-8", "surrogateescape") for k in usemtl_lines)
    first = min(faces, default=len(lines))
    if min(usemtl_lines, default=first) >= first:
        new_lines.append(b"usemtl " + material.encode("utf-8", "surrogateescape"))
        names[material] = None
    removed = (b"mtllib",) if uv is None else (b"mtllib", b"vt")
    before_faces = [line for line, keyword in zip(lines[:first], keywords, strict=False) if keyword not in removed]
    rest = [line for line, keyword in zip(lines[first:], keywords[first:], strict=True) if keyword not in removed]
    library_line = b"mtllib " + library.encode("utf-8", "surrogateescape")
    return b"\n".join([library_line, *before_faces, *new_lines, *rest]), list(names)


def with_colors(name: str, data: bytes, colors: Float[Floats, "V 4"]) -> bytes:
    """Return the bytes of an obj with new vertex colors (sRGB, 0..1), written after the positions."""
    number = count()

    def with_color(found: re.Match[bytes]) -> bytes:
        k = next(number)
        return found[0] if k >= len(colors) else b"%b %.6g %.6g %.6g" % (found[1], *rows[k])

    rows = colors[:, :3].tolist()
    text = _VERTEX.sub(with_color, join_lines(data))
    if next(number) != len(colors):
        raise InputError(f"cannot tell the vertices of {name} apart", "export it again, one 'v' line for each")
    return text


def content_beyond_triangles(name: str, data: bytes) -> list[str]:
    """Kinds of content besides the triangles of one mesh with one material, in words ("polygons", "groups", ...)."""
    data = join_lines(data)
    normals, _, sizes = entries_and_faces(name, data, b"vn")[1:4]
    groups, objects, materials, uv = lines_starting_with(without_comments(data), b"g", b"o", b"usemtl", b"vt")
    present = {
        "polygons": bool(len(sizes)) and int(sizes.max()) > 3,
        "groups": len(groups[1]) + len(objects[1]) > 1,
        "materials": len({name.strip() for name in materials[0].split(b"\n")} - {b""}) > 1,
        COORDINATES: len(uv[1]) > 0,
        "normals": len(normals) > 0,
    }
    return [word for word, is_present in present.items() if is_present]


def _with_uv_indices(line: bytes, uv_indices: Iterator[int]) -> bytes:
    """Replace the texture coordinate indices of a face line by the next ones of `uv_indices`."""
    line, hash_sign, comment = line.partition(b"#")
    word, *corners = SPACED_SLASH.sub(rb"\1", line.strip()).split()
    out = [word]
    for corner in corners:
        vertex, _, rest = corner.partition(b"/")
        normal = rest.partition(b"/")[2]
        out.append(
            b"%b/%d/%b" % (vertex, next(uv_indices), normal) if normal else b"%b/%d" % (vertex, next(uv_indices))
        )
    return b" ".join(out) + (b" " + hash_sign + comment if hash_sign else b"")


def _replace_numbers(data: bytes, word: bytes, rows: Floats, number_format: str) -> bytes | None:
    """Replace the first three numbers of all lines that begin with `word`; None unless there is one line per row.

    Lines whose row is not finite are kept.
    """
    line = number_format.encode().join([rb"%b", rb"%b", rb"%b", rb""])
    is_finite: list[bool] = np.asarray(np.isfinite(rows).all(axis=1)).tolist()
    values, counter = rows.tolist(), count()

    def replacement(found: re.Match[bytes]) -> bytes:
        k = next(counter)
        if k >= len(values) or not is_finite[k]:
            return found[0]
        (x, y, z), (start, first, second) = values[k], found.groups()
        return line % (start, x, first, y, second, z)

    text = _NUMBERS[word].sub(replacement, data)
    return text if next(counter) == len(values) else None


def _turned_normals(name: str, data: bytes, turns: Float[Floats, "V 3 3"]) -> Float[Floats, "N 3"]:
    """Rotate the normals (``vn``) with the vertices whose corners use them (averaged); NaN for unused normals."""
    text, lines, faces, sizes, face_lines = entries_and_faces(name, data, b"vn")
    counts = words_per_line(text)
    if len(counts) < len(lines) or (len(counts) and counts.min() < 3):
        return np.empty((0, 3))
    normals = columns(parse_numbers(name, text), counts, 0, 3)
    vertex_lines = entries_and_faces(name, data, b"v")[1]
    vertices = vertices_of_corners(name, faces, sizes, vertex_lines, face_lines)
    normal_of_corner: Ints = resolve_indices(
        name,
        "normal",
        parse_numbers(name, _UP_TO_NORMAL.sub(b"", _WITHOUT_NORMAL.sub(b"0", faces))),
        lines,
        np.repeat(face_lines, sizes),
    )
    used_corners = np.flatnonzero(normal_of_corner > 0)
    normal_index = normal_of_corner[used_corners] - 1
    rotated = np.full(normals.shape, np.nan)
    rotated[normal_index] = 0.0
    np.add.at(rotated, normal_index, np.einsum("nij,nj->ni", turns[vertices[used_corners]], normals[normal_index]))
    return normalized(rotated)
