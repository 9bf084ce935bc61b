"""Triangles: areas, normals, closest points; and which rows, edges and faces belong together, by sorting."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints, Ints32

# Neighbours are discontinuous if their images are further apart than this (sqrt(area)) plus so many times their own
# distance. Set by hand.
_GAP, _STRETCH = 0.06, 3.0
_CHUNK = 65_536  # edges at a time
_MIX = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)


def cross_product(a: Float[Floats, "N 3"], b: Float[Floats, "N 3"]) -> Float[Floats, "N 3"]:
    """a x b, column by column: three times as fast as `numpy.cross` on long arrays."""
    out = np.empty_like(a)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out[:, i] = a[:, j] * b[:, k] - a[:, k] * b[:, j]
    return out


def dot(a: Float[Floats, "N D"], b: Float[Floats, "N D"]) -> Float[Floats, " N"]:
    """Products of rows; several times as fast as summing along an axis of three."""
    return np.asarray(np.einsum("ni,ni->n", a, b))


def squared_lengths(vectors: Float[Floats, "N D"]) -> Float[Floats, " N"]:
    """Squared length of each row."""
    return dot(vectors, vectors)


def row_sums(rows: Float[Floats, "N 3"]) -> Float[Floats, " N"]:
    """A quarter of the time of ``rows.sum(1)``, and the same bits."""
    return rows[:, 0] + rows[:, 1] + rows[:, 2]


def unit(vectors: Float[Floats, "N D"]) -> Float[Floats, "N D"]:
    """Rows of length 1; a row of zeros stays zero."""
    lengths = np.sqrt(squared_lengths(vectors))
    return np.asarray(vectors / np.where(lengths > 0, lengths, 1.0)[:, None])


def shortest_turns(before: Float[Floats, "N 3"], after: Float[Floats, "N 3"]) -> Float[Floats, "N 3 3"]:
    """The rotations that take unit vectors to others the shortest way; none where one of the two is zero."""
    axis = np.cross(before, after)  # as long as the sine of the angle
    cosine = np.where(squared_lengths(before) * squared_lengths(after) > 0, dot(before, after), 1.0)
    turns = axis[:, :, None] * axis[:, None, :] / np.maximum(1.0 + cosine, 1e-6)[:, None, None]
    turns += cosine[:, None, None] * np.eye(3)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        turns[:, i, j] -= axis[:, k]
        turns[:, j, i] += axis[:, k]
    return turns


def triangle_vectors(verts: Float[NDArray[Any], "V 3"], faces: Int[NDArray[Any], "F 3"]) -> Float[Floats, "F 3"]:
    """Normal of each triangle by the right-hand rule, twice its area long."""
    a, b, c = (verts.take(faces[:, k], 0) for k in range(3))
    return cross_product(b - a, c - a)


def triangle_areas(verts: Float[Floats, "V 3"], faces: Int[NDArray[Any], "F 3"]) -> Float[Floats, " F"]:
    """Area of each triangle."""
    return np.asarray(0.5 * np.sqrt(squared_lengths(triangle_vectors(verts, faces))))


def signed_areas(corners: Float[Floats, "F 3 2"]) -> Float[Floats, " F"]:
    """Areas of triangles in the plane, negative where their corners turn clockwise."""
    one, two = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return np.asarray(0.5 * (one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]))


def flat_areas(corners: Float[Floats, "F 3 2"]) -> Float[Floats, " F"]:
    """Areas of triangles in the plane."""
    return np.asarray(np.abs(signed_areas(corners)))


def vertex_areas(verts: Float[Floats, "V 3"], faces: Int[NDArray[Any], "F 3"]) -> Float[Floats, " V"]:
    """A third of the area of the triangles around each vertex."""
    return share_areas(triangle_areas(verts, faces), faces, len(verts))


def vertex_normals(verts: Float[NDArray[Any], "V 3"], faces: Int[NDArray[Any], "F 3"]) -> Float[Floats, "V 3"]:
    """Unit normals, the area-weighted mean of the triangles around; zeros where there is none."""
    return average_normals(triangle_vectors(verts, faces), faces, len(verts))


def share_areas(areas: Float[Floats, " F"], faces: Int[NDArray[Any], "F 3"], V: int) -> Float[Floats, " V"]:
    """Areas of triangles, a third for each corner."""
    return np.asarray(np.bincount(faces.ravel(), np.repeat(areas / 3.0, 3), V), np.float64)


def average_normals(vectors: Float[Floats, "F 3"], faces: Int[NDArray[Any], "F 3"], V: int) -> Float[Floats, "V 3"]:
    """Unit normals of V vertices from the normals of triangles, whose lengths are their weights."""
    corners = faces.ravel()
    sums = np.empty((V, 3))
    for axis in range(3):
        sums[:, axis] = np.bincount(corners, weights=np.repeat(vectors[:, axis], 3), minlength=V)
    return unit(sums)


def interpolate(
    values: Float[Floats, "V D"], corners: Int[NDArray[Any], "N K"], weights: Float[NDArray[Any], "N K"]
) -> Float[Floats, "N D"]:
    """Values between rows: sum_k ``weights[n, k] * values[corners[n, k]]``.

    For points on a mesh, ``corners`` is ``faces[face]`` and ``weights`` are barycentric.
    """
    return blend(values.take(corners, 0), weights)  # much faster than an index


def blend(values: Float[Floats, "N K D"], weights: Float[NDArray[Any], "N K"]) -> Float[Floats, "N D"]:
    """Weighted sums over the second axis, such as points of triangles by barycentric weights."""
    return np.asarray(np.einsum("nk,nkd->nd", weights, values))


def closest_on_triangles(
    points: Float[Floats, "N 3"], a: Float[Floats, "N 3"], b: Float[Floats, "N 3"], c: Float[Floats, "N 3"]
) -> Float[Floats, "N 3"]:
    """Barycentric weights of the point of triangle (a, b, c)[n] that is closest to points[n].

    The plane's foot where it lies inside, else the closest point of the edges beyond which the foot lies: one or two.
    """
    ab, ac, ap = b - a, c - a, points - a
    d00, d01, d11 = dot(ab, ab), dot(ab, ac), dot(ac, ac)
    d20, d21 = dot(ap, ab), dot(ap, ac)
    area = d00 * d11 - d01 * d01
    scale = np.maximum(area, 1e-300)
    v = (d11 * d20 - d01 * d21) / scale
    w = (d00 * d21 - d01 * d20) / scale
    result = np.empty((len(points), 3))
    result[:, 0], result[:, 1], result[:, 2] = 1 - v - w, v, w
    flat = ~(area > 1e-14 * d00 * d11)
    best = np.full(len(points), np.inf)
    for i, j, beyond in ((0, 1, w < 0), (1, 2, v + w > 1), (2, 0, v < 0)):
        rows = np.flatnonzero(beyond | flat)
        start, asked = (a, b, c)[i].take(rows, 0), points.take(rows, 0)
        along = (a, b, c)[j].take(rows, 0) - start
        t = dot(asked - start, along) / np.maximum(dot(along, along), 1e-300)
        t = np.clip(t, 0, 1)
        squared = squared_lengths(start + t[:, None] * along - asked)
        closer = np.flatnonzero(squared < best[rows])
        rows, t = rows[closer], t[closer]
        best[rows] = squared[closer]
        result[rows] = 0.0
        result[rows, i] = 1 - t
        result[rows, j] = t
    return result


def covering_balls(
    triangles: Float[Floats, "N 3 3"],
) -> tuple[Int[Ints, " M"], Float[Floats, "M 3"], Float[Floats, " M"]]:
    """Balls that cover triangles, the larger of them with several along their longest side, so that they are thin where
    these are: at most three times as many as there are triangles.

    Returns
    -------
    item
        Which triangle each covers a part of.
    center, radius
        Of each ball.
    """
    rows, sides = np.arange(len(triangles)), triangles[:, [1, 2, 0]] - triangles
    squared = np.square(sides).sum(axis=2)
    longest = squared.argmax(axis=1)
    start, side = triangles[rows, longest], sides[rows, longest]
    across = triangles[rows, (longest + 2) % 3] - start
    across -= (dot(across, side) / np.maximum(squared[rows, longest], 1e-300))[:, None] * side
    length, height = np.sqrt(squared[rows, longest]), np.sqrt(squared_lengths(across))
    least = np.maximum(0.5 * length.mean(), 2 * height) + 1e-300
    count = np.maximum(np.ceil(length / least - 1e-9), 1).astype(np.int64)  # of even triangles one
    item = np.repeat(rows, count)
    share = (np.arange(len(item)) - (np.cumsum(count) - count)[item] + 0.5) / count[item]
    center = start[item] + share[:, None] * side[item] + 0.5 * across[item]
    radius = np.sqrt(np.square(0.5 * length / count) + np.square(0.5 * height))
    whole = count == 1
    center[whole[item]] = triangles[whole].mean(axis=1)
    reach = np.square(triangles[whole] - triangles[whole].mean(axis=1)[:, None]).sum(axis=2)
    radius[whole] = np.sqrt(reach.max(axis=1, initial=0.0))
    return item, center, radius[item] * (1 + 1e-12)


def together(count: int, one: Int[Ints, " N"], two: Int[Ints, " N"]) -> Int[Ints, " count"]:
    """The least of all that hang together, for each; of so few at a time sparse graphs cost more."""
    least = np.arange(count)
    while (differ := least[one] != least[two]).any():
        one, two = one[differ], two[differ]
        ends = least[one], least[two]
        np.minimum.at(least, np.maximum(*ends), np.minimum(*ends))
        while (further := least[least] != least).any():
            least[further] = least[least[further]]
    return least


def same_rows(rows: Float[Floats, "N D"] | Int[Ints, "N D"]) -> Int[Ints, " N"]:
    """(N,) for each row the first row that is equal to it: itself where it is the first. 0.0 equals -0.0."""
    own = np.arange(len(rows))
    if len(rows) < 2:
        return own
    hashed = _hash(rows)
    ordered = np.sort(hashed)
    if not (ordered[1:] == ordered[:-1]).any():
        return own
    begins = np.flatnonzero(np.concatenate([[True], ordered[1:] != ordered[:-1]]))
    del ordered, own  # for millions of rows ask for little memory
    order = np.argsort(hashed)
    del hashed
    first = np.empty(len(rows), np.int64)
    first[order] = np.repeat(np.minimum.reduceat(order, begins), np.diff(np.append(begins, len(rows))))
    del order, begins
    blocks = (slice(low, low + _CHUNK) for low in range(0, len(rows), _CHUNK))
    if all((rows[block] == rows[first[block]]).all() for block in blocks):
        return first
    # two different rows with one hash: the slow way
    _, index, inverse = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    return np.asarray(index[inverse.ravel()], np.int64)


def face_parts(faces: Int[Ints, "F 3"], V: int) -> Int[Ints, " F"]:
    """(F,) number of the connected part that each face is in; faces that share a vertex are connected."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    kind: Any = np.int32 if V < 2**31 else np.int64
    ends = faces[:, :2].ravel().astype(kind), faces[:, 1:].ravel().astype(kind)  # two edges of a face join its corners
    graph = coo_array((np.ones(len(ends[0]), np.int8), ends), shape=(V, V)).tocsr()
    del ends  # for millions of faces ask for little memory
    label = connected_components(graph, directed=False)[1][faces[:, 0]]
    used = np.zeros(V, np.int64)  # a vertex without a face is no part
    used[label] = 1
    return np.asarray((np.cumsum(used) - 1)[label])


