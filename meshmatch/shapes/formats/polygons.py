"""Triangulate polygons without new vertices: convex ones as fans, others with reflex corners by ear clipping.

Triangles are indices into the list of all corners, so that one triangulation also applies to other data of corners, such as
texture coordinates.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshmatch.arrays import Bools, Float, Floats, Int, Ints
from meshmatch.errors import warn
from meshmatch.geometry.triangles import cross_product, dot
from meshmatch.shapes.formats import concatenated_ranges, fan
from meshmatch.shapes.shape import LARGEST

MAX_CORNERS = 16_384
"""Maximum number of corners of a polygon for ear clipping, which takes quadratic time."""
MAX_TESTS = 300_000_000
"""Maximum sum of the squared corner counts for a file: some ten seconds."""
_MAX_REFLEX = 1e-3  # maximum sum of the sines of reflex angles at which a polygon still counts as convex
_BATCH_CORNERS = 1 << 18  # corners of polygons processed at once
_MIN_AREA = 1e-12  # doubled area that counts as rounding error, relative to the square of a polygon's extent
_EDGE_TOLERANCE = 1e-9  # the same for a corner on the edge of an ear


def triangles_of(
    name: str, verts: Float[Floats, "V 3"], corners: Int[Ints, " N"], sizes: Int[Ints, " P"]
) -> Int[Ints, "F 3"]:
    """Triangulate polygons: n - 2 triangles for n corners, none for fewer than 3.

    A convex polygon a b c d ... becomes the fan a b c, a c d, ...; others are triangulated by ear clipping, projected along
    their mean normal (a quad is split along its inner diagonal). A polygon that crosses itself, that has no area, or that
    has a corner without a position becomes a fan. So do concave ones beyond `MAX_CORNERS` or `MAX_TESTS`, with a
    `MeshmatchWarning`.

    Parameters
    ----------
    name
        Name of the file, for warnings.
    verts
        Vertex positions.
    corners
        Vertex indices of all polygons, one polygon after the other.
    sizes
        Number of corners of each polygon.

    Returns
    -------
    (F, 3) array of int
        Triangles, as indices into `corners`.
    """
    triangles = fan(np.arange(len(corners)), sizes)
    if len(verts) == 0 or not (sizes > 3).any():
        return triangles
    starts, counts = np.cumsum(sizes) - sizes, np.maximum(sizes - 2, 0)

    def places_of(polygons: Ints) -> Floats:
        """Positions of the corners of some polygons, one polygon after the other; NaN for corners without one."""
        number = corners[concatenated_ranges(starts[polygons], sizes[polygons])]
        found = verts[np.clip(number, 0, len(verts) - 1)]
        found[(number < 0) | (number >= len(verts)) | ~(np.abs(found) < LARGEST).all(axis=1)] = np.nan
        return found

    candidates = np.flatnonzero(sizes > 3)
    batches = np.split(candidates, np.flatnonzero(np.diff(np.cumsum(sizes[candidates]) // _BATCH_CORNERS)) + 1)
    concave = np.concatenate([batch[_has_reflex_corners(places_of(batch), sizes[batch])] for batch in batches])
    concave = concave[np.argsort(sizes[concave], kind="stable")]
    tests = np.cumsum(sizes[concave].astype(np.float64) ** 2)
    chosen = concave[(sizes[concave] <= MAX_CORNERS) & (tests <= MAX_TESTS)]
    begins = np.cumsum(counts) - counts
    for batch in _batches(chosen, sizes):
        batch_sizes = sizes[batch]
        ears, complete = _clip_ears(_project(places_of(batch), batch_sizes), batch_sizes)
        rows = concatenated_ranges(begins[batch][complete], counts[batch][complete])
        shifted = ears[complete] + starts[batch][complete][:, None, None]
        triangles[rows] = shifted[np.arange(ears.shape[1]) < counts[batch][complete][:, None]]
    if len(chosen) < len(concave):
        left_out = len(concave) - len(chosen)
        what = f"{left_out:,} polygons have" if left_out > 1 else "a polygon has"
        warn(f"{name}: {what} too many corners; concave ones are split into triangles that overlap")
    return triangles


def majority_of_triangles(arrays: Mapping[str, NDArray[Any]], sizes: Int[Ints, " P"]) -> dict[str, NDArray[Any]]:
    """Convert arrays (F, ...) on triangles to arrays (P, ...) on polygons of `sizes` corners, by majority vote.

    A polygon gets the most frequent value of the first array among its triangles, and the values of the other arrays at
    such a triangle. Polygons without triangles get -1, or 0 in arrays of unsigned type.
    """
    codes = np.unique(next(iter(arrays.values())), return_inverse=True)[1].reshape(-1)
    polygon = np.repeat(np.arange(len(sizes)), np.maximum(sizes - 2, 0))
    _, group, counts = np.unique(polygon * (codes.max(initial=0) + 1) + codes, return_inverse=True, return_counts=True)
    order = np.lexsort((np.arange(len(codes)), -counts[group.reshape(-1)], polygon))
    chosen = np.full(len(sizes), -1)
    owners, first = np.unique(polygon[order], return_index=True)
    chosen[owners] = order[first]
    missing = {label: np.full_like(each[:1], 0 if each.dtype.kind == "u" else -1) for label, each in arrays.items()}
    return {label: np.append(each, missing[label], axis=0)[chosen] for label, each in arrays.items()}


def _batches(polygons: Ints, sizes: Ints) -> Iterator[Ints]:
    """Split polygons, sorted by size, into batches of about `_BATCH_CORNERS` corners.

    The sizes of polygons in a batch differ by less than a factor of two, except for those of at most 8 corners.
    """
    log = np.ceil(np.log2(np.maximum(sizes[polygons], 8))).astype(np.int64)
    for each in np.unique(log).tolist():
        polygons_of_size = polygons[log == each]
        yield from np.array_split(polygons_of_size, max(1, -(-(len(polygons_of_size) << each) // _BATCH_CORNERS)))


def _sines(edges: Floats, before: Floats, normal: Floats) -> Floats:
    """(N,) sine of the signed exterior angle at each corner, about the given normal; 0 at edges of zero length."""
    turn = dot(cross_product(before, edges), normal)
    size = np.prod([np.sqrt(dot(each, each)) for each in (before, edges, normal)], axis=0)
    return np.asarray(np.divide(turn, size, out=np.zeros_like(turn), where=size > 0))


def _neighbours(sizes: Ints) -> tuple[Ints, Ints]:
    """(N,) indices of the previous and the next corner of each corner, for polygons listed one after the other."""
    begins = np.cumsum(sizes) - sizes
    place = np.arange(int(sizes.sum()))
    before, after = place - 1, place + 1
    before[begins] = begins + sizes - 1
    after[begins + sizes - 1] = begins
    return before, after


def _normals(places: Floats, sizes: Ints) -> Floats:
    """(P, 3) normal of each polygon by Newell's method, of length twice its area; computed relative to its first corner."""
    after = _neighbours(sizes)[1]
    begins = np.cumsum(sizes) - sizes
    relative = places - np.repeat(places[begins], sizes, axis=0)
    return np.add.reduceat(cross_product(relative, relative[after]), begins, axis=0)


