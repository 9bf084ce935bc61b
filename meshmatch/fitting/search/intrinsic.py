"""A simplified shape and its intrinsic properties, which do not change when it bends, for the search without a model.

These are distances along the surface, Laplacian eigenfunctions, and extremities: the ends of limbs, fins, legs and handles.
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

_N_FUNCTIONS = 50  # number of eigenfunctions
_SMOOTHING_LENGTHS = 0.02, 0.08  # units of sqrt(area)
_RELIEF_STEP = 0.001  # relief is rounded to multiples of this, so that a plane has none
_NORMAL_WEIGHT = 0.1  # weight of unit normals against positions
_REGULARIZATION = 1e-12  # for vertices whose triangles have no area
_N_LANDMARKS = 300  # evenly spread vertices that represent all
_N_DISTANCES = 12  # number of distances in the area profile of an extremity
# Shares of the diameter along the surface: an extremity is a maximum of the eccentricity with at least the first
# persistence, farther than the second number from the others. The third number is the maximum number of extremities.
_MIN_PERSISTENCE, _MIN_DISTANCE, _MAX_EXTREMITIES = 0.04, 0.08, 14
_PATH_SHARES = (0.15, 0.3, 0.5, 0.7)  # shares of the paths from the center to extremities at which paths are compared
# Shares of the paths at which there are rings, and half the width of a ring.
_RING_SHARES, _RING_HALF_WIDTH = (0.25, 0.5, 0.75), 0.03


@dataclass(frozen=True, eq=False)
class SimplifiedMesh:
    """A shape reduced to about the given number of triangles, on some of its own vertices; in the shape's frame."""

    verts: Float[Floats, "V 3"]
    faces: Int[Ints, "F 3"]

    @classmethod
    def of(cls, shape: Shape, faces: int) -> SimplifiedMesh:
        """Simplify a shape. Raises `InputError` for a cloud whose points do not lie on a surface."""
        kept, corners = low_mesh(shape, faces)
        used, renumbered = np.unique(corners, return_inverse=True)
        if len(used) > faces:  # twice as many as on a closed surface: too fragmented, so treat it as a cloud
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
        """Tree over positions and weighted normals."""
        return feature_tree(with_normals(self.verts, self.normals, _NORMAL_WEIGHT))

    @cached_property
    def relief(self) -> Float[Floats, "V R"]:
        """Height of each vertex above the smoothed surface, as ranks by area from -1/2 to 1/2.

        There is one column for each of two smoothing lengths. Noses are high, navels low.
        """
        stiffness, mass = robust_laplacian.mesh_laplacian(self.verts, self.faces)
        ranks = []
        # about the length of an edge
        shortest = np.sqrt(2 * vertex_areas(self.verts, self.faces).sum() / len(self.faces))
        for length in np.maximum(_SMOOTHING_LENGTHS, shortest):
            system = csc_matrix(mass + length**2 * stiffness + _REGULARIZATION * identity(len(self.verts)))
            smooth = splu(system).solve(mass @ self.verts)
            heights = ((self.verts - smooth) * self.normals).sum(1)
            height, level = np.unique(np.round(heights / _RELIEF_STEP), return_inverse=True)
            share = np.bincount(level, self.areas, len(height))
            ranks.append((np.cumsum(share) - share / 2 - 0.5)[level])
        return np.stack(ranks, 1)

    def likeness(self, other: SimplifiedMesh, moved: OrientedPoints) -> float:
        """Correlation (0..1) of the relief with that of another mesh.

        ``moved`` are this mesh's vertices, deformed onto the other mesh; each is compared with the nearest vertex there.
        """
        nearest = other.tree.query(with_normals(moved.points, moved.normals, _NORMAL_WEIGHT))[1]
        own, theirs = self.relief, other.relief[nearest]  # the mean of `own` is 0 already
        theirs = theirs - self.areas @ theirs
        spreads = np.sqrt((self.areas @ own**2) * (self.areas @ theirs**2))
        return float(np.abs((self.areas @ (own * theirs)) / np.maximum(spreads, 1e-12)).mean())

    @cached_property
    def graph(self) -> csr_matrix:
        """Edge lengths as a graph; separate parts are connected where they are nearest.

        So all distances are finite.
        """
        edges = edges_of(self.faces).vertices.astype(np.int64)
        length = edge_lengths(self.verts, edges)
        part = connected_components(coo_matrix((length, edges.T), (len(self.verts),) * 2), directed=False)[1]
        bridges = _bridges(self.verts, part.astype(np.int64))
        edges = np.concatenate([edges, bridges])
        length = np.maximum(edge_lengths(self.verts, edges), 1e-9)
        graph = coo_matrix((length, edges.T), (len(self.verts),) * 2).tocsr()
        return graph + graph.T


