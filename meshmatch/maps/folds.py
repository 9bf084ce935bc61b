"""Measure how a map folds: triangles that it flips, crushes or stretches."""

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
    normalized,
    squared_lengths,
    triangle_vectors,
)
from meshmatch.maps.indices import corners_of
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.faces import orient_faces
from meshmatch.shapes.shape import Shape

_ROUNDING = 1e-6  # area ratios are rounded by this much: an image without area is not flipped
CRUSHED_RATIO = 0.25
"""A triangle is crushed if the area of its image is less than this share of its own, both shapes scaled to equal area."""


@dataclass(frozen=True)
class Folds:
    """Injectivity and stretch of a map between two meshes.

    Attributes
    ----------
    flipped
        Share (0..1) of the source's area in triangles whose images are turned over.
    crushed
        Share of the source's area in triangles whose images have less than a quarter of their area, both shapes scaled to
        equal area.
    stretch
        Median over the source's area of the largest factor by which lengths grow or shrink in any direction; 1 for an
        isometry.
    """

    flipped: float
    crushed: float
    stretch: float

    @classmethod
    def of(cls, found: VertexMap, source: Shape, target: Shape) -> Folds:
        """Measure a map between two meshes."""
        points, verts = found.points(target) / _scale(target), source.verts / _scale(source)
        faces, areas = consistent_faces(source)[source.valid_faces], source.face_areas[source.valid_faces]
        normals = normals_at(found, target)
        normals *= 1.0 if orientation_agreement(points, normals, verts, faces) >= 0 else -1.0
        ratio = area_ratios(points, normals, verts, faces)
        known = np.isfinite(ratio) & (areas > 0)
        if not known.any():
            return cls(0.0, 0.0, 1.0)
        share = areas[known] / areas[known].sum()
        ratio, factor = ratio[known], _stretch_factors(points, normals, verts, faces[known])
        order = np.argsort(factor)
        middle = order[np.searchsorted(np.cumsum(share[order]), 0.5)]
        flipped = ratio < -_ROUNDING
        crushed = ~flipped & (ratio < CRUSHED_RATIO)
        return cls(float(share[flipped].sum()), float(share[crushed].sum()), float(factor[middle]))


def normals_or_zeros(shape: Shape) -> Float[Floats, "V 3"]:
    """Unit vertex normals of a mesh; zeros for a cloud, whose orientation is unknown."""
    if shape.is_cloud:
        return np.zeros_like(shape.verts)
    faces = consistent_faces(shape)
    return average_normals(triangle_vectors(shape.verts, faces), faces, shape.V)


@derived
def consistent_faces(shape: Shape) -> Int[Ints, "F 3"]:
    """Faces reoriented so that neighbours have the same winding, which those of a file need not have."""
    edges = shape.edges
    return (
        orient_faces(shape.verts, shape.faces, shape.face_vectors, edges)[0] if edges.disagreeing.any() else shape.faces
    )


def normals_at(found: VertexMap, target: Shape) -> Float[Floats, "V_source 3"]:
    """Unit normals of the target at the images of the source's vertices; zeros on a cloud."""
    corners = corners_of(target.faces, found.face, found.index)
    return normalized(interpolate(normals_or_zeros(target), corners, found.barycentric))


def orientation_agreement(
    points: Float[Floats, "V 3"], normals: Float[Floats, "V 3"], verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"]
) -> float:
    """Area-weighted mean of +1 for triangles that keep their orientation and -1 for others, from 1 to -1.

    A map to a mirror image gives -1. Arguments as in `area_ratios`.
    """
    images = dot(triangle_vectors(points, faces), _unit_face_normals(normals, faces))
    areas = np.sqrt(squared_lengths(triangle_vectors(verts, faces)))
    return float((areas * np.where(images >= 0, 1.0, -1.0)).sum() / max(areas.sum(), 1e-300))


def area_ratios(
    points: Float[Floats, "V 3"], normals: Float[Floats, "V 3"], verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"]
) -> Float[Floats, " F"]:
    """Signed area of each triangle's image over the area of the triangle.

    Images are projected along the target's ``normals`` at the images ``points`` of ``verts``. Negative where the image is
    turned over, nan where the triangle has no area.
    """
    directions = _unit_face_normals(normals, faces)
    areas = np.sqrt(squared_lengths(triangle_vectors(verts, faces)))
    return np.asarray(dot(triangle_vectors(points, faces), directions) / np.where(areas > 0, areas, np.nan))


def _stretch_factors(points: Floats, normals: Floats, verts: Floats, faces: Ints) -> Floats:
    """(F,) largest factor by which lengths grow or shrink, at least 1, with images projected onto the target's surface."""
    directions = _unit_face_normals(normals, faces)
    metric = []
    for each, flat in ((verts, None), (points, directions)):
        first, second = (each.take(faces[:, k], 0) - each.take(faces[:, 0], 0) for k in (1, 2))
        if flat is not None:
            first, second = (edge - dot(edge, flat)[:, None] * flat for edge in (first, second))
        metric.append((dot(first, first), dot(first, second), dot(second, second), cross_product(first, second)))
    (a, b, c, own), (p, q, r, image) = metric
    square = squared_lengths(own)
    total = (c * p - 2 * b * q + a * r) / np.maximum(square, 1e-300)  # sum of the squared singular values
    product = np.sqrt(squared_lengths(image) / np.maximum(square, 1e-300))
    difference = np.sqrt(np.maximum(total**2 - 4 * product**2, 0.0))
    large = np.sqrt(np.maximum(total + difference, 0.0) / 2)
    small = product / np.maximum(large, 1e-300)
    return np.asarray(np.maximum(large, 1 / np.maximum(small, 1e-12)))


def _unit_face_normals(normals: Floats, faces: Ints) -> Floats:
    return normalized(sum(normals.take(faces[:, k], 0) for k in range(3)))  # type: ignore[arg-type]


def _scale(shape: Shape) -> float:
    return float(np.sqrt(shape.area)) or 1.0
