"""Shapes that are put together from separate parts: a part goes to its counterpart as a whole.

The template is one smooth skin. Where a shape has a joint between two solids, such as a robot's elbow, or a sleeve that ends
on an arm, the fit does not know on which side of the gap a vertex lies. The parts do: they vote. Two parts belong together
by how much of either goes to the other, and what would leave its counterparts is looked up again among them.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.sparse import csr_array

from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints
from meshmatch.geometry.triangles import face_parts, vertex_areas
from meshmatch.maps.footpoints import Footpoints, joined
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
    counterparts = _counterparts(
        _shares(own, there, own_areas, shape) + _shares(theirs, back, their_areas, shape[::-1]).T
    )
    known = np.flatnonzero((own >= 0) & (there >= 0) & (np.diff(counterparts.indptr) > 0)[own])
    pairs = np.repeat(np.arange(shape[0]), np.diff(counterparts.indptr)) * shape[1] + counterparts.indices
    astray = known[~np.isin(own[known] * shape[1] + there[known], pairs)]
    if not len(astray):
        return found
    fitted = np.flatnonzero(target.fitted)
    faces_of = _members(theirs[target.stands[target.faces[fitted, 0]]], shape[1])
    rows_of = _members(own[astray], shape[0])
    # parts with the same counterparts are looked up together: there may be thousands on one torso
    alike: dict[bytes, list[int]] = {}
    for part in np.unique(own[astray]).tolist():
        alike.setdefault(_row(counterparts, part).tobytes(), []).append(part)
    rows, again = [], []
    for same in alike.values():
        faces = np.sort(np.concatenate([fitted[faces_of(part)] for part in _row(counterparts, same[0]).tolist()]))
        rows.append(astray[np.sort(np.concatenate([rows_of(part) for part in same]))])
        again.append(target.nearest(source.resting[rows[-1]], workers, faces))
    return found.updated(np.concatenate(rows), joined(again))


def _members(part: Int[Ints, " N"], count: int) -> Callable[[int], Int[Ints, " M"]]:
    """What gives the places of a part's number, for all of ``count`` parts; sorted once."""
    order = np.argsort(part, kind="stable")
    begins = np.searchsorted(part[order], np.arange(count + 1))
    return lambda number: order[begins[number] : begins[number + 1]]


def _row(table: csr_array, part: int) -> Ints:
    return np.asarray(table.indices[table.indptr[part] : table.indptr[part + 1]])


def _counterparts(belongs: csr_array) -> csr_array:
    """Of each part those that it belongs to nearly as well as to the best; none of one that belongs nowhere."""
    table = csr_array(belongs)
    best = np.repeat(table.max(axis=1).toarray().ravel(), np.diff(table.indptr))
    table.data = np.asarray((table.data > 0) & (table.data >= _COUNTERPART * best))
    table.eliminate_zeros()
    table.sort_indices()
    return table


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
) -> csr_array:
    """How much (0..1) of each part goes to each of the other shape's: sparse, for there may be thousands of both."""
    known: Bool[Bools, " V"] = (part >= 0) & (other >= 0)
    table = csr_array((areas[known], (part[known], other[known])), shape=shape)
    table.sum_duplicates()
    table.data /= np.repeat(np.maximum(np.asarray(table.sum(axis=1)).ravel(), 1e-300), np.diff(table.indptr))
    return table
