"""Small islands of a map: pieces of a mesh that it takes elsewhere than all around them.

Where two sheets of a surface touch, the closest point may lie on the wrong one. Neighbours whose images lie far apart
reveal it: what such discontinuities cut off is searched again, near the images of its surroundings.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints
from meshmatch.geometry.topology import edges_of, is_discontinuous
from meshmatch.maps.surface import Footpoints

# A piece with at least this share of the surface is not an island. Set by hand.
_MAINLAND = 0.06
# Steps from the rim into an island over which images of the surroundings are extended.
_STEPS = 120
Found = TypeVar("Found", bound=Footpoints)


def reassign_islands(
    verts: Float[Floats, "V 3"],
    faces: Int[Ints, "F 3"],
    areas: Float[Floats, " V"],
    found: Found,
    images: Callable[[Found], Float[Floats, "N 3"]],
    search: Callable[[Int[Ints, " M"], Float[Floats, "M 3"]], Found],
    rounds: int,
) -> tuple[Found, Float[Floats, "V 3"]]:
    """Search again for the vertices on small islands of a map of a mesh.

    Parameters
    ----------
    verts, faces, areas
        The mesh, in units of sqrt(area); the areas around its vertices in any unit.
    found : Footpoints
        Where each vertex lies.
    images
        The points themselves, in units of their own surface's sqrt(area).
    search
        Footpoints of some vertices (M,), near points (M, 3) in the unit of ``images``.

    Returns
    -------
    Footpoints, and their images (V, 3).
    """
    edges = edges_of(faces).vertices
    length = np.linalg.norm(verts[edges[:, 0]] - verts[edges[:, 1]], axis=1)
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
    continuous = ~is_discontinuous(image[edges[:, 0]], image[edges[:, 1]], length)
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
    V = len(values)
    graph = csr_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), (V, V))
    graph = (graph + graph.T).tocsr()
    rows = np.flatnonzero(unknown)
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
