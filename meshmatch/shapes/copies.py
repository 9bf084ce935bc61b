"""Copies of a mesh in one scene, such as one that is drawn at two nodes.

A copy has the same triangles, and lies as the other one does after it was moved, turned, scaled or mirrored as a whole.
"""

from __future__ import annotations

import numpy as np

from meshmatch.arrays import Bool, Bools, Floats, Int, Ints
from meshmatch.shapes.shape import Shape

_SAME = 1e-4  # of the size of a mesh: how far a copy's vertices may lie from where moving it puts them


def counterparts(shape: Shape, lost: Bool[Bools, " V"]) -> Int[Ints, " V"]:
    """Where what is not lost of a scene stands there again, such as a figure at another node: of each vertex of a mesh that
    is lost as a whole its counterpart in the mesh that it is a copy of. -1 of others, and of all where some mesh that is not
    lost has no copy, for shoes are often copies of one another.

    Where several meshes are alike, the first that is lost is a copy of the first that is not, and so on.
    """
    found, none = np.full(shape.V, -1), np.full(shape.V, -1)
    counts = [count for _, count in shape.meshes]
    if len(counts) < 2 or sum(counts) != shape.V or not lost.any():
        return none
    ends = np.cumsum(counts)
    starts = ends - counts
    of_face = np.searchsorted(ends, shape.faces[:, 0], side="right")
    by_mesh = shape.faces[np.argsort(of_face, kind="stable")]
    own_faces = np.split(by_mesh, np.cumsum(np.bincount(of_face, minlength=len(counts)))[:-1])
    alike: dict[tuple[int, bytes], tuple[list[int], list[int]]] = {}
    for k, (start, end) in enumerate(zip(starts.tolist(), ends.tolist(), strict=True)):
        faces = np.sort(own_faces[k] - start, axis=1)  # a mirror turns them over
        if len(faces):
            alike.setdefault((end - start, faces.tobytes()), ([], []))[int(lost[start:end].all())].append(k)
    for kept, copies in alike.values():
        single = set(kept)
        for number, copy in enumerate(copies if kept else ()):
            own = kept[number % len(kept)]
            if _is_moved(shape.verts[starts[own] : ends[own]], shape.verts[starts[copy] : ends[copy]]):
                found[starts[copy] : ends[copy]] = np.arange(starts[own], ends[own])
                single.discard(own)
        if single:
            return none
    return found


def _is_moved(here: Floats, there: Floats) -> bool:
    """Whether one affine map takes all points to others."""
    if not (np.isfinite(here).all() and np.isfinite(there).all()):
        return False
    rows = np.column_stack([here - here.mean(axis=0), np.ones(len(here))])
    off = np.abs(rows @ np.linalg.lstsq(rows, there, rcond=None)[0] - there)
    return bool(off.max() <= _SAME * np.ptp(there, axis=0).max())
