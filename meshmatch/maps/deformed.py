"""The mesh of one fitted shape, deformed onto the shape of another fit of the same template."""

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
    """The shape of the source's file, in the frame and unit of the target's: its vertices follow the template from one fit
    to the other, and keep their offsets from it, which turn with it.
    """
    source.check_template(target.template_hash)
    still = np.tile(np.eye(3), (len(source.points), 1, 1))
    turns = surface_rotations(source.points, target.points, source.faces)
    binding = SurfaceBinding(part, source, still, workers)
    moved = binding.shape(target.frame.undo(binding.at(target.points, turns)), part.original.name)
    other_side = source.frame.mirrored != target.frame.mirrored
    return replace(moved, faces=moved.faces[:, ::-1]) if other_side else moved


def surface_rotations(
    before: Float[Floats, "V 3"], after: Float[Floats, "V 3"], faces: Int[Ints, "F 3"]
) -> Float[Floats, "V 3 3"]:
    """The rotation around each vertex of a mesh that moved: the best one of its edges and of its normal, which tells where
    the edges lie in a plane.
    """
    edges = edges_of(faces).vertices
    a, b = edges[:, 0], edges[:, 1]
    here, there = before[b] - before[a], after[b] - after[a]
    products = there[:, :, None] * here[:, None, :]
    length = np.square(here).sum(1)
    total, weight = np.zeros((len(before), 3, 3)), np.zeros(len(before))
    for end in (a, b):
        np.add.at(total, end, products)
        np.add.at(weight, end, length)
    normals = vertex_normals(before, faces), vertex_normals(after, faces)
    total += 0.5 * weight[:, None, None] * normals[1][:, :, None] * normals[0][:, None, :]
    return nearest_rotations(total, np.broadcast_to(np.eye(3), total.shape))
