"""Triangles of polygons, without new vertices: fans of convex ones, and ears cut off those with corners that turn back.

What lies on a polygon's corners, such as texture coordinates, is split with it: triangles are given by places in the list
of all corners, so that one answer serves for everything that is listed alike.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from meshmatch.arrays import Bools, Float, Floats, Int, Ints
from meshmatch.errors import warn
from meshmatch.shapes.formats import runs
from meshmatch.shapes.shape import LARGEST

MOST_CORNERS = 16_384
"""Of a concave polygon whose ears are looked for, which takes time with the square of them."""
MOST_TESTS = 300_000_000
"""The sum of those squares for a file: some ten seconds."""
_BENT = 1e-3  # radians that a polygon's corners may turn back, in all, and still count as convex
_TOGETHER = 1 << 18  # corners
_FLAT = 1e-12  # of the square of a polygon's extent: a doubled area that is rounding
_NARROW = 64  # corners, of which all are looked at
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
    starts, counts = np.cumsum(sizes) - sizes, np.maximum(sizes - 2, 0)
    if len(sizes) and (sizes == 3).all():
        return np.arange(len(corners)).reshape(-1, 3)
    first, second = np.repeat(starts, counts), runs(starts + 1, counts)
    triangles = np.stack([first, second, second + 1], axis=1)
    begins = np.cumsum(counts) - counts
    fine = bool(len(corners) == 0 or (corners.min() >= 0 and corners.max() < len(verts)))

    def places_of(at: Ints) -> Floats:
        """Positions of corners; nan for one that has none."""
        number = corners[at]
        found = verts[number if fine else np.clip(number, 0, len(verts) - 1)]
        unusable = ~(np.abs(found) < LARGEST).all(axis=1)
        if not fine:
            unusable |= (number < 0) | (number >= len(verts))
        if unusable.any():
            found[unusable] = np.nan
        return found

    if len(verts) == 0:
        return triangles
    quads = np.flatnonzero(sizes == 4)
    for few in np.array_split(quads, max(1, -(-len(quads) // (_TOGETHER // 4)))):
        at = starts[few, None] + np.arange(4)
        turned = few[_other_diagonal(places_of(at.ravel()).reshape(-1, 4, 3))]
        a, b, c, d = (starts[turned] + k for k in range(4))
        triangles[begins[turned]] = np.stack([b, c, d], axis=1)
        triangles[begins[turned] + 1] = np.stack([b, d, a], axis=1)
    larger = np.flatnonzero(sizes > 4)
    concave, left_out = [np.empty(0, np.int64)], 0
    for few in _parts(larger, sizes):
        if sizes[few[0]] > _TOGETHER:  # one polygon
            left_out += 1
            continue
        bent = few[_turns_back(places_of(runs(starts[few], sizes[few])), sizes[few])]
        concave.append(bent[sizes[bent] <= MOST_CORNERS])
        left_out += int((sizes[bent] > MOST_CORNERS).sum())
    chosen = np.concatenate(concave)
    chosen = chosen[np.argsort(sizes[chosen], kind="stable")]
    enough = int(np.searchsorted(np.cumsum(sizes[chosen].astype(np.float64) ** 2), MOST_TESTS, side="right"))
    left_out += len(chosen) - enough
    chosen = chosen[:enough]
    for few in _alike(chosen, sizes):
        own = sizes[few]
        flat = _flattened(places_of(runs(starts[few], own)), own)
        cut, whole = _ears(flat, own)
        rows = runs(begins[few][whole], counts[few][whole])
        shifted = cut[whole] + starts[few][whole][:, None, None]
        triangles[rows] = shifted[np.arange(cut.shape[1]) < counts[few][whole][:, None]]
    if left_out:
        many = f"{left_out:,} polygons have" if left_out > 1 else "a polygon has"
        warn(f"{name}: {many} too many corners; what is concave there is split into triangles that overlap")
    return triangles


def _parts(polygons: Ints, sizes: Ints) -> Iterator[Ints]:
    """Polygons, some `_TOGETHER` corners at a time; one with more of them alone."""
    number = np.cumsum(sizes[polygons]) // _TOGETHER
    alone = sizes[polygons] > _TOGETHER
    edges = np.flatnonzero((np.diff(number) > 0) | alone[1:] | alone[:-1]) + 1
    yield from (few for few in np.split(polygons, edges) if len(few))


def _alike(polygons: Ints, sizes: Ints) -> Iterator[Ints]:
    """Polygons, sorted by size, of sizes that differ by less than twice; some `_TOGETHER` corners at a time."""
    log = np.ceil(np.log2(np.maximum(sizes[polygons], 8))).astype(np.int64)
    for each in np.unique(log).tolist():
        same = polygons[log == each]
        yield from np.array_split(same, max(1, -(-(len(same) << each) // _TOGETHER)))


def _other_diagonal(quads: Float[Floats, "Q 4 3"]) -> Bools:
    """(Q,) True for a quad that is concave at its second or fourth corner, and there alone."""
    normal = _cross(quads[:, 2] - quads[:, 0], quads[:, 3] - quads[:, 1])
    edges = [quads[:, (k + 1) % 4] - quads[:, k] for k in range(4)]
    turns = [np.einsum("qi,qi->q", _cross(edges[k - 1], edges[k]), normal) for k in range(4)]
    out = np.zeros(len(quads), bool)
    some = np.flatnonzero(np.minimum(np.minimum(turns[0], turns[1]), np.minimum(turns[2], turns[3])) < 0)
    back = np.stack([_sines(edges[k][some], edges[k - 1][some], normal[some]) for k in range(4)], axis=1) < -_BENT
    out[some] = (back.sum(axis=1) == 1) & (back[:, 1] | back[:, 3])
    return out


def _cross(a: Floats, b: Floats) -> Floats:
    """Cross products of rows; `np.cross` takes several times as long."""
    out = np.empty_like(a)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out[:, i] = a[:, j] * b[:, k] - a[:, k] * b[:, j]
    return out


def _sines(edges: Floats, before: Floats, normal: Floats) -> Floats:
    """(N,) sine of the turn at each corner, seen along a normal; 0 at an edge of no length."""
    turn = np.einsum("ni,ni->n", _cross(before, edges), normal)
    lengths = [np.einsum("ni,ni->n", each, each) for each in (before, edges, normal)]
    size = np.sqrt(lengths[0]) * np.sqrt(lengths[1]) * np.sqrt(lengths[2])
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
    return np.add.reduceat(_cross(own, own[after]), begins, axis=0)


def _turns_back(places: Floats, sizes: Ints) -> Bools:
    """(P,) True for a polygon whose corners turn back, by more than what may be rounding."""
    before = _neighbours(sizes)[0]
    edges = places[_neighbours(sizes)[1]] - places
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
    flat = np.stack([np.einsum("ni,ni->n", own, np.repeat(each, sizes, axis=0)) for each in (right, up)], axis=1)
    low, high = (each.reduceat(flat, begins, axis=0) for each in (np.minimum, np.maximum))
    tall = np.repeat((high - low)[:, 1] > (high - low)[:, 0], sizes)
    flat[tall] = np.stack([flat[tall, 1], -flat[tall, 0]], axis=1)  # lying: ears are looked for by the first coordinate
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
    out = np.zeros((many, max(width - 2, 1), 3), np.int64)
    whole = np.zeros(many, bool)
    number, alive = np.arange(many), np.ones(many, bool)
    order = np.argsort(flat[..., 0], axis=1, kind="stable")  # within, corners are numbered from left to right
    rank = np.argsort(order, axis=1)
    after, before = np.empty_like(rank), np.empty_like(rank)
    for step, neighbour in ((1, after), (-1, before)):
        own = np.arange(width) + step
        np.put_along_axis(neighbour, rank, np.take_along_axis(rank, own[None] % sizes[:, None], axis=1), axis=1)
    there = np.take_along_axis(np.arange(width) < sizes[:, None], order, axis=1)
    queue = np.zeros((many, 6 * width), np.int32)
    queue[:, :width] = rank
    head, tail, left, patience = np.zeros(many, np.int64), sizes.copy(), sizes.copy(), np.zeros(many, np.int64)
    x, y = (np.take_along_axis(flat[..., k], order, axis=1) for k in range(2))
    keys = _keys(x)
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
            if width > _NARROW:
                seen = _window(
                    keys, look, np.minimum(np.minimum(px, qx), rx)[look], np.maximum(np.maximum(px, qx), rx)[look]
                )
                points = x.reshape(-1)[seen], y.reshape(-1)[seen], there.reshape(-1)[seen]
            else:
                points = x[look], y[look], there[look]
            ear[look] = ~_any_inside(points, triangle, on)
        cut = np.flatnonzero(ear)
        corners = [order[number[cut], each[cut]] for each in (p, at, r)]
        out[number[cut], sizes[cut] - left[cut]] = np.stack(corners, axis=1)
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
            alive, keys = np.ones(len(number), bool), _keys(x)
    return out, whole


def _keys(x: Floats) -> Floats:
    """First coordinates (P, n) within -1..1, sorted, as one list that is sorted: those of each polygon lie 3 further on."""
    return (np.nan_to_num(x, nan=1.5) + 3.0 * np.arange(len(x))[:, None]).reshape(-1)


def _window(keys: Floats, polygons: Ints, low: Floats, high: Floats) -> Ints:
    """(K, widest) where in `_keys` the corners of some polygons lie between two coordinates; the last again for the rest."""
    first = np.searchsorted(keys, low + 3.0 * polygons - 1e-6)
    last = np.searchsorted(keys, high + 3.0 * polygons + 1e-6)
    return np.minimum(first[:, None] + np.arange((last - first).max()), last[:, None] - 1)


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
