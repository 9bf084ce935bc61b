"""What the arrays of a map must be, and whether they belong to a shape."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from meshmatch.arrays import Int, Ints
from meshmatch.errors import InputError

UNKNOWN = -1
"""A number of vertices that is not known."""


def checked_arrays(
    label: str,
    index: ArrayLike,
    face: ArrayLike | None,
    barycentric: ArrayLike | None,
    confidence: ArrayLike | None,
    target_vertices: int,
) -> tuple[int, dict[str, NDArray[np.generic]]]:
    """The number of source vertices, and copies of a map's arrays, if they are what `VertexMap` says (`InputError`)."""
    vertex = _whole_numbers(index, f"{label}: index")
    size = len(vertex) if vertex.ndim else 0
    if vertex.ndim != 1 or size == 0:
        raise InputError(f"{label}: index must be a list of (V_source,) vertices, not an array of {vertex.shape}")
    if target_vertices != UNKNOWN and target_vertices < 1:
        raise InputError(f"{label}: a target needs vertices, not {target_vertices}")
    check_range(vertex, target_vertices, label)
    faces = np.full(size, -1) if face is None else _whole_numbers(face, f"{label}: face")
    weights = np.array(np.tile([1.0, 0.0, 0.0], (size, 1)) if barycentric is None else barycentric, np.float64)
    trust = np.array(np.ones(size) if confidence is None else confidence, np.float32)
    arrays = {"index": vertex, "face": faces, "barycentric": weights, "confidence": trust}
    for name, array in arrays.items():
        shape = (size, 3) if name == "barycentric" else (size,)
        if array.shape != shape:
            raise InputError(f"{label}: {name} must be an array of {shape}, not {array.shape}")
    if faces.min() < -1:
        raise InputError(f"{label}: face {int(faces.min())} does not exist")
    if not (weights >= -1e-9).all() or not np.allclose(weights.sum(axis=1), 1.0, atol=1e-6):
        raise InputError(f"{label}: barycentric weights must be 0 or more and sum to 1")
    if not ((trust >= 0) & (trust <= 1)).all():
        raise InputError(f"{label}: confidence must lie in 0..1")
    return size, arrays


def check_faces(face: Int[Ints, " V_source"], target_faces: int, label: str) -> None:
    """Refuse faces that a target of so many does not have (`InputError`)."""
    if face.max() >= target_faces:
        raise InputError(f"{label} names face {int(face.max())}, but its target has only {target_faces} faces")


def corners_of(faces: Int[Ints, "F 3"] | None, face: Int[Ints, " N"], vertex: Int[Ints, " N"]) -> Int[Ints, "N 3"]:
    """Corners of faces (N,); where the face is -1, three times the vertex itself."""
    corners = np.repeat(vertex[:, None], 3, axis=1)
    inside = face >= 0
    if faces is not None:
        corners[inside] = faces[face[inside]]
    return corners


def check_range(index: Int[Ints, ...], target_vertices: int, label: str) -> None:
    if index.min() < 0:
        first = int(np.argmin(index))
        raise InputError(f"{label}: vertex {first} is matched to {int(index.min())}; indices start at 0")
    if target_vertices != UNKNOWN and index.max() >= target_vertices:
        one_based = index.min() >= 1 and index.max() == target_vertices
        matched = f"{label}: vertex {int(np.argmax(index))} is matched to vertex {int(index.max())}"
        hint = "it looks 1-based: subtract 1" if one_based else "is it a map to another shape, or the other way round?"
        raise InputError(f"{matched}, but the target has only {target_vertices} vertices", hint)


def _whole_numbers(values: ArrayLike, label: str) -> Int[Ints, ...]:
    array = np.asarray(values)
    if array.dtype.kind == "f" and np.isfinite(array).all() and (array == np.round(array)).all():
        return array.astype(np.int64)  # MATLAB's numbers are doubles
    if array.dtype.kind not in "iu":
        raise InputError(f"{label} must be whole numbers, not {array.dtype}")
    return np.array(array, dtype=np.int64)
