"""Vertices with one pair of texture coordinates each: copies where the surface is cut in its image; and their tangents."""

from __future__ import annotations

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.geometry.triangles import cross_product, dot, unit


def split_at_seams(
    V: int, faces: Int[Ints, "F 3"], uv: Float[Floats, "F 3 2"]
) -> tuple[Int[Ints, " N"], Float[Floats, "N 2"], Int[Ints, "F 3"]]:
    """Vertices with one pair of coordinates each: which vertex of the mesh each is, coordinates, and faces over them.

    The first V are those of the mesh in their order (zero coordinates where no face uses one); then come the copies
    that seams need. Coordinates that are one 32-bit float are one.
    """
    corner = faces.reshape(-1)
    pairs = np.ascontiguousarray(uv.reshape(-1, 2).astype("<f4") + np.float32(0))  # no -0
    order = np.lexsort((pairs[:, 1], pairs[:, 0], corner))
    fresh_vertex = np.diff(corner[order], prepend=-1) != 0
    fresh = fresh_vertex.copy()
    fresh[1:] |= (pairs[order][1:] != pairs[order][:-1]).any(axis=1)
    copies = fresh & ~fresh_vertex
    number = np.where(fresh_vertex, corner[order], V - 1 + np.cumsum(copies))
    new = np.empty(len(corner), np.int64)
    new[order] = number[fresh][np.cumsum(fresh) - 1]
    coordinates = np.zeros((V + int(copies.sum()), 2), np.float64)
    coordinates[new] = pairs
    return np.concatenate([np.arange(V), corner[order][copies]]), coordinates, new.reshape(-1, 3)


def vertex_tangents(
    verts: Float[Floats, "N 3"], normals: Float[Floats, "N 3"], faces: Int[Ints, "F 3"], uv: Float[Floats, "N 2"]
) -> Float[Floats, "N 4"]:
    """The unit tangent of each vertex of `split_at_seams`, along u, and on which side of normal and tangent v decreases
    (1 or -1), as glTF has them: the mean over the faces around, by their angles, as MikkTSpace takes it.
    """
    corners, flat = verts[faces], uv[faces]
    one, two = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    (u1, v1), (u2, v2) = ((flat[:, k] - flat[:, 0]).T[:, :, None] for k in (1, 2))
    turned = np.sign(u1 * v2 - u2 * v1)  # v points down: the image lies right way up where this is negative
    along = unit(turned * (v2 * one - v1 * two))
    total, side = np.zeros((len(verts), 3)), np.zeros(len(verts))
    for k in range(3):
        a, b = (unit(corners[:, (k + step) % 3] - corners[:, k]) for step in (1, 2))
        angle = np.arccos(np.clip(dot(a, b), -1.0, 1.0))
        vertex = faces[:, k]
        normal = normals[vertex]
        flattened = unit(along - dot(along, normal)[:, None] * normal)
        for axis in range(3):
            total[:, axis] += np.bincount(vertex, angle * flattened[:, axis], len(verts))
        side -= np.bincount(vertex, angle * turned[:, 0], len(verts))
    total -= dot(total, normals)[:, None] * normals
    bare = np.flatnonzero(np.einsum("ni,ni->n", total, total) < 1e-20)
    if len(bare):  # any direction along the surface
        axis = np.eye(3)[np.abs(normals[bare]).argmin(axis=1)]
        total[bare] = cross_product(normals[bare], axis)
    return np.column_stack([unit(total), np.where(side < 0, -1.0, 1.0)])
