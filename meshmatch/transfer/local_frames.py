"""Local rotation and scale of a map around each vertex of the source."""

from __future__ import annotations

import numpy as np

from meshmatch.arrays import Float, Floats
from meshmatch.errors import InputError, OptionError
from meshmatch.fitting.solve.priors import nearest_rotations
from meshmatch.geometry.smoothing import smooth_values
from meshmatch.geometry.triangles import edge_lengths, is_discontinuous
from meshmatch.maps.folds import normals_at, orientation_agreement
from meshmatch.maps.mapped_mesh import length_of
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.shape import Shape

# Set by hand, in units of sqrt(area): distance over which rotations and scales are averaged.
_AVERAGING = 0.06
_INSIDE_OUT = -0.5  # lower limit of `orientation_agreement`, -1 to 1: three quarters of the surface are flipped


def local_frames(
    forward: VertexMap, source: Shape, target: Shape
) -> tuple[Float[Floats, "V 3 3"], Float[Floats, " V"]]:
    """Rotations (V, 3, 3) from source to target and scales (V,) at each vertex of the source, averaged over the surface
    around it, so that an error of the map at one vertex counts for little.

    `InputError`: the source is a point cloud. `OptionError`: the map turns it inside out.
    """
    name = source.name or "the source"
    if source.is_cloud:
        raise InputError(f"{name} is a point cloud, which has no surface", "give a mesh")
    image = forward.points(target)
    normals = normals_at(forward, target)
    if orientation_agreement(image, normals, source.verts, source.faces[source.valid_faces]) < _INSIDE_OUT:
        hint = "mirror one of the files, or match without mirror images (--mirror no)"
        raise OptionError(f"{name} matches as a mirror image: what is carried would be inside out", hint)
    edges = source.edges.vertices.astype(np.int64)
    source_edges, image_edges = (place[edges[:, 1]] - place[edges[:, 0]] for place in (source.verts, image))
    length, image_length = edge_lengths(source.verts, edges), edge_lengths(image, edges)
    discontinuous = is_discontinuous(image_length / length_of(target), length / length_of(source)) | (length == 0)
    trust = np.where(discontinuous, 0.0, forward.assumed_confidence[edges].min(axis=1)) + 1e-6
    weight = trust / np.maximum(length, 1e-12 * length_of(source))
    products = weight[:, None, None] * image_edges[:, :, None] * source_edges[:, None, :]
    sums = np.zeros((source.V, 11))  # products (9), and sums of lengths after and before
    rows = np.column_stack([products.reshape(-1, 9), trust * image_length, trust * length])
    for end in edges.T:
        np.add.at(sums, end, rows)
    scale = float(sums[:, 9].sum() / max(sums[:, 10].sum(), 1e-300))
    outwards = 0.5 * scale * sums[:, 10, None, None] * normals[:, :, None] * source.vertex_normals[:, None, :]
    sums[:, :9] += outwards.reshape(-1, 9)
    sums = smooth_values(sums, np.ones(source.V), edges, length, _AVERAGING * length_of(source))
    averaged_products = sums[:, :9].reshape(-1, 3, 3)
    rotations = nearest_rotations(averaged_products, np.broadcast_to(np.eye(3), averaged_products.shape))
    ratio = np.maximum(sums[:, 9], 0.0) / np.maximum(sums[:, 10], 1e-300)
    return rotations, np.where(ratio > 0, ratio, scale)
