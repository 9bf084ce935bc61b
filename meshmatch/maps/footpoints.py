"""Closest points on a surface, among those with similar normals, and the footpoints of a shape's vertices on the template.

`Surface` is made for many queries near it, such as the vertices of a shape around a fitted template: it finds the nearest
vertex in a space of positions and normals, then the closest of that vertex's triangles. It is fast and can use places
on the rest template, but is not exact for triangles that are large compared with the distance. `meshmatch.maps.mapped_mesh`
is exact for triangles of any size; `meshmatch.transfer.surface_walk` starts from a known face and stays on its sheet.

Where two sheets of a surface touch, the closest point may lie on the wrong one. Discontinuities reveal it: neighbours whose
images lie far apart. The small islands that discontinuities cut off are searched again, near the images around them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Self, TypeVar

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints, Ints32
from meshmatch.fitting.fit import Fit
from meshmatch.geometry.oriented import feature_tree
from meshmatch.geometry.trees import cKDTree
from meshmatch.geometry.triangles import (
    closest_on_triangles,
    edge_lengths,
    interpolate,
    is_discontinuous,
    squared_lengths,
    vertex_normals,
)
from meshmatch.maps.indices import corners_of
from meshmatch.shapes.repair import Repaired
from meshmatch.shapes.shape import Shape
from meshmatch.threads import parallel_map

# Distance per unit of difference between unit normals, in units of sqrt(area); opposite normals differ by 2. Enough to
# separate the sides of a thin wall. A larger weight would move points along the surface to where it bends the same way.
# Set by hand.
NORMAL_WEIGHT = 0.02
# Weight of a distance on the rest template relative to one in space. Set by hand.
RESTING_WEIGHT = 0.4
# Queries per chunk, so that their data stay in the processor's cache.
_CHUNK = 2048
_ROUNDS = 3
# Neighbours of a point, as a share of a cloud's points, where noise is 1 % of the diagonal; and the range of their number.
# Set by hand on noisy scans of bodies.
_NEIGHBOURS, _NEIGHBOUR_RANGE = 0.005, (9, 64)
_MEDIAN_CHUNK = 16_384  # points per chunk
# A connected piece with at least this share of the surface is not an island. Set by hand.
_MAX_ISLAND = 0.06
# An island at least as large as a hand (share of the surface) stays where it is if its new images would be near the template
# (units of sqrt(area)) but face another way (loss of the mean cosine): it is a limb that a scan has fused with what it
# touches. An island whose new images would be far away was fitted wrong, and a smaller one may lie on either sheet. Set
# by hand.
_MIN_LIMB, _MAX_LIMB_DISTANCE, _MIN_COSINE_LOSS = 0.01, 0.04, 0.35
# Steps by which images of the surroundings are extended from the rim into an island.
_DIFFUSION_STEPS = 120
Found = TypeVar("Found", bound="Footpoints")


@dataclass(frozen=True, eq=False)
class Footpoints:
    """Closest points on a surface to N queries, with distances in the unit of the surface.

    `vertex` is the corner with the largest weight, or the one at which the search started. `face` is -1 where the point is
    the vertex itself (always for a cloud); the barycentric weights are then (1, 0, 0).
    """

    vertex: Int[Ints, " N"]
    face: Int[Ints, " N"]
    barycentric: Float[Floats, "N 3"]
    distance: Float[Floats, " N"]

    def values(self, faces: Int[Ints, "F 3"], values: Float[Floats, "V D"]) -> Float[Floats, "N D"]:
        """Interpolate values (V, D) of the surface's vertices at the points."""
        found = np.empty((len(self.vertex), values.shape[1]))
        for low in range(0, len(found), _CHUNK):
            part = slice(low, low + _CHUNK)
            corners = corners_of(faces, self.face[part], self.vertex[part])
            found[part] = interpolate(values, corners, self.barycentric[part])
        return found

    def rows(self, rows: Int[Ints, " M"]) -> Self:
        """Select M of the points."""
        return replace(self, **{field.name: getattr(self, field.name)[rows] for field in fields(self)})

    def updated(self, rows: Int[Ints, " M"], other: Self) -> Self:
        """Return a copy in which M rows are replaced by those of `other`."""
        arrays = {field.name: getattr(self, field.name).copy() for field in fields(self)}
        for name, array in arrays.items():
            array[rows] = getattr(other, name)
        return replace(self, **arrays)


