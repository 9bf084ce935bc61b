"""Match the separate parts of two shapes as wholes.

The template is one smooth skin. Where a shape has a joint between two solids, such as a robot's elbow, or a sleeve that ends
on an arm, the fit does not know on which side of the gap a vertex lies. The parts decide by vote: two parts correspond
according to the share of each that is mapped to the other. Vertices that are mapped outside the counterparts of their part
are matched again, to the counterparts only.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.sparse import csr_array

from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints
from meshmatch.geometry.triangles import face_parts, vertex_areas
from meshmatch.maps.footpoints import Footpoints, concatenated
from meshmatch.maps.places import Places

# Set by hand, on generated robots and soldiers. A shape is multipart if it has at least this many parts of at least this
# share of its surface, and no part with more than the last share.
_MIN_PARTS, _MIN_SHARE, _MAX_SHARE = 4, 0.01, 0.6
# The counterparts of a part are those whose overlap is at least this share of the best: a long sleeve has two, a short
# sleeve and the bare arm.
_MIN_OVERLAP = 0.65


def match_parts(source: Places, target: Places, found: Footpoints, workers: int = 1) -> Footpoints:
    """Move footpoints of source vertices onto the counterparts of their parts.

    Footpoints ``found`` that lie on a counterpart already are unchanged, as are all if either shape is not multipart.
    """
    parts = {}
    # the smaller shape first: if it is not multipart, the larger one, with millions of faces, is not examined
    for places in sorted((source, target), key=lambda places: len(places.faces)):
        parts[id(places)] = _connected_parts(places)
        if not _is_multipart(*parts[id(places)]):
            return found
    (own, own_areas), (theirs, their_areas) = parts[id(source)], parts[id(target)]
    back = own[source.nearest(target.resting, workers).vertex]
    there = theirs[found.vertex]
    shape = int(own.max()) + 1, int(theirs.max()) + 1
    counterparts = _find_counterparts(
        _overlaps(own, there, own_areas, shape) + _overlaps(theirs, back, their_areas, shape[::-1]).T
    )
    known = np.flatnonzero((own >= 0) & (there >= 0) & (np.diff(counterparts.indptr) > 0)[own])
    pairs = np.repeat(np.arange(shape[0]), np.diff(counterparts.indptr)) * shape[1] + counterparts.indices
    astray = known[~np.isin(own[known] * shape[1] + there[known], pairs)]
    if not len(astray):
        return found
    fitted = np.flatnonzero(target.fitted)
    faces_of = _member_lookup(theirs[target.stands[target.faces[fitted, 0]]], shape[1])
    rows_of = _member_lookup(own[astray], shape[0])
    # one search for all parts with the same counterparts: there may be thousands on one torso
    alike: dict[bytes, list[int]] = {}
    for part in np.unique(own[astray]).tolist():
        alike.setdefault(_row(counterparts, part).tobytes(), []).append(part)
    rows, again = [], []
    for same in alike.values():
        faces = np.sort(np.concatenate([fitted[faces_of(part)] for part in _row(counterparts, same[0]).tolist()]))
        rows.append(astray[np.sort(np.concatenate([rows_of(part) for part in same]))])
        again.append(target.nearest(source.resting[rows[-1]], workers, faces))
    return found.updated(np.concatenate(rows), concatenated(again))


def _member_lookup(part: Int[Ints, " N"], count: int) -> Callable[[int], Int[Ints, " M"]]:
    """Return a function from the number of a part to the indices of its members; sorts once."""
    order = np.argsort(part, kind="stable")
    begins = np.searchsorted(part[order], np.arange(count + 1))
    return lambda number: order[begins[number] : begins[number + 1]]


def _row(table: csr_array, part: int) -> Ints:
    return np.asarray(table.indices[table.indptr[part] : table.indptr[part + 1]])


def _find_counterparts(overlaps: csr_array) -> csr_array:
    """Counterparts of each part: those with nearly the largest overlap; none without overlap."""
    table = csr_array(overlaps)
    best = np.repeat(table.max(axis=1).toarray().ravel(), np.diff(table.indptr))
    table.data = np.asarray((table.data > 0) & (table.data >= _MIN_OVERLAP * best))
    table.eliminate_zeros()
    table.sort_indices()
    return table


def _connected_parts(places: Places) -> tuple[Int[Ints, " V"], Float[Floats, " V"]]:
    """Connected part of each vertex (-1 if it is in none), and the area around it on the rest template."""
    V = len(places.stands)
    faces = places.stands[places.faces[places.fitted]].astype(np.int64)
    part = np.full(V, -1, np.int64)
    if not len(faces):
        return part, np.zeros(V)
    part[faces] = face_parts(faces, V)[:, None]
    return part[places.stands], vertex_areas(places.resting.astype(np.float64), faces)


def _is_multipart(part: Int[Ints, " V"], areas: Float[Floats, " V"]) -> bool:
    """Whether a shape consists of several large parts."""
    if not areas.sum() > 0:
        return False
    shares = np.bincount(part[part >= 0], areas[part >= 0]) / areas.sum()
    return bool((shares >= _MIN_SHARE).sum() >= _MIN_PARTS and shares.max() <= _MAX_SHARE)


def _overlaps(
    part: Int[Ints, " V"], other: Int[Ints, " V"], areas: Float[Floats, " V"], shape: tuple[int, int]
) -> csr_array:
    """Share (0..1) of each part that is mapped to each part of the other shape; sparse, as there may be thousands."""
    known: Bool[Bools, " V"] = (part >= 0) & (other >= 0)
    table = csr_array((areas[known], (part[known], other[known])), shape=shape)
    table.sum_duplicates()
    table.data /= np.repeat(np.maximum(np.asarray(table.sum(axis=1)).ravel(), 1e-300), np.diff(table.indptr))
    return table