def _bridges(verts: Float[Floats, "V 3"], part: Int[Ints, " V"]) -> Int[Ints, "N 2"]:
    """Pairs of vertices that connect all parts.

    Each part, from the second largest on, is connected to the nearest of the larger ones.
    """
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
    """Intrinsic properties of a shape, on a simplified mesh.

    Distances are along edges, relative to the ``diameter``: the largest distance from any of the `landmarks`. Distances
    between all vertices would take long, and would hold Python's lock meanwhile.
    """

    mesh: SimplifiedMesh

    @cached_property
    def landmarks(self) -> Int[Ints, " L"]:
        """Evenly spread vertices that represent all vertices where that suffices."""
        return farthest_points(self.mesh.verts, min(_N_LANDMARKS, len(self.mesh.verts)))

    @cached_property
    def _from_landmarks(self) -> Float[Floats, "L V"]:
        return np.asarray(dijkstra(self.mesh.graph, indices=self.landmarks))

    @cached_property
    def diameter(self) -> float:
        """Largest distance along the surface from any landmark."""
        return float(self._from_landmarks.max())

    @cached_property
    def landmark_distances(self) -> Float[Floats, "L L"]:
        """Distances between the landmarks."""
        return np.asarray(self._from_landmarks[:, self.landmarks] / self.diameter)

    def distances_from(self, vertices: Int[Ints, " N"]) -> Float[Floats, "N V"]:
        """Distances from some vertices to all."""
        return np.asarray(dijkstra(self.mesh.graph, indices=vertices) / self.diameter)

    @cached_property
    def functions(self) -> Float[Floats, "V K"]:
        """The first eigenfunctions of the Laplacian."""
        mesh, V = self.mesh, len(self.mesh.verts)
        stiffness, mass = robust_laplacian.mesh_laplacian(mesh.verts, mesh.faces)
        start = np.random.default_rng(0).standard_normal(V)
        return np.asarray(eigsh(stiffness, min(_N_FUNCTIONS, V - 2), mass, sigma=-1e-8, v0=start)[1])

    @cached_property
    def eccentricity(self) -> Float[Floats, " V"]:
        """Mean distance to the whole surface, estimated by the landmarks: small in the center, large at extremities."""
        nearest = self._from_landmarks.argmin(0)
        around = np.bincount(nearest, self.mesh.areas, len(self.landmarks))
        return np.asarray(around @ self._from_landmarks / self.diameter)

    @cached_property
    def extremities(self) -> Int[Ints, " T"]:
        """The outermost vertices, most prominent first: maxima of the eccentricity, by persistence."""
        maxima = _persistent_maxima(self.eccentricity, self.mesh.graph)
        found = np.array([vertex for persistence, vertex in maxima if persistence >= _MIN_PERSISTENCE], np.int64)
        is_apart, chosen = self.distances_from(found)[:, found] > _MIN_DISTANCE, list[int]()
        for number in range(len(found)):
            if len(chosen) < _MAX_EXTREMITIES and is_apart[number, chosen].all():
                chosen.append(number)
        return found[chosen]

    @cached_property
    def from_extremities(self) -> Float[Floats, "T V"]:
        """Distances from each extremity."""
        return self.distances_from(self.extremities)

    @cached_property
    def from_middle(self) -> Float[Floats, " V"]:
        """Distances from the center, where the eccentricity is smallest."""
        return np.asarray(self.distances_from(np.array([self.eccentricity.argmin()]))[0])

    @cached_property
    def profiles(self) -> Float[Floats, "T R"]:
        """Share of the surface within increasing distances of each extremity; small near the end of a thin limb."""
        within = self.from_extremities[:, :, None] < np.linspace(0.05, 1, _N_DISTANCES)
        return np.asarray(np.einsum("tvr,v->tr", within.astype(np.float64), self.mesh.areas))

    def _path_vertices(self, shares: Sequence[float]) -> Int[Ints, "S T"]:
        """The vertex at each share of the path from the center to each extremity."""
        from_middle, reach = self.from_middle, self.from_middle[self.extremities][:, None]
        detour = from_middle + self.from_extremities - reach  # (T, V), 0 on the way to each
        return np.array([(np.abs(from_middle - share * reach) + 2 * detour).argmin(1) for share in shares])

    @cached_property
    def spread(self) -> Float[Floats, "T T"]:
        """Distances between the paths from the center to two extremities, from 0 for the closest two to 1 for the farthest.

        These are mean distances between points at the same shares of two paths, whatever the paths' lengths. They reflect
        the order of legs along a body, or of arms around it.
        """
        at = self._path_vertices(_PATH_SHARES)
        rows = self.distances_from(at.ravel()).reshape(*at.shape, -1)
        off = ~np.eye(at.shape[1], dtype=bool)
        spread = np.zeros(off.shape)
        for here, distances in zip(at, rows, strict=True):
            apart = distances[:, here]
            low, high = apart[off].min(), apart[off].max()
            spread += np.where(off, (apart - low) / max(high - low, 1e-9), 0) / len(_PATH_SHARES)
        return spread

    @cached_property
    def rings(self) -> list[list[Int[Ints, " N"]]]:
        """For each limb, rings of vertices around it.

        There is one at each of some shares of the path from the center, and the last is the limb's end.
        """
        at = self._path_vertices(_RING_SHARES).T
        rows, found = self.distances_from(at.ravel()).reshape(*at.shape, -1), []
        for before, places, distances in zip(self.from_extremities, at, rows, strict=True):
            # near the path, which excludes the body next to the limb
            limb = (
                (np.abs(before - before[place]) < _RING_HALF_WIDTH)
                & (away < _RING_HALF_WIDTH + 0.6 * min(before[place], 0.25))
                for place, away in zip(places, distances, strict=True)
            )
            found.append([*map(np.flatnonzero, limb), np.flatnonzero(before < _RING_HALF_WIDTH)])
        return found

    @cached_property
    def skeleton(self) -> Float[Floats, "T R 3"]:
        """Centers of the `rings`."""
        verts = self.mesh.verts
        return np.array([[verts[ring].mean(0) for ring in limb] for limb in self.rings]).reshape(
            -1, len(_RING_SHARES) + 1, 3
        )

    @cached_property
    def tour(self) -> list[int]:
        """The extremities in their order around the shape: the shortest closed tour by `spread`."""
        return shortest_tour(self.spread)

    @cached_property
    def limbs(self) -> tuple[Float[Floats, " T"], Float[Floats, "V T"]]:
        """Distance of each extremity from the center, and the position of each vertex along the limb towards it.

        The position is 0 in the center or on another limb and 1 at the end, whatever the limb's length (Gromov product).
        """
        reach = self.from_middle[self.extremities]
        along = 0.5 * (self.from_middle[:, None] + reach - self.from_extremities.T)
        return reach, along / reach


def _persistent_maxima(height: Float[Floats, " V"], graph: csr_matrix) -> list[tuple[float, int]]:
    """Maxima of a function on a graph with their persistence, the height above the pass to a higher maximum; highest first.

    Computed by adding vertices from the highest down (a merge tree).
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
        neighbours = graph.indices[graph.indptr[vertex] : graph.indptr[vertex + 1]]
        roots = sorted(
            {root(int(other)) for other in neighbours if parent[other] >= 0} - {vertex}, key=lambda r: -height[peak[r]]
        )
        if roots:
            parent[vertex] = roots[0]
        for lower in roots[1:]:
            found.append((float(height[peak[lower]] - height[vertex]), int(peak[lower])))
            parent[lower] = roots[0]
    return sorted(found, reverse=True)


def shortest_tour(lengths: Float[Floats, "T T"]) -> list[int]:
    """A shortest closed tour through a few places, by the Held-Karp algorithm (T^2 2^T steps)."""
    count = len(lengths)
    if count < 4:
        return list(range(count))
    last = count - 1  # start of the tour; subsets of the other places are bit masks
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
