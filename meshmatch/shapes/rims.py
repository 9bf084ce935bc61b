"""Open boundaries of a mesh: where a bust, a half shell or a broken bone ends."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from meshmatch.arrays import Float, Floats
from meshmatch.geometry.triangles import edge_lengths
from meshmatch.shapes.shape import Shape

RIM = 0.3  # length of the boundary of a part at least, in units of sqrt(area); cracks of a mesh are shorter


def rim_lengths(shape: Shape) -> Float[Floats, " V"]:
    """Length of the connected boundary that each vertex lies at, in units of sqrt(area); 0 for a vertex at none."""
    edges = shape.edges.open
    graph = coo_matrix((np.ones(len(edges)), edges.T), (shape.V, shape.V))
    rim = connected_components(graph, directed=False)[1]
    lengths = np.bincount(rim[edges[:, 0]], edge_lengths(shape.verts, edges), shape.V)[rim]
    return np.asarray(lengths / np.sqrt(shape.area))