def _has_reflex_corners(places: Floats, sizes: Ints) -> Bools:
    """(P,) whether a polygon has reflex corners, beyond rounding errors."""
    before, after = _neighbours(sizes)
    edges = places[after] - places
    sines = _sines(edges, edges[before], np.repeat(_normals(places, sizes), sizes, axis=0))
    begins = np.cumsum(sizes) - sizes
    return np.asarray(np.add.reduceat(np.maximum(-sines, 0.0), begins) > _MAX_REFLEX)


def _project(places: Floats, sizes: Ints) -> Floats:
    """(P, max size, 2) positions of corners, projected along the normal of their polygon and divided by its extent.

    They are counterclockwise, and NaN beyond the corners of a polygon.
    """
    begins = np.cumsum(sizes) - sizes
    normal = _normals(places, sizes)
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    axis = np.eye(3)[np.abs(normal).argmin(axis=1)]
    right = np.cross(axis, normal)
    right /= np.linalg.norm(right, axis=1)[:, None]
    up = np.cross(normal, right)
    relative = places - np.repeat(places[begins], sizes, axis=0)
    flat = np.stack([dot(relative, np.repeat(each, sizes, axis=0)) for each in (right, up)], axis=1)
    extent = np.maximum.reduceat(np.abs(flat).max(axis=1), begins)
    out = np.full((len(sizes), int(sizes.max()), 2), np.nan)
    out[np.arange(out.shape[1]) < sizes[:, None]] = flat / np.repeat(extent, sizes)[:, None]
    return out