def concatenated(parts: Sequence[Footpoints]) -> Footpoints:
    """Concatenate footpoints."""
    names = [field.name for field in fields(Footpoints)]
    return Footpoints(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


class Surface:
    """A search structure for closest points on a mesh or cloud; lengths in units of sqrt(area).

    `normals` are unit vectors, zeros where unknown; None ignores them. `resting` are the vertices' places on the rest
    template: queries that have such places as well find the right one of two sheets that touch, such as a hand on a thigh.
    """

    def __init__(
        self,
        verts: Float[Floats, "V 3"],
        faces: Int[Ints, "F 3"],
        normals: Float[Floats, "V 3"] | None = None,
        resting: Float[Floats, "V 3"] | None = None,
    ) -> None:
        self.verts, self.faces = verts, faces
        # the faces around each vertex, concatenated (CSC)
        corners = np.ones(faces.size, np.int8), faces.reshape(-1), np.arange(0, faces.size + 1, 3)
        at_vertices = csr_matrix(corners, (len(faces), len(verts))).tocsc()
        self._around, self._start = (array.astype(np.int64) for array in (at_vertices.indices, at_vertices.indptr))
        self._used = np.flatnonzero(np.diff(self._start)) if len(faces) else np.arange(len(verts))
        features = _features(verts, normals, resting)
        self._tree = feature_tree(features if len(self._used) == len(verts) else features[self._used])

    def query(
        self,
        points: Float[Floats, "N 3"],
        normals: Float[Floats, "N 3"] | None = None,
        workers: int = 1,
        resting: Float[Floats, "N 3"] | None = None,
    ) -> Footpoints:
        """Find the closest points; ``normals`` and ``resting`` are given if and only if the surface has them."""
        N = len(points)
        vertex = np.empty(N, np.int64)
        face = np.full(N, -1, np.int64)
        weights = np.tile([1.0, 0.0, 0.0], (N, 1))
        distance = np.empty(N)

        def query_chunk(low: int) -> None:
            part = slice(low, min(low + _CHUNK, N))
            features = _features(*(None if rows is None else rows[part] for rows in (points, normals, resting)))
            vertex[part] = self._used[self._tree.query(features)[1]]
            if len(self.faces):
                face[part], weights[part], distance[part] = self._on_faces(points[part], vertex[part])
            else:
                distance[part] = np.linalg.norm(points[part] - self.verts[vertex[part]], axis=1)

        parallel_map(query_chunk, range(0, N, _CHUNK), threads=workers)
        return Footpoints(vertex, face, weights, distance)

    def _on_faces(self, points: Floats, vertex: Ints) -> tuple[Ints, Floats, Floats]:
        """Closest of the faces around each vertex (N,), barycentric weights (N, 3) and distance (N,)."""
        counts = (self._start[1:] - self._start[:-1]).take(vertex)
        first = np.cumsum(counts) - counts
        query = np.repeat(np.arange(len(vertex)), counts)
        face = self._around.take(np.arange(len(query)) + (self._start.take(vertex) - first).take(query))
        a, b, c = (self.verts.take(corner.take(face), 0) for corner in self.faces.T)
        query_points = points.take(query, 0)
        weights = closest_on_triangles(query_points, a, b, c)
        squared = squared_lengths(interpolate(self.verts, self.faces.take(face, 0), weights) - query_points)
        # Of equally near faces of a query, the first.
        nearest = np.flatnonzero(squared == np.minimum.reduceat(squared, first).take(query))
        best = nearest[np.searchsorted(nearest, first)]
        return face[best], weights[best], np.sqrt(squared[best])


def _features(*rows: Floats | None) -> Floats:
    weighted = zip((1.0, NORMAL_WEIGHT, RESTING_WEIGHT), rows, strict=True)
    return np.concatenate([weight * each for weight, each in weighted if each is not None], 1)


def template_footpoints(shape: Shape, fit: Fit, workers: int = 1) -> tuple[Footpoints, Float[Floats, "V 3"]]:
    """Find the footpoint of every vertex on the fitted template, and the corresponding points on the rest template.

    Islands of a mesh are searched again (`reassign_islands`). A cloud has no edges that would reveal islands, and its noise
    moves points to other sheets: each point is searched again near the median of its neighbours' places.
    """
    points, normals = in_core_frame(shape, fit)
    facing = vertex_normals(fit.points, fit.faces)
    found = Surface(fit.points, fit.faces, facing).query(points, normals, workers)
    surface = Surface(fit.points, fit.faces, facing, fit.resting)

    def fused(rows: Ints, island: Ints, before: Footpoints, after: Footpoints) -> Bools:
        """Mask of the islands (indexed by number) that are limbs that a scan has fused with their surroundings."""
        areas = shape.vertex_areas[rows]
        alike = [(normals[rows] * foot.values(fit.faces, facing)).sum(1) for foot in (after, before)]
        sums = [np.bincount(island, areas * each) for each in (after.distance, alike[1] - alike[0])]
        area = np.bincount(island, areas)
        limb = area >= _MIN_LIMB * shape.vertex_areas.sum()
        return np.asarray(limb & (sums[0] < _MAX_LIMB_DISTANCE * area) & (sums[1] > _MIN_COSINE_LOSS * area))

    def resting(foot: Footpoints) -> Floats:
        return foot.values(fit.faces, fit.resting)

    if not shape.is_cloud:

        def search(rows: Ints, near: Floats) -> Footpoints:
            return surface.query(points[rows], normals[rows], workers, near)

        return reassign_islands(
            points, shape.edges.vertices, shape.vertex_areas, found, resting, search, _ROUNDS,
            fused if fit.verdict != "poor" else None,  # a poor fit may have put a limb onto another
        )  # fmt: skip
    near = neighbours(points, shape.roughness)
    for _ in range(_ROUNDS):
        found = surface.query(points, normals, workers, neighbour_medians(resting(found), near))
    return found, resting(found)


def closest_footpoints(shape: Shape, fit: Fit, workers: int = 1) -> Footpoints:
    """Closest points on the fitted template, among those with normals like the shape's; islands are left as they are."""
    surface = Surface(fit.points, fit.faces, vertex_normals(fit.points, fit.faces))
    return surface.query(*in_core_frame(shape, fit), workers)


def neighbours(points: Float[Floats, "V 3"], roughness: float) -> Int[Ints, "V K"]:
    """Indices of each point's nearest points, itself first; K grows with noise (``roughness``, `Shape.roughness`)."""
    k = int(np.clip(_NEIGHBOURS * roughness * len(points), *_NEIGHBOUR_RANGE))
    return np.asarray(cKDTree(points).query(points, min(k, len(points)))[1])


def neighbour_medians(values: Float[Floats, "V D"], near: Int[Ints, "V K"]) -> Float[Floats, "V D"]:
    """Componentwise median of the neighbours' values."""
    found = np.empty_like(values)
    for low in range(0, len(values), _MEDIAN_CHUNK):
        part = slice(low, low + _MEDIAN_CHUNK)
        found[part] = np.median(values[near[part]], axis=1)
    return found


def in_core_frame(shape: Shape, fit: Fit) -> tuple[Float[Floats, "V 3"], Float[Floats, "V 3"]]:
    """Vertices and unit normals of a shape in the core frame of its fit; zero normals for a cloud."""
    points = fit.frame.apply(shape.verts)
    return points, np.zeros_like(points) if shape.is_cloud else shape.vertex_normals @ fit.frame.rotation.T


def reassign_islands(
    verts: Float[Floats, "V 3"],
    edges: Int[Ints32, "E 2"],
    areas: Float[Floats, " V"],
    found: Found,
    images: Callable[[Found], Float[Floats, "N 3"]],
    search: Callable[[Int[Ints, " M"], Float[Floats, "M 3"]], Found],
    rounds: int,
    stay: Callable[[Int[Ints, " M"], Int[Ints, " M"], Found, Found], Bool[Bools, " I"]] | None = None,
) -> tuple[Found, Float[Floats, "V 3"]]:
    """Search again for the images of vertices on small islands of a map of a mesh.

    Parameters
    ----------
    verts, edges, areas
        The mesh, in units of sqrt(area); its edges as `Edges` sorts them; areas around vertices, in any unit.
    found
        Footpoints of all vertices.
    images
        Returns the positions of footpoints, in units of their own surface's sqrt(area).
    search
        Returns footpoints of some vertices, near given positions.
    rounds
        Maximum number of repetitions.
    stay
        Returns which islands, indexed by number, are left unchanged; called with vertices, the number of the island of each,
        and their footpoints before and after.

    Returns
    -------
    tuple
        The footpoints and their positions.
    """
    length = edge_lengths(verts, edges)
    image = images(found)
    for _ in range(rounds):
        island = small_islands(edges, length, image, areas)
        around = surrounding_values(edges, image, island >= 0)
        rows = np.flatnonzero((island >= 0) & np.isfinite(around).all(axis=1))
        if not len(rows):
            break
        again = search(rows, around[rows])
        if stay is not None:
            moves = ~stay(rows, island[rows], found.rows(rows), again)[island[rows]]
            rows, again = rows[moves], again.rows(np.flatnonzero(moves))
        found, image[rows] = found.updated(rows, again), images(again)
    return found, image


def small_islands(
    edges: Int[Ints32, "E 2"], length: Float[Floats, " E"], image: Float[Floats, "V 3"], areas: Float[Floats, " V"]
) -> Int[Ints, " V"]:
    """Label the small pieces that discontinuities cut off; -1 for all other vertices.

    Discontinuities are edges whose ends have images much farther apart than the ends are. Edges are sorted by their first
    vertex. Lengths are in units of sqrt(area); ``areas`` are those around the vertices.
    """
    V = len(image)
    continuous = ~is_discontinuous(edge_lengths(image, edges), length)
    if continuous.all():
        return np.full(V, -1)
    begins = np.zeros(V + 1, np.int32)
    np.cumsum(np.bincount(edges[continuous, 0], minlength=V), out=begins[1:])
    graph = csr_matrix((np.ones(begins[-1], np.int8), edges[continuous, 1], begins), (V, V))
    piece = connected_components(graph, directed=False)[1]
    small = np.bincount(piece, areas) < _MAX_ISLAND * areas.sum()
    return np.where(small[piece], piece, -1).astype(np.int64)


def surrounding_values(
    edges: Int[Ints32, "E 2"], values: Float[Floats, "V D"], unknown: Bool[Bools, " V"]
) -> Float[Floats, "V D"]:
    """Fill in unknown rows by diffusion from their surroundings; NaN out of reach."""
    edges = edges[unknown[edges[:, 0]] | unknown[edges[:, 1]]]
    # the unknown vertices and their neighbours
    near, ends = np.unique(np.concatenate([edges.reshape(-1), np.flatnonzero(unknown)]), return_inverse=True)
    start, end = ends[: edges.size].reshape(-1, 2).T
    graph = csr_matrix((np.ones(len(start)), (start, end)), (len(near), len(near)))
    rows = np.flatnonzero(unknown[near])
    part = (graph + graph.T).tocsr()[rows]
    # values, and 1 in the last column; zeros where unknown
    state = np.where(unknown[near, None], 0.0, np.column_stack([values[near], np.ones(len(near))]))
    for _ in range(_DIFFUSION_STEPS):
        total = part @ state
        weight = total[:, -1:]
        state[rows] = np.where(weight > 0, total / np.maximum(weight, 1e-12), state[rows])
    filled = np.where(state[rows, -1:] > 0, state[rows, :-1], np.nan)
    every = values.copy()
    every[near[rows]] = filled
    return every


class SurfaceBinding:
    """Binds every vertex of a shape to its footpoint on the fitted template.

    Offsets from the footpoints are kept, and rotate with the template (``turns`` are rotations at its vertices), so the
    pose of the fit reproduces the shape in full detail.
    """

    def __init__(self, part: Repaired, fit: Fit, turns: Float[Floats, "V 3 3"], workers: int = 1) -> None:
        self._shape = part.original
        foot, _ = template_footpoints(part.shape, fit, workers)
        rows = part.original_to_repaired  # all vertices of the original are bound
        self._corners, self._weights = fit.faces[foot.face[rows]], foot.barycentric[rows]
        here = fit.frame.apply(part.original.verts)
        self._apart = np.zeros_like(here)
        if part.copied is not None:  # a copy moves with its original, at a constant offset
            self._apart[part.copied] = (here - here[part.kept_vertex[rows]])[part.copied]
        offset = here - self._apart - self._on(fit.points)
        self._offsets = [np.einsum("nji,nj->ni", turns[self._corners[:, k]], offset) for k in range(3)]

    def at(self, points: Float[Floats, "V 3"], turns: Float[Floats, "V 3 3"]) -> Float[Floats, "N 3"]:
        """Compute the shape's vertices (N, 3) from the template's points (V, 3) and rotations (V, 3, 3); core frame."""
        verts = self._on(points) + self._apart
        for k, offset in enumerate(self._offsets):
            turned = np.einsum("nij,nj->ni", turns[self._corners[:, k]], offset)
            verts += self._weights[:, k, None] * turned
        return verts

    def shape(self, verts: Float[Floats, "N 3"], name: str = "") -> Shape:
        """Return the shape with new positions (N, 3) of its vertices."""
        return Shape(verts, self._shape.faces, name, self._shape.colors, self._shape.invalid)

    def _on(self, points: Floats) -> Floats:
        return interpolate(points, self._corners, self._weights)
