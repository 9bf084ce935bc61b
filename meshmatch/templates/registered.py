"""Which shapes of a folder are registered: every file has the vertices and triangles of the template's."""

from __future__ import annotations

import numpy as np

from meshmatch.geometry.frames import kabsch
from meshmatch.shapes.align import Align
from meshmatch.shapes.repair import Repaired

FEW = 100
"""Fewer registered shapes than this are learned by a network that finds no orientation: the card says it."""

_ALIKE = 30.0  # degrees: registered shapes that are turned less stand alike


def same_faces(like: Repaired, found: list[Repaired]) -> bool:
    """Whether all files have one file's vertex count and triangles."""
    first = like.original
    return not first.is_cloud and all(
        clean.original.V == first.V and np.array_equal(clean.original.faces, first.faces) for clean in found
    )


def registered_stack(
    first: Repaired, found: list[Repaired], vertices: np.ndarray, notes: list[str]
) -> np.ndarray:
    """Vertices (N, V, 3) of the shapes that share the first one's connectivity; N = 0 unless all of them do."""
    whole = []
    for clean in found if same_faces(first, found) else ():
        invalid = clean.original.invalid
        if invalid is None or not invalid[vertices].any():
            whole.append(clean.original.verts[vertices])
        else:
            notes.append(f"{clean.original.name}: not among the registered shapes, vertices lack a position")
    if len(whole) < 2:
        return np.zeros((0, len(vertices), 3), np.float32)
    chosen = np.stack(whole)
    # Centred before the numbers become short: a scan in a surveyor's coordinates would lose its digits.
    return (chosen - chosen.mean(1, keepdims=True)).astype(np.float32)


def turned(stack: np.ndarray, like: np.ndarray) -> Align:
    """How few registered shapes (N, V, 3) are turned to the template's vertices (V, 3)."""
    if len(stack) >= FEW:
        return "none"
    cosines = [(np.trace(kabsch(like, verts.astype(np.float64)).rotation) - 1) / 2 for verts in stack]
    return "near" if min(cosines) > np.cos(np.radians(_ALIKE)) else "rigid"
