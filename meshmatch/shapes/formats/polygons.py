"""Triangles of polygons, without new vertices: fans of convex ones, and ears cut off those with corners that turn back.

What lies on a polygon's corners, such as texture coordinates, is split with it: triangles are given by places in the list
of all corners, so that one answer serves for everything that is listed alike.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshmatch.arrays import Bools, Float, Floats, Int, Ints
from meshmatch.errors import warn
from meshmatch.geometry.triangles import cross_product, dot
from meshmatch.shapes.formats import fan, runs
from meshmatch.shapes.shape import LARGEST

MOST_CORNERS = 16_384
"""Of a concave polygon whose ears are looked for, which takes time with the square of them."""
MOST_TESTS = 300_000_000
"""The sum of those squares for a file: some ten seconds."""
_BENT = 1e-3  # radians that a polygon's corners may turn back, in all, and still count as convex
_TOGETHER = 1 << 18  # corners
_FLAT = 1e-12  # of the square of a polygon's extent: a doubled area that is rounding
_ON = 1e-9  # the same for a corner on the edge of an ear


def triangles_of(
    name: str, verts: Float[Floats, "V 3"], corners: Int[Ints, " N"], sizes: Int[Ints, " P"]
) -> Int[Ints, "F 3"]:
    """Places in `corners` of the triangles of polygons, n - 2 for one of n corners and none for fewer than 3.

    A convex polygon a b c d ... becomes the fan a b c, a c d, ...; a quad that is not is split along its inner diagonal, and
    of larger ones ears are cut, as they look along their mean normal. A polygon that crosses itself, that has no area or a
    corner without a position, becomes a fan. So does one with more than `MOST_CORNERS`, which is said (`MeshmatchWarning`).

    `corners` are numbers of vertices, one polygon after the other, of which `sizes` has how many each has; `name` is the
    file's.
    """
    triangles = fan(np.arange(len(corners)), sizes)
    if len(verts) == 0 or not (sizes > 3).any():
        return triangles
    starts, counts = np.cumsum(sizes) - sizes, np.maximum(sizes - 2, 0)

    def places_of(polygons: Ints) -> Floats:
        """Positions of the corners of some polygons, one after the other; nan for one that has none."""
        number = corners[runs(starts[polygons], sizes[polygons])]
        found = verts[np.clip(number, 0, len(verts) - 1)]
        found[(number < 0) | (number >= len(verts)) | ~(np.abs(found) < LARGEST).all(axis=1)] = np.nan
        return found

    larger = np.flatnonzero(sizes > 3)
    batches = np.split(larger, np.flatnonzero(np.diff(np.cumsum(sizes[larger]) // _TOGETHER)) + 1)
    bent = np.concatenate([few[_turns_back(places_of(few), sizes[few])] for few in batches])
    bent = bent[np.argsort(sizes[bent], kind="stable")]
    tests = np.cumsum(sizes[bent].astype(np.float64) ** 2)
    chosen = bent[(sizes[bent] <= MOST_CORNERS) & (tests <= MOST_TESTS)]
    begins = np.cumsum(counts) - counts
    for few in _alike(chosen, sizes):
        own = sizes[few]
        cut, whole = _ears(_flattened(places_of(few), own), own)
        rows = runs(begins[few][whole], counts[few][whole])
        shifted = cut[whole] + starts[few][whole][:, None, None]
        triangles[rows] = shifted[np.arange(cut.shape[1]) < counts[few][whole][:, None]]
    if len(chosen) < len(bent):
        left_out = len(bent) - len(chosen)
        many = f"{left_out:,} polygons have" if left_out > 1 else "a polygon has"
        warn(f"{name}: {many} too many corners; what is concave there is split into triangles that overlap")
    return triangles


def of_most_triangles(arrays: Mapping[str, NDArray[Any]], sizes: Int[Ints, " P"]) -> dict[str, NDArray[Any]]:
    """Arrays (F, ...) for the triangles of polygons as arrays (P, ...) for polygons, of so many corners each.

    A polygon has what most of its triangles have, by the first of the arrays; one without triangles has -1, or 0 of what is
    never negative.
    """
    codes = np.unique(next(iter(arrays.values())), return_inverse=True)[1].reshape(-1)
    polygon = np.repeat(np.arange(len(sizes)), np.maximum(sizes - 2, 0))
    _, which, counts = np.unique(polygon * (codes.max(initial=0) + 1) + codes, return_inverse=True, return_counts=True)
    order = np.lexsort((np.arange(len(codes)), -counts[which.reshape(-1)], polygon))
    chosen = np.full(len(sizes), -1)
    owners, first = np.unique(polygon[order], return_index=True)
    chosen[owners] = order[first]
    none = {label: np.full_like(each[:1], 0 if each.dtype.kind == "u" else -1) for label, each in arrays.items()}
    return {label: np.append(each, none[label], axis=0)[chosen] for label, each in arrays.items()}


def _alike(polygons: Ints, sizes: Ints) -> Iterator[Ints]:
    """Polygons, sorted by size, of sizes that differ by less than twice; some `_TOGETHER` corners at a time."""
    log = np.ceil(np.log2(np.maximum(sizes[polygons], 8))).astype(np.int64)
    for each in np.unique(log).tolist():
        same = polygons[log == each]
        yield from np.array_split(same, max(1, -(-(len(same) << each) // _TOGETHER)))


def _sines(edges: Floats, before: Floats, normal: Floats) -> Floats:
    """(N,) sine of the turn at each corner, seen along a normal; 0 at an edge of no length."""
    turn = dot(cross_product(before, edges), normal)
    size = np.prod([np.sqrt(dot(each, each)) for each in (before, edges, normal)], axis=0)
    return np.asarray(np.divide(turn, size, out=np.zeros_like(turn), where=size > 0))


def _neighbours(sizes: Ints) -> tuple[Ints, Ints]:
    """Of polygons that are listed one after the other: (N,) the place of the corner before and after each."""
    begins = np.cumsum(sizes) - sizes
    place = np.arange(int(sizes.sum()))
    before, after = place - 1, place + 1
    before[begins] = begins + sizes - 1
    after[begins + sizes - 1] = begins
    return before, after


def _normals(places: Floats, sizes: Ints) -> Floats:
    """(P, 3) Newell's normal of each polygon, twice its area long; positions are measured from its first corner."""
    after = _neighbours(sizes)[1]
    begins = np.cumsum(sizes) - sizes
    own = places - np.repeat(places[begins], sizes, axis=0)
    return np.add.reduceat(cross_product(own, own[after]), begins, axis=0)


