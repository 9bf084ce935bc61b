"""Triangle meshes as arrays: areas, normals, closest points, and connectivity by sorting rows, edges and faces."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints, Ints32

# A map is discontinuous between neighbours if their images are farther apart than `_GAP` (in sqrt(area)) plus `_STRETCH`
# times the neighbours' own distance. Set by hand.
_GAP, _STRETCH = 0.06, 3.0
_CHUNK = 65_536  # rows per chunk
_MIX = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)


def cross_product(a: Float[Floats, "N 3"], b: Float[Floats, "N 3"]) -> Float[Floats, "N 3"]:
    """Cross products of rows, column by column: three times as fast as `numpy.cross` on long arrays."""
    out = np.empty_like(a)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out[:, i] = a[:, j] * b[:, k] - a[:, k] * b[:, j]
    return out


def dot(a: Float[Floats, "N D"], b: Float[Floats, "N D"]) -> Float[Floats, " N"]:
    """Dot products of rows; several times as fast as summing over an axis of length three."""
    return np.asarray(np.einsum("ni,ni->n", a, b))


def squared_lengths(vectors: Float[Floats, "N D"]) -> Float[Floats, " N"]:
    """Squared length of each row."""
    return dot(vectors, vectors)


def row_sums(rows: Float[Floats, "N 3"]) -> Float[Floats, " N"]:
    """Sums of rows: the same bits as ``rows.sum(1)`` in a quarter of the time."""
    return rows[:, 0] + rows[:, 1] + rows[:, 2]


def normalized(vectors: Float[Floats, "N D"]) -> Float[Floats, "N D"]:
    """Rows scaled to length 1; zero rows stay zero."""
    lengths = np.sqrt(squared_lengths(vectors))
    return np.asarray(vectors / np.where(lengths > 0, lengths, 1.0)[:, None])


def rotations_between(before: Float[Floats, "N 3"], after: Float[Floats, "N 3"]) -> Float[Floats, "N 3 3"]:
    """Rotations that take unit vectors ``before`` to ``after`` the shortest way; the identity where either is zero."""
    axis = np.cross(before, after)  # its length is the sine of the angle
    cosine = np.where(squared_lengths(before) * squared_lengths(after) > 0, dot(before, after), 1.0)
    turns = axis[:, :, None] * axis[:, None, :] / np.maximum(1.0 + cosine, 1e-6)[:, None, None]
    turns += cosine[:, None, None] * np.eye(3)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        turns[:, i, j] -= axis[:, k]
        turns[:, j, i] += axis[:, k]
    return turns


def triangle_vectors(verts: Float[NDArray[Any], "V 3"], faces: Int[NDArray[Any], "F 3"]) -> Float[Floats, "F 3"]:
    """Normal of each triangle by the right-hand rule, with a length of twice its area."""
    a, b, c = (verts.take(faces[:, k], 0) for k in range(3))
    return cross_product(b - a, c - a)


def triangle_areas(verts: Float[Floats, "V 3"], faces: Int[NDArray[Any], "F 3"]) -> Float[Floats, " F"]:
    """Area of each triangle."""
    return np.asarray(0.5 * np.sqrt(squared_lengths(triangle_vectors(verts, faces))))


def signed_areas(corners: Float[Floats, "F 3 2"]) -> Float[Floats, " F"]:
    """Areas of triangles in the plane; negative if their corners run clockwise."""
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return np.asarray(0.5 * (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]))


def planar_areas(corners: Float[Floats, "F 3 2"]) -> Float[Floats, " F"]:
    """Areas of triangles in the plane."""
    return np.asarray(np.abs(signed_areas(corners)))


def vertex_areas(verts: Float[Floats, "V 3"], faces: Int[NDArray[Any], "F 3"]) -> Float[Floats, " V"]:
    """A third of the area of the triangles around each vertex."""
    return areas_to_vertices(triangle_areas(verts, faces), faces, len(verts))


def vertex_normals(verts: Float[NDArray[Any], "V 3"], faces: Int[NDArray[Any], "F 3"]) -> Float[Floats, "V 3"]:
    """Unit vertex normals: area-weighted means of the surrounding triangles' normals; zeros where there are none."""
    return average_normals(triangle_vectors(verts, faces), faces, len(verts))


