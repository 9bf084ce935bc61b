"""Nodes on a shape itself, each of which moves only what is near it along the surface.

The two sides of a wing, touching fingers and the leaves of a plant are close in space but independent. Templates of a
category avoid this problem by the positions of their nodes; for a new shape, the vertices that each node moves are listed
explicitly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints
from meshmatch.fields.shape_functions import build_surface_field
from meshmatch.fitting.solve.priors import ViscousGradient
from meshmatch.fitting.solve.system import NodeSystem
from meshmatch.geometry.triangles import vertex_normals
from meshmatch.shapes.sampling import farthest_points
from meshmatch.shapes.shape import Shape

_FIRST_LIMIT = 0.2  # share of the distance limit within which neighbours are searched first


@dataclass(frozen=True, kw_only=True)
class SurfaceNodes:
    """How nodes are placed; lengths in units of sqrt(area). Set by hand.

    Attributes
    ----------
    K, radius : number of nodes, and their support radius
    max_along : largest distance along the surface, as a multiple of the radius
    max_depth : nodes lie up to this far below the surface, so that vectors across it can rotate it
    min_nodes : minimum number of nodes per vertex; where there are fewer, the radii of the nearest nodes grow
    gradient_points : number of points where the deformation gradient is evaluated
    neighbours : number of gradient points, including the point itself, over which the viscous prior averages
    """

    K: int
    radius: float
    max_along: float = 1.5
    max_depth: float = 0.02
    min_nodes: int = 8
    gradient_points: int = 1500
    neighbours: int = 6

    def system(self, shape: Shape, graph: csr_matrix, seed: int = 0) -> tuple[NodeSystem, ViscousGradient]:
        """The least-squares system of a simplified mesh in the template frame, and its viscous prior along the surface.

        ``graph`` has the lengths of its edges, see `SimplifiedMesh`.
        """
        verts = np.asarray(shape.verts)
        at = farthest_points(verts, min(self.K, len(verts)))
        normals = vertex_normals(verts, np.asarray(shape.faces))[at]
        depth = np.random.default_rng(seed).uniform(0, self.max_depth, (len(at), 1))
        nodes = verts[at] - depth * normals
        far = 3 * self.max_along * self.radius
        lengths = np.asarray(dijkstra(graph, directed=False, indices=at, limit=far))
        straight = np.linalg.norm(nodes[:, None] - verts, axis=2)
        radii, reached = self._grow_radii(straight, lengths)
        vertex, node = np.nonzero(reached.T)
        field = build_surface_field(verts, nodes, radii, (vertex, node))
        system = NodeSystem(shape, field, self.gradient_points)
        points = system.gradient_points
        return system, ViscousGradient.by_distance(
            _edge_distances(graph, points, self.neighbours, far), self.neighbours
        )

    def _grow_radii(
        self, straight: Float[Floats, "K V"], lengths: Float[Floats, "K V"]
    ) -> tuple[Float[Floats, " K"], Bool[Bools, "K V"]]:
        """Radii, and which vertices each node moves, such that each vertex has enough nodes."""
        radii = np.full(len(straight), self.radius)
        near = np.where(np.isfinite(lengths), straight, np.inf)
        count = min(self.min_nodes, len(straight))
        for _ in range(30):
            reached = (straight < radii[:, None]) & (lengths < self.max_along * radii[:, None])
            lacking = reached.sum(0) < count
            if not lacking.any():
                return radii, reached
            nearest = np.argpartition(near[:, lacking], count - 1, axis=0)[:count]
            radii[np.unique(nearest)] *= 1.15
        # A part with too few nodes: its vertices get the nearest ones, however far away.
        for vertex in np.flatnonzero(lacking).tolist():
            closest = np.argsort(straight[:, vertex], kind="stable")[:count]
            radii[closest] = np.maximum(radii[closest], 1.5 * straight[closest, vertex])
            reached[closest, vertex] = True
        return radii, reached


def _edge_distances(graph: csr_matrix, points: Int[Ints, " G"], count: int, far: float) -> Float[Floats, "G G"]:
    """Distances along edges between some vertices.

    They are finite at least for the ``count`` nearest of each, or up to ``far``; the others may be infinite.
    """
    limit = _FIRST_LIMIT * far
    while True:
        found = np.asarray(dijkstra(graph, directed=False, indices=points, limit=limit))[:, points]
        if limit >= far or (np.isfinite(found).sum(1) >= count).all():
            return found
        limit *= 2
