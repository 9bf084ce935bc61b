"""What of a shape a page draws: all of it, or less of a large one."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from meshmatch.arrays import Floats, Ints
from meshmatch.shapes.debris import seams
from meshmatch.shapes.decimate import decimate
from meshmatch.shapes.shape import Shape

MOST = 150_000
"""Vertices up to which a shape is drawn whole."""
NO_FACES = np.empty((0, 3), np.int64)
_NONE = np.empty(0, np.int64)
_LEAN = 2 / 3  # of `MOST` is drawn of a larger one
_NORMAL_WEIGHT = 3.0  # mean edges of the drawn mesh that an opposite normal pushes a vertex away


@dataclass(frozen=True, eq=False)
class Drawn:
    """The part of a shape that is drawn.

    Parameters
    ----------
    verts : (N, 3) float64
        Positions, the file's own frame and unit.
    faces : (M, 3) int64
        Triangles of these; (0, 3) where points are drawn.
    normals : (N, 3) float64
        Unit normals, the same on both sides of a texture seam; zeros where there is none.
    vertex : (N,) int64
        The vertex of the file that each stands for.
    file_face : (M,) int64
        The face of the file that each triangle is; empty where the surface is drawn coarser.
    note : str
        What was left out, for people; empty if nothing was.
    """

    verts: Floats
    faces: Ints
    normals: Floats
    vertex: Ints
    file_face: Ints
    note: str = ""

    @property
    def radius(self) -> float:
        """Half the way from a point to its sixth nearest: balls that nearly touch. 0 for triangles."""
        if len(self.faces) or len(self.verts) < 2:
            return 0.0
        some = self.verts[:: max(1, len(self.verts) // 2_000)]
        reach, _ = cKDTree(self.verts).query(some, k=min(6, len(self.verts)))
        return float(np.median(reach[:, -1])) / 2

    @cached_property
    def used(self) -> Ints:
        """Rows that can be seen: those of a face, or every point."""
        return _corners(self.faces, len(self.verts)) if len(self.faces) else np.arange(len(self.verts))


def draw(shape: Shape, most: int = MOST) -> Drawn:
    """What to draw of a shape: no vertex without a position, and of more than `most` a coarser surface."""
    valid = np.ones(shape.V, bool) if shape.invalid is None else ~shape.invalid
    if not valid.any():  # nothing but stand-ins: still a page
        valid[:] = True
    if shape.is_cloud:
        return _some_points(shape, np.flatnonzero(valid), most)
    sound = np.flatnonzero(valid[shape.faces].all(axis=1))
    faces = shape.faces[sound]
    if len(faces) == 0:
        return _some_points(shape, np.flatnonzero(valid), most)
    joined = seams(shape.verts, faces)
    smooth = Shape(shape.verts, joined[faces]).vertex_normals[joined]
    if shape.V <= most:
        return Drawn(shape.verts, faces, smooth, np.arange(shape.V), sound)
    coarse = decimate(_compact(shape.verts, joined[faces]), 2 * int(_LEAN * most))
    if coarse.V > most:  # nothing that holds together: a heap of single triangles
        return _some_points(shape, _corners(faces, shape.V), most)
    normals = coarse.vertex_normals
    vertex = _stands_for(coarse, shape.verts, smooth, _corners(faces, shape.V))
    note = f"drawn with {coarse.V:,} of {shape.V:,} vertices"
    return Drawn(coarse.verts, coarse.faces, normals, vertex, _NONE, note)


def _some_points(shape: Shape, rows: NDArray[np.int64], most: int) -> Drawn:
    note = ""
    if len(rows) > most:
        count = len(rows)
        rows = rows[np.linspace(0, count - 1, int(_LEAN * most)).astype(np.int64)]
        note = f"drawn with {len(rows):,} of {count:,} points"
    normals = (Shape(shape.verts[rows], NO_FACES) if shape.is_cloud else shape).vertex_normals
    normals = normals if shape.is_cloud else normals[rows]
    return Drawn(shape.verts[rows], NO_FACES, normals, rows, _NONE, note)


def _compact(verts: Floats, faces: Ints) -> Shape:
    used = _corners(faces, len(verts))
    new = np.empty(len(verts), np.int64)
    new[used] = np.arange(len(used))
    return Shape(verts[used], new[faces])


def _corners(faces: Ints, V: int) -> Ints:
    """The vertices of some face, in order."""
    seen = np.zeros(V, bool)
    seen[faces] = True
    return np.flatnonzero(seen)


def _stands_for(coarse: Shape, verts: Floats, normals: Floats, used: Ints) -> Ints:
    """(N,) for each vertex of the coarse mesh the nearest used one of the file that faces the same way."""
    edges = coarse.verts[coarse.faces] - coarse.verts[np.roll(coarse.faces, 1, axis=1)]
    weight = _NORMAL_WEIGHT * float(np.linalg.norm(edges, axis=2).mean()) / 2
    tree = cKDTree(np.hstack([verts[used], weight * normals[used]]))
    return np.asarray(used[tree.query(np.hstack([coarse.verts, weight * coarse.vertex_normals]))[1]])
