"""Triangles that a map turns over, crushes or stretches."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.derived import derived
from meshmatch.geometry.triangles import (
    average_normals,
    cross_product,
    dot,
    interpolate,
    squared_lengths,
    triangle_vectors,
    unit,
)
from meshmatch.maps.named_places import corners_of
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.faces import turn_faces
from meshmatch.shapes.shape import Shape

_ROUNDING = 1e-6  # of a ratio of areas: what has none is not turned over
CRUSHED = 0.25
"""An image of less than this share of a triangle's area, both shapes scaled to the same area, is crushed."""


@dataclass(frozen=True)
class Folds:
    """Where a map is not one to one, and how much it stretches.

    Attributes
    ----------
    flipped
        Share (0..1) of the source's area on triangles whose images are turned over.
    crushed
        Share on triangles whose images have less than a quarter of their area, or none, both shapes scaled to the same area.
    stretch
        Half of the source's area is stretched, or shrunk, by more than this factor in some direction; 1 for an isometry.
    """

    flipped: float
    crushed: float
    stretch: float

    @classmethod
    def of(cls, found: VertexMap, source: Shape, target: Shape) -> Folds:
        """Those of a map between two meshes."""
        points, verts = found.points(target) / _length(target), source.verts / _length(source)
        faces, areas = wound_alike(source)[source.valid_faces], source.face_areas[source.valid_faces]
        normals = normals_at(found, target)
        normals *= 1.0 if facing(points, normals, verts, faces) >= 0 else -1.0
        ratio = area_ratios(points, normals, verts, faces)
        known = np.isfinite(ratio) & (areas > 0)
        if not known.any():
            return cls(0.0, 0.0, 1.0)
        share = areas[known] / areas[known].sum()
        ratio, factor = ratio[known], _factors(points, normals, verts, faces[known])
        order = np.argsort(factor)
        middle = order[np.searchsorted(np.cumsum(share[order]), 0.5)]
        flipped = ratio < -_ROUNDING
        crushed = ~flipped & (ratio < CRUSHED)
        return cls(float(share[flipped].sum()), float(share[crushed].sum()), float(factor[middle]))


def known_normals(shape: Shape) -> Float[Floats, "V 3"]:
    """Unit vertex normals of a mesh; zeros for a cloud, where inside and outside may be confused."""
    if shape.is_cloud:
        return np.zeros_like(shape.verts)
    faces = wound_alike(shape)
    return average_normals(triangle_vectors(shape.verts, faces), faces, shape.V)


@derived
def wound_alike(shape: Shape) -> Int[Ints, "F 3"]:
    """Faces of which neighbours run the same way around, as those of a file need not."""
    edges = shape.edges
    return (
        turn_faces(shape.verts, shape.faces, shape.face_vectors, edges)[0] if edges.disagreeing.any() else shape.faces
    )


def normals_at(found: VertexMap, target: Shape) -> Float[Floats, "V_source 3"]:
    """Unit normals of the target where the vertices of the source are matched; zeros on a cloud."""
    corners = corners_of(target.faces, found.face, found.index)
    return unit(interpolate(known_normals(target), corners, found.barycentric))


def facing(
    points: Float[Floats, "V 3"], normals: Float[Floats, "V 3"], verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"]
) -> float:
    """How much of the surface keeps its side: 1 all of it, -1 nothing, as by a map to a mirror image. Arguments as in
    `area_ratios`.
    """
    images = dot(triangle_vectors(points, faces), _facing(normals, faces))
    own = np.sqrt(squared_lengths(triangle_vectors(verts, faces)))
    return float((own * np.where(images >= 0, 1.0, -1.0)).sum() / max(own.sum(), 1e-300))


def area_ratios(
    points: Float[Floats, "V 3"], normals: Float[Floats, "V 3"], verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"]
) -> Float[Floats, " F"]:
    """Area of the image of each triangle, seen along the surface that it lies on, over the triangle's own: negative where
    it is turned over, nan where the triangle has no area. ``points`` are the images of ``verts``.
    """
    facing = _facing(normals, faces)
    own = np.sqrt(squared_lengths(triangle_vectors(verts, faces)))
    return np.asarray(dot(triangle_vectors(points, faces), facing) / np.where(own > 0, own, np.nan))


def _factors(points: Floats, normals: Floats, verts: Floats, faces: Ints) -> Floats:
    """(F,) by how much lengths change most, as a factor of at least 1, across the surface that the images lie on."""
    facing = _facing(normals, faces)
    metric = []
    for each, flat in ((verts, None), (points, facing)):
        first, second = (each.take(faces[:, k], 0) - each.take(faces[:, 0], 0) for k in (1, 2))
        if flat is not None:
            first, second = (edge - dot(edge, flat)[:, None] * flat for edge in (first, second))
        metric.append((dot(first, first), dot(first, second), dot(second, second), cross_product(first, second)))
    (a, b, c, own), (p, q, r, image) = metric
    square = squared_lengths(own)
    total = (c * p - 2 * b * q + a * r) / np.maximum(square, 1e-300)  # squared singular values, added up
    product = np.sqrt(squared_lengths(image) / np.maximum(square, 1e-300))
    difference = np.sqrt(np.maximum(total**2 - 4 * product**2, 0.0))
    large = np.sqrt(np.maximum(total + difference, 0.0) / 2)
    small = product / np.maximum(large, 1e-300)
    return np.asarray(np.maximum(large, 1 / np.maximum(small, 1e-12)))


def _facing(normals: Floats, faces: Ints) -> Floats:
    return unit(sum(normals.take(faces[:, k], 0) for k in range(3)))  # type: ignore[arg-type]


def _length(shape: Shape) -> float:
    return float(np.sqrt(shape.area)) or 1.0
