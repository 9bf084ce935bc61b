"""Pairs of shapes with known maps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.shape import Shape


@dataclass(frozen=True, eq=False)
class Pair:
    """Two shapes and the vertex maps in both directions."""

    source: Shape
    target: Shape
    there: VertexMap
    back: VertexMap


def identical_pair(shape: Shape) -> Pair:
    """Pair a shape with itself."""
    same = VertexMap.identity(shape)
    return Pair(shape, shape, same, same)


def shuffled_pair(
    shape: Shape, name: str = "stirred", verdict: str = "good", reasons: tuple[str, ...] = (), lean: float = 0.0
) -> Pair:
    """Pair a shape with a copy that is scaled, translated, z up instead of y up, and has permuted vertices.

    ``lean`` shears the copy to one side, as a fraction of its height.
    """
    order = np.random.default_rng(5).permutation(shape.V)  # vertex k of the copy is vertex order[k] of the shape
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
    """Deform a sphere into an asymmetric shape: stretched, with a bump near +z."""
    nose = np.exp(-8 * ((sphere.verts - [0.2, 0.3, 0.9]) ** 2).sum(axis=1))
    return Shape(sphere.verts * np.array([0.8, 1.5, 0.6]) * (1 + 0.5 * nose)[:, None], sphere.faces, "egg.ply")
