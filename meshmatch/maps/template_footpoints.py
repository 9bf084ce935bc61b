"""Where on the template every vertex of a shape belongs, told apart where two sheets touch."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from meshmatch.fitting.fit import Fit
from meshmatch.geometry.topology import edges_of, is_discontinuous
from meshmatch.geometry.triangles import interpolate, vertex_normals
from meshmatch.maps.surface import Footpoints, Surface
from meshmatch.shapes.shape import Shape

# A piece between tears is believed if it has this share of the surface.
_BELIEVED = 0.06
_ROUNDS, _FILL_STEPS = 3, 120
# Of a cloud, the share of its points that are neighbours of one where noise is 1 % of the diagonal, and how many at
# least and at most.
_NEAR, _FEW_MANY = 0.005, (9, 64)
_CHUNK = 16_384  # points at a time


@lru_cache(maxsize=4)
def template_footpoints(shape: Shape, fit: Fit, workers: int = 1) -> tuple[Footpoints, np.ndarray]:
    """Points of the template as fitted for every vertex, and the same on the resting template (V, 3).

    The closest point in space jumps to another limb where two of them touch. Neighbours on the shape that
    belong far apart on the template reveal it: small pieces cut out by such tears ask again, knowing where
    their surroundings belong. Points of a cloud have no such edges, and noise carries them across: each asks
    again, knowing the median of its neighbours.
    """
    points, normals = in_core_frame(shape, fit)
    template_normals = vertex_normals(fit.points, fit.faces)
    foot = closest_footpoints(shape, fit, workers)
    resting = at_footpoints(foot, fit.faces, fit.resting)
    knowing = Surface(fit.points, fit.faces, template_normals, fit.resting)
    if shape.is_cloud:
        near = neighbours(points, shape.roughness)
        for _ in range(_ROUNDS):
            foot = knowing.query(points, normals, workers, neighbour_medians(resting, near))
            resting = at_footpoints(foot, fit.faces, fit.resting)
        return foot, resting
    edges = edges_of(shape.faces).vertices
    length = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
    for _ in range(_ROUNDS):
        doubted = small_islands(edges, length, resting, shape.vertex_areas)
        if not doubted.any():
            break
        around = surrounding_values(edges, resting, doubted)
        ask = np.flatnonzero(doubted & np.isfinite(around).all(1))
        if not len(ask):
            break
        again = knowing.query(points[ask], normals[ask], workers, around[ask])
        resting[ask] = at_footpoints(again, fit.faces, fit.resting)
        for name in ("vertex", "face", "barycentric", "distance"):
            getattr(foot, name)[ask] = getattr(again, name)
    return foot, resting


def closest_footpoints(shape: Shape, fit: Fit, workers: int = 1) -> Footpoints:
    """Closest points of the template as fitted, of those that face the same way as the vertices of a shape."""
    points, normals = in_core_frame(shape, fit)
    return Surface(fit.points, fit.faces, vertex_normals(fit.points, fit.faces)).query(
        points, normals, workers
    )


def neighbours(points: np.ndarray, roughness: float) -> np.ndarray:
    """(V, k) the nearest points of each of a cloud, itself first: more of them where noise is large (`Shape.roughness`)."""
    k = int(np.clip(_NEAR * roughness * len(points), *_FEW_MANY))
    return np.asarray(cKDTree(points).query(points, min(k, len(points)))[1])


def neighbour_medians(values: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Median (V, D), coordinate by coordinate, of values (V, D) over neighbours (V, k)."""
    found = np.empty_like(values)
    for low in range(0, len(values), _CHUNK):
        part = slice(low, low + _CHUNK)
        found[part] = np.median(values[near[part]], axis=1)
    return found


def small_islands(edges: np.ndarray, length: np.ndarray, resting: np.ndarray, area: np.ndarray) -> np.ndarray:
    """(V,) True on small pieces between tears: edges whose ends belong much further apart than they are.

    Parameters
    ----------
    edges : (E, 2)
    length : (E,) of the edges
    resting : (V, 3) where each vertex belongs
    area : (V,) around each vertex; lengths are in units of the square root of the whole
    """
    V = len(resting)
    whole = ~is_discontinuous(resting[edges[:, 0]], resting[edges[:, 1]], length)
    if whole.all():
        return np.zeros(V, bool)
    kept = edges[whole]
    graph = csr_matrix((np.ones(len(kept)), (kept[:, 0], kept[:, 1])), (V, V))
    piece = connected_components(graph, directed=False)[1]
    return (np.bincount(piece, area) < _BELIEVED * area.sum())[piece]


def surrounding_values(edges: np.ndarray, resting: np.ndarray, doubted: np.ndarray) -> np.ndarray:
    """Resting positions with the doubted ones replaced by the average of their surroundings; NaN out of reach."""
    V = len(resting)
    ones = np.ones(len(edges))
    graph = csr_matrix((ones, (edges[:, 0], edges[:, 1])), (V, V))
    graph = (graph + graph.T).tocsr()
    rows = np.flatnonzero(doubted)
    part = graph[rows]
    filled = np.where(doubted[:, None], 0.0, resting)
    known = (~doubted).astype(float)
    for _ in range(_FILL_STEPS):
        weight = part @ known
        total = part @ (known[:, None] * filled)
        filled[rows] = np.where(weight[:, None] > 0, total / np.maximum(weight, 1e-12)[:, None], filled[rows])
        known[rows] = weight > 0
    filled[rows[known[rows] == 0]] = np.nan
    return filled


def at_footpoints(foot: Footpoints, faces: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Values (V, D) of the vertices at footpoints: (N, D)."""
    return interpolate(values, faces[foot.face], foot.barycentric)


def in_core_frame(shape: Shape, fit: Fit) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and unit normals (V, 3) of a shape where its fit lives; zero normals for a cloud."""
    if shape.is_cloud:
        return fit.frame.apply(shape.verts), np.zeros_like(shape.verts)
    return fit.frame.apply(shape.verts), shape.vertex_normals @ fit.frame.rotation.T
