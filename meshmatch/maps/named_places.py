"""Numbers of vertices and faces that a map names: what they may be, and which corners they stand for."""

from __future__ import annotations

import numpy as np

from meshmatch.arrays import Int, Ints
from meshmatch.errors import InputError

UNKNOWN = -1
"""A number of vertices that is not known."""


def check_range(index: Int[Ints, ...], target_vertices: int, label: str) -> None:
    """Refuse vertices that a target of so many does not have (`InputError`)."""
    if index.min() < 0:
        first = int(np.argmin(index))
        raise InputError(f"{label}: vertex {first} is matched to {int(index.min())}; indices start at 0")
    if target_vertices != UNKNOWN and index.max() >= target_vertices:
        one_based = index.min() >= 1 and index.max() == target_vertices
        matched = f"{label}: vertex {int(np.argmax(index))} is matched to vertex {int(index.max())}"
        hint = "it looks 1-based: subtract 1" if one_based else "is it a map to another shape, or the other way round?"
        raise InputError(f"{matched}, but the target has only {target_vertices} vertices", hint)


def check_faces(face: Int[Ints, " V_source"], target_faces: int, label: str) -> None:
    """Refuse faces that a target of so many does not have (`InputError`)."""
    if face.max() >= target_faces:
        raise InputError(f"{label} names face {int(face.max())}, but its target has only {target_faces} faces")


def corners_of(faces: Int[Ints, "F 3"] | None, face: Int[Ints, " N"], vertex: Int[Ints, " N"]) -> Int[Ints, "N 3"]:
    """Corners of faces (N,); where the face is -1, three times the vertex itself."""
    inside = face >= 0
    if faces is not None and inside.all():
        return faces.take(face, 0)
    corners = np.repeat(vertex[:, None], 3, axis=1)
    if faces is not None:
        corners[inside] = faces[face[inside]]
    return corners
