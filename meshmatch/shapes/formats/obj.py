"""Wavefront OBJ: positions and faces. Texture and normal indices are ignored, so seams split nothing; what lies on
the faces is read by `meshmatch.shapes.formats.obj_look`.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.errors import InputError
from meshmatch.shapes.formats import NO_FACES, Raw, damaged, fan
from meshmatch.shapes.formats.text import columns, first_index, lines_of, numbers, words_per_line
from meshmatch.shapes.shape import Shape


def read(path: Path, data: bytes) -> Raw:
    """One vertex per ``v`` line, in their order; with colours where six numbers are given."""
    name = path.name
    if b"\0" in data[:4096]:
        raise InputError(f"{name} is not an obj file: it is binary", "does the suffix fit the content?")
    data = joined_lines(data)
    if b"#" in data:
        data = re.sub(rb"#[^\n]*", b"", data)
    (text, vertex_lines), *faces_found = lines_of(data, b"v", b"f", b"fo")
    faces_text, face_lines = with_old(faces_found)
    if len(vertex_lines) == 0:
        raise InputError(f"{name} holds no vertices: it has no 'v' lines", "is it a mesh or a point cloud at all?")
    counts = words_per_line(text)
    if len(counts) < len(vertex_lines) or counts.min() < 3:
        raise damaged(name, "a vertex has fewer than 3 coordinates")
    values = numbers(name, text)
    colors = None
    if counts.min() >= 6:
        colors = np.ones((len(counts), 4))
        colors[:, :3] = _channels(columns(values, counts, 3, 6))
    faces = _faces(name, faces_text, face_lines, vertex_lines)
    return Raw(columns(values, counts, 0, 3), faces, colors)


def joined_lines(data: bytes) -> bytes:
    """Text whose lines end in a newline, and none in a backslash."""
    if b"\n" not in data:
        data = data.replace(b"\r", b"\n")
    return re.sub(rb"\\\r?\n", b" ", data) if b"\\" in data else data


def with_old(found: list[tuple[bytes, Ints]]) -> tuple[bytes, Ints]:
    """Lines of faces, those of the old spelling ``fo`` last."""
    (text, lines), (old, old_lines) = found
    return (text + b"\n" + old, np.concatenate([lines, old_lines])) if len(old_lines) else (text, lines)


def write(path: Path, shape: Shape) -> None:
    """Positions with every digit that they have."""
    verts = shape.verts_or_nan
    if shape.colors is None:
        lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in verts.tolist()]
    else:
        rows = np.hstack([verts, shape.colors[:, :3]]).tolist()
        lines = [f"v {x!r} {y!r} {z!r} {r!r} {g!r} {b!r}" for x, y, z, r, g, b in rows]
    lines += [f"f {a} {b} {c}" for a, b, c in (shape.faces + 1).tolist()]
    path.write_text("\n".join(["# meshmatch", *lines, ""]))


def _faces(name: str, text: bytes, lines: Ints, vertex_lines: Ints) -> Ints:
    if b"/" in text:
        text = first_index(text)  # position/texture/normal: the first alone
    sizes = words_per_line(text)
    if len(sizes) < len(lines):
        raise damaged(name, "a face has no corners")
    values = numbers(name, text)
    if len(values) == 0:
        return NO_FACES
    if (values == 0).any():
        raise damaged(name, "a face refers to vertex 0, but obj files count from 1")
    return fan(from_one(name, "vertex", values, vertex_lines, np.repeat(lines, sizes)) - 1, sizes)


def from_one(
    name: str, what: str, values: Float[Floats, " N"], listed: Int[Ints, " M"], lines: Int[Ints, " N"]
) -> Int[Ints, " N"]:
    """Numbers of faces that count from 1, also those that counted backwards from the last entry before their line.

    Parameters
    ----------
    values : (N,)
        As the faces have them; 0 stays 0.
    listed : (M,)
        The lines of the entries.
    lines : (N,)
        The line of the face of each value.
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


def _channels(values: Floats) -> Floats:
    values = np.nan_to_num(values)
    return np.clip(values / (255.0 if (values > 1).any() else 1.0), 0.0, 1.0)