@dataclass(frozen=True, eq=False)
class Edges:
    """The edges of faces, sorted once for several questions."""

    vertices: Int[Ints32, "E 2"]  # the two vertices of each edge, the smaller first; sorted
    begins: NDArray[np.int32]  # (E,) where each edge begins in the sorted `directed_edges`
    sizes: NDArray[np.int32]  # (E,) and how many faces it has
    disagreeing: Bool[Bools, " pairs"]  # for each edge of exactly two faces: do both run along it the same way?

    @property
    def open(self) -> Int[Ints32, "N 2"]:
        """Vertices of the edges that have one face."""
        return np.asarray(self.vertices[self.sizes == 1])

    @property
    def counts(self) -> tuple[int, int]:
        """How many edges have one face (open), and how many have more than two (non-manifold)."""
        return int((self.sizes == 1).sum()), int((self.sizes > 2).sum())


def edges_of(faces: Int[Ints, "F 3"]) -> Edges:
    """Sort the edges of `faces`; what that takes is freed at once, for millions of faces ask for little memory."""
    ordered = directed_edges(faces)
    ordered.sort()
    first = np.ones(len(ordered), bool)
    first[1:] = (ordered[1:] ^ ordered[:-1]) > 1  # all but the last bit is the edge's number
    begins = np.flatnonzero(first).astype(np.int32)
    sizes = np.diff(np.append(begins, np.int32(len(ordered)))).astype(np.int32)
    two = begins[sizes == 2]
    disagreeing = ordered[two] == ordered[two + 1]
    vertices = np.empty((len(begins), 2), np.int32)
    for low in range(0, len(begins), _CHUNK):
        keys = ordered[begins[low : low + _CHUNK]] >> 1
        vertices[low : low + _CHUNK, 0], vertices[low : low + _CHUNK, 1] = np.divmod(keys, _stride(faces))
    return Edges(vertices, begins, sizes, disagreeing)


