"""Blendshapes: named displacements of a mesh's vertices, as expressions of a face are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from meshmatch.arrays import Brief, Float, Floats, Floats32
from meshmatch.geometry.triangles import same_rows, vertex_normals
from meshmatch.shapes.shape import Shape


@dataclass(frozen=True, eq=False, repr=False)
class WeightClip(Brief):
    """A clip that animates blendshapes: the weights of all of them at each time.

    Of a cubic spline there are three rows for each time: the slopes before it, the weights and the slopes after it.
    """

    name: str
    times: Float[Floats, " T"]  # seconds
    weights: Float[Floats, "N K"]
    interpolation: str


@dataclass(frozen=True, eq=False, repr=False)
class BlendShapes(Brief):
    """Blendshapes of one mesh, or morph targets as glTF calls them.

    Attributes
    ----------
    names
        Of the K shapes, none twice.
    moves
        (K, V, 3) float32: where each vertex goes when a shape is fully on, minus where it is; in the frame and unit of
        the mesh's file.
    weights
        (K,) how much of each shape is on when the file is opened.
    normals
        Whether the file has the directions of normals for each shape as well.
    clips
        Clips that animate them.
    """

    names: tuple[str, ...]
    moves: Float[Floats32, "K V 3"]
    weights: Float[Floats, " K"]
    normals: bool = True
    clips: tuple[WeightClip, ...] = ()


def shape_normals(shape: Shape, moves: Float[Floats32, "K V 3"]) -> Float[Floats32, "N V 3"]:
    """Smooth normals at rest, and with each of the K shapes on; vertices at one place share theirs."""
    twin = same_rows(shape.verts)
    faces = twin[shape.faces]
    places = (shape.verts, *(shape.verts + move for move in moves))
    return np.stack([vertex_normals(verts, faces)[twin].astype(np.float32) for verts in places])
