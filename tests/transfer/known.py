"""Two meshes of the same surface with exact maps, and a brute-force closest point search."""

import numpy as np

from meshmatch.geometry.triangles import closest_on_triangles
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.shape import Shape


def split(shape: Shape, name: str = "split") -> tuple[Shape, VertexMap, VertexMap]:
    """Split each triangle into four; return the result and the exact maps shape -> split and split -> shape."""
    f = shape.faces
    ends = np.sort(np.concatenate([f[:, [0, 1]], f[:, [1, 2]], f[:, [2, 0]]]), axis=1)
    edges, first, inverse = np.unique(ends, axis=0, return_index=True, return_inverse=True)
    ab, bc, ca = shape.V + inverse.reshape(3, -1)
    a, b, c = f.T
    verts = np.concatenate([shape.verts, shape.verts[edges].mean(axis=1)])
    faces = np.concatenate([np.stack(t, 1) for t in ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))])
    fine = Shape(verts, faces, name)
    side, face = np.divmod(first, shape.F)
    weights = np.full((len(edges), 3), 0.5)
    weights[np.arange(len(edges)), (side + 2) % 3] = 0.0
    back = VertexMap.between(
        fine,
        shape,
        np.concatenate([np.arange(shape.V), edges[:, 0]]),
        face=np.concatenate([np.full(shape.V, -1), face]),
        barycentric=np.concatenate([np.tile([1.0, 0, 0], (shape.V, 1)), weights]),
        verdict="good",
    )
    return fine, VertexMap.between(shape, fine, np.arange(shape.V), verdict="good"), back


def brute_force(points: np.ndarray, verts: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find the closest point on a mesh of each point over all triangles: distances (N,), points (N, 3)."""
    best, feet = np.empty(len(points)), np.empty_like(points)
    for n, point in enumerate(points):
        weights = closest_on_triangles(np.tile(point, (len(faces), 1)), *verts[faces].swapaxes(0, 1))
        found = np.einsum("fk,fkd->fd", weights, verts[faces])
        distance = np.linalg.norm(found - point, axis=1)
        best[n], feet[n] = distance.min(), found[distance.argmin()]
    return best, feet
