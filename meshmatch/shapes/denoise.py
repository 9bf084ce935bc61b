"""Noise of meshes: its measurement, and smoothing."""

from __future__ import annotations

import numpy as np

from meshmatch.geometry.triangles import squared_lengths, triangle_vectors
from meshmatch.shapes.shape import Shape

# Coherence below which a mesh is smoothed, and up to which; set by hand. Noisy scans, dressed bodies and animals are all
# above 0.89; noise as large as the triangles gives 0.3 to 0.64, two to ten times the area, and meaningless normals.
_MIN_COHERENCE, _TARGET_COHERENCE = 0.75, 0.94
_MAX_PASSES = 60
# one step inwards and one outwards, which preserve the volume
_TAUBIN_PASS = {"lamb": 0.5, "nu": 0.53, "iterations": 2}
# Minimum triangles per part: parts of simple solids have few triangles, and corners that are not noise.
_MIN_TRIANGLES = 100
_MAX_WEIGHT = 20.0  # maximum weight of a vertex, in units of the median area around a vertex
_EVALUATED = 20_000  # vertices to evaluate, evenly chosen: enough for a mean


def coherence(shape: Shape) -> float:
    """Area-weighted mean length of the vertex normals (0..1): how far the triangles around a vertex face the same way."""
    chosen = np.zeros(shape.V, bool)
    chosen[:: max(1, shape.V // _EVALUATED)] = True
    faces = shape.faces[chosen[shape.faces].any(axis=1)]
    vectors, corners = triangle_vectors(shape.verts, faces), faces.ravel()
    areas = np.sqrt(squared_lengths(vectors))
    resultant, total = (
        np.stack([np.bincount(corners, np.repeat(column, 3), shape.V)[chosen] for column in columns])
        for columns in (vectors.T, areas[None])
    )
    total, resultant = total[0], np.linalg.norm(resultant, axis=0)
    # limits the weight of large plain parts, such as a box under a body, whose few corners say nothing about noise
    weight = np.minimum(1.0, _MAX_WEIGHT * np.median(total) / np.maximum(total, 1e-300))
    return float((weight * resultant).sum() / max(float((weight * total).sum()), 1e-300))


def remove_noise(shape: Shape, parts: int = 1) -> tuple[Shape, int]:
    """Smooth a mesh with ``parts`` parts if its noise is as large as its triangles.

    Returns the mesh, and the number of passes, 0 if it is unchanged. Smoothing follows Taubin, *A signal processing
    approach to fair surface design* (SIGGRAPH 1995).
    """
    if shape.F < _MIN_TRIANGLES * parts or coherence(shape) >= _MIN_COHERENCE:
        return shape, 0
    from trimesh import Trimesh
    from trimesh.smoothing import filter_taubin, laplacian_calculation

    mesh = Trimesh(shape.verts, shape.faces, process=False)
    neighbours, smooth, passes = laplacian_calculation(mesh), shape, 0
    while passes < _MAX_PASSES and coherence(smooth) < _TARGET_COHERENCE:
        filter_taubin(mesh, **_TAUBIN_PASS, laplacian_operator=neighbours)
        smooth = Shape(
            np.array(mesh.vertices), shape.faces, shape.name, shape.colors, weights=shape.weights, upright=shape.upright
        )
        passes += 1
    return smooth, passes
