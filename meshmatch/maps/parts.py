"""Shapes that are put together from separate parts: a part goes to its counterpart as a whole.

The template is one smooth skin. Where a shape has a joint between two solids, such as a robot's elbow, or a sleeve that ends
on an arm, the fit does not know on which side of the gap a vertex lies. The parts do: they vote. Two parts belong together
by how much of either goes to the other, and what would leave its counterparts is looked up again among them.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array

from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints
from meshmatch.geometry.triangles import face_parts, vertex_areas
from meshmatch.maps.footpoints import Footpoints
from meshmatch.maps.places import Places

# Set by hand, on generated robots and soldiers. A shape is put together if it has so many parts of at least this share of
# its surface, and none of them is nearly all of it.
_FEWEST, _SMALLEST, _LARGEST = 4, 0.01, 0.6
# A part's counterparts are those that it belongs to so well, against the best: a long sleeve goes to a short one and to
# the bare arm.
_COUNTERPART = 0.65


def kept_together(source: Places, target: Places, found: Footpoints, workers: int = 1) -> Footpoints:
    """Footpoints on the target of all source vertices, on the counterparts of their parts.

    They are ``found`` where they lie there already, and everywhere if not both shapes are put together from parts.
    """
    parts = {}
    # the smaller shape first: of millions of faces not without need
    for places in sorted((source, target), key=lambda places: len(places.faces)):
        parts[id(places)] = _parts(places)
        if not _put_together(*parts[id(places)]):
            return found
    (own, own_areas), (theirs, their_areas) = parts[id(source)], parts[id(target)]
    back = own[source.nearest(target.resting, workers).vertex]
    there = theirs[found.vertex]
    shape = int(own.max()) + 1, int(theirs.max()) + 1
    belongs = _shares(own, there, own_areas, shape) + _shares(theirs, back, their_areas, shape[::-1]).T
    counterparts = belongs >= _COUNTERPART * belongs.max(1, keepdims=True)
    astray = (own >= 0) & (there >= 0) & ~counterparts[own, there]
    part_of_face = theirs[target.stands[target.faces[:, 0]]]
    for part in np.unique(own[astray]):
        rows = np.flatnonzero(astray & (own == part))
        faces = np.flatnonzero(target.fitted & np.isin(part_of_face, np.flatnonzero(counterparts[part])))
        found = found.updated(rows, target.nearest(source.resting[rows], workers, faces))
    return found


def _parts(places: Places) -> tuple[Int[Ints, " V"], Float[Floats, " V"]]:
    """The number of each vertex's connected part (-1: of none), and the area around it on the resting template."""
    V = len(places.stands)
    faces = places.stands[places.faces[places.fitted]].astype(np.int64)
    part = np.full(V, -1, np.int64)
    if not len(faces):
        return part, np.zeros(V)
    part[faces] = face_parts(faces, V)[:, None]
    return part[places.stands], vertex_areas(places.resting.astype(np.float64), faces)


def _put_together(part: Int[Ints, " V"], areas: Float[Floats, " V"]) -> bool:
    """Whether a shape consists of several parts that matter."""
    if not areas.sum() > 0:
        return False
    shares = np.bincount(part[part >= 0], areas[part >= 0]) / areas.sum()
    return bool((shares >= _SMALLEST).sum() >= _FEWEST and shares.max() <= _LARGEST)


def _shares(
    part: Int[Ints, " V"], other: Int[Ints, " V"], areas: Float[Floats, " V"], shape: tuple[int, int]
) -> Float[Floats, "P Q"]:
    """How much (0..1) of each part goes to each of the other shape's."""
    known: Bool[Bools, " V"] = (part >= 0) & (other >= 0)
    table = csr_array((areas[known], (part[known], other[known])), shape=shape).toarray()
    return np.asarray(table / np.maximum(table.sum(1, keepdims=True), 1e-300))
