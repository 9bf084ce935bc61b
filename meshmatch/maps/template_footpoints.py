"""Where every vertex of a shape belongs on the template, also where two sheets of the surface touch.

There the closest point may lie on the wrong sheet. Neighbours whose images lie far apart reveal it: the small islands
that such discontinuities cut off are searched again, near the images of their surroundings.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints
from meshmatch.fitting.fit import Fit
from meshmatch.geometry.triangles import edge_lengths, interpolate, is_discontinuous, vertex_normals
from meshmatch.maps.surface import Footpoints, Surface
from meshmatch.shapes.repair import Repaired
from meshmatch.shapes.shape import Shape

_ROUNDS = 3
# The share of a cloud's points that are neighbours of one where noise is 1 % of the diagonal; and the least and the
# largest number of them. Set by hand on noisy scans of bodies.
_NEIGHBOURS, _NEIGHBOUR_RANGE = 0.005, (9, 64)
_CHUNK = 16_384  # points at a time
# A piece with at least this share of the surface is not an island. Set by hand.
_MAINLAND = 0.06
# Steps from the rim into an island over which images of the surroundings are extended.
_STEPS = 120
Found = TypeVar("Found", bound=Footpoints)


def template_footpoints(shape: Shape, fit: Fit, workers: int = 1) -> tuple[Footpoints, Float[Floats, "V 3"]]:
    """The point of the fitted template for every vertex, and the same point of the resting template.

    Points of a cloud have no edges that would reveal an island, and noise takes them across: each is searched again,
    near the median of its neighbours.
    """
    points, normals = in_core_frame(shape, fit)
    surface = Surface(fit.points, fit.faces, vertex_normals(fit.points, fit.faces), fit.resting)
    found = closest_footpoints(shape, fit, workers)

    def resting(foot: Footpoints) -> Floats:
        return foot.values(fit.faces, fit.resting)

    if not shape.is_cloud:

        def search(rows: Ints, near: Floats) -> Footpoints:
            return surface.query(points[rows], normals[rows], workers, near)

        return reassign_islands(points, shape.edges.vertices, shape.vertex_areas, found, resting, search, _ROUNDS)
    near = neighbours(points, shape.roughness)
    for _ in range(_ROUNDS):
        found = surface.query(points, normals, workers, neighbour_medians(resting(found), near))
    return found, resting(found)


def closest_footpoints(shape: Shape, fit: Fit, workers: int = 1) -> Footpoints:
    """Closest points of the fitted template, of those that face the same way as the vertices of a shape."""
    surface = Surface(fit.points, fit.faces, vertex_normals(fit.points, fit.faces))
    return surface.query(*in_core_frame(shape, fit), workers)


def neighbours(points: Float[Floats, "V 3"], roughness: float) -> Int[Ints, "V K"]:
    """The nearest points of each of a cloud, itself first: more of them where noise is large (`Shape.roughness`)."""
    k = int(np.clip(_NEIGHBOURS * roughness * len(points), *_NEIGHBOUR_RANGE))
    return np.asarray(cKDTree(points).query(points, min(k, len(points)))[1])


def neighbour_medians(values: Float[Floats, "V D"], near: Int[Ints, "V K"]) -> Float[Floats, "V D"]:
    """Median, coordinate by coordinate, of the values of neighbours."""
    found = np.empty_like(values)
    for low in range(0, len(values), _CHUNK):
        part = slice(low, low + _CHUNK)
        found[part] = np.median(values[near[part]], axis=1)
    return found


def in_core_frame(shape: Shape, fit: Fit) -> tuple[Float[Floats, "V 3"], Float[Floats, "V 3"]]:
    """Vertices and unit normals of a shape in the core frame, where its fit is; zero normals for a cloud."""
    points = fit.frame.apply(shape.verts)
    return points, np.zeros_like(points) if shape.is_cloud else shape.vertex_normals @ fit.frame.rotation.T


def reassign_islands(
    verts: Float[Floats, "V 3"],
    edges: Int[Ints, "E 2"],
    areas: Float[Floats, " V"],
    found: Found,
    images: Callable[[Found], Float[Floats, "N 3"]],
    search: Callable[[Int[Ints, " M"], Float[Floats, "M 3"]], Found],
    rounds: int,
) -> tuple[Found, Float[Floats, "V 3"]]:
    """Search again for the vertices on small islands of a map of a mesh.

    The mesh is in units of sqrt(area), `areas` are those around its vertices in any unit. Each vertex lies at a place in
    `found`; `images` are the points themselves, in units of their own surface's sqrt(area), and `search` gives
    footpoints of some vertices near such points. Returns the footpoints and their images.
    """
    length = edge_lengths(verts, edges)
    image = images(found)
    for _ in range(rounds):
        island = small_islands(edges, length, image, areas)
        if not island.any():
            break
        around = surrounding_values(edges, image, island)
        rows = np.flatnonzero(island & np.isfinite(around).all(axis=1))
        if not len(rows):
            break
        again = search(rows, around[rows])
        found, image[rows] = found.updated(rows, again), images(again)
    return found, image


def small_islands(
    edges: Int[Ints, "E 2"], length: Float[Floats, " E"], image: Float[Floats, "V 3"], areas: Float[Floats, " V"]
) -> Bool[Bools, " V"]:
    """True on small pieces between discontinuities: edges whose ends have images much further apart than they are.

    Lengths are in units of sqrt(area); ``areas`` are those around the vertices.
    """
    V = len(image)
    continuous = ~is_discontinuous(edge_lengths(image, edges), length)
    if continuous.all():
        return np.zeros(V, bool)
    kept = edges[continuous]
    graph = csr_matrix((np.ones(len(kept)), (kept[:, 0], kept[:, 1])), (V, V))
    piece = connected_components(graph, directed=False)[1]
    return np.asarray((np.bincount(piece, areas) < _MAINLAND * areas.sum())[piece])


def surrounding_values(
    edges: Int[Ints, "E 2"], values: Float[Floats, "V D"], unknown: Bool[Bools, " V"]
) -> Float[Floats, "V D"]:
    """Values with the unknown rows replaced by the average of their surroundings; NaN out of reach."""
    V, rows = len(values), np.flatnonzero(unknown)
    edges = edges[unknown[edges].any(axis=1)]
    graph = csr_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), (V, V))
    graph = (graph + graph.T).tocsr()
    part = graph[rows]
    filled = np.where(unknown[:, None], 0.0, values)
    known = (~unknown).astype(float)
    for _ in range(_STEPS):
        weight = part @ known
        total = part @ (known[:, None] * filled)
        filled[rows] = np.where(weight[:, None] > 0, total / np.maximum(weight, 1e-12)[:, None], filled[rows])
        known[rows] = weight > 0
    filled[rows[known[rows] == 0]] = np.nan
    return filled


class SurfaceBinding:
    """Every vertex of a shape is bound to its footpoint on the fitted template.

    The offset from the footpoint is kept, and turns with the template (``turns`` are rotations at its vertices): so the
    pose of the fit reproduces the shape with all its detail.
    """

    def __init__(self, part: Repaired, fit: Fit, turns: Float[Floats, "V 3 3"], workers: int = 1) -> None:
        self._shape = part.original
        foot, _ = template_footpoints(part.shape, fit, workers)
        rows = part.original_to_repaired  # all vertices of the original are bound
        self._corners, self._weights = fit.faces[foot.face[rows]], foot.barycentric[rows]
        offset = fit.frame.apply(part.original.verts) - self._on(fit.points)
        self._offsets = [np.einsum("nji,nj->ni", turns[self._corners[:, k]], offset) for k in range(3)]

    def at(self, points: Float[Floats, "V 3"], turns: Float[Floats, "V 3 3"]) -> Float[Floats, "N 3"]:
        """Vertices (N, 3) of the shape for points (V, 3) and rotations (V, 3, 3) of the template; core frame."""
        verts = self._on(points)
        for k, offset in enumerate(self._offsets):
            turned = np.einsum("nij,nj->ni", turns[self._corners[:, k]], offset)
            verts += self._weights[:, k, None] * turned
        return verts

    def shape(self, verts: Float[Floats, "N 3"], name: str = "") -> Shape:
        """The shape with other positions (N, 3) of its vertices."""
        return Shape(verts, self._shape.faces, name, self._shape.colors, self._shape.invalid)

    def _on(self, points: Floats) -> Floats:
        return interpolate(points, self._corners, self._weights)
