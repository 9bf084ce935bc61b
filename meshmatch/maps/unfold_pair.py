"""Remove folds from the maps of a pair of shapes, restricted to the parts that were fitted.

What was left out, such as the floor under a scan, is matched like the nearest vertex that was fitted; a vertex without a
position or a face is matched like its representative. Such images would count as folds, and an inverse would search the
whole other shape for each such vertex.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from meshmatch.arrays import Int, Ints
from meshmatch.maps.unfold import unfold, unfold_both_ways
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.shape import Shape

_MAX_BOTH_WAYS = 60_000  # vertices up to which both maps are unfolded together: beyond, that takes longer than matching


def unfold_pair(
    found: VertexMap, opposite: Callable[[], VertexMap], source: Shape, target: Shape, partial: bool, workers: int = 1
) -> tuple[VertexMap, VertexMap | None]:
    """Reduce the folds of a map between two shapes.

    For two whole meshes with a good match, and not too large, the second result is the inverse, which replaces the map that
    ``opposite`` makes; otherwise it is None. Maps from or to clouds are returned unchanged.
    """
    if source.is_cloud or target.is_cloud:
        return found, None
    a, b = _FittedPart.of(source), _FittedPart.of(target)
    inside = a.between(found, b)
    if inside is None:
        return found, None
    if partial or found.verdict != "good" or max(a.shape.V, b.shape.V) > _MAX_BOTH_WAYS:
        return a.in_file(unfold(inside, a.shape, b.shape, workers), found, b), None
    back = opposite()
    inside_back = b.between(back, a)
    if inside_back is None:
        return a.in_file(unfold(inside, a.shape, b.shape, workers), found, b), None
    forward, backward = unfold_both_ways(inside, inside_back, a.shape, b.shape, workers)
    return a.in_file(forward, found, b), b.in_file(backward, back, a)


def unfold_both(
    found: VertexMap, opposite: VertexMap, source: Shape, target: Shape, partial: bool
) -> tuple[VertexMap, VertexMap]:
    """Reduce the folds of a map and of its opposite: together where `unfold_pair` does so, otherwise independently."""
    forward, backward = unfold_pair(found, lambda: opposite, source, target, partial)
    return forward, backward or unfold_pair(opposite, lambda: found, target, source, partial=True)[0]


@dataclass(frozen=True, eq=False)
class _FittedPart:
    """A mesh without the vertices that have weight 0, no position or no face.

    ``verts`` and ``faces`` are the indices, in the file, of the vertices and faces of ``shape``.
    """

    shape: Shape
    verts: Int[Ints, " N"]
    faces: Int[Ints, " M"]
    is_whole: bool

    @classmethod
    def of(cls, shape: Shape) -> _FittedPart:
        chosen = shape.valid_faces
        if shape.weights is not None:
            chosen = chosen & (shape.weights > 0)[shape.faces].any(axis=1)  # as repair keeps them
        faces = np.flatnonzero(chosen)
        verts = np.flatnonzero(np.bincount(shape.faces[faces].ravel(), minlength=shape.V))
        if len(verts) == shape.V and len(faces) == shape.F:
            return cls(shape, verts, faces, True)
        corners = np.searchsorted(verts, shape.faces[faces])
        return cls(Shape(shape.verts[verts], corners, shape.name), verts, faces, False)

    def between(self, found: VertexMap, target: _FittedPart) -> VertexMap | None:
        """Restrict a map between two files to the fitted parts; None if an image lies outside the target's."""
        if self.is_whole and target.is_whole:
            return found
        index, face = found.index[self.verts], found.face[self.verts]
        vertex = np.minimum(np.searchsorted(target.verts, index), len(target.verts) - 1)
        number = np.minimum(np.searchsorted(target.faces, face), len(target.faces) - 1)
        on_face = face >= 0
        if (target.verts[vertex] != index).any() or (target.faces[number] != face)[on_face].any():
            return None
        arrays = {"barycentric": found.barycentric[self.verts], "confidence": found.confidence[self.verts]}
        face = np.where(on_face, number, -1)
        return VertexMap.between(self.shape, target.shape, vertex, face=face, verdict=found.verdict, **arrays)

    def in_file(self, some: VertexMap, found: VertexMap, target: _FittedPart) -> VertexMap:
        """Insert the images of a map between the fitted parts into a map between the files."""
        if self.is_whole and target.is_whole:
            return some
        index, face, weights = found.index.copy(), found.face.copy(), found.barycentric.copy()
        index[self.verts], weights[self.verts] = target.verts[some.index], some.barycentric
        face[self.verts] = np.where(some.face >= 0, target.faces[some.face], -1)
        return replace(found, index=index, face=face, barycentric=weights)
