"""Noise of meshes: how much of it there is, and a surface without it."""

from __future__ import annotations

import numpy as np

from meshmatch.shapes.shape import Shape

# Set by hand. Of noisy scans, dressed bodies and animals none is below 0.89; noise as large as the triangles makes 0.3 to
# 0.64, twice to ten times the area, and normals that say nothing.
_ROUGH, _SMOOTH = 0.75, 0.94
_MOST = 60  # passes
_PASS = {"lamb": 0.5, "nu": 0.53, "iterations": 2}  # a step inwards and a step outwards: the volume stays
# What is made of plain solids has few triangles a part; their corners are no noise.
_TRIANGLES = 100


def coherence(shape: Shape) -> float:
    """How far (0..1) the triangles around a vertex face the same way: the length of the mean normal, by area."""
    along = (shape.face_vectors * shape.vertex_normals[shape.faces].mean(axis=1)).sum()
    return float(0.5 * along / shape.area)


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
        smooth = Shape(np.array(mesh.vertices), shape.faces, shape.name, shape.colors, weights=shape.weights)
        passes += 1
    return smooth, passes
