"""Geodesic distances: Dijkstra on a graph of the edges and of the straight diagonals across them.

A path along edges alone is about 3 % too long. Two triangles that share an edge can be unfolded into one
plane without stretching; where the straight line between their far corners crosses the shared edge, that line
lies on the surface and its length is exact. Adding these diagonals to the graph reduces the error to between
1 and 2.5 %. Every path of the graph lies on the surface, so no distance is underestimated.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.errors import InputError
from meshmatch.geometry.trees import cKDTree
from meshmatch.geometry.triangles import edges_of, same_rows
from meshmatch.shapes.shape import Shape

CHUNK_BYTES = 64_000_000
# Local search for nearby pairs: first radius in median edges, its growth per round, largest radius as a share of the shape's
# size, smallest cell in median edges. With no more pairs than the last number there is no local search.
_FIRST_REACH, _REACH_GROWTH, _MAX_REACH, _MIN_CELL, _MIN_PAIRS = 1.5, 2.0**0.5, 0.1, 18.0, 200
_N_HUBS = 16  # vertices whose distances to all others give lower bounds
# If more distances than this would be computed (those from 400 vertices of a shape of 60,000), they are bounded instead;
# bounds differ from their mean by at most this share.
_MAX_DISTANCES, _BOUND_TOLERANCE = 24_000_000, 0.03
GEODESIC = "Dijkstra on edges and unfolded diagonals"

Arcs = tuple[Ints, Ints, Floats]


def edge_arcs(verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"]) -> Arcs:
    """Every edge once: its two ends, and its length in the unit of ``verts``."""
    i, j = edges_of(faces).vertices.T.astype(np.int64)
    i, j = i[i != j], j[i != j]
    return i, j, np.linalg.norm(verts[i] - verts[j], axis=1)


def diagonal_arcs(verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"]) -> Arcs:
    """Straight lines between the far corners of every two adjacent faces, unfolded into one plane.

    Only lines that cross the shared edge are kept: otherwise the shortest path passes through a vertex, along
    edges. At a non-manifold edge, faces that follow each other in ``faces`` are paired.
    """
    ends = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    far = faces[:, [2, 0, 1]].reshape(-1)
    order = np.lexsort((ends[:, 1], ends[:, 0]))
    ends, far = ends[order], far[order]
    shared = np.flatnonzero((ends[1:] == ends[:-1]).all(axis=1) & (far[1:] != far[:-1]))
    along = verts[ends[shared, 1]] - verts[ends[shared, 0]]
    length = np.linalg.norm(along, axis=1)
    shared, along, length = shared[length > 0], along[length > 0], length[length > 0]
    a, c, d = ends[shared, 0], far[shared], far[shared + 1]
    along = along / length[:, None]
    x_c, y_c = _plane_coordinates(verts[c] - verts[a], along)
    x_d, y_d = _plane_coordinates(verts[d] - verts[a], along)
    height = y_c + y_d
    crossing = (x_c * y_d + x_d * y_c) / np.where(height > 0, height, 1.0)
    valid = (height > 0) & (crossing >= 0) & (crossing <= length)
    return c[valid], d[valid], np.hypot(x_c - x_d, height)[valid]


def _plane_coordinates(offset: Floats, along: Floats) -> tuple[Floats, Floats]:
    x = np.einsum("ij,ij->i", offset, along)
    return x, np.linalg.norm(offset - x[:, None] * along, axis=1)


def surface_graph(verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"]) -> csr_matrix:
    """Symmetric sparse graph ``(V, V)`` of edges, diagonals, seams and bridges.

    *Seams*: vertices at the same position are joined at no cost (OBJ and glTF files split them). *Bridges*: every
    other component is joined to the largest one by the shortest straight line between their vertices, so that
    every distance is finite, and means over a body with loose eyes include all points.
    """
    size = len(verts)
    i, j, length = (np.concatenate(p) for p in zip(edge_arcs(verts, faces), diagonal_arcs(verts, faces), strict=True))
    first = same_rows(verts)
    other = np.flatnonzero(first != np.arange(size))
    i, j = np.concatenate([i, first[other]]), np.concatenate([j, other])
    length = np.concatenate([length, np.zeros(len(other))])
    count, part = connected_components(csr_matrix((np.ones(len(i)), (i, j)), shape=(size, size)), directed=False)
    if count > 1:
        largest = int(np.bincount(part).argmax())
        main, rest = np.flatnonzero(part == largest), np.flatnonzero(part != largest)
        gap, nearest = cKDTree(verts[main]).query(verts[rest])
        order = np.lexsort((gap, part[rest]))
        chosen = order[np.unique(part[rest][order], return_index=True)[1]]
        i, j = np.concatenate([i, rest[chosen]]), np.concatenate([j, main[nearest[chosen]]])
        length = np.concatenate([length, gap[chosen]])
    # An explicit zero would vanish from the sparse graph, and repeated entries would be added up.
    length = np.maximum(length, 1e-12 * max(float(np.ptp(verts)), 1e-300))
    i, j = np.minimum(i, j), np.maximum(i, j)
    order = np.lexsort((length, j, i))
    order = order[np.append(True, (np.diff(i[order]) != 0) | (np.diff(j[order]) != 0))[: len(order)]]
    i, j, length = i[order], j[order], length[order]
    rows, columns = np.concatenate([i, j]), np.concatenate([j, i])
    return csr_matrix((np.concatenate([length, length]), (rows, columns)), shape=(size, size))


class GeodesicDistances:
    """Geodesic distances on one shape; the graph is built once.

    Distances are those of `surface_graph`, divided by `unit`, by default the square root of the surface area. They are 1
    to 2.5 % above the exact ones, measured on bodies of 5,000 vertices, and more on regular grids and long triangles.
    `on_surface` are the vertices that a face uses. `InputError` for a cloud, which has no surface.
    """

    def __init__(self, shape: Shape, unit: float | None = None) -> None:
        if shape.is_cloud:
            what = f"{shape.name or 'the shape'} has no faces, so it has no distances along a surface"
            raise InputError(what, "measure on the mesh that the points came from")
        self.unit = float(np.sqrt(shape.area)) if unit is None else float(unit)
        if not self.unit > 0:
            raise InputError(f"{shape.name or 'the shape'} has no surface area")
        # The position of an invalid vertex is a placeholder: a path through it would cut through the body.
        self.graph = surface_graph(shape.verts, shape.faces[shape.valid_faces])
        self.on_surface = np.flatnonzero(shape.on_surface)
        self._verts = shape.verts
        self._edge = float(np.median(self.graph.data)) if self.graph.nnz else 0.0

    @property
    def V(self) -> int:
        """Number of vertices."""
        return int(self.graph.shape[0])

    def rows(self, sources: Int[Ints, " S"]) -> Float[Floats, "S V"]:
        """Distances from S vertices to all. See `chunks` for bounded memory."""
        found = dijkstra(self.graph, directed=True, indices=np.asarray(sources, dtype=np.int64))
        return np.asarray(found).reshape(-1, self.V) / self.unit

    def chunks(self, sources: Ints, chunk_bytes: int = CHUNK_BYTES) -> Iterator[tuple[int, Floats]]:
        """Yield the rows of many sources in chunks: the index of a chunk's first source, and its rows ``(<=n, V)``."""
        step = max(1, chunk_bytes // (8 * self.V))
        for first in range(0, len(sources), step):
            yield first, self.rows(sources[first : first + step])

    def between(
        self, a: Int[Ints, " N"], b: Int[Ints, " N"], progress: Callable[[float], None] | None = None
    ) -> Float[Floats, " N"]:
        """Distances between vertices ``a[n]`` and ``b[n]``; ``progress`` is called with the share of pairs that are done.

        For nearby pairs only the graph around them is searched. For all others one Dijkstra search is run from each
        distinct vertex of ``a`` or of ``b``, whichever has fewer. Where that would take minutes, as for a bad map of a
        large shape, distances of far pairs are the means of two bounds, accurate to 3 %.
        """
        a, b = np.asarray(a, dtype=np.int64), np.asarray(b, dtype=np.int64)
        report = progress or (lambda share: None)
        # The distance of a vertex to itself is 0: an identity costs nothing.
        result = np.zeros(len(a))
        differ = np.flatnonzero(a != b)
        for left in self._solve_nearby(a, b, differ, result):
            report(1.0 - len(left) / max(len(a), 1))
            differ = left
        starts, column = np.unique(a[differ], return_inverse=True)
        other = b[differ]
        ends, end_column = np.unique(other, return_inverse=True)
        if len(ends) < len(starts):
            starts, column, other = ends, end_column, a[differ]
        done = 1.0 - len(differ) / max(len(a), 1)
        if len(starts) * self.V > _MAX_DISTANCES:
            result[differ] = self._bounded(a[differ], b[differ], lambda share: report(done + (1.0 - done) * share))
            return result
        for first, rows in self.chunks(starts):
            mine = np.flatnonzero((column >= first) & (column < first + len(rows)))
            result[differ[mine]] = rows[column[mine] - first, other[mine]]
            report(done + (1.0 - done) * (first + len(rows)) / len(starts))
        return result

    def _bounded(
        self, a: Int[Ints, " N"], b: Int[Ints, " N"], progress: Callable[[float], None]
    ) -> Float[Floats, " N"]:
        """Distances of pairs from lower and upper bounds by the triangle inequality over hubs.

        The next hub is, of the vertices of pairs whose bounds are not yet close, the one farthest from all hubs; its own
        pairs become exact.
        """
        low, high, apart = np.zeros(len(a)), np.full(len(a), np.inf), np.full(self.V, np.inf)
        left = np.arange(len(a))
        while len(left):
            ends = np.concatenate([a[left], b[left]])
            row = self.rows(ends[[apart[ends].argmax()]])[0]
            apart = np.minimum(apart, row)
            one, other = row[a[left]], row[b[left]]
            low[left] = np.maximum(low[left], np.abs(one - other))
            high[left] = np.minimum(high[left], one + other)
            left = left[high[left] - low[left] > 2e-9 + _BOUND_TOLERANCE * (high[left] + low[left])]
            progress(1.0 - len(left) / len(a))
        return np.asarray(0.5 * (low + high))

    def _solve_nearby(self, a: Ints, b: Ints, left: Ints, result: Floats) -> Iterator[Ints]:
        """Fill in ``result`` for nearby pairs, in rounds of growing radius; yield the remaining pairs after each round.

        A path is at least as long as the straight line between its ends, so a path of some length stays within that
        distance of its start: only a box around it has to be searched.
        """
        low, high = self._verts.min(axis=0), self._verts.max(axis=0)
        reach, max_reach = _FIRST_REACH * self._edge, _MAX_REACH * float((high - low).max())
        if not (reach < max_reach and len(left) > _MIN_PAIRS):
            return
        tree, lower = cKDTree(self._verts), self._lower_bounds(a[left], b[left])
        while reach < max_reach and len(left) > _MIN_PAIRS:
            width = max(reach, _MIN_CELL * self._edge)
            candidates = np.flatnonzero(lower <= reach)
            cells = np.floor((self._verts[a[left[candidates]]] - low) / width).astype(np.int64)
            order = np.lexsort(cells.T)
            changes = (np.diff(cells[order], axis=0) != 0).any(axis=1)
            found = np.zeros(len(left), bool)
            for group in np.split(candidates[order], np.flatnonzero(changes) + 1) if len(candidates) else ():
                pairs = left[group]
                center = low + (np.floor((self._verts[a[pairs[0]]] - low) / width) + 0.5) * width
                nodes = np.sort(tree.query_ball_point(center, 0.5 * width + reach, p=np.inf))
                part = self.graph[nodes][:, nodes]
                begin, end = _frequent_first(a[pairs], b[pairs])
                starts, row = np.unique(begin, return_inverse=True)
                ends = np.searchsorted(nodes, end).clip(max=len(nodes) - 1)
                is_inside = nodes[ends] == end
                size = max(1, CHUNK_BYTES // (8 * len(nodes)))
                for first in range(0, len(starts), size):
                    chunk = np.searchsorted(nodes, starts[first : first + size])
                    rows = dijkstra(part, directed=True, indices=chunk, limit=reach).reshape(len(chunk), -1)
                    mine = np.flatnonzero(is_inside & (row >= first) & (row < first + len(chunk)))
                    values = rows[row[mine] - first, ends[mine]]
                    known = np.isfinite(values)
                    result[pairs[mine[known]]] = values[known] / self.unit
                    found[group[mine[known]]] = True
            left, lower = left[~found], lower[~found]
            reach *= _REACH_GROWTH
            yield left

    def _lower_bounds(self, a: Int[Ints, " N"], b: Int[Ints, " N"]) -> Float[Floats, " N"]:
        """Lower bounds of the distances of pairs, in the unit of the file: straight lines, and the triangle inequality over
        hubs that lie far from each other.
        """
        least = np.linalg.norm(self._verts[a] - self._verts[b], axis=1)
        apart, hub = np.full(self.V, np.inf), int(a[0])
        for _ in range(_N_HUBS):
            row = self.rows(np.array([hub]))[0] * self.unit
            least = np.maximum(least, np.abs(row[a] - row[b]))
            apart = np.minimum(apart, row)
            hub = int(apart.argmax())
        return np.asarray(least)


def _frequent_first(a: Int[Ints, " N"], b: Int[Ints, " N"]) -> tuple[Ints, Ints]:
    """Order each pair so that the vertex that occurs in more pairs comes first: few distinct vertices are then first."""
    often = [np.unique(ends, return_inverse=True, return_counts=True)[1:] for ends in (a, b)]
    of_a, of_b = (count[number] for number, count in often)
    return np.where(of_b > of_a, b, a), np.where(of_b > of_a, a, b)
