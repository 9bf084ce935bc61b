"""Read and write Wavefront OBJ files: positions, faces and vertex colors; textured meshes are written only.

Reading ignores texture and normal indices, so that seams do not split vertices; texture coordinates and materials are read
by `meshmatch.shapes.formats.obj_appearance`.
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
from meshmatch.shapes.input_files import check_text_size
from meshmatch.shapes.shape import Shape

if TYPE_CHECKING:
    from meshmatch.shapes.appearance import BakedMaterial

_ENTRIES = (
    rb"v|vt|vn|vp|vc|f|fo|l|p|g|o|s|mg|usemtl|mtllib|newmtl|illum|"
    rb"d|tr|k[ade]|ks|ns|ni|tf|bump|disp|decal|refl|norm|map_\w+"
)
_ENDS_IN_BACKSLASH = re.compile(rb"\\[ \t]*(?:\n|\Z)")
_CONTINUED_LINE = re.compile(rb"^[^\n]*\\[ \t]*$", re.MULTILINE)
_CONTINUATION = re.compile(rb"\\[ \t]*\n(?![ \t]*(?:" + _ENTRIES + rb")[ \t])", re.IGNORECASE)
_COMMENT = re.compile(rb"(?:^|[ \t])#")
SPACED_SLASH = re.compile(rb"(?<![ \t])[ \t]++(//?)[ \t]*+")
_MIXED_CORNERS = re.compile(rb"/[ \t]++[^\s/]++(?!/)")
_COLOR_LINE = re.compile(rb"^[ \t]*+vc[ \t]", re.MULTILINE)
_POLYPAINT = re.compile(rb"(?:[0-9a-fA-F]{8})+")


def read(path: Path, data: bytes) -> Raw:
    """Read one vertex per ``v`` line, in file order, and vertex colors if there are any (see `_colors`)."""
    name = path.name
    if b"\0" in data[:4096]:
        raise InputError(f"{name} is not an obj file: it is binary", formats.WRONG_SUFFIX)
    check_text_size(name, data)
    data = join_lines(data)
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
    """0-based vertex index at each corner of all faces; `faces`, `sizes` and lines are those of `entries_and_faces`."""
    if b"/" in faces:
        faces = re.sub(rb"/\S*", b"", faces)  # of position/texture/normal, only the position
    corners = parse_numbers(name, faces)
    if len(corners) != sizes.sum():
        raise damaged(name, "a corner of a face has no vertex before its slash")
    if (corners == 0).any():
        raise damaged(name, "a face refers to vertex 0, but obj files count from 1")
    return resolve_indices(name, "vertex", corners, vertex_lines, np.repeat(face_lines, sizes)) - 1


def join_lines(data: bytes) -> bytes:
    r"""Normalise line ends to \n and join lines that are continued by a backslash.

    A comment is not continued, even if it ends in a backslash, as a path may. A line that begins with the keyword of an
    entry is not a continuation, so that a name that ends in a backslash does not swallow it.
    """
    if b"\r" in data:
        data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    if b"\\" not in data or not _ENDS_IN_BACKSLASH.search(data):
        return data
    data = _CONTINUED_LINE.sub(_without_continuation, data)
    return _ENDS_IN_BACKSLASH.sub(b"\n", _CONTINUATION.sub(b" ", data))


def _without_continuation(line: re.Match[bytes]) -> bytes:
    """Remove the final backslash of a line if the line has a comment."""
    return line[0].rstrip(b"\\ \t") if _COMMENT.search(line[0]) else line[0]


def _colors(name: str, data: bytes, values: Floats, counts: Ints) -> Floats | None:
    """(V, 4) vertex colors from numbers after the positions, ZBrush polypaint (``#MRGB``) or ``vc`` lines, or None."""
    has_color = counts >= 6
    if has_color.any():
        width = 4 if (counts == 7).all() else 3
        starts = (np.cumsum(counts) - counts)[has_color]
        parsed = formats.rgba_from_channels(values[starts[:, None] + np.arange(3, 3 + width)])
        if has_color.all():
            return parsed
        colors = np.ones((len(counts), 4))
        colors[has_color] = parsed
        return colors
    if b"#MRGB" in data:
        # Eight hexadecimal digits per vertex: mask, red, green, blue. The mask protects vertices from edits in ZBrush.
        rows = formats.lines_starting_with(data, b"#MRGB")[0][0].split()
        if not all(map(_POLYPAINT.fullmatch, rows)):
            warn(f"{name} has polypaint (#MRGB) that is not of eight hexadecimal digits a vertex; it is left out")
            return None
        masked = np.frombuffer(bytes.fromhex(b"".join(rows).decode()), np.uint8).reshape(-1, 4)
        return _fill_colors(name, "polypaint (#MRGB)", masked[:, 1:] / 255.0, len(counts))
    if b"vc" in data and _COLOR_LINE.search(data):
        [(text, lines)] = formats.lines_starting_with(formats.without_comments(data), b"vc")
        counts_per_line = words_per_line(text)
        if len(counts_per_line) == len(lines) and len(counts_per_line) and counts_per_line.min() >= 3:
            return _fill_colors(
                name,
                "colors (vc)",
                formats.rgba_from_channels(columns(parse_numbers(name, text), counts_per_line, 0, 3)),
                len(counts),
            )
    return None


def _fill_colors(name: str, what: str, colors_given: Floats, count: int) -> Floats | None:
    """Return (count, 4) colors from a separate list, with a warning if its length differs; missing colors are white."""
    if len(colors_given) == 0:
        return None
    if len(colors_given) != count:
        rest = "others are white" if len(colors_given) < count else "what is too much is left out"
        warn(f"{name} has {what} for {len(colors_given):,} vertices, but {count:,} of these: {rest}")
    colors = np.ones((count, 4))
    colors[: len(colors_given), : colors_given.shape[1]] = colors_given[:count]
    return colors


def entries_and_faces(name: str, data: bytes, word: bytes) -> tuple[bytes, Ints, bytes, Ints, Ints]:
    """Find the entries that begin with a word, and the faces.

    Returns the text and line numbers of the entries, then the text, corner counts and line numbers of the faces. Faces in
    the old spelling ``fo`` come last.
    """
    data = formats.without_comments(data)
    (text, entry_lines), (faces, face_lines), (old_faces, old_lines) = formats.lines_starting_with(
        data, word, b"f", b"fo"
    )
    if len(old_lines):
        faces, face_lines = faces + b"\n" + old_faces, np.concatenate([face_lines, old_lines])
    if b" /" in faces or b"\t/" in faces:  # 1 / 2 is the corner 1/2
        faces = SPACED_SLASH.sub(rb"\1", faces)
    if (b"/ " in faces or b"/\t" in faces) and _MIXED_CORNERS.search(faces):
        raise damaged(name, "a face has a slash at the end of one corner, and none at the next: where do they end?")
    sizes = words_per_line(faces)
    if len(sizes) < len(face_lines):
        raise damaged(name, "a face has no corners")
    return text, entry_lines, faces, sizes, face_lines


def resolve_indices(
    name: str, what: str, values: Float[Floats, " N"], entry_lines: Int[Ints, " M"], lines: Int[Ints, " N"]
) -> Int[Ints, " N"]:
    """Resolve indices of faces to positive 1-based ones; negative ones count back from the last entry before their line.

    `values` are the indices in the file (0 stays 0) and `lines` the lines where they occur; `entry_lines` are the lines of
    the entries that they refer to.
    """
    if not (np.abs(values) < 2**53).all() or (values != np.trunc(values)).any():
        raise damaged(name, f"a face refers to a {what} that is not a whole number")
    index = values.astype(np.int64)
    if (index < 0).any():
        is_negative = index < 0
        index[is_negative] += np.searchsorted(entry_lines, lines[is_negative]) + 1
        index[is_negative & (index < 1)] = len(entry_lines) + 1  # before the first entry: an error
    if len(index) and index.max() > len(entry_lines):
        raise damaged(name, f"a face refers to {what} {index.max()}, but there are only {len(entry_lines)}")
    return index


def write(path: Path, shape: Shape) -> None:
    """Write a mesh or a point cloud, with positions in full precision."""
    verts = shape.verts_or_nan
    rows = verts if shape.colors is None else np.hstack([verts, shape.colors[:, :3]])
    lines = ["v " + " ".join(map(repr, row)) for row in rows.tolist()]
    _write(path, [*lines, *(f"f {a} {b} {c}" for a, b, c in (shape.faces + 1).tolist())])


def write_textured(path: Path, mesh: formats.TexturedMesh, mtl: str, material: str) -> None:
    """Write a textured mesh; texture coordinates are indexed separately, so that seams do not split vertices.

    `mtl` is the name of the material file in the same folder, `material` that of its only material.
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
    """Write an mtl file with several materials that differ only in their names.

    ``images`` has the names of the image files: "color", and optionally "normal", "roughness", "metal" and "emission".
    Metalness, roughness, emission and normals are written with the keywords that most programs read. Options of maps are
    left out, since not every reader knows them, except for the strength of normal maps: without it, Blender imports them
    with strength 0.
    """
    properties = ["Ka 0 0 0", "Kd 1 1 1", "Ks 0 0 0", "d 1", "illum 1", f"map_Kd {images['color']}"]
    if material.alpha != "opaque":
        properties.append(f"map_d {images['color']}")
    if (material.roughness, material.metal) != (1.0, 0.0) or "roughness" in images:
        properties += [f"Pr {material.roughness:.6g}", f"Pm {material.metal:.6g}"]
    if max(material.light) > 0:
        properties.append("Ke {:.6g} {:.6g} {:.6g}".format(*material.light))
    keywords = (("roughness", "map_Pr"), ("metal", "map_Pm"), ("emission", "map_Ke"), ("normal", "norm"))
    properties += [
        f"{keyword} {images[what]}" for what, keyword in (*keywords, ("normal", "map_Bump -bm 1")) if what in images
    ]
    _write(path, [line for name in names for line in (f"newmtl {name}", *properties)])
