"""Deform the mesh of one fitted shape onto another, by two fits of the same template."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.solve.priors import nearest_rotations
from meshmatch.geometry.triangles import edges_of, vertex_normals
from meshmatch.maps.footpoints import SurfaceBinding
from meshmatch.shapes.repair import Repaired
from meshmatch.shapes.shape import Shape


def deformed(part: Repaired, source: Fit, target: Fit, workers: int = 1) -> Shape:
    """Return the source's mesh in the pose and shape of the target.

    Vertices follow the template from one fit to the other and keep their offsets from it, rotated with its surface. The
    result has the vertices and faces of the source's file, in the frame and unit of the target's.
    """
    source.check_template(target.template_hash)
    identity = np.tile(np.eye(3), (len(source.points), 1, 1))
    rotations = surface_rotations(source.points, target.points, source.faces)
    binding = SurfaceBinding(part, source, identity, workers)
    result = binding.shape(target.frame.undo(binding.at(target.points, rotations)), part.original.name)
    is_mirrored = source.frame.mirrored != target.frame.mirrored
    return replace(result, faces=result.faces[:, ::-1]) if is_mirrored else result


def surface_rotations(
    before: Float[Floats, "V 3"], after: Float[Floats, "V 3"], faces: Int[Ints, "F 3"]
) -> Float[Floats, "V 3 3"]:
    """Best rotation around each vertex from one position of a mesh to another.

    Fitted to the vertex's edges and, because those alone are ambiguous where they lie in a plane, to its normal.
    """
    edges = edges_of(faces).vertices
    a, b = edges[:, 0], edges[:, 1]
    edges_before, edges_after = before[b] - before[a], after[b] - after[a]
    products = edges_after[:, :, None] * edges_before[:, None, :]
    length = np.square(edges_before).sum(1)
    total, weight = np.zeros((len(before), 3, 3)), np.zeros(len(before))
    for end in (a, b):
        np.add.at(total, end, products)
        np.add.at(weight, end, length)
    normals = vertex_normals(before, faces), vertex_normals(after, faces)
    total += 0.5 * weight[:, None, None] * normals[1][:, :, None] * normals[0][:, None, :]
    return nearest_rotations(total, np.broadcast_to(np.eye(3), total.shape))
