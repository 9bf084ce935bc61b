"""Triangles for a point cloud: each point's Delaunay star in its tangent plane, and the triangles that agree.

After the localised Delaunay triangulation of Gopi, Krishnan and Silva (*Surface Reconstruction based on Lower
Dimensional Localized Delaunay Triangulation*, 2000): a triangle is kept where the stars of all three corners have it.
Where points are noisy stars disagree and a small hole stays; nothing is moved or invented.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import Delaunay, QhullError, cKDTree

from meshmatch.arrays import Floats, Int, Ints
from meshmatch.errors import InputError
from meshmatch.shapes.sampling import farthest_points
from meshmatch.shapes.shape import Shape

_NEIGHBOURS = 16
_LONGEST = 3.0  # of an edge, against the usual reach of a point's sixth neighbour


def triangulate_cloud(cloud: Shape, most: int) -> tuple[Int[Ints, " V"], Int[Ints, "F 3"]]:
    """A mesh over some points of a cloud.

    Parameters
    ----------
    most : int
        About how many triangles at most; half as many points are taken, evenly spread.

    Returns
    -------
    kept : (V,) int64
        Points of the cloud that are corners.
    faces : (F, 3) int64
        Counter-clockwise seen from where the cloud's estimated normals point.

    Raises
    ------
    InputError
        Hardly any two stars agree: the points lie on no surface.
    """
    chosen = np.arange(cloud.V)
    if cloud.V > most // 2:
        chosen = np.sort(farthest_points(cloud.verts, most // 2))
    points, normals = cloud.verts[chosen], cloud.vertex_normals[chosen]
    k = min(_NEIGHBOURS, len(points) - 1)
    distance, index = cKDTree(points).query(points, k + 1)
    reach = _LONGEST * np.median(distance[:, min(6, k)])
    votes: dict[tuple[int, int, int], int] = {}
    for own, near in enumerate(index):
        for second, third in _star(points[near], normals[own], reach):
            corners = sorted((own, int(near[second]), int(near[third])))
            key = (corners[0], corners[1], corners[2])
            votes[key] = votes.get(key, 0) + 1
    faces = np.array([key for key, count in votes.items() if count == 3], np.int64).reshape(-1, 3)
    if 3 * len(faces) < len(points):
        raise InputError(
            f"{cloud.name or 'the cloud'} is too rough for a template: its points lie on no surface",
            "give a cleaner or denser cloud, or a mesh, with --template",
        )
    a, b, c = (points[faces[:, i]] for i in range(3))
    outwards = (np.cross(b - a, c - a) * normals[faces].sum(1)).sum(1)
    faces[outwards < 0] = faces[outwards < 0][:, ::-1]
    used, renumbered = np.unique(faces, return_inverse=True)
    return chosen[used], renumbered.reshape(-1, 3)


def _star(points: Floats, normal: Floats, reach: float) -> list[tuple[int, int]]:
    """Triangles around the first of some points, as pairs of the others, in the plane across a normal."""
    across = np.linalg.svd(normal[None])[2][1:]
    flat = (points - points[0]) @ across.T
    try:
        triangles = Delaunay(flat).simplices
    except QhullError:
        return []  # all on a line
    found = []
    for corners in triangles:
        if 0 in corners:
            b, c = (int(i) for i in corners if i != 0)
            edges = (points[b] - points[0], points[c] - points[0], points[b] - points[c])
            if max(float(edge @ edge) for edge in edges) < reach**2:
                found.append((b, c))
    return found
