"""Choosing control nodes: candidates in the volume near the surface, a rejection rule, farthest points.

Rejection keeps a node from moving two pieces of surface that are close in space but not along the body
(two thighs, an arm and a flank). Four rules, all measured by the paper: body ``parts``, ``spectral``
clusters, ``geodesic`` distance, and ``uniform`` (no rejection).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import robust_laplacian
from scipy.cluster.vq import kmeans2
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.sparse.linalg import eigsh
from scipy.spatial import cKDTree

from meshmatch.errors import OptionError, TemplateError
from meshmatch.shapes.sampling import farthest_points, sample_surface
from meshmatch.shapes.shape import Shape
from meshmatch.templates.support import poorly_supported

Strategy = Literal["parts", "spectral", "geodesic", "uniform"]
STRATEGIES: tuple[Strategy, ...] = ("parts", "spectral", "geodesic", "uniform")
_GEODESIC_SHARE = 0.2


@dataclass(frozen=True)
class NodeConfig:
    """How nodes are chosen. Lengths in units of sqrt(surface area).

    radius 0.13 is the paper's 0.2 in the unit sphere for a standing body.
    """

    strategy: Strategy = "parts"
    K: int = 320
    radius: float = 0.13
    depth: float = 0.03
    clusters: int = 24
    seed: int = 0


def choose_nodes(shape: Shape, config: NodeConfig, labels: np.ndarray | None = None) -> np.ndarray:
    """Choose nodes (K', 3) such that every vertex has four non-coplanar ones in reach.

    Parameters
    ----------
    shape : Shape
        Mesh in the template frame.
    labels : int array (V,), optional
        Body parts, needed by strategy ``parts``.

    Returns
    -------
    float64 array (K', 3)
        At least ``config.K`` nodes: vertices that farthest points leave short are given more.

    Raises
    ------
    OptionError
        Unknown strategy, or ``parts`` without labels.
    TemplateError
        If some vertices cannot be supported; the message names them.
    """
    if config.strategy not in STRATEGIES:
        raise OptionError(f"no node strategy {config.strategy!r}", f"choose one of {', '.join(STRATEGIES)}")
    rng = np.random.default_rng(config.seed)
    samples = sample_surface(shape, 30 * config.K, rng)
    inwards = samples.normals * rng.uniform(0, config.depth, (len(samples.points), 1))
    candidates = samples.points - inwards
    own = shape.faces[samples.face, samples.barycentric.argmax(1)] if shape.F else None
    allowed = _allowed(shape, config, labels, candidates, own, rng)
    candidates = candidates[allowed] if allowed.any() else candidates
    chosen = farthest_points(candidates, min(config.K, len(candidates)))
    nodes = candidates[chosen]
    return _complete(shape, config, nodes, candidates)


def _complete(shape: Shape, config: NodeConfig, nodes: np.ndarray, candidates: np.ndarray) -> np.ndarray:
    """Add the candidates that poorly supported vertices lack, nearest first, a few rounds."""
    for _ in range(20):
        bad = poorly_supported(shape.verts, nodes, config.radius)
        if not len(bad):
            return nodes
        extra = candidates[
            cKDTree(candidates).query(shape.verts[bad], k=min(40, len(candidates)))[1].reshape(-1)
        ]
        spread = farthest_points(np.concatenate([nodes, extra]), min(len(nodes) + 8, len(nodes) + len(extra)))
        fresh = spread[spread >= len(nodes)] - len(nodes)
        if not len(fresh):
            fresh = np.arange(min(8, len(extra)))
        nodes = np.concatenate([nodes, extra[fresh]])
    some = ", ".join(str(int(index)) for index in bad[:5])
    raise TemplateError(
        f"{len(bad)} vertices have fewer than four non-coplanar nodes within {config.radius:g} (vertices {some}"
        + (", ...)" if len(bad) > 5 else ")"),
        "use more nodes, a larger radius or another strategy",
    )


def _allowed(shape, config, labels, candidates, own, rng) -> np.ndarray:
    """Mask of the candidates that the rejection rule keeps."""
    if config.strategy == "uniform" or shape.is_cloud:
        return np.ones(len(candidates), bool)
    touched = cKDTree(shape.verts).query_ball_point(candidates, config.radius)
    if config.strategy == "geodesic":
        return _geodesic_allowed(shape, touched, own)
    if config.strategy == "parts":
        if labels is None:
            raise OptionError(
                "node strategy 'parts' needs part labels", "use --strategy spectral or geodesic"
            )
        parts = labels
    else:
        parts = spectral_clusters(shape, config.clusters, rng)
    neighbours = _part_neighbours(shape, parts)
    home = parts[own]
    return np.array([neighbours[home[i], np.unique(parts[hits])].all() for i, hits in enumerate(touched)])


def _part_neighbours(shape: Shape, parts: np.ndarray) -> np.ndarray:
    """Boolean (N, N): parts that share an edge (or are the same)."""
    N = int(parts.max()) + 1
    joined = np.eye(N, dtype=bool)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        joined[parts[shape.faces[:, a]], parts[shape.faces[:, b]]] = True
    return joined | joined.T


def edge_graph(shape: Shape) -> coo_matrix:
    """Symmetric sparse graph (V, V) of edge lengths."""
    edges = np.unique(np.sort(shape.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    length = np.linalg.norm(shape.verts[edges[:, 0]] - shape.verts[edges[:, 1]], axis=1)
    length = np.maximum(length, 1e-12)
    return coo_matrix(
        (np.tile(length, 2), (edges.T.reshape(-1), edges[:, ::-1].T.reshape(-1))), (shape.V, shape.V)
    ).tocsr()


def _geodesic_allowed(shape: Shape, touched: list, own: np.ndarray) -> np.ndarray:
    """Drop candidates that touch surface further than a fifth of the diameter along the surface."""
    graph = edge_graph(shape)
    landmarks = farthest_points(shape.verts, 40)
    far = dijkstra(graph, indices=landmarks)
    diameter = far[np.isfinite(far)].max()
    owners, place = np.unique(own, return_inverse=True)
    distance = dijkstra(graph, indices=owners, limit=_GEODESIC_SHARE * diameter)
    return np.array([np.isfinite(distance[place[i], hits]).all() for i, hits in enumerate(touched)])


def spectral_clusters(
    shape: Shape, clusters: int, rng: np.random.Generator, functions: int = 12
) -> np.ndarray:
    """k-means on the global point signature (Rustamov 2007): labels (V,) from Laplace-Beltrami eigenvectors."""
    stiffness, mass = robust_laplacian.mesh_laplacian(shape.verts, shape.faces)
    count = min(functions + 1, shape.V - 2)
    values, vectors = eigsh(stiffness, count, mass, sigma=-1e-8, v0=np.ones(shape.V))
    signature = vectors[:, 1:] / np.sqrt(np.maximum(values[1:], 1e-9))
    start = signature[farthest_points_any(signature, clusters)]
    return kmeans2(signature, start, minit="matrix", missing="warn")[1].astype(np.int64)


def farthest_points_any(points: np.ndarray, K: int) -> np.ndarray:
    """Farthest-point sampling in any dimension: indices (K,), starting from the first point."""
    chosen = [0]
    distance = np.full(len(points), np.inf)
    for _ in range(min(K, len(points)) - 1):
        distance = np.minimum(distance, np.square(points - points[chosen[-1]]).sum(1))
        chosen.append(int(distance.argmax()))
    return np.array(chosen)
