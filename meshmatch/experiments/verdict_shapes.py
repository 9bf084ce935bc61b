"""What sound shapes are damaged with, and shapes that are no bodies."""

from __future__ import annotations

from functools import reduce

import numpy as np
import trimesh

from meshmatch.arrays import Bool, Bools, Float, Floats, Ints
from meshmatch.shapes.shape import Shape


def direction(rng: np.random.Generator) -> Float[Floats, " 3"]:
    """A random unit vector."""
    found = rng.normal(size=3)
    return np.asarray(found / np.linalg.norm(found))


def faces_kept(shape: Shape, truth: Ints, kept: Bool[Bools, " F"]) -> tuple[Shape, Ints]:
    """Only some faces, with their vertices."""
    used, faces = np.unique(shape.faces[kept], return_inverse=True)
    return Shape(shape.verts[used], faces.reshape(-1, 3)), truth[used]


def between(shape: Shape, truth: Ints, axis: Float[Floats, " 3"], low: float, high: float) -> tuple[Shape, Ints]:
    """Only the faces between two quantiles (0..1) of their places along an axis."""
    along = shape.verts[shape.faces].mean(1) @ axis
    first, last = np.quantile(along, [low, high])
    return faces_kept(shape, truth, np.asarray((along > first) & (along <= last)))


def joined(shape: Shape, other: Shape, at: Float[Floats, "W 3"]) -> Shape:
    """Two shapes as one, the second one with its vertices elsewhere."""
    return Shape(np.concatenate([shape.verts, at]), np.concatenate([shape.faces, other.faces + shape.V]))


def grid(side: float, cells: int) -> Shape:
    """A square in the plane y = 0 around the origin."""
    x, z = np.meshgrid(*[np.linspace(-0.5 * side, 0.5 * side, cells + 1)] * 2, indexing="ij")
    corner = np.arange((cells + 1) ** 2).reshape(cells + 1, cells + 1)
    a, b, c, d = corner[:-1, :-1].ravel(), corner[:-1, 1:].ravel(), corner[1:, 1:].ravel(), corner[1:, :-1].ravel()
    faces = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    return Shape(np.column_stack([x.ravel(), np.zeros(x.size), z.ravel()]), faces)


def refined(shape: Shape, F: int) -> Shape:
    """The same surface in F triangles or a few more; where triangles of two sizes meet there are slits."""
    verts, faces = np.asarray(shape.verts), np.asarray(shape.faces)
    while len(faces) < F:
        some = np.arange(min(len(faces), -(-(F - len(faces)) // 3)))
        verts, faces = trimesh.remesh.subdivide(verts, faces, some)
    return Shape(verts, faces)


def solids(rng: np.random.Generator) -> Shape:
    """A few boxes, balls and rods run together."""
    parts = []
    for _ in range(int(rng.integers(1, 7))):
        size = rng.uniform(0.1, 1.0, 3)
        made = (
            trimesh.creation.box(size).subdivide_to_size(0.1),
            trimesh.creation.icosphere(4, size[0]),
            trimesh.creation.capsule(size[0] * 2, size[1] * 0.3),
        )[rng.integers(3)]
        made.apply_transform(trimesh.transformations.random_rotation_matrix(rng.uniform(size=3)))
        made.apply_translation(rng.normal(size=3) * 0.4)
        parts.append(Shape(np.asarray(made.vertices), np.asarray(made.faces)))
    return reduce(lambda whole, part: joined(whole, part, part.verts), parts)
