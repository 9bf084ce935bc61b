"""The two maps of a pair without folds, between what nobody left out of the two shapes.

What was left out, such as the floor under a scan, is matched like the nearest vertex that was fitted, and so is a vertex
without a position or a face like the one that stands for it. Those images would count as folds, and the inverse would look
for each such vertex on all of the other shape.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from meshmatch.arrays import Int, Ints
from meshmatch.maps.unfold import unfolded, unfolded_both_ways
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.shape import Shape

_LARGEST_BOTH_WAYS = 60_000  # vertices for which both maps are made at once: of more that takes longer than matching


def unfolded_pair(
    found: VertexMap, opposite: Callable[[], VertexMap], source: Shape, target: Shape, partial: bool, workers: int = 1
) -> tuple[VertexMap, VertexMap | None]:
    """A map between two shapes with fewer folds; of two whole meshes that match well, and are not too large, with its
    inverse, which takes the place of the map that ``opposite`` makes.
    """
    if source.is_cloud or target.is_cloud:
        return found, None
    here, there = _Kept.of(source), _Kept.of(target)
    some = here.between(found, there)
    if some is None:
        return found, None
    if partial or found.verdict != "good" or max(here.shape.V, there.shape.V) > _LARGEST_BOTH_WAYS:
        return here.in_file(unfolded(some, here.shape, there.shape, workers), found, there), None
    back = opposite()
    some_back = there.between(back, here)
    if some_back is None:
        return here.in_file(unfolded(some, here.shape, there.shape, workers), found, there), None
    forward, backward = unfolded_both_ways(some, some_back, here.shape, there.shape, workers)
    return here.in_file(forward, found, there), there.in_file(backward, back, here)


def both_unfolded(
    found: VertexMap, opposite: VertexMap, source: Shape, target: Shape, partial: bool
) -> tuple[VertexMap, VertexMap]:
    """A map between two shapes and its opposite with fewer folds: as `unfolded_pair` makes them, or each by itself."""
    forward, backward = unfolded_pair(found, lambda: opposite, source, target, partial)
    return forward, backward or unfolded_pair(opposite, lambda: found, target, source, partial=True)[0]


@dataclass(frozen=True, eq=False)
class _Kept:
    """What is left of a mesh of which vertices have weight 0, no position or no face: ``shape``, of which vertices and faces
    of the file.
    """

    shape: Shape
    verts: Int[Ints, " N"]
    faces: Int[Ints, " M"]
    all_of_it: bool

    @classmethod
    def of(cls, shape: Shape) -> _Kept:
        chosen = shape.valid_faces
        if shape.weights is not None:
            chosen = chosen & (shape.weights > 0)[shape.faces].any(axis=1)  # as repair keeps them
        faces = np.flatnonzero(chosen)
        verts = np.flatnonzero(np.bincount(shape.faces[faces].ravel(), minlength=shape.V))
        if len(verts) == shape.V and len(faces) == shape.F:
            return cls(shape, verts, faces, True)
        corners = np.searchsorted(verts, shape.faces[faces])
        return cls(Shape(shape.verts[verts], corners, shape.name), verts, faces, False)

    def between(self, found: VertexMap, target: _Kept) -> VertexMap | None:
        """A map between two files as one between what is left of them; None where one has images on what is not."""
        if self.all_of_it and target.all_of_it:
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

    def in_file(self, some: VertexMap, found: VertexMap, target: _Kept) -> VertexMap:
        """A map between two files, with the images of a map between what is left of them."""
        if self.all_of_it and target.all_of_it:
            return some
        index, face, weights = found.index.copy(), found.face.copy(), found.barycentric.copy()
        index[self.verts], weights[self.verts] = target.verts[some.index], some.barycentric
        face[self.verts] = np.where(some.face >= 0, target.faces[some.face], -1)
        return replace(found, index=index, face=face, barycentric=weights)
