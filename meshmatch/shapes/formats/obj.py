"""Wavefront OBJ: positions and faces, and textured meshes to be written. Texture and normal indices are ignored when a
shape is read, so seams split nothing; what lies on the faces is read by `meshmatch.shapes.formats.obj_look`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.errors import InputError, warn
from meshmatch.shapes import formats
from meshmatch.shapes.formats import Raw, columns, damaged, parse_numbers, words_per_line
from meshmatch.shapes.formats.polygons import triangles_of
from meshmatch.shapes.input_files import check_text
from meshmatch.shapes.shape import Shape

if TYPE_CHECKING:
    from meshmatch.shapes.appearance import BakedMaterial

_ENTRIES = (
    rb"v|vt|vn|vp|vc|f|fo|l|p|g|o|s|mg|usemtl|mtllib|newmtl|illum|"
    rb"d|tr|k[ade]|ks|ns|ni|tf|bump|disp|decal|refl|norm|map_\w+"
)
_ENDS_IN_BACKSLASH = re.compile(rb"\\[ \t]*(?:\n|\Z)")
_LINE_THAT_GOES_ON = re.compile(rb"^[^\n]*\\[ \t]*$", re.MULTILINE)
_GOES_ON = re.compile(rb"\\[ \t]*\n(?![ \t]*(?:" + _ENTRIES + rb")[ \t])", re.IGNORECASE)
_COMMENT = re.compile(rb"(?:^|[ \t])#")
SLASH_APART = re.compile(rb"(?<![ \t])[ \t]++(//?)[ \t]*+")
_MIXED_CORNERS = re.compile(rb"/[ \t]++[^\s/]++(?!/)")
_POLYPAINT = re.compile(rb"(?:[0-9a-fA-F]{8})+")


def read(path: Path, data: bytes) -> Raw:
    """One vertex per ``v`` line, in their order; with colors where six numbers are given."""
    name = path.name
    if b"\0" in data[:4096]:
        raise InputError(f"{name} is not an obj file: it is binary", formats.WRONG_SUFFIX)
    check_text(name, data)
    data = joined_lines(data)
    text, vertex_lines, faces_text, sizes, face_lines = entries_and_faces(name, data, b"v")
    formats.check_element_count(
        name, len(data), len(vertex_lines), max(int(sizes.sum()) - 2 * len(sizes), 0), text=True
    )
    if len(vertex_lines) == 0:
        raise InputError(f"{name} holds no vertices: it has no 'v' lines", formats.NO_MESH)
    counts = words_per_line(text)
    if len(counts) < len(vertex_lines) or counts.min() < 3:
        raise damaged(name, "a vertex has fewer than 3 coordinates")
    values = parse_numbers(name, text)
    verts = columns(values, counts, 0, 3)
    corner = vertices_of_corners(name, faces_text, sizes, vertex_lines, face_lines)
    faces = corner[triangles_of(name, verts, corner, sizes)]
    formats.warn_if_no_triangles(name, len(sizes), faces)
    return Raw(verts, faces, _colors(name, data, values, counts))


def vertices_of_corners(
    name: str, faces: bytes, sizes: Int[Ints, " P"], vertex_lines: Int[Ints, " V"], face_lines: Int[Ints, " P"]
) -> Int[Ints, " N"]:
    """The vertex, from 0, at each corner of all faces, which are as `entries_and_faces` finds them."""
    if b"/" in faces:
        faces = re.sub(rb"/\S*", b"", faces)  # position/texture/normal: the first alone
    corners = parse_numbers(name, faces)
    if len(corners) != sizes.sum():
        raise damaged(name, "a corner of a face has no vertex before its slash")
    if (corners == 0).any():
        raise damaged(name, "a face refers to vertex 0, but obj files count from 1")
    return from_one(name, "vertex", corners, vertex_lines, np.repeat(face_lines, sizes)) - 1


def joined_lines(data: bytes) -> bytes:
    """Text whose lines end in a newline, and go on where one ended in a backslash.

    A comment ends with its line, also one that ends in a backslash, as a path may; and a line that begins with the word of
    an entry is one of its own, so that a name that ends in a backslash does not swallow it.
    """
    if b"\r" in data:
        data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    if b"\\" not in data or not _ENDS_IN_BACKSLASH.search(data):
        return data
    data = _LINE_THAT_GOES_ON.sub(_comment_ended, data)
    return _ENDS_IN_BACKSLASH.sub(b"\n", _GOES_ON.sub(b" ", data))


def _comment_ended(line: re.Match[bytes]) -> bytes:
    return line[0].rstrip(b"\\ \t") if _COMMENT.search(line[0]) else line[0]


def _colors(name: str, data: bytes, values: Floats, counts: Ints) -> Floats | None:
    """(V, 4) colors of vertices: as numbers behind their positions, as lines of their own, or as ZBrush writes them."""
    painted = counts >= 6
    if painted.any():
        width = 4 if (counts == 7).all() else 3
        starts = (np.cumsum(counts) - counts)[painted]
        found = formats.painted(values[starts[:, None] + np.arange(3, 3 + width)])
        if painted.all():
            return found
        colors = np.ones((len(counts), 4))
        colors[painted] = found
        return colors
    if b"#MRGB" in data:
        # Eight digits a vertex: mask, red, green, blue. The mask says what ZBrush may change, and is no part of the look.
        rows = formats.lines_starting_with(data, b"#MRGB")[0][0].split()
        if not all(map(_POLYPAINT.fullmatch, rows)):
            warn(f"{name} has polypaint (#MRGB) that is not of eight hexadecimal digits a vertex; it is left out")
            return None
        masked = np.frombuffer(bytes.fromhex(b"".join(rows).decode()), np.uint8).reshape(-1, 4)
        return _for_all(name, "polypaint (#MRGB)", masked[:, 1:] / 255.0, len(counts))
    if b"\nvc " in data:
        [(text, lines)] = formats.lines_starting_with(formats.without_comments(data), b"vc")
        own = words_per_line(text)
        if len(own) == len(lines) and len(own) and own.min() >= 3:
            return _for_all(
                name, "colors (vc)", formats.painted(columns(parse_numbers(name, text), own, 0, 3)), len(counts)
            )
    return None


def _for_all(name: str, what: str, found: Floats, count: int) -> Floats | None:
    """Colors that are listed apart, white where there are fewer of them than vertices."""
    if len(found) == 0:
        return None
    if len(found) != count:
        rest = "others are white" if len(found) < count else "what is too much is left out"
        warn(f"{name} has {what} for {len(found):,} vertices, but {count:,} of these: {rest}")
    colors = np.ones((count, 4))
    colors[: len(found), : found.shape[1]] = found[:count]
    return colors


def entries_and_faces(name: str, data: bytes, word: bytes) -> tuple[bytes, Ints, bytes, Ints, Ints]:
    """Text and lines of the entries that begin with a word; text, sizes and lines of faces.

    Faces of the old spelling ``fo`` come last.
    """
    data = formats.without_comments(data)
    (text, listed), (faces, lines), (old, old_lines) = formats.lines_starting_with(data, word, b"f", b"fo")
    if len(old_lines):
        faces, lines = faces + b"\n" + old, np.concatenate([lines, old_lines])
    if b" /" in faces or b"\t/" in faces:  # 1 / 2 is the corner 1/2
        faces = SLASH_APART.sub(rb"\1", faces)
    if (b"/ " in faces or b"/\t" in faces) and _MIXED_CORNERS.search(faces):
        raise damaged(name, "a face has a slash at the end of one corner, and none at the next: where do they end?")
    sizes = words_per_line(faces)
    if len(sizes) < len(lines):
        raise damaged(name, "a face has no corners")
    return text, listed, faces, sizes, lines


def from_one(
    name: str, what: str, values: Float[Floats, " N"], listed: Int[Ints, " M"], lines: Int[Ints, " N"]
) -> Int[Ints, " N"]:
    """Numbers of faces that count from 1, also those that counted backwards from the last entry before their line.

    `values` are as the faces have them (0 stays 0), on the `lines` of these; `listed` are the lines of the entries.
    """
    if not (np.abs(values) < 2**53).all() or (values != np.trunc(values)).any():
        raise damaged(name, f"a face refers to a {what} that is not a whole number")
    index = values.astype(np.int64)
    if (index < 0).any():
        behind = index < 0
        index[behind] += np.searchsorted(listed, lines[behind]) + 1
        index[behind & (index < 1)] = len(listed) + 1  # before the first one
    if len(index) and index.max() > len(listed):
        raise damaged(name, f"a face refers to {what} {index.max()}, but there are only {len(listed)}")
    return index


def write(path: Path, shape: Shape) -> None:
    """Positions with every digit that they have."""
    verts = shape.verts_or_nan
    rows = verts if shape.colors is None else np.hstack([verts, shape.colors[:, :3]])
    lines = ["v " + " ".join(map(repr, row)) for row in rows.tolist()]
    _write(path, [*lines, *(f"f {a} {b} {c}" for a, b, c in (shape.faces + 1).tolist())])


def write_textured(path: Path, mesh: formats.Textured, mtl: str, material: str) -> None:
    """Vertices and faces exactly as they are, texture coordinates listed apart: seams split nothing.

    `mtl` is the name of the material file beside it, `material` that of the only material in it.
    """
    unique, index = np.unique(mesh.uv.reshape(-1, 2).astype("<f4"), axis=0, return_inverse=True)
    lines = [f"mtllib {mtl}", *(f"v {x!r} {y!r} {z!r}" for x, y, z in mesh.verts.tolist())]
    lines += [f"vt {u!r} {1.0 - v!r}" for u, v in unique.astype(np.float64).round(8).tolist()]
    table = np.stack([mesh.faces, index.reshape(-1, 3)], axis=2).reshape(-1, 6) + 1
    faces = [f"f {a}/{p} {b}/{q} {c}/{r}" for a, p, b, q, c, r in table.tolist()]
    _write(path, [*lines, f"usemtl {material}", *faces])


def _write(path: Path, lines: list[str]) -> None:
    path.write_text("\n".join(["# meshmatch", *lines, ""]), encoding="utf-8", errors="surrogateescape")


def write_materials(path: Path, names: Iterable[str], material: BakedMaterial, images: Mapping[str, str]) -> None:
    """The mtl: materials of these names that are all the same. ``images`` has file names by what they show: "color", and
    maybe "normal", "roughness", "metal" and "emission".

    Metal, roughness, light and normals as most programs read them. Options of maps are not known to every reader, and left
    out, all but the strength of normal maps: Blender imports them with strength 0 where it is not given.
    """
    paint = ["Ka 0 0 0", "Kd 1 1 1", "Ks 0 0 0", "d 1", "illum 1", f"map_Kd {images['color']}"]
    if material.alpha != "opaque":
        paint.append(f"map_d {images['color']}")
    if (material.roughness, material.metal) != (1.0, 0.0) or "roughness" in images:
        paint += [f"Pr {material.roughness:.6g}", f"Pm {material.metal:.6g}"]
    if max(material.light) > 0:
        paint.append("Ke {:.6g} {:.6g} {:.6g}".format(*material.light))
    words = (("roughness", "map_Pr"), ("metal", "map_Pm"), ("emission", "map_Ke"), ("normal", "norm"))
    paint += [f"{word} {images[what]}" for what, word in (*words, ("normal", "map_Bump -bm 1")) if what in images]
    _write(path, [line for name in names for line in (f"newmtl {name}", *paint)])
