"""A shape as the search without a model sees it: thinned, with what does not change when it bends.

Distances along the surface, eigenfunctions of the Laplacian, and extremities: the ends of limbs, fins, legs and handles.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np
import robust_laplacian
from scipy.sparse import coo_matrix, csc_matrix, csr_matrix, identity
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.sparse.linalg import eigsh, splu

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.geometry.oriented import OrientedPoints, feature_tree, with_normals
from meshmatch.geometry.trees import cKDTree
from meshmatch.geometry.triangles import edge_lengths, edges_of, vertex_areas, vertex_normals
from meshmatch.shapes.sampling import farthest_points, triangulate_cloud
from meshmatch.shapes.shape import Shape
from meshmatch.templates.make import low_mesh

_FUNCTIONS = 50  # eigenfunctions
_SMOOTHED = 0.02, 0.08  # lengths over which a surface is smoothed, in units of sqrt(area)
_FLAT = 0.001  # heights that differ by less are the same: so a plane has no relief
_NORMAL_WEIGHT = 0.1  # of unit normals beside positions
_TINY = 1e-12  # area of vertices whose triangles have none
_LANDMARKS = 300  # vertices, evenly spread, that stand for all
_PROFILE = 12  # distances at which the area around an extremity is asked
# Of the diameter along the surface: an extremity is a maximum of the mean distance that stands out by so much from the
# way to a higher one, and lies so far from the others. At most so many are told apart.
_PERSISTENCE, _APART, _MOST = 0.04, 0.08, 14
_SHARES = (0.15, 0.3, 0.5, 0.7)  # of the way to an extremity: where ways are compared
_RINGS, _RING = (0.25, 0.5, 0.75), 0.03  # shares of the way where there are rings, and half of their width


@dataclass(frozen=True, eq=False)
class DecimatedMesh:
    """A shape with about as many triangles as are asked, on some of its own vertices; in its frame."""

    verts: Float[Floats, "V 3"]
    faces: Int[Ints, "F 3"]

    @classmethod
    def of(cls, shape: Shape, faces: int) -> DecimatedMesh:
        """`InputError` for a cloud whose points lie on no surface."""
        kept, corners = low_mesh(shape, faces)
        used, renumbered = np.unique(corners, return_inverse=True)
        if len(used) > faces:  # twice as many as of a closed surface: it is in crumbs, and is thinned as a cloud
            cloud = Shape(shape.verts, np.empty((0, 3), np.int64), shape.name)
            kept, corners = triangulate_cloud(cloud, faces)
            used, renumbered = np.unique(corners, return_inverse=True)
        return cls(np.asarray(shape.verts)[kept[used]], renumbered.reshape(-1, 3).astype(np.int64))

    @cached_property
    def shape(self) -> Shape:
        return Shape(self.verts, self.faces)

    @cached_property
    def normals(self) -> Float[Floats, "V 3"]:
        return vertex_normals(self.verts, self.faces)

    @cached_property
    def areas(self) -> Float[Floats, " V"]:
        """Share of the surface around each vertex."""
        areas = vertex_areas(self.verts, self.faces)
        return np.asarray(areas / areas.sum())

    @cached_property
    def tree(self) -> cKDTree:
        """Of positions and weighted normals."""
        return feature_tree(with_normals(self.verts, self.normals, _NORMAL_WEIGHT))

    @cached_property
    def relief(self) -> Float[Floats, "V R"]:
        """How far vertices stand out of the surface smoothed over two lengths, noses and navels: as ranks by area, from -1/2
        to 1/2."""
        stiffness, mass = robust_laplacian.mesh_laplacian(self.verts, self.faces)
        ranks = []
        shortest = np.sqrt(2 * vertex_areas(self.verts, self.faces).sum() / len(self.faces))  # about an edge
        for length in np.maximum(_SMOOTHED, shortest):
            system = csc_matrix(mass + length**2 * stiffness + _TINY * identity(len(self.verts)))
            smooth = splu(system).solve(mass @ self.verts)
            out = ((self.verts - smooth) * self.normals).sum(1)
            height, level = np.unique(np.round(out / _FLAT), return_inverse=True)
            share = np.bincount(level, self.areas, len(height))
            ranks.append((np.cumsum(share) - share / 2 - 0.5)[level])
        return np.stack(ranks, 1)

    def likeness(self, other: DecimatedMesh, moved: OrientedPoints) -> float:
        """Correlation (0..1) of its relief with that of another mesh, where its vertices are moved to on it."""
        nearest = other.tree.query(with_normals(moved.points, moved.normals, _NORMAL_WEIGHT))[1]
        own, theirs = self.relief, other.relief[nearest]  # of its own the mean is 0
        theirs = theirs - self.areas @ theirs
        spreads = np.sqrt((self.areas @ own**2) * (self.areas @ theirs**2))
        return float(np.abs((self.areas @ (own * theirs)) / np.maximum(spreads, 1e-12)).mean())

    @cached_property
    def graph(self) -> csr_matrix:
        """Edge lengths; separate parts are joined where they are nearest, so that every distance is finite."""
        edges = edges_of(self.faces).vertices.astype(np.int64)
        length = edge_lengths(self.verts, edges)
        part = connected_components(coo_matrix((length, edges.T), (len(self.verts),) * 2), directed=False)[1]
        bridges = _bridges(self.verts, part.astype(np.int64))
        edges = np.concatenate([edges, bridges])
        length = np.maximum(edge_lengths(self.verts, edges), 1e-9)
        graph = coo_matrix((length, edges.T), (len(self.verts),) * 2).tocsr()
        return graph + graph.T


def _bridges(verts: Float[Floats, "V 3"], part: Int[Ints, " V"]) -> Int[Ints, "N 2"]:
    """Pairs of vertices that join all parts: each part, from the largest on, with the nearest of those before it."""
    found = []
    order = np.argsort(-np.bincount(part), kind="stable")
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    rank = rank[part]
    for number in range(1, len(order)):
        here, before = np.flatnonzero(rank == number), np.flatnonzero(rank < number)
        distance, nearest = cKDTree(verts[before]).query(verts[here])
        closest = int(distance.argmin())
        found.append((here[closest], before[nearest[closest]]))
    return np.array(found, np.int64).reshape(-1, 2)


@dataclass(frozen=True, eq=False)
class Intrinsic:
    """What does not change when a shape bends, on a thin mesh.

    Lengths along the surface are along edges, and shares of the ``diameter``: the longest from any of the `landmarks`. Those
    between all vertices would take long, and keep Python's lock meanwhile.
    """

    mesh: DecimatedMesh

    @cached_property
    def landmarks(self) -> Int[Ints, " L"]:
        """Vertices that are evenly spread, and stand for all where that suffices."""
        return farthest_points(self.mesh.verts, min(_LANDMARKS, len(self.mesh.verts)))

    @cached_property
    def _from_landmarks(self) -> Float[Floats, "L V"]:
        return np.asarray(dijkstra(self.mesh.graph, indices=self.landmarks))

    @cached_property
    def diameter(self) -> float:
        return float(self._from_landmarks.max())

    @cached_property
    def among_landmarks(self) -> Float[Floats, "L L"]:
        """Distances between them."""
        return np.asarray(self._from_landmarks[:, self.landmarks] / self.diameter)

    def distances_from(self, vertices: Int[Ints, " N"]) -> Float[Floats, "N V"]:
        """From some vertices to all."""
        return np.asarray(dijkstra(self.mesh.graph, indices=vertices) / self.diameter)

    @cached_property
    def functions(self) -> Float[Floats, "V K"]:
        """The first eigenfunctions of the Laplacian."""
        mesh, V = self.mesh, len(self.mesh.verts)
        stiffness, mass = robust_laplacian.mesh_laplacian(mesh.verts, mesh.faces)
        start = np.random.default_rng(0).standard_normal(V)
        return np.asarray(eigsh(stiffness, min(_FUNCTIONS, V - 2), mass, sigma=-1e-8, v0=start)[1])

    @cached_property
    def eccentricity(self) -> Float[Floats, " V"]:
        """Mean distance from all of the surface, by the landmarks: small in the middle, large at extremities."""
        nearest = self._from_landmarks.argmin(0)
        around = np.bincount(nearest, self.mesh.areas, len(self.landmarks))
        return np.asarray(around @ self._from_landmarks / self.diameter)

    @cached_property
    def extremities(self) -> Int[Ints, " T"]:
        """The vertices furthest out, those first that stand out most: maxima of the eccentricity by their persistence."""
        maxima = _persistent_maxima(self.eccentricity, self.mesh.graph)
        found = np.array([vertex for persistence, vertex in maxima if persistence >= _PERSISTENCE], np.int64)
        apart, chosen = self.distances_from(found)[:, found] > _APART, list[int]()
        for number in range(len(found)):
            if len(chosen) < _MOST and apart[number, chosen].all():
                chosen.append(number)
        return found[chosen]

    @cached_property
    def from_extremities(self) -> Float[Floats, "T V"]:
        """Distances from each extremity."""
        return self.distances_from(self.extremities)

    @cached_property
    def from_middle(self) -> Float[Floats, " V"]:
        """Distances from where the eccentricity is least."""
        return np.asarray(self.distances_from(np.array([self.eccentricity.argmin()]))[0])

    @cached_property
    def profiles(self) -> Float[Floats, "T R"]:
        """Share of the surface within growing distances of each extremity: a thin limb has little nearby."""
        within = self.from_extremities[:, :, None] < np.linspace(0.05, 1, _PROFILE)
        return np.asarray(np.einsum("tvr,v->tr", within.astype(np.float64), self.mesh.areas))

    def _on_the_way(self, shares: Sequence[float]) -> Int[Ints, "S T"]:
        """The vertex at each share of the way from the middle to each extremity."""
        near, reach = self.from_middle, self.from_middle[self.extremities][:, None]
        detour = near + self.from_extremities - reach  # (T, V), 0 on the way to each
        return np.array([(np.abs(near - share * reach) + 2 * detour).argmin(1) for share in shares])

    @cached_property
    def spread(self) -> Float[Floats, "T T"]:
        """How far apart the ways from the middle to two extremities run, from 0 for the closest two to 1 for the furthest:
        distances between points at the same shares of each way, whatever their lengths. The order of legs along a body, or
        of arms around it, is in these.
        """
        at = self._on_the_way(_SHARES)
        rows = self.distances_from(at.ravel()).reshape(*at.shape, -1)
        off = ~np.eye(at.shape[1], dtype=bool)
        spread = np.zeros(off.shape)
        for here, distances in zip(at, rows, strict=True):
            apart = distances[:, here]
            low, high = apart[off].min(), apart[off].max()
            spread += np.where(off, (apart - low) / max(high - low, 1e-9), 0) / len(_SHARES)
        return spread

    @cached_property
    def rings(self) -> list[list[Int[Ints, " N"]]]:
        """Of each limb, vertices around it: at some shares of the way from the middle, and at its end."""
        at = self._on_the_way(_RINGS).T
        rows, found = self.distances_from(at.ravel()).reshape(*at.shape, -1), []
        for before, places, distances in zip(self.from_extremities, at, rows, strict=True):
            # so close that it is not the body beside the limb
            limb = (
                (np.abs(before - before[place]) < _RING) & (away < _RING + 0.6 * min(before[place], 0.25))
                for place, away in zip(places, distances, strict=True)
            )
            found.append([*map(np.flatnonzero, limb), np.flatnonzero(before < _RING)])
        return found

    @cached_property
    def skeleton(self) -> Float[Floats, "T R 3"]:
        """The middle of each of the `rings`."""
        verts = self.mesh.verts
        return np.array([[verts[ring].mean(0) for ring in limb] for limb in self.rings]).reshape(-1, len(_RINGS) + 1, 3)

    @cached_property
    def tour(self) -> list[int]:
        """The extremities in the order in which they lie around the shape: along the shortest closed tour by `spread`."""
        return shortest_tour(self.spread)

    @cached_property
    def limbs(self) -> tuple[Float[Floats, " T"], Float[Floats, "V T"]]:
        """How far each extremity lies from the middle, and how far each vertex lies along the way there: from 0 in the
        middle, or on another limb, to 1 at the end, whatever the length of the limb (Gromov's product).
        """
        reach = self.from_middle[self.extremities]
        along = 0.5 * (self.from_middle[:, None] + reach - self.from_extremities.T)
        return reach, along / reach


def _persistent_maxima(height: Float[Floats, " V"], graph: csr_matrix) -> list[tuple[float, int]]:
    """Maxima of a function on a graph and how far each stands above the pass to a higher one; the highest persistence
    first. By joining vertices from the highest down (a merge tree).
    """
    parent, peak = np.full(len(height), -1), np.arange(len(height))

    def root(vertex: int) -> int:
        while parent[vertex] != vertex:
            parent[vertex] = parent[parent[vertex]]
            vertex = int(parent[vertex])
        return vertex

    found = [(float(np.ptp(height)), int(height.argmax()))]
    for vertex in np.argsort(-height, kind="stable").tolist():
        parent[vertex] = vertex
        around = graph.indices[graph.indptr[vertex] : graph.indptr[vertex + 1]]
        roots = sorted(
            {root(int(other)) for other in around if parent[other] >= 0} - {vertex}, key=lambda r: -height[peak[r]]
        )
        if roots:
            parent[vertex] = roots[0]
        for lower in roots[1:]:
            found.append((float(height[peak[lower]] - height[vertex]), int(peak[lower])))
            parent[lower] = roots[0]
    return sorted(found, reverse=True)


def shortest_tour(lengths: Float[Floats, "T T"]) -> list[int]:
    """The order of a shortest closed tour through all of a few places (Held and Karp's algorithm: T^2 2^T steps)."""
    count = len(lengths)
    if count < 4:
        return list(range(count))
    last = count - 1  # where the tour begins; a set of the others is a number
    own = np.arange(last)
    cost, before = np.full((1 << last, last), np.inf), np.zeros((1 << last, last), np.int64)
    cost[1 << own, own] = lengths[last, own]
    sets = np.arange(1 << last)
    sizes = (sets[:, None] >> own & 1).sum(1)
    for size, new in product(range(1, last), own):
        some = sets[(sizes == size) & (sets >> new & 1 == 0)]
        through = cost[some] + lengths[:last, new]
        cost[some | 1 << new, new] = through.min(1)
        before[some | 1 << new, new] = through.argmin(1)
    at, visited = int((cost[-1] + lengths[:last, last]).argmin()), (1 << last) - 1
    tour = [last]
    while visited:
        tour.append(at)
        at, visited = int(before[visited, at]), visited & ~(1 << at)
    return tour
