"""Noise of meshes: how much of it there is, and a surface without it."""

from __future__ import annotations

import numpy as np

from meshmatch.geometry.triangles import squared_lengths, triangle_vectors
from meshmatch.shapes.shape import Shape

# Set by hand. Of noisy scans, dressed bodies and animals none is below 0.89; noise as large as the triangles makes 0.3 to
# 0.64, twice to ten times the area, and normals that say nothing.
_ROUGH, _SMOOTH = 0.75, 0.94
_MOST = 60  # passes
_PASS = {"lamb": 0.5, "nu": 0.53, "iterations": 2}  # a step inwards and a step outwards: the volume stays
# What is made of plain solids has few triangles a part; their corners are no noise.
_TRIANGLES = 100
_LARGE = 20.0  # times the usual area around a vertex: more counts no more
_ASKED = 20_000  # vertices, evenly among all: enough for a mean


def coherence(shape: Shape) -> float:
    """How far (0..1) the triangles around a vertex face the same way: the length of the mean normal, by area."""
    asked = np.zeros(shape.V, bool)
    asked[:: max(1, shape.V // _ASKED)] = True
    faces = shape.faces[asked[shape.faces].any(axis=1)]
    vectors, corners = triangle_vectors(shape.verts, faces), faces.ravel()
    areas = np.sqrt(squared_lengths(vectors))
    summed, total = (
        np.stack([np.bincount(corners, np.repeat(column, 3), shape.V)[asked] for column in columns])
        for columns in (vectors.T, areas[None])
    )
    total, summed = total[0], np.linalg.norm(summed, axis=0)
    # a few corners of something large and plain, such as a box that a body sits on, tell nothing of noise
    weight = np.minimum(1.0, _LARGE * np.median(total) / np.maximum(total, 1e-300))
    return float((weight * summed).sum() / max(float((weight * total).sum()), 1e-300))


def without_noise(shape: Shape, parts: int = 1) -> tuple[Shape, int]:
    """A mesh of so many parts, smoothed where noise is as large as its triangles; and how many passes that took, 0 if none.

    Taubin's: *A signal processing approach to fair surface design* (SIGGRAPH 1995).
    """
    if shape.F < _TRIANGLES * parts or coherence(shape) >= _ROUGH:
        return shape, 0
    from trimesh import Trimesh
    from trimesh.smoothing import filter_taubin, laplacian_calculation

    mesh = Trimesh(shape.verts, shape.faces, process=False)
    neighbours, smooth, passes = laplacian_calculation(mesh), shape, 0
    while passes < _MOST and coherence(smooth) < _SMOOTH:
        filter_taubin(mesh, **_PASS, laplacian_operator=neighbours)
        smooth = Shape(
            np.array(mesh.vertices), shape.faces, shape.name, shape.colors, weights=shape.weights, upright=shape.upright
        )
        passes += 1
    return smooth, passes
