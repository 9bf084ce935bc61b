"""What sound shapes are damaged with, and shapes that are no bodies."""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce

import numpy as np
import trimesh

from meshmatch.arrays import Bool, Bools, Float, Floats, Ints
from meshmatch.shapes.shape import Shape

METRES = 1.7
"""How large what is no person is made."""
LIMBS = (
    ("left thigh", "left shin", "left foot"), ("right thigh", "right shin", "right foot"),
    ("left upper arm", "left forearm", "left hand"), ("right upper arm", "right forearm", "right hand"),
    ("head", "neck"), ("left forearm", "left hand"), ("right hand",), ("left foot", "left shin"),
    ("chest", "belly", "hips"),
    ("hips", "left thigh", "left shin", "left foot", "right thigh", "right shin", "right foot"),
)  # fmt: skip
"""Labels of parts of people that are cut out together."""


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


def boxes(corners: Sequence[Float[Floats, "2 3"]], edge: float) -> Shape:
    """Boxes by their lower and upper corners, which may run into each other; no edge is longer than that."""
    parts = []
    for low, high in corners:
        made = trimesh.creation.box(high - low).subdivide_to_size(edge)
        parts.append(Shape(np.asarray(made.vertices) + 0.5 * (low + high), np.asarray(made.faces)))
    return reduce(lambda whole, part: joined(whole, part, part.verts), parts)


def on_floor(shape: Shape, side: float) -> Shape:
    """A shape above the middle of a square that it stands on."""
    plane = grid(side, 40)
    at = np.array([shape.verts[:, 0].mean(), shape.verts[:, 1].min(), shape.verts[:, 2].mean()])
    return joined(shape, plane, plane.verts + at)


def no_body(verts: Floats, faces: Ints) -> tuple[Shape, Ints]:
    """A shape as large as a person, none of whose vertices has a counterpart."""
    return Shape(verts * (METRES / np.ptp(verts, axis=0).max()), faces), np.full(len(verts), -1)