def _turns_back(places: Floats, sizes: Ints) -> Bools:
    """(P,) True for a polygon whose corners turn back, by more than what may be rounding."""
    before, after = _neighbours(sizes)
    edges = places[after] - places
    sines = _sines(edges, edges[before], np.repeat(_normals(places, sizes), sizes, axis=0))
    begins = np.cumsum(sizes) - sizes
    return np.asarray(np.add.reduceat(np.maximum(-sines, 0.0), begins) > _BENT)


def _flattened(places: Floats, sizes: Ints) -> Floats:
    """(P, largest, 2) positions of corners as they look along the normal of their polygon, counter-clockwise, in units of
    its extent; nan beyond its corners.
    """
    begins = np.cumsum(sizes) - sizes
    normal = _normals(places, sizes)
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    axis = np.eye(3)[np.abs(normal).argmin(axis=1)]
    right = np.cross(axis, normal)
    right /= np.linalg.norm(right, axis=1)[:, None]
    up = np.cross(normal, right)
    own = places - np.repeat(places[begins], sizes, axis=0)
    flat = np.stack([dot(own, np.repeat(each, sizes, axis=0)) for each in (right, up)], axis=1)
    extent = np.maximum.reduceat(np.abs(flat).max(axis=1), begins)
    out = np.full((len(sizes), int(sizes.max()), 2), np.nan)
    out[np.arange(out.shape[1]) < sizes[:, None]] = flat / np.repeat(extent, sizes)[:, None]
    return out


