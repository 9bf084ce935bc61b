"""Split vertices at texture seams, so that each has one pair of texture coordinates, and compute their tangents."""

from __future__ import annotations

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.geometry.triangles import cross_product, dot, normalized


def split_at_seams(
    V: int, faces: Int[Ints, "F 3"], uv: Float[Floats, "F 3 2"]
) -> tuple[Int[Ints, " N"], Float[Floats, "N 2"], Int[Ints, "F 3"]]:
    """Duplicate vertices at seams, so that each has one pair of texture coordinates.

    Returns the original vertex of each new vertex, its coordinates, and the faces over new vertices. The first V are the
    original vertices in order (coordinates are zero if no face uses one), followed by the duplicates. Coordinates are
    compared as 32-bit floats.
    """
    corner = faces.reshape(-1)
    pairs = np.ascontiguousarray(uv.reshape(-1, 2).astype("<f4") + np.float32(0))  # turns -0 into 0
    order = np.lexsort((pairs[:, 1], pairs[:, 0], corner))
    is_first_use = np.diff(corner[order], prepend=-1) != 0
    is_new = is_first_use.copy()
    is_new[1:] |= (pairs[order][1:] != pairs[order][:-1]).any(axis=1)
    is_duplicate = is_new & ~is_first_use
    new_index = np.where(is_first_use, corner[order], V - 1 + np.cumsum(is_duplicate))
    new_of_corner = np.empty(len(corner), np.int64)
    new_of_corner[order] = new_index[is_new][np.cumsum(is_new) - 1]
    coordinates = np.zeros((V + int(is_duplicate.sum()), 2), np.float64)
    coordinates[new_of_corner] = pairs
    return np.concatenate([np.arange(V), corner[order][is_duplicate]]), coordinates, new_of_corner.reshape(-1, 3)


def vertex_tangents(
    verts: Float[Floats, "N 3"], normals: Float[Floats, "N 3"], faces: Int[Ints, "F 3"], uv: Float[Floats, "N 2"]
) -> Float[Floats, "N 4"]:
    """Compute glTF tangents of the vertices of `split_at_seams`: unit vectors along u, and handedness (1 or -1).

    Handedness times cross(normal, tangent) points towards decreasing v. Both are means over the adjacent faces, weighted by
    angle as in MikkTSpace.
    """
    corners, corner_uv = verts[faces], uv[faces]
    edge1, edge2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    (u1, v1), (u2, v2) = ((corner_uv[:, k] - corner_uv[:, 0]).T[:, :, None] for k in (1, 2))
    orientation = np.sign(u1 * v2 - u2 * v1)  # negative where the image is not mirrored, since v points down
    tangent = normalized(orientation * (v2 * edge1 - v1 * edge2))
    total, side = np.zeros((len(verts), 3)), np.zeros(len(verts))
    for k in range(3):
        a, b = (normalized(corners[:, (k + step) % 3] - corners[:, k]) for step in (1, 2))
        angle = np.arccos(np.clip(dot(a, b), -1.0, 1.0))
        vertex = faces[:, k]
        normal = normals[vertex]
        projected = normalized(tangent - dot(tangent, normal)[:, None] * normal)
        for axis in range(3):
            total[:, axis] += np.bincount(vertex, angle * projected[:, axis], len(verts))
        side -= np.bincount(vertex, angle * orientation[:, 0], len(verts))
    total -= dot(total, normals)[:, None] * normals
    undefined = np.flatnonzero(np.einsum("ni,ni->n", total, total) < 1e-20)
    if len(undefined):  # without a defined tangent, any direction orthogonal to the normal
        axis = np.eye(3)[np.abs(normals[undefined]).argmin(axis=1)]
        total[undefined] = cross_product(normals[undefined], axis)
    return np.column_stack([normalized(total), np.where(side < 0, -1.0, 1.0)])
