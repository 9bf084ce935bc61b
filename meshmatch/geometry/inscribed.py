"""How thick a closed surface is: the largest balls inside it.

Ma, Bae and Choi, *3D medial axis point approximation using nearest neighbors and the normal field* (The Visual Computer 28,
2012): a ball that touches a point from inside shrinks until no other point lies in it.
"""

from __future__ import annotations

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.geometry.trees import cKDTree
from meshmatch.geometry.triangles import vertex_normals

_ROUNDS = 30
_LESS = 1e-3  # of its radius: a ball that shrinks less has ended
_APART = np.cos(
    np.radians(20.0)
)  # points seen closer together from its center are neighbours, and noise tells them apart


def inscribed_diameters(verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"]) -> Float[Floats, " V"]:
    """Diameter of the largest ball inside a mesh that touches it at each vertex; nan where nothing lies opposite, as of a
    sheet, and at vertices without a triangle.
    """
    normals = vertex_normals(verts, faces)
    known = np.flatnonzero(np.linalg.norm(normals, axis=1) > 0)
    points, inwards = verts[known], -normals[known]
    tree, largest = cKDTree(points), float(np.linalg.norm(np.ptp(points, axis=0))) / 2 if len(known) else 0.0
    radius = np.full(len(known), largest)
    going = np.arange(len(known))
    for _ in range(_ROUNDS):
        if not len(going):
            break
        center = points[going] + radius[going, None] * inwards[going]
        near = points[tree.query(center)[1]]
        step = near - points[going]
        ahead, squared = (step * inwards[going]).sum(1), (step**2).sum(1)
        smaller = np.full(len(going), np.inf)
        np.divide(squared, 2 * ahead, out=smaller, where=ahead > 0)
        seen = 1 - squared / (
            2 * np.maximum(radius[going] ** 2, 1e-300)
        )  # cosine of the angle between both, for small ones
        shrinks = (smaller < (1 - _LESS) * radius[going]) & ((seen < _APART) | (radius[going] == largest))
        going = going[shrinks]
        radius[going] = smaller[shrinks]
    found = np.full(len(verts), np.nan)
    found[known] = np.where(radius < largest, 2 * radius, np.nan)
    return found
