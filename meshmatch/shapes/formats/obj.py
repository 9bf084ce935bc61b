"""Wavefront OBJ: positions and faces, and textured meshes to be written. Texture and normal indices are ignored when a
shape is read, so seams split nothing; what lies on the faces is read by `meshmatch.shapes.formats.obj_look`.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.errors import InputError
from meshmatch.shapes import formats
from meshmatch.shapes.formats import Raw, columns, damaged, fan, numbers, words_per_line
from meshmatch.shapes.input_files import check_text
from meshmatch.shapes.shape import Shape


def read(path: Path, data: bytes) -> Raw:
    """One vertex per ``v`` line, in their order; with colors where six numbers are given."""
    name = path.name
    if b"\0" in data[:4096]:
        raise InputError(f"{name} is not an obj file: it is binary", formats.WRONG_SUFFIX)
    check_text(name, data)
    text, vertex_lines, faces_text, sizes, face_lines = entries_and_faces(name, joined_lines(data), b"v")
    formats.check_places(name, len(data), len(vertex_lines), max(int(sizes.sum()) - 2 * len(sizes), 0), text=True)
    if len(vertex_lines) == 0:
        raise InputError(f"{name} holds no vertices: it has no 'v' lines", formats.NO_MESH)
    counts = words_per_line(text)
    if len(counts) < len(vertex_lines) or counts.min() < 3:
        raise damaged(name, "a vertex has fewer than 3 coordinates")
    values = numbers(name, text)
    if b"/" in faces_text:
        faces_text = re.sub(rb"/\S*", b"", faces_text)  # position/texture/normal: the first alone
    corners = numbers(name, faces_text)
    if (corners == 0).any():
        raise damaged(name, "a face refers to vertex 0, but obj files count from 1")
    corner = from_one(name, "vertex", corners, vertex_lines, np.repeat(face_lines, sizes)) - 1
    colors = formats.painted(columns(values, counts, 3, 6)) if counts.min() >= 6 else None
    return Raw(columns(values, counts, 0, 3), fan(corner, sizes), colors)


def joined_lines(data: bytes) -> bytes:
    """Text whose lines end in a newline, and none in a backslash."""
    if b"\n" not in data:
        data = data.replace(b"\r", b"\n")
    return re.sub(rb"\\\r?\n", b" ", data) if b"\\" in data else data


def entries_and_faces(name: str, data: bytes, word: bytes) -> tuple[bytes, Ints, bytes, Ints, Ints]:
    """Text and lines of the entries that begin with a word; text, sizes and lines of faces.

    Faces of the old spelling ``fo`` come last.
    """
    data = formats.without_comments(data)
    (text, listed), (faces, lines), (old, old_lines) = formats.lines_of(data, word, b"f", b"fo")
    if len(old_lines):
        faces, lines = faces + b"\n" + old, np.concatenate([lines, old_lines])
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


def write_material(path: Path, material: str, image: str, mesh: formats.Textured) -> None:
    """The mtl: plain paint in the colors of the image. No options of maps: not every reader knows them."""
    paint = [f"newmtl {material}", "Ka 0 0 0", "Kd 1 1 1", "Ks 0 0 0", "d 1", "illum 1", f"map_Kd {image}"]
    _write(path, paint if mesh.alpha == "opaque" else [*paint, f"map_d {image}"])


def _write(path: Path, lines: list[str]) -> None:
    path.write_text("\n".join(["# meshmatch", *lines, ""]), encoding="utf-8", errors="surrogateescape")
