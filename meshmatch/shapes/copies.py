"""Detection of copies of a mesh in one scene, such as a mesh that is drawn at two nodes.

A copy has the same triangles, and its vertices are an affine image of the other mesh's.
"""

from __future__ import annotations

import numpy as np

from meshmatch.arrays import Bool, Bools, Floats, Int, Ints
from meshmatch.shapes.shape import Shape

_TOLERANCE = 1e-4  # maximum deviation of a copy's vertices from the affine image, as a fraction of the mesh's size


def counterparts(shape: Shape, lost: Bool[Bools, " V"]) -> Int[Ints, " V"]:
    """Match dropped meshes of a scene with kept meshes that they are copies of.

    Such copies are the same figure at another node, for example. Returns, for each vertex of a mesh that is ``lost`` as
    a whole, the corresponding vertex of the kept mesh; -1 for all other vertices. All are -1 unless every kept mesh has
    a lost copy, because single meshes, such as shoes, are often copies of one another. Among identical meshes the first
    lost one corresponds to the first kept one, and so on.
    """
    result, none = np.full(shape.V, -1), np.full(shape.V, -1)
    counts = [count for _, count in shape.meshes]
    if len(counts) < 2 or sum(counts) != shape.V or not lost.any():
        return none
    ends = np.cumsum(counts)
    starts = ends - counts
    mesh_of_face = np.searchsorted(ends, shape.faces[:, 0], side="right")
    by_mesh = shape.faces[np.argsort(mesh_of_face, kind="stable")]
    mesh_faces = np.split(by_mesh, np.cumsum(np.bincount(mesh_of_face, minlength=len(counts)))[:-1])
    identical: dict[tuple[int, bytes], tuple[list[int], list[int]]] = {}
    for k, (start, end) in enumerate(zip(starts.tolist(), ends.tolist(), strict=True)):
        faces = np.sort(mesh_faces[k] - start, axis=1)  # mirroring reverses corners
        if len(faces):
            identical.setdefault((end - start, faces.tobytes()), ([], []))[int(lost[start:end].all())].append(k)
    for kept, copies in identical.values():
        unmatched = set(kept)
        for number, copy in enumerate(copies if kept else ()):
            match = kept[number % len(kept)]
            if _is_affine_image(shape.verts[starts[match] : ends[match]], shape.verts[starts[copy] : ends[copy]]):
                result[starts[copy] : ends[copy]] = np.arange(starts[match], ends[match])
                unmatched.discard(match)
        if unmatched:
            return none
    return result


def _is_affine_image(source: Floats, target: Floats) -> bool:
    """Whether an affine map takes all points to the others."""
    if not (np.isfinite(source).all() and np.isfinite(target).all()):
        return False
    rows = np.column_stack([source - source.mean(axis=0), np.ones(len(source))])
    deviation = np.abs(rows @ np.linalg.lstsq(rows, target, rcond=None)[0] - target)
    return bool(deviation.max() <= _TOLERANCE * np.ptp(target, axis=0).max())
