"""Two shapes with a map between them that is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.shape import Shape


@dataclass(frozen=True, eq=False)
class Pair:
    """There and back between two shapes, vertex by vertex."""

    source: Shape
    target: Shape
    there: VertexMap
    back: VertexMap


def itself(shape: Shape) -> Pair:
    """A shape and the same one."""
    same = VertexMap.identity(shape)
    return Pair(shape, shape, same, same)


def stirred(
    shape: Shape, name: str = "stirred", verdict: str = "good", reasons: tuple[str, ...] = (), lean: float = 0.0
) -> Pair:
    """A shape, and the same one larger, elsewhere, z instead of y up, its vertices in another order; leaning to
    one side by so much of its height.
    """
    order = np.random.default_rng(5).permutation(shape.V)  # new row k is the old row order[k]
    place: NDArray[np.int64] = np.argsort(order)
    leaning = shape.verts + lean * shape.verts[:, [1]] * np.array([1.0, 0.0, 0.0])
    verts = 3.0 * leaning[order][:, [0, 2, 1]] * np.array([1.0, -1.0, 1.0]) + 7.0
    target = Shape(verts, place[shape.faces] if shape.F else shape.faces, name)
    confidence = np.linspace(0, 1, shape.V).astype(np.float32)
    words = {"verdict": verdict, "reasons": reasons}
    there = VertexMap.between(shape, target, place, confidence=confidence, **words)
    back = VertexMap.between(target, shape, order, confidence=confidence[order], **words)
    return Pair(shape, target, there, back)


def bump(sphere: Shape) -> Shape:
    """A sphere that has no symmetry: a nose at +z, longer than wide."""
    nose = np.exp(-8 * ((sphere.verts - [0.2, 0.3, 0.9]) ** 2).sum(axis=1))
    return Shape(sphere.verts * np.array([0.8, 1.5, 0.6]) * (1 + 0.5 * nose)[:, None], sphere.faces, "egg.ply")
