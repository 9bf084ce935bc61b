"""Wrapping: a mesh that lies near a scan is projected onto it, with a smooth displacement that gets finer in rounds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from meshmatch.arrays import Bool, Bools, Float, Floats, Ints
from meshmatch.fitting.solve.priors import nearest_rotations
from meshmatch.geometry.smoothing import smooth_values
from meshmatch.geometry.trees import cKDTree
from meshmatch.geometry.triangles import dot, edge_lengths, interpolate, normalized, same_rows, vertex_normals
from meshmatch.maps.deformed import surface_rotations
from meshmatch.maps.folds import normals_or_zeros
from meshmatch.maps.indices import corners_of
from meshmatch.maps.mapped_mesh import MappedMesh, length_of
from meshmatch.shapes.shape import Shape

# All set by hand; lengths in units of sqrt(area).
# Distances over which displacements are averaged, in order.
_RADII = (0.03, 0.015, 0.008, 0.004, 0.002)
# Distance from the scan at which a target point counts 1/e.
_REACH = 0.03
# Weight of points without a target, so that they follow their surroundings.
_MIN_WEIGHT = 1e-4
# Vertices that a disconnected free part follows.
_N_AROUND = 24


@dataclass(frozen=True, eq=False)
class Wrapped:
    """A base mesh wrapped onto a scan.

    ``verts`` (V, 3) in the scan's frame and unit; ``turns`` (V, 3, 3) rotation of each vertex; ``distance`` (V,) of each
    vertex from the scan's surface.
    """

    verts: Float[Floats, "V 3"]
    turns: Float[Floats, "V 3 3"]
    distance: Float[Floats, " V"]


def wrap_onto(
    base: Shape, near: Float[Floats, "V 3"], scan: Shape, free: Bool[Bools, " V"], workers: int = 1
) -> Wrapped:
    """Wrap a base whose vertices are already ``near`` a scan onto it; ``free`` vertices keep their shape and follow others.

    A vertex is drawn to the closest point of the scan with a similar normal, unless that is on the rim of a hole.
    """
    own, back = np.unique(same_rows(base.verts), return_inverse=True)  # welded, so that seams stay closed
    faces, bound = back[base.faces], ~free[own]
    mesh = Shape(base.verts[own], faces, base.name)
    edges = mesh.edges.vertices.astype(np.int64)
    surface, unit_length = _Scan(scan, workers), length_of(scan)
    verts = near[own]
    for radius in _RADII:
        step, trust = surface.steps_towards(verts, vertex_normals(verts, faces))
        trust = np.where(bound & mesh.valid, trust, 0.0) + _MIN_WEIGHT
        verts = verts + smooth_values(step, trust, edges, edge_lengths(verts, edges), radius * unit_length)
    if not bound.all():
        verts = _with_free_parts(mesh, near[own], verts, bound)
    turns = surface_rotations(mesh.verts, verts, faces)
    return Wrapped(verts[back], turns[back], surface.distance(verts)[back])


class _Scan:
    """Surface of the scan, with closest points."""

    def __init__(self, scan: Shape, workers: int) -> None:
        self._scan, self._mesh, self._workers = scan, MappedMesh.of(scan), workers
        self._normals = normals_or_zeros(scan)
        self._rim = np.zeros(scan.V, bool)
        self._rim[scan.edges.vertices[scan.edges.sizes == 1]] = True
        self._reach = _REACH * length_of(scan)

    def steps_towards(self, points: Floats, normals: Floats) -> tuple[Floats, Floats]:
        """Steps (N, 3) to the surface, and their weights (N,)."""
        found = self._mesh.query(points, normals, self._workers)
        corners = corners_of(self._scan.faces, found.face, found.vertex)
        foot = interpolate(self._scan.verts, corners, found.barycentric)
        trust = np.exp(-np.square(found.distance / self._reach))
        if not self._scan.is_cloud:
            facing = normalized(interpolate(self._normals, corners, found.barycentric))
            trust *= np.maximum(dot(facing, normals), 0.0)
            on_rim = (self._rim[corners] | (found.barycentric < 1e-9)).all(axis=1)
            trust[on_rim] = 0.0
        return foot - points, trust

    def distance(self, points: Floats) -> Floats:
        return self._mesh.query(points, workers=self._workers).distance


def _with_free_parts(mesh: Shape, near: Floats, verts: Floats, bound: Bools) -> Floats:
    """Restore the shape of free vertices, as before the projection.

    Those connected to others have followed these already. A wholly free part, such as an eyeball, follows the nearest bound
    vertices by a similarity (rotation, scale, translation) from the base.
    """
    verts = verts.copy()
    known = np.flatnonzero(bound)
    free_parts = np.setdiff1d(np.unique(mesh.vertex_parts), mesh.vertex_parts[known])
    if not len(known):
        return near
    tree = cKDTree(mesh.verts[known])
    for part in free_parts.tolist():
        rows = np.flatnonzero(mesh.vertex_parts == part)
        followed: Ints = known[np.unique(tree.query(mesh.verts[rows], min(_N_AROUND, len(known)))[1])]
        base_points, wrapped_points = mesh.verts[followed], verts[followed]
        a, b = base_points - base_points.mean(axis=0), wrapped_points - wrapped_points.mean(axis=0)
        rotation = nearest_rotations((b.T @ a)[None], np.eye(3)[None])[0]
        scale = np.sqrt(np.square(b).sum() / max(np.square(a).sum(), 1e-300))
        verts[rows] = scale * (mesh.verts[rows] - base_points.mean(axis=0)) @ rotation.T + wrapped_points.mean(axis=0)
    return verts
