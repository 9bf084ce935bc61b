"""Local thickness of a closed surface by its largest inscribed balls.

Shrinking balls after Ma, Bae and Choi, *3D medial axis point approximation using nearest neighbors and the normal
field* (The Visual Computer 28, 2012): a ball that touches a point from inside shrinks until it contains no other point.
"""

from __future__ import annotations

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.geometry.trees import cKDTree
from meshmatch.geometry.triangles import vertex_normals

_MAX_ROUNDS = 30
_MIN_SHRINKAGE = 1e-3  # as a fraction of the radius; a ball that would shrink less has converged
# Two points closer together than this angle, seen from the ball's center, are neighbours that only noise separates.
_MIN_ANGLE_COSINE = np.cos(np.radians(20.0))


def inscribed_diameters(verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"]) -> Float[Floats, " V"]:
    """Diameter of the largest ball inside a mesh that touches each vertex.

    nan where no surface lies opposite, as on a sheet, and at vertices without a triangle.
    """
    normals = vertex_normals(verts, faces)
    used = np.flatnonzero(np.linalg.norm(normals, axis=1) > 0)
    points, inwards = verts[used], -normals[used]
    tree, largest = cKDTree(points), float(np.linalg.norm(np.ptp(points, axis=0))) / 2 if len(used) else 0.0
    radius = np.full(len(used), largest)
    active = np.arange(len(used))
    for _ in range(_MAX_ROUNDS):
        if not len(active):
            break
        center = points[active] + radius[active, None] * inwards[active]
        near = points[tree.query(center)[1]]
        step = near - points[active]
        ahead, squared = (step * inwards[active]).sum(1), (step**2).sum(1)
        smaller = np.full(len(active), np.inf)
        np.divide(squared, 2 * ahead, out=smaller, where=ahead > 0)
        # cosine of the angle between both points, accurate for small angles
        cosine = 1 - squared / (2 * np.maximum(radius[active] ** 2, 1e-300))
        shrinks = (smaller < (1 - _MIN_SHRINKAGE) * radius[active]) & (
            (cosine < _MIN_ANGLE_COSINE) | (radius[active] == largest)
        )
        active = active[shrinks]
        radius[active] = smaller[shrinks]
    diameters = np.full(len(verts), np.nan)
    diameters[used] = np.where(radius < largest, 2 * radius, np.nan)
    return diameters