def _clip_ears(flat: Floats, sizes: Ints) -> tuple[Ints, Bools]:
    """Triangulate polygons by ear clipping, all in parallel.

    An ear is a convex corner whose triangle contains no other corner. Each polygon has a queue of corners to test: first
    all, then the two neighbours of each ear that was cut, since the status of others does not change. If the queue runs
    empty too early, it is filled with all remaining corners, and corners on the edge of an ear are tolerated from then on;
    after the next time, ears of zero area as well; after the third, the polygon is given up.

    Returns
    -------
    (P, max size - 2, 3) array of int
        Corners of the triangles, within each polygon.
    (P,) array of bool
        Whether the triangulation is complete.
    """
    n_polygons, width = flat.shape[:2]
    out = np.zeros((n_polygons, width - 2, 3), np.int64)
    complete = np.zeros(n_polygons, bool)
    number, alive = np.arange(n_polygons), np.ones(n_polygons, bool)
    place, last = np.arange(width), sizes[:, None] - 1
    remaining = place <= last
    after, before = np.where(place < last, place + 1, 0), np.where(place > 0, place - 1, last)
    queue = np.zeros((n_polygons, 6 * width), np.int32)
    queue[:, :width] = place
    head, tail, n_remaining, n_refills = (
        np.zeros(n_polygons, np.int64),
        sizes.copy(),
        sizes.copy(),
        np.zeros(n_polygons, np.int64),
    )
    x, y = flat[..., 0], flat[..., 1]
    while len(number):
        row = np.arange(len(number))
        at = queue[row, head].astype(np.int64)
        head += alive
        p, r = before[row, at], after[row, at]
        px, py, qx, qy, rx, ry = x[row, p], y[row, p], x[row, at], y[row, at], x[row, r], y[row, r]
        area = (qx - px) * (ry - py) - (qy - py) * (rx - px)
        ear = alive & remaining[row, at] & ((area > _MIN_AREA) | ((n_refills > 1) & (area > -_MIN_AREA)))
        to_check = np.flatnonzero(ear & (n_remaining > 3) & (area > _MIN_AREA))
        if len(to_check):
            triangle = [each[to_check, None] for each in (px, py, qx, qy, rx, ry)]
            tolerance = np.where(n_refills[to_check] > 0, _EDGE_TOLERANCE, -_EDGE_TOLERANCE)[:, None]
            ear[to_check] = ~_any_inside((x[to_check], y[to_check], remaining[to_check]), triangle, tolerance)
        cut = np.flatnonzero(ear)
        out[number[cut], sizes[cut] - n_remaining[cut]] = np.stack([p[cut], at[cut], r[cut]], axis=1)
        after[cut, p[cut]], before[cut, r[cut]] = r[cut], p[cut]
        remaining[cut, at[cut]] = False
        n_remaining[cut] -= 1
        queue[cut, tail[cut]], queue[cut, tail[cut] + 1] = p[cut], r[cut]
        tail[cut] += 2
        complete[number[n_remaining < 3]] = True
        alive &= n_remaining > 2
        stuck = np.flatnonzero(alive & (head == tail))
        if len(stuck):
            n_refills[stuck] += 1
            stuck_row, corner = np.nonzero(remaining[stuck])
            queue[stuck[stuck_row], concatenated_ranges(tail[stuck], n_remaining[stuck])] = corner
            tail[stuck] += n_remaining[stuck]
            alive &= n_refills < 3
        if alive.sum() < 0.75 * len(number):
            number, sizes, head, tail, n_remaining, n_refills = (
                e[alive] for e in (number, sizes, head, tail, n_remaining, n_refills)
            )
            after, before, queue = after[alive], before[alive], queue[alive]
            remaining, x, y = remaining[alive], x[alive], y[alive]
            alive = np.ones(len(number), bool)
    return out, complete


def _any_inside(points: tuple[Floats, Floats, Bools], triangle: list[Floats], tolerance: Floats) -> Bools:
    """(P,) whether any of the points (P, n) lies in a triangle.

    `points` are x, y and a mask of the points to test; `triangle` has x and y of the three corners, as columns. A point
    lies inside if its doubled areas with all edges exceed `tolerance`, unless it coincides with a corner.
    """
    x, y, is_tested = points
    px, py, qx, qy, rx, ry = triangle
    inside = is_tested & ((qx - px) * (y - py) - (qy - py) * (x - px) > tolerance)
    inside &= (rx - qx) * (y - qy) - (ry - qy) * (x - qx) > tolerance
    inside &= (px - rx) * (y - ry) - (py - ry) * (x - rx) > tolerance
    hit = np.flatnonzero(inside.any(axis=1))
    for cx, cy in ((px, py), (qx, qy), (rx, ry)):
        inside[hit] &= (x[hit] != cx[hit]) | (y[hit] != cy[hit])
    return np.asarray(inside.any(axis=1))
