"""Nodes on a shape itself, each moving only what lies near it along the surface.

The two sides of a wing, fingers that touch and the leaves of a plant are near in space and have nothing to do with each
other. A template of a category has nodes that avoid this by where they lie; here a shape is met for the first time, and each
node is told what it moves.
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

_NEAR = 0.2  # share of the distance to look for neighbours in, at first


@dataclass(frozen=True, kw_only=True)
class SurfaceNodes:
    """How nodes are placed; lengths in units of sqrt(area). Set by hand.

    Attributes
    ----------
    K, radius : how many nodes, and how far each reaches
    along : how many times as far it may be along the surface as the radius
    depth : nodes lie up to so far below the surface, for vectors across it to turn it
    least : nodes that a vertex has at least; where it has fewer, those around it grow
    gradient_points : where the deformation gradient is asked
    neighbours : gradient points, itself included, over which the viscous prior averages
    """

    K: int
    radius: float
    along: float = 1.5
    depth: float = 0.02
    least: int = 8
    gradient_points: int = 1500
    neighbours: int = 6

    def system(self, shape: Shape, graph: csr_matrix, seed: int = 0) -> tuple[NodeSystem, ViscousGradient]:
        """The least-squares system of a thin mesh in the template frame, and its viscous prior along the surface.

        ``graph`` holds the lengths of its edges, see `DecimatedMesh`.
        """
        verts = np.asarray(shape.verts)
        at = farthest_points(verts, min(self.K, len(verts)))
        normals = vertex_normals(verts, np.asarray(shape.faces))[at]
        depth = np.random.default_rng(seed).uniform(0, self.depth, (len(at), 1))
        nodes = verts[at] - depth * normals
        far = 3 * self.along * self.radius
        lengths = np.asarray(dijkstra(graph, directed=False, indices=at, limit=far))
        straight = np.linalg.norm(nodes[:, None] - verts, axis=2)
        radii, reached = self._grown(straight, lengths)
        vertex, node = np.nonzero(reached.T)
        field = build_surface_field(verts, nodes, radii, (vertex, node))
        system = NodeSystem(shape, field, self.gradient_points)
        points = system.gradient_points
        return system, ViscousGradient.by_distance(_apart(graph, points, self.neighbours, far), self.neighbours)

    def _grown(
        self, straight: Float[Floats, "K V"], lengths: Float[Floats, "K V"]
    ) -> tuple[Float[Floats, " K"], Bool[Bools, "K V"]]:
        """Radii, and which vertices each node moves: at least so many for each vertex."""
        radii = np.full(len(straight), self.radius)
        near = np.where(np.isfinite(lengths), straight, np.inf)
        least = min(self.least, len(straight))
        for _ in range(30):
            reached = (straight < radii[:, None]) & (lengths < self.along * radii[:, None])
            few = reached.sum(0) < least
            if not few.any():
                return radii, reached
            around = np.argpartition(near[:, few], least - 1, axis=0)[:least]
            radii[np.unique(around)] *= 1.15
        # A part with fewer nodes than that: its vertices take the nearest ones, however far.
        for vertex in np.flatnonzero(few).tolist():
            closest = np.argsort(straight[:, vertex], kind="stable")[:least]
            radii[closest] = np.maximum(radii[closest], 1.5 * straight[closest, vertex])
            reached[closest, vertex] = True
        return radii, reached


def _apart(graph: csr_matrix, points: Int[Ints, " G"], count: int, far: float) -> Float[Floats, "G G"]:
    """Distances along edges between some vertices, as far as it takes to know so many nearest ones of each, or ``far``;
    infinite beyond."""
    limit = _NEAR * far
    while True:
        found = np.asarray(dijkstra(graph, directed=False, indices=points, limit=limit))[:, points]
        if limit >= far or (np.isfinite(found).sum(1) >= count).all():
            return found
        limit *= 2
