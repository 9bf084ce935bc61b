"""Open boundaries of a mesh (rims): the ends of a bust, a half shell or a broken bone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.geometry.frames import Frame
from meshmatch.geometry.triangles import edge_lengths
from meshmatch.shapes.shape import Shape

MIN_RIM_LENGTH = 0.3  # minimum length of a rim, in units of sqrt(area); cracks of a mesh are shorter
# minimum length of all rims of a sheet: no flat shape has less than a disk's 3.54; a broken bone has 2.6
MIN_SHEET_RIMS = 3.5


def rim_lengths(shape: Shape) -> Float[Floats, " V"]:
    """Length of the connected boundary at each vertex, in units of sqrt(area); 0 for vertices that are on none."""
    edges = shape.edges.open
    graph = coo_matrix((np.ones(len(edges)), edges.T), (shape.V, shape.V))
    rim = connected_components(graph, directed=False)[1]
    lengths = np.bincount(rim[edges[:, 0]], edge_lengths(shape.verts, edges), shape.V)[rim]
    return np.asarray(lengths / np.sqrt(shape.area))


def is_sheet(shape: Shape) -> bool:
    """Whether a shape is an open sheet, such as a leaf: its rims are natural ends, unlike those of a cut shape."""
    if shape.is_cloud:
        return False
    ends = shape.edges.open[rim_lengths(shape)[shape.edges.open[:, 0]] > MIN_RIM_LENGTH]
    return bool(edge_lengths(shape.verts, ends).sum() > MIN_SHEET_RIMS * np.sqrt(shape.area))


def rim_corners(shape: Shape) -> Int[Ints, "E 3"]:
    """Both ends of each edge of a rim, and the third corner of its triangle; shorter boundaries (cracks) are ignored."""
    faces = np.asarray(shape.faces)
    corners = np.concatenate([faces, faces[:, [1, 2, 0]], faces[:, [2, 0, 1]]])
    corners = corners[(rim_lengths(shape) > MIN_RIM_LENGTH)[corners[:, :2]].all(axis=1)]
    keys = np.sort(corners[:, :2], axis=1) @ np.array([shape.V, 1])
    first, faces_at = np.unique(keys, return_index=True, return_counts=True)[1:]
    return np.asarray(corners[first[faces_at == 1]])


def rim_edges(
    verts: Float[Floats, "V 3"], corners: Int[Ints, "E 3"]
) -> tuple[Float[Floats, " E"], Float[Floats, "E 3"], Float[Floats, "E 3"]]:
    """Length of each rim edge, and unit vectors that point out of the surface there, and along the edge."""
    a, b, c = verts[corners.T]
    length = np.linalg.norm(b - a, axis=1)
    along = (b - a) / np.maximum(length, 1e-300)[:, None]
    out = (a - c) - ((a - c) * along).sum(axis=1, keepdims=True) * along
    return length, out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-300), along


@dataclass(frozen=True, eq=False)
class RimPoints:
    """Points along the rims of a mesh, with unit vectors that point out of the surface, and along the rim."""

    points: Float[Floats, "P 3"]
    outward: Float[Floats, "P 3"]
    along: Float[Floats, "P 3"]

    @classmethod
    def of(cls, shape: Shape, step: float) -> RimPoints:
        """Points at most ``step`` apart (in units of sqrt(area)); none for a shape without a rim."""
        corners = rim_corners(shape)
        length, outward, along = rim_edges(shape.verts, corners)
        count = np.ceil(np.maximum(length / (step * np.sqrt(shape.area)), 1.0)).astype(np.int64)
        edge = np.repeat(np.arange(len(corners)), count)
        share = (np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count) + 0.5) / count[edge]
        a, b, _ = shape.verts[corners[edge].T]
        return cls(a + share[:, None] * (b - a), outward[edge], along[edge])

    def in_frame(self, frame: Frame) -> RimPoints:
        """The points and vectors in another frame."""
        return RimPoints(frame.apply(self.points), self.outward @ frame.rotation.T, self.along @ frame.rotation.T)
