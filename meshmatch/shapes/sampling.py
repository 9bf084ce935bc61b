"""Points spread evenly over a shape."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.errors import InputError
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.geometry.triangles import interpolate
from meshmatch.shapes.shape import Shape


@dataclass(frozen=True, eq=False, kw_only=True)
class Samples(OrientedPoints):
    """Points on a shape in its own frame, with the normals of their faces; a cloud's are estimated, not signed.

    Parameters
    ----------
    face : (P,) int64
        Face that each point lies on; -1 for a cloud.
    barycentric : (P, 3) float64
        Weights of that face's corners, in 0..1, sum 1; for a cloud (1, 0, 0).
    vertex : (P,) int64
        The face's corner of the largest weight; for a cloud the very point that was drawn.
    """

    face: Int[Ints, " P"]
    barycentric: Float[Floats, "P 3"]
    vertex: Int[Ints, " P"]


def sample_surface(shape: Shape, P: int, rng: np.random.Generator) -> Samples:
    """Draw `P` points with equal probability per area; the same `rng` state gives the same points.

    From a cloud, its own points are drawn with probability proportional to the area that each stands for
    (so a dense patch is not favoured), without repetition while there are enough.

    Raises
    ------
    InputError
        The shape has no area.
    """
    if P < 0:
        raise ValueError(f"cannot draw {P} points")
    areas = shape.vertex_areas if shape.is_cloud else shape.face_areas
    total = np.cumsum(areas)
    if not total[-1] > 0:
        raise InputError(f"{shape.name or 'the shape'} has no surface to sample", "all its faces are degenerate")
    if shape.is_cloud:
        chosen = _draw_points(areas, P, rng)
        weights = np.zeros((P, 3))
        weights[:, 0] = 1.0
        normals = shape.vertex_normals[chosen]
        face = np.full(P, -1, np.int64)
        return Samples(shape.verts[chosen], normals, signed=False, face=face, barycentric=weights, vertex=chosen)
    # side="right" steps over faces without area
    face = np.searchsorted(total, rng.random(P) * total[-1], side="right").astype(np.int64)
    face = np.minimum(face, np.flatnonzero(areas)[-1])
    root = np.sqrt(rng.random(P))
    other = rng.random(P)
    weights = np.stack([1.0 - root, root * (1.0 - other), root * other], axis=1)  # P 3
    corners = shape.faces[face]  # P 3
    points = interpolate(shape.verts, corners, weights)
    vertex = corners[np.arange(P), weights.argmax(axis=1)]
    return Samples(points, shape.face_normals[face], face=face, barycentric=weights, vertex=vertex)


def farthest_points(points: Float[Floats, "N 3"], K: int, start: int = 0) -> Int[Ints, " K"]:
    """Indices (K,) of points that are each as far as possible from all before them, beginning with `start`.

    Takes K passes over the points. With fewer distinct points than `K` the last ones repeat positions, never
    indices.

    Raises
    ------
    InputError
        `K` is larger than the number of points.
    """
    points = np.asarray(points, np.float64)
    if not 0 < K <= len(points):
        raise InputError(f"cannot choose {K} of {len(points)} points")
    if not 0 <= start < len(points):
        raise ValueError(f"start {start} is not one of {len(points)} points")
    x, y, z = np.ascontiguousarray(points.T)
    chosen = np.empty(K, np.int64)
    nearest = np.full(len(points), np.inf)
    current = start
    for k in range(K):
        chosen[k] = current
        squared = (x - x[current]) ** 2
        squared += (y - y[current]) ** 2
        squared += (z - z[current]) ** 2
        np.minimum(nearest, squared, out=nearest)
        nearest[current] = -1.0  # never again
        current = int(nearest.argmax())
    return chosen


def _draw_points(areas: Floats, P: int, rng: np.random.Generator) -> Ints:
    """Indices (P,) drawn by weight, first without repetition (Efraimidis and Spirakis 2006), then with."""
    possible = np.flatnonzero(areas)
    with np.errstate(divide="ignore"):
        keys = np.log(rng.random(len(possible))) / areas[possible]
    once = possible[np.argsort(keys, kind="stable")[::-1][:P]]
    if len(once) >= P:
        return once.astype(np.int64)
    total = np.cumsum(areas[possible])
    again = np.searchsorted(total, rng.random(P - len(once)) * total[-1], side="right")
    return np.concatenate([once, possible[np.minimum(again, len(possible) - 1)]]).astype(np.int64)
