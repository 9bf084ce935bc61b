"""Blendshapes: named displacements of a mesh's vertices, such as facial expressions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from meshmatch.arrays import Float, Floats, Floats32, ShortRepr
from meshmatch.geometry.triangles import same_rows, vertex_normals
from meshmatch.shapes.shape import Shape


@dataclass(frozen=True, eq=False, repr=False)
class WeightClip(ShortRepr):
    """An animation clip of blendshapes: the weights of all of them at each time.

    Cubic splines have three rows for each time: the incoming slopes, the weights and the outgoing slopes.
    """

    name: str
    times: Float[Floats, " T"]  # seconds
    weights: Float[Floats, "N K"]
    interpolation: str


@dataclass(frozen=True, eq=False, repr=False)
class BlendShapes(ShortRepr):
    """Blendshapes of one mesh, or morph targets as glTF calls them.

    Attributes
    ----------
    names
        Unique names of the K shapes.
    moves
        (K, V, 3) float32: displacement of each vertex when a shape is fully on, in the frame and unit of the mesh's file.
    weights
        (K,) weight of each shape when the file is opened.
    normals
        Whether the file has normals for each shape as well.
    clips
        Animation clips of the weights.
    """

    names: tuple[str, ...]
    moves: Float[Floats32, "K V 3"]
    weights: Float[Floats, " K"]
    normals: bool = True
    clips: tuple[WeightClip, ...] = ()


def shape_normals(shape: Shape, moves: Float[Floats32, "K V 3"]) -> Float[Floats32, "N V 3"]:
    """Smooth normals of the mesh at rest and with each of the K shapes fully on; vertices at one position share theirs."""
    twin = same_rows(shape.verts)
    faces = twin[shape.faces]
    places = (shape.verts, *(shape.verts + move for move in moves))
    return np.stack([vertex_normals(verts, faces)[twin].astype(np.float32) for verts in places])
