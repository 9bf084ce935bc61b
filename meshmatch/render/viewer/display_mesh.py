"""What a page draws of a shape: all of it, or a coarser version of a large one."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.shapes.decimate import decimate
from meshmatch.shapes.duplicates import seams
from meshmatch.shapes.shape import Shape

MAX_VERTICES = 150_000
"""Vertices up to which a shape is drawn in full."""
NO_FACES = np.empty((0, 3), np.int64)
_NONE = np.empty(0, np.int64)
_REDUCED = 2 / 3  # of `MAX_VERTICES` are drawn of a larger one
_NORMAL_WEIGHT = 3.0  # mean edges of the drawn mesh that an opposite normal pushes a vertex away


@dataclass(frozen=True, eq=False)
class DisplayMesh:
    """What is drawn of a shape, in the file's own frame and unit.

    Parameters
    ----------
    faces
        Triangles; none where points are drawn.
    normals
        Unit, the same on both sides of a texture seam; zeros where there is none.
    vertex
        The vertex of the file that each one stands for.
    file_face
        The face of the file that each triangle is; empty where the surface is drawn coarser.
    note
        What was left out, for people; empty if nothing was.
    """

    verts: Float[Floats, "N 3"]
    faces: Int[Ints, "M 3"]
    normals: Float[Floats, "N 3"]
    vertex: Int[Ints, " N"]
    file_face: Int[Ints, " K"]
    note: str = ""

    @property
    def radius(self) -> float:
        """Half the distance from a point to its fifth neighbor: balls that nearly touch. 0 for triangles."""
        if len(self.faces) or len(self.verts) < 2:
            return 0.0
        some = self.verts[:: max(1, len(self.verts) // 2_000)]
        reach, _ = cKDTree(self.verts).query(some, k=min(6, len(self.verts)))
        return float(np.median(reach[:, -1])) / 2

    @cached_property
    def used(self) -> Int[Ints, " K"]:
        """Rows that can be seen: those of a face, or every point."""
        return _corners(self.faces, len(self.verts)) if len(self.faces) else np.arange(len(self.verts))


def display_mesh(shape: Shape, max_vertices: int = MAX_VERTICES) -> DisplayMesh:
    """What to draw of a shape: no vertex without a position, and a coarser surface if it has more than ``max_vertices``."""
    valid = np.ones(shape.V, bool) if shape.invalid is None else ~shape.invalid
    if not valid.any():  # no position is known: still a page
        valid[:] = True
    if shape.is_cloud:
        return _some_points(shape, np.flatnonzero(valid), max_vertices)
    valid_faces = np.flatnonzero(valid[shape.faces].all(axis=1))
    faces = shape.faces[valid_faces]
    if len(faces) == 0:
        return _some_points(shape, np.flatnonzero(valid), max_vertices)
    joined = seams(shape.verts, faces)
    smooth = Shape(shape.verts, joined[faces]).vertex_normals[joined]
    if shape.V <= max_vertices:
        return DisplayMesh(shape.verts, faces, smooth, np.arange(shape.V), valid_faces)
    coarse = decimate(_compact(shape.verts, joined[faces]), 2 * int(_REDUCED * max_vertices))
    if coarse.V > max_vertices:  # a heap of unconnected triangles cannot be simplified
        return _some_points(shape, _corners(faces, shape.V), max_vertices)
    normals = coarse.vertex_normals
    vertex = _represented(coarse, shape.verts, smooth, _corners(faces, shape.V))
    note = f"drawn with {coarse.V:,} of {shape.V:,} vertices"
    return DisplayMesh(coarse.verts, coarse.faces, normals, vertex, _NONE, note)


def _some_points(shape: Shape, rows: Int[Ints, " K"], max_vertices: int) -> DisplayMesh:
    note = ""
    if len(rows) > max_vertices:
        count = len(rows)
        rows = rows[np.linspace(0, count - 1, int(_REDUCED * max_vertices)).astype(np.int64)]
        note = f"drawn with {len(rows):,} of {count:,} points"
    normals = (Shape(shape.verts[rows], NO_FACES) if shape.is_cloud else shape).vertex_normals
    normals = normals if shape.is_cloud else normals[rows]
    return DisplayMesh(shape.verts[rows], NO_FACES, normals, rows, _NONE, note)


def _compact(verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"]) -> Shape:
    used = _corners(faces, len(verts))
    new = np.empty(len(verts), np.int64)
    new[used] = np.arange(len(used))
    return Shape(verts[used], new[faces])


def _corners(faces: Int[Ints, "F 3"], V: int) -> Int[Ints, " K"]:
    """The vertices of any face, in order."""
    seen = np.zeros(V, bool)
    seen[faces] = True
    return np.flatnonzero(seen)


def _represented(
    coarse: Shape, verts: Float[Floats, "V 3"], normals: Float[Floats, "V 3"], used: Int[Ints, " K"]
) -> Int[Ints, " N"]:
    """For each vertex of the coarse mesh the closest used one of the file that faces the same way."""
    edges = coarse.verts[coarse.faces] - coarse.verts[np.roll(coarse.faces, 1, axis=1)]
    weight = _NORMAL_WEIGHT * float(np.linalg.norm(edges, axis=2).mean()) / 2
    tree = cKDTree(np.hstack([verts[used], weight * normals[used]]))
    return np.asarray(used[tree.query(np.hstack([coarse.verts, weight * coarse.vertex_normals]))[1]])
