"""What a point cloud does not say by itself: how much surface a point stands for, and which way that faces."""

import numpy as np
from numpy.typing import NDArray

from meshmatch.shapes.shape import Floats


def local_areas(points: Floats, invalid: NDArray[np.bool_] | None = None, neighbours: int = 16) -> Floats:
    """(V,) area that each point stands for, squared units; 0 for an invalid one."""
    from scipy.spatial import cKDTree

    valid = np.ones(len(points), bool) if invalid is None else ~invalid
    own = points[valid]
    k = min(neighbours, len(own) - 1)
    areas = np.zeros(len(points))
    if k < 1:
        return areas
    distance, _ = cKDTree(own).query(own, k + 1)
    areas[valid] = np.pi * distance[:, -1] ** 2 / k
    return areas


def estimate_normals(
    points: Floats, invalid: NDArray[np.bool_] | None = None, neighbours: int = 16
) -> Floats:
    """(V, 3) unit normals: the direction in which the neighbourhood is thinnest, away from the centroid."""
    from scipy.spatial import cKDTree

    own = points
    _, index = cKDTree(own).query(own, min(neighbours, len(own)))
    local = own[index] - own[index].mean(axis=1, keepdims=True)
    normals = np.linalg.svd(np.einsum("vki,vkj->vij", local, local))[2][:, 2]
    outward = np.einsum("vi,vi->v", normals, own - own.mean(axis=0))
    return np.where(outward[:, None] < 0, -normals, normals)