def areas_to_vertices(areas: Float[Floats, " F"], faces: Int[NDArray[Any], "F 3"], V: int) -> Float[Floats, " V"]:
    """Distribute areas of triangles to the V vertices, a third to each corner."""
    return np.asarray(np.bincount(faces.ravel(), np.repeat(areas / 3.0, 3), V), np.float64)


def average_normals(vectors: Float[Floats, "F 3"], faces: Int[NDArray[Any], "F 3"], V: int) -> Float[Floats, "V 3"]:
    """Unit normals of V vertices from normals of triangles, whose lengths are their weights."""
    corners = faces.ravel()
    sums = np.empty((V, 3))
    for axis in range(3):
        sums[:, axis] = np.bincount(corners, weights=np.repeat(vectors[:, axis], 3), minlength=V)
    return normalized(sums)


def interpolate(
    values: Float[Floats, "V D"], corners: Int[NDArray[Any], "N K"], weights: Float[NDArray[Any], "N K"]
) -> Float[Floats, "N D"]:
    """Interpolated rows: sum over k of ``weights[n, k] * values[corners[n, k]]``.

    For points on a mesh, ``corners`` is ``faces[face]`` and ``weights`` are barycentric.
    """
    return blend(values.take(corners, 0), weights)  # much faster than indexing


def blend(values: Float[Floats, "N K D"], weights: Float[NDArray[Any], "N K"]) -> Float[Floats, "N D"]:
    """Weighted sums over the second axis, such as points of triangles from barycentric weights."""
    return np.asarray(np.einsum("nk,nkd->nd", weights, values))


