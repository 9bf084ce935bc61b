"""Parts thinner than a pixel, which slip between the rays: their edges are sampled and so found."""

from __future__ import annotations

import numpy as np

from meshmatch.arrays import Bool, Bools, Float, Floats32
from meshmatch.render.layout import Viewport
from meshmatch.render.scene import Scene

MOST_POINTS = 6_000_000
"""Maximum along each of the three sides of all triangles."""


def edge_points(scene: Scene, viewport: Viewport) -> Float[Floats32, "N 3"]:
    """Points along all edges of the scene, not more than a pixel apart: column, row, depth."""
    column = (scene.verts[:, 0] - np.float32(viewport.left)) / np.float32(viewport.pixel)
    row = (np.float32(viewport.top) - scene.verts[:, 1]) / np.float32(viewport.pixel)
    points = np.stack([column, row, scene.verts[:, 2]], axis=1)
    parts = [points]
    for first, second in ((0, 1), (1, 2), (2, 0)):
        a, b = points[scene.faces[:, first]], points[scene.faces[:, second]]
        steps = np.ceil(np.abs(b[:, :2] - a[:, :2]).max(axis=1)) - 1
        crowd = steps.sum(dtype=np.float64) / MOST_POINTS
        steps = (steps / max(1.0, crowd)).astype(np.int64)  # millions of long edges hide each other anyway
        long = np.flatnonzero(steps > 0)
        count = steps[long]
        which = np.repeat(long, count)
        number = 1 + np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        share = (number / np.repeat(count + 1, count)).astype(np.float32)[:, None]
        parts.append((1 - share) * a[which] + share * b[which])
    return np.concatenate(parts)


def slivers(
    edges: Float[Floats32, "N 3"], low: int, depth: Float[Floats32, "H W"], viewport: Viewport
) -> Bool[Bools, "H W"]:
    """Pixels, from row ``low`` on, in which an edge lies in front of everything that the rays around it hit."""
    H, W = depth.shape
    row, column = edges[:, 1] - low, edges[:, 0]
    inside = np.flatnonzero((row >= 0) & (row < H) & (column >= 0) & (column < W))
    row, column = row[inside].astype(np.int64), column[inside].astype(np.int64)
    padded = np.pad(depth, 1, constant_values=-np.inf)
    front = np.max([padded[i : i + H, j : j + W] for i in range(3) for j in range(3)], axis=0)
    before = edges[inside, 2] > front[row, column] + 1.5 * viewport.pixel
    result = np.zeros((H, W), bool)
    result[row[before], column[before]] = True
    return result
