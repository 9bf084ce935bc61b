"""Check the vertex and face indices of a map, and look up the corners of faces."""

from __future__ import annotations

import numpy as np

from meshmatch.arrays import Int, Ints
from meshmatch.errors import InputError

UNKNOWN = -1
"""Stands for an unknown number of vertices."""


def check_range(index: Int[Ints, ...], target_vertices: int, label: str) -> None:
    """Raise `InputError` if a vertex index is negative or not below ``target_vertices``."""
    if index.min() < 0:
        first = int(np.argmin(index))
        what = f"{label}: vertex {first} is matched to {int(index.min())}; indices start at 0"
        raise InputError(what, "a map covers every vertex: give those without a match any vertex and confidence 0")
    if target_vertices != UNKNOWN and index.max() >= target_vertices:
        one_based = index.min() >= 1 and index.max() == target_vertices
        matched = f"{label}: vertex {int(np.argmax(index))} is matched to vertex {int(index.max())}"
        hint = "it looks 1-based: subtract 1" if one_based else "is it a map to another shape, or the other way round?"
        raise InputError(f"{matched}, but the target has only {target_vertices} vertices", hint)


def check_faces(face: Int[Ints, " V_source"], target_faces: int, label: str) -> None:
    """Raise `InputError` if a face index is not below ``target_faces``."""
    if face.max() >= target_faces:
        raise InputError(f"{label} names face {int(face.max())}, but its target has only {target_faces} faces")


def corners_of(faces: Int[Ints, "F 3"] | None, face: Int[Ints, " N"], vertex: Int[Ints, " N"]) -> Int[Ints, "N 3"]:
    """(N, 3) corners of faces; where the face is -1, three times the vertex itself."""
    inside = face >= 0
    if faces is not None and inside.all():
        return faces.take(face, 0)
    corners = np.repeat(vertex[:, None], 3, axis=1)
    if faces is not None:
        corners[inside] = faces[face[inside]]
    return corners