def _ears(flat: Floats, sizes: Ints) -> tuple[Ints, Bools]:
    """Cut ears off polygons, of all at once: (P, largest - 2, 3) corners of the triangles, and (P,) whether it went well.

    An ear is a corner that turns forward, and in whose triangle there is no other one. Each polygon has a queue of corners
    to be looked at: all, and again the two beside an ear that was cut, for the others stay what they are. If the queue is
    empty too early, it is filled again, and from then on a corner on the edge of an ear is accepted; then an ear of no area;
    then the polygon is given up.
    """
    many, width = flat.shape[:2]
    out = np.zeros((many, width - 2, 3), np.int64)
    whole = np.zeros(many, bool)
    number, alive = np.arange(many), np.ones(many, bool)
    place, last = np.arange(width), sizes[:, None] - 1
    there = place <= last
    after, before = np.where(place < last, place + 1, 0), np.where(place > 0, place - 1, last)
    queue = np.zeros((many, 6 * width), np.int32)
    queue[:, :width] = place
    head, tail, left, patience = np.zeros(many, np.int64), sizes.copy(), sizes.copy(), np.zeros(many, np.int64)
    x, y = flat[..., 0], flat[..., 1]
    while len(number):
        row = np.arange(len(number))
        at = queue[row, head].astype(np.int64)
        head += alive
        p, r = before[row, at], after[row, at]
        px, py, qx, qy, rx, ry = x[row, p], y[row, p], x[row, at], y[row, at], x[row, r], y[row, r]
        area = (qx - px) * (ry - py) - (qy - py) * (rx - px)
        ear = alive & there[row, at] & ((area > _FLAT) | ((patience > 1) & (area > -_FLAT)))
        look = np.flatnonzero(ear & (left > 3) & (area > _FLAT))
        if len(look):
            triangle = [each[look, None] for each in (px, py, qx, qy, rx, ry)]
            on = np.where(patience[look] > 0, _ON, -_ON)[:, None]
            ear[look] = ~_any_inside((x[look], y[look], there[look]), triangle, on)
        cut = np.flatnonzero(ear)
        out[number[cut], sizes[cut] - left[cut]] = np.stack([p[cut], at[cut], r[cut]], axis=1)
        after[cut, p[cut]], before[cut, r[cut]] = r[cut], p[cut]
        there[cut, at[cut]] = False
        left[cut] -= 1
        queue[cut, tail[cut]], queue[cut, tail[cut] + 1] = p[cut], r[cut]
        tail[cut] += 2
        whole[number[left < 3]] = True
        alive &= left > 2
        again = np.flatnonzero(alive & (head == tail))
        if len(again):
            patience[again] += 1
            which, corner = np.nonzero(there[again])
            queue[again[which], runs(tail[again], left[again])] = corner
            tail[again] += left[again]
            alive &= patience < 3
        if alive.sum() < 0.75 * len(number):
            number, sizes, head, tail, left, patience = (e[alive] for e in (number, sizes, head, tail, left, patience))
            after, before, queue = after[alive], before[alive], queue[alive]
            there, x, y = there[alive], x[alive], y[alive]
            alive = np.ones(len(number), bool)
    return out, whole


def _any_inside(points: tuple[Floats, Floats, Bools], triangle: list[Floats], on: Floats) -> Bools:
    """(P,) whether one of the points (P, n) lies in a triangle, given by the columns of its corners.

    Of each point the coordinates, and whether it counts at all. One counts if it is further inside than `on` from all
    edges, in doubled areas; not one at the place of a corner.
    """
    x, y, there = points
    px, py, qx, qy, rx, ry = triangle
    inside = there & ((qx - px) * (y - py) - (qy - py) * (x - px) > on)
    inside &= (rx - qx) * (y - qy) - (ry - qy) * (x - qx) > on
    inside &= (px - rx) * (y - ry) - (py - ry) * (x - rx) > on
    some = np.flatnonzero(inside.any(axis=1))
    for cx, cy in ((px, py), (qx, qy), (rx, ry)):
        inside[some] &= (x[some] != cx[some]) | (y[some] != cy[some])
    return np.asarray(inside.any(axis=1))