def closest_on_triangles(
    points: Float[Floats, "N 3"], a: Float[Floats, "N 3"], b: Float[Floats, "N 3"], c: Float[Floats, "N 3"]
) -> Float[Floats, "N 3"]:
    """Barycentric weights of the point of triangle (a, b, c)[n] that is closest to points[n].

    It is the projection onto the plane where that lies inside, else the closest point of the one or two edges beyond
    which the projection lies.
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
    is_degenerate = ~(area > 1e-14 * d00 * d11)
    best = np.full(len(points), np.inf)
    for i, j, beyond in ((0, 1, w < 0), (1, 2, v + w > 1), (2, 0, v < 0)):
        rows = np.flatnonzero(beyond | is_degenerate)
        start, queries = (a, b, c)[i].take(rows, 0), points.take(rows, 0)
        along = (a, b, c)[j].take(rows, 0) - start
        t = dot(queries - start, along) / np.maximum(dot(along, along), 1e-300)
        t = np.clip(t, 0, 1)
        squared = squared_lengths(start + t[:, None] * along - queries)
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
    """Balls that together cover triangles; large triangles get several small ones along their longest side.

    There are at most three times as many balls as triangles.

    Returns
    -------
    item
        (M,) index of the triangle that each ball covers a part of.
    center, radius
        (M, 3) and (M,) of each ball.
    """
    rows, sides = np.arange(len(triangles)), triangles[:, [1, 2, 0]] - triangles
    squared = np.square(sides).sum(axis=2)
    longest = squared.argmax(axis=1)
    start, side = triangles[rows, longest], sides[rows, longest]
    across = triangles[rows, (longest + 2) % 3] - start
    across -= (dot(across, side) / np.maximum(squared[rows, longest], 1e-300))[:, None] * side
    length, height = np.sqrt(squared[rows, longest]), np.sqrt(squared_lengths(across))
    spacing = np.maximum(0.5 * length.mean(), 2 * height) + 1e-300
    count = np.maximum(np.ceil(length / spacing - 1e-9), 1).astype(np.int64)  # one for triangles of about equal sides
    item = np.repeat(rows, count)
    position = (np.arange(len(item)) - (np.cumsum(count) - count)[item] + 0.5) / count[item]
    center = start[item] + position[:, None] * side[item] + 0.5 * across[item]
    radius = np.sqrt(np.square(0.5 * length / count) + np.square(0.5 * height))
    is_single = count == 1
    center[is_single[item]] = triangles[is_single].mean(axis=1)
    reach = np.square(triangles[is_single] - triangles[is_single].mean(axis=1)[:, None]).sum(axis=2)
    radius[is_single] = np.sqrt(reach.max(axis=1, initial=0.0))
    return item, center, radius[item] * (1 + 1e-12)


def component_minima(count: int, start: Int[Ints, " N"], end: Int[Ints, " N"]) -> Int[Ints, " count"]:
    """Connected components of a graph with ``count`` nodes: the smallest node of each node's component.

    For graphs with few edges, where SciPy's sparse graphs cost more.
    """
    component = np.arange(count)
    while (differ := component[start] != component[end]).any():
        start, end = start[differ], end[differ]
        ends = component[start], component[end]
        np.minimum.at(component, np.maximum(*ends), np.minimum(*ends))
        while (further := component[component] != component).any():
            component[further] = component[component[further]]
    return component


def same_rows(rows: Float[Floats, "N D"] | Int[Ints, "N D"]) -> Int[Ints, " N"]:
    """(N,) index of the first row equal to each row: its own index if it is the first. 0.0 equals -0.0."""
    indices = np.arange(len(rows))
    if len(rows) < 2:
        return indices
    hashed = _hash(rows)
    ordered = np.sort(hashed)
    if not (ordered[1:] == ordered[:-1]).any():
        return indices
    begins = np.flatnonzero(np.concatenate([[True], ordered[1:] != ordered[:-1]]))
    del ordered, indices  # saves memory for millions of rows
    order = np.argsort(hashed)
    del hashed
    first = np.empty(len(rows), np.int64)
    first[order] = np.repeat(np.minimum.reduceat(order, begins), np.diff(np.append(begins, len(rows))))
    del order, begins
    blocks = (slice(low, low + _CHUNK) for low in range(0, len(rows), _CHUNK))
    if all((rows[block] == rows[first[block]]).all() for block in blocks):
        return first
    # a hash collision: the slow way
    _, index, inverse = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    return np.asarray(index[inverse.ravel()], np.int64)


def face_parts(faces: Int[Ints, "F 3"], V: int) -> Int[Ints, " F"]:
    """(F,) number of the connected component of each face; faces that share a vertex are connected."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    dtype: Any = np.int32 if V < 2**31 else np.int64
    ends = faces[:, :2].ravel().astype(dtype), faces[:, 1:].ravel().astype(dtype)  # two edges connect all three corners
    graph = coo_array((np.ones(len(ends[0]), np.int8), ends), shape=(V, V)).tocsr()
    del ends  # saves memory for millions of faces
    label = connected_components(graph, directed=False)[1][faces[:, 0]]
    used = np.zeros(V, np.int64)  # vertices without faces are not numbered
    used[label] = 1
    return np.asarray((np.cumsum(used) - 1)[label])


@dataclass(frozen=True, eq=False)
class Edges:
    """The edges of faces, sorted once for several uses."""

    vertices: Int[Ints32, "E 2"]  # vertices of each edge, the smaller first; sorted
    begins: NDArray[np.int32]  # (E,) start of each edge in the sorted `directed_edges`
    sizes: NDArray[np.int32]  # (E,) number of faces at each edge
    # for each edge with exactly two faces: whether both traverse it in the same direction
    disagreeing: Bool[Bools, " pairs"]

    @property
    def open(self) -> Int[Ints32, "N 2"]:
        """(N, 2) vertices of the edges with one face."""
        return np.asarray(self.vertices[self.sizes == 1])

    @property
    def counts(self) -> tuple[int, int]:
        """Number of open edges (one face) and of non-manifold edges (more than two faces)."""
        return int((self.sizes == 1).sum()), int((self.sizes > 2).sum())


