"""Directions, such as normals: interpolated, then turned as the surface turns from source to target."""

from __future__ import annotations

import numpy as np

from meshmatch.arrays import Float, Floats
from meshmatch.errors import InputError
from meshmatch.geometry.topology import edges_of
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.shape import Shape


def pull_directions(
    back: VertexMap, source: Shape, target: Shape, directions: Float[Floats, "V_source 3"]
) -> Float[Floats, "V_target 3"]:
    """Unit vectors at the target's vertices from vectors at the source's, both in their file's own frame.

    Around each vertex of the target the rotation is taken that best turns the edges and the normal of the source
    there into those of the target (Kabsch); vectors that cancel become zeros.

    Raises
    ------
    InputError
        One of the shapes is a point cloud, or there is not one vector for each vertex.
    """
    if source.is_cloud or target.is_cloud:
        raise InputError("directions need meshes, not point clouds", "transfer them as plain numbers")
    if directions.shape != (source.V, 3):
        raise InputError(f"directions must be an array of ({source.V}, 3), not {directions.shape}")
    pulled = back.apply(np.nan_to_num(directions))
    turned = np.einsum("nij,nj->ni", _rotations(back, source, target), pulled)
    length = np.linalg.norm(turned, axis=1, keepdims=True)
    return turned / np.where(length > 0, length, 1.0)


def _rotations(back: VertexMap, source: Shape, target: Shape) -> Float[Floats, "V_target 3 3"]:
    points = back.points(source)
    edges = edges_of(target.faces).vertices
    here, there = (place[edges[:, 1]] - place[edges[:, 0]] for place in (target.verts, points))
    unit = np.sqrt(target.area * source.area) or 1.0
    products = np.einsum("ni,nj->nij", here, there) / unit
    sums = np.zeros((target.V, 3, 3))
    np.add.at(sums, edges[:, 0], products)
    np.add.at(sums, edges[:, 1], products)
    normals = back.apply(source.vertex_normals)
    # the normal counts as much as the edges do: in a flat ring these leave its sign open
    weight = np.maximum(np.linalg.norm(sums, axis=(1, 2)), 1e-12)[:, None, None]
    sums += weight * np.einsum("ni,nj->nij", target.vertex_normals, normals)
    left, _, right = np.linalg.svd(sums)
    sign = np.ones((target.V, 3))
    sign[:, 2] = np.sign(np.linalg.det(left @ right))
    return (left * sign[:, None, :]) @ right
