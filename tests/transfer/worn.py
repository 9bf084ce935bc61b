"""A rod, a sleeve around it, and a bend of both: small shapes with known results."""

import numpy as np

from meshmatch.arrays import Floats
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.shape import Shape

RADIUS, LENGTH = 0.2, 2.0


def tube(radius: float, length: float, around: int, along: int, name: str, closed: bool = False) -> Shape:
    """A pipe along y, centred at the origin; ``closed`` adds a fan of triangles at each end."""
    height, angle = np.meshgrid(np.linspace(-0.5, 0.5, along) * length, np.arange(around) * 2 * np.pi / around)
    height, angle = height.T.ravel(), angle.T.ravel()
    verts = np.stack([radius * np.sin(angle), height, radius * np.cos(angle)], axis=1)
    low = np.arange((along - 1) * around).reshape(along - 1, around)
    right = np.roll(low, -1, axis=1)
    faces = np.stack([np.stack([low, right, right + around], -1), np.stack([low, right + around, low + around], -1)])
    faces = faces.reshape(-1, 3)
    if closed:
        first, last = np.arange(around), np.arange(around) + (along - 1) * around
        n = len(verts)
        caps = [
            np.stack([np.full(around, n), np.roll(first, -1), first], axis=1),
            np.stack([np.full(around, n + 1), last, np.roll(last, -1)], axis=1),
        ]
        verts = np.concatenate([verts, [[0, -0.5 * length, 0], [0, 0.5 * length, 0]]])
        faces = np.concatenate([faces, *caps])
    return Shape(verts, faces, name)


def bent(points: Floats, turn: float = 1.2) -> Floats:
    """Bend points of a rod along y to an arc: each cross-section moves rigidly."""
    radius = LENGTH / turn
    angle = points[:, 1] / radius
    out = radius + points[:, 0]
    return np.stack([out * np.cos(angle) - radius, out * np.sin(angle), points[:, 2]], axis=1)


def rod() -> Shape:
    return tube(RADIUS, LENGTH, 24, 41, "rod", closed=True)


def sleeve(gap: float = 0.05) -> Shape:
    return tube(RADIUS + gap, 1.0, 16, 15, "sleeve")


def same_numbers(source: Shape, target: Shape) -> VertexMap:
    """Map vertex i to vertex i."""
    return VertexMap.between(source, target, np.arange(source.V), verdict="good")