def edges_of(faces: Int[Ints, "F 3"]) -> Edges:
    """The edges of `faces`, sorted; intermediate arrays are freed early, to save memory for millions of faces."""
    ordered = directed_edges(faces)
    ordered.sort()
    first = np.ones(len(ordered), bool)
    first[1:] = (ordered[1:] ^ ordered[:-1]) > 1  # all bits but the last are the edge's key
    begins = np.flatnonzero(first).astype(np.int32)
    sizes = np.diff(np.append(begins, np.int32(len(ordered)))).astype(np.int32)
    interior = begins[sizes == 2]
    disagreeing = ordered[interior] == ordered[interior + 1]
    vertices = np.empty((len(begins), 2), np.int32)
    for low in range(0, len(begins), _CHUNK):
        keys = ordered[begins[low : low + _CHUNK]] >> 1
        vertices[low : low + _CHUNK, 0], vertices[low : low + _CHUNK, 1] = np.divmod(keys, _stride(faces))
    return Edges(vertices, begins, sizes, disagreeing)


@dataclass(frozen=True, eq=False)
class FacesAround:
    """Faces at each vertex: those at vertex v are ``face[start[v] : start[v + 1]]``."""

    start: Int[Ints, " V_plus_1"]
    face: Int[Ints, " N"]

    @classmethod
    def of(cls, faces: Int[Ints, "F 3"], V: int) -> FacesAround:
        """Build the table for V vertices."""
        corners = faces.ravel()
        start = np.concatenate([[0], np.cumsum(np.bincount(corners, minlength=V))])
        return cls(start, np.argsort(corners, kind="stable") // 3)

    def at(self, vertices: Int[Ints, " N"]) -> Int[Ints, " M"]:
        """Faces at any of these vertices, each once, in increasing order."""
        first, count = self.start[vertices], self.start[vertices + 1] - self.start[vertices]
        within = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        return np.unique(self.face[np.repeat(first, count) + within])


def directed_edges(faces: Int[Ints, "F 3"]) -> Int[Ints, " F_times_3"]:
    """(3 F,) twice the key of each face's edges (`edge_keys`), plus 1 if traversed from the smaller to the larger
    vertex.
    """
    keys = edge_keys(faces, _stride(faces))
    keys *= 2
    for k, column in enumerate(keys.reshape(3, -1)):
        column += faces[:, k] < faces[:, (k + 1) % 3]
    return keys


def edge_keys(faces: Int[Ints, "F 3"], V: int) -> Int[Ints, " F_times_3"]:
    """(3 F,) integer key of each face's undirected edges: first all edges 0-1, then 1-2, then 2-0."""
    keys = np.empty((3, len(faces)), np.int64)
    for k, column in enumerate(keys):
        start, end = faces[:, k], faces[:, (k + 1) % 3]
        np.minimum(start, end, out=column)
        column *= V
        column += np.maximum(start, end)
    return keys.ravel()


def _stride(faces: Ints) -> int:
    return int(faces.max()) + 1 if len(faces) else 1


def is_watertight(faces: Int[Ints, "F 3"]) -> bool:
    """True if every edge has exactly two faces."""
    return len(faces) > 0 and edges_of(faces).counts == (0, 0)


def _hash(rows: Floats | Ints) -> NDArray[np.uint64]:
    """64-bit hash of each row; equal rows have equal hashes."""
    total = np.zeros(len(rows), np.uint64)
    for k, column in enumerate(rows.T):
        total ^= (column + 0 if rows.dtype.kind == "i" else column + 0.0).view(np.uint64)
        total *= _MIX[k % 3]
        total ^= total >> np.uint64(29)
    return total


def edge_lengths(points: Float[Floats, "V 3"], edges: Int[NDArray[Any], "E 2"]) -> Float[Floats, " E"]:
    """Length of each edge; computed in chunks, so that millions of edges take no more memory than the result."""
    length = np.empty(len(edges))
    for low in range(0, len(edges), _CHUNK):
        chunk = slice(low, low + _CHUNK)
        difference = points.take(edges[chunk, 0], 0) - points.take(edges[chunk, 1], 0)
        length[chunk] = np.sqrt(squared_lengths(difference))
    return length


def is_discontinuous(apart: Float[Floats, " N"], length: Float[Floats, " N"]) -> Bool[Bools, " N"]:
    """Whether the images of neighbours are so far ``apart`` that the map is torn between them.

    ``length`` is the distance of the neighbours; both are in units of sqrt(area).
    """
    return np.asarray(apart >= _GAP + _STRETCH * length)