@dataclass(frozen=True, eq=False)
class FacesAround:
    """Which faces touch each vertex: those of vertex v from ``start[v]`` to ``start[v + 1]``."""

    start: Int[Ints, " V_plus_1"]
    face: Int[Ints, " N"]

    @classmethod
    def of(cls, faces: Int[Ints, "F 3"], V: int) -> FacesAround:
        """Of V vertices."""
        corners = faces.ravel()
        start = np.concatenate([[0], np.cumsum(np.bincount(corners, minlength=V))])
        return cls(start, np.argsort(corners, kind="stable") // 3)

    def at(self, vertices: Int[Ints, " N"]) -> Int[Ints, " M"]:
        """The faces that touch any of these vertices, each once and in order."""
        first, count = self.start[vertices], self.start[vertices + 1] - self.start[vertices]
        within = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        return np.unique(self.face[np.repeat(first, count) + within])


def directed_edges(faces: Int[Ints, "F 3"]) -> Int[Ints, " F_times_3"]:
    """(3 F,) twice the number of each edge of each face (`edge_keys`), plus 1 if the face runs from the smaller vertex to
    the larger.
    """
    keys = edge_keys(faces, _stride(faces))
    keys *= 2
    for k, found in enumerate(keys.reshape(3, -1)):
        found += faces[:, k] < faces[:, (k + 1) % 3]
    return keys


def edge_keys(faces: Int[Ints, "F 3"], V: int) -> Int[Ints, " F_times_3"]:
    """(3 F,) a number for each edge of each face, the same both ways: F of the edges 0-1, then 1-2, 2-0."""
    keys = np.empty((3, len(faces)), np.int64)
    for k, found in enumerate(keys):
        start, end = faces[:, k], faces[:, (k + 1) % 3]
        np.minimum(start, end, out=found)
        found *= V
        found += np.maximum(start, end)
    return keys.ravel()


def _stride(faces: Ints) -> int:
    return int(faces.max()) + 1 if len(faces) else 1


def is_watertight(faces: Int[Ints, "F 3"]) -> bool:
    """True if every edge has exactly two faces."""
    return len(faces) > 0 and edges_of(faces).counts == (0, 0)


def _hash(rows: Floats | Ints) -> NDArray[np.uint64]:
    total = np.zeros(len(rows), np.uint64)
    for k, column in enumerate(rows.T):
        total ^= (column + 0 if rows.dtype.kind == "i" else column + 0.0).view(np.uint64)
        total *= _MIX[k % 3]
        total ^= total >> np.uint64(29)
    return total


def edge_lengths(points: Float[Floats, "V 3"], edges: Int[NDArray[Any], "E 2"]) -> Float[Floats, " E"]:
    """Distance of the two ends of each edge, by parts: millions of edges cost no more memory than their lengths."""
    length = np.empty(len(edges))
    for low in range(0, len(edges), _CHUNK):
        part = slice(low, low + _CHUNK)
        apart = points.take(edges[part, 0], 0) - points.take(edges[part, 1], 0)
        length[part] = np.sqrt(squared_lengths(apart))
    return length


def is_discontinuous(apart: Float[Floats, " N"], length: Float[Floats, " N"]) -> Bool[Bools, " N"]:
    """Whether images of neighbours lie much further ``apart`` than the neighbours do, as at a tear of the map.

    ``length`` is the distance of the neighbours; both are in units of sqrt(area).
    """
    return np.asarray(apart >= _GAP + _STRETCH * length)
