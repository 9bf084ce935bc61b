"""Parameterization of topological disks: one-to-one maps of surface patches without holes to the plane.

A convex border and positive weights guarantee that no triangle flips (Tutte, *How to draw a graph*, 1963; Floater,
*Mean value coordinates*, 2003). Weights that follow the stretch give shrunken regions, such as fingertips, their area
back (Yoshizawa, Belyaev and Seidel, *A fast and simple stretch-minimizing mesh parameterization*, 2004).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csc_array, csr_array

from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints
from meshmatch.geometry.smoothing import factorize
from meshmatch.geometry.trees import cKDTree
from meshmatch.geometry.triangles import (
    areas_to_vertices,
    component_minima,
    dot,
    edge_keys,
    edges_of,
    squared_lengths,
    triangle_areas,
)

# All set by hand.
_MIN_EDGE = 1e-6  # minimum edge length, as a fraction of the usual one; shorter edges are treated as this long
_MAX_TANGENT = 50.0  # upper bound on the tangent of a half angle in mean value weights (slivers)
_STRETCH_ROUNDS = 4  # rounds of reweighting by stretch; ten gain little more
_MIN_AREA = 1e-8  # minimum area of a triangle in the plane, as a fraction of its area in space
_STRETCH_BOUNDS = 1e-2, 1e4  # bounds on the stretch around a vertex, as the weights see it
_FLIP_PENALTY = 1e12  # penalty of a flipped triangle, relative to squared stretches
_MAX_DENSE = 300  # up to this number of vertices a dense solver is faster than a sparse one
_INSIDE_TOLERANCE = 1e-9  # tolerance of barycentric weights for a point on a triangle's border
_CANDIDATES = 24  # candidate triangles for a point in the plane: those with the nearest centers


@dataclass(frozen=True, eq=False)
class Disk:
    """Faces of a surface that form a topological disk: one border, no hole."""

    faces: Int[Ints, " F"]  # indices of the surface's faces
    vertices: Int[Ints, " M"]  # indices of the surface's vertices
    corners: Int[Ints, "F 3"]  # the faces as indices into `vertices`
    rim: Int[Ints, " R"]  # indices into `vertices` along the border, in the direction of the faces

    @classmethod
    def of(cls, surface: Int[Ints, "F_surface 3"], faces: Int[Ints, " F"]) -> Disk | None:
        """The disk that ``faces`` of ``surface`` form; None if they do not form one."""
        vertices, corners = np.unique(surface[faces], return_inverse=True)
        corners, M = corners.reshape(-1, 3), len(vertices)
        keys, first_index, count = np.unique(edge_keys(corners, M), return_index=True, return_counts=True)
        face, side = first_index[count == 1] % len(faces), first_index[count == 1] // len(faces)
        tail, head = corners[face, side], corners[face, (side + 1) % 3]
        successor = dict(zip(tail.tolist(), head.tolist(), strict=True))
        if count.max() > 2 or M - len(keys) + len(faces) != 1 or not len(tail):
            return None
        rim = [int(tail[0])]
        while (following := successor.get(rim[-1])) is not None and following != rim[0] and len(rim) <= len(tail):
            rim.append(following)
        return cls(faces, vertices, corners, np.array(rim)) if len(rim) == len(tail) else None

    def laid_flat(
        self, verts: Float[Floats, "V 3"], rim: Float[Floats, "R 2"] | None = None, side: float = 1.0
    ) -> Float[Floats, "M 2"] | None:
        """Map the vertices to the plane: one to one if the border is convex, otherwise with as little stretch as found.

        Parameters
        ----------
        verts
            (V, 3) vertices of the surface.
        rim
            (R, 2) positions of the border; by default on a circle.
        side
            -1 if the border runs clockwise.

        Returns
        -------
        places
            (M, 2); None if the faces have no area or some vertices are unconstrained.
        """
        own = verts[self.vertices]
        areas = triangle_areas(own, self.corners)
        if not areas.sum() > 0:
            return None
        around = np.maximum(areas_to_vertices(areas, self.corners, len(own)), 1e-300)
        rim = _circle(own[self.rim], float(areas.sum())) if rim is None else rim
        best, best_energy, scales = None, np.inf, np.ones(len(own))
        springs = _Springs(mean_values(own, self.corners), self.rim)
        for _ in range(_STRETCH_ROUNDS):
            try:
                places = springs.equilibrium(scales, rim)
            except (RuntimeError, np.linalg.LinAlgError):  # singular: some vertices are unconstrained
                return best
            squared, flipped = _squared_stretch(own, places, self.corners, side)
            energy = float(
                (areas * np.where(flipped, _FLIP_PENALTY, np.minimum(squared, _STRETCH_BOUNDS[1] ** 2))).sum()
            )
            if not energy < best_energy:
                break
            best, best_energy = places, energy
            mean = areas_to_vertices(areas * squared, self.corners, len(own)) / around
            scales = scales / np.clip(np.sqrt(np.maximum(mean, 0.0)), *_STRETCH_BOUNDS)
        return best


class _Springs:
    """A spring network with weights (M, M) between neighbours and some fixed vertices."""

    def __init__(self, weights: csr_array, fixed: Int[Ints, " R"]) -> None:
        M = weights.shape[0]
        moves = np.ones(M, bool)
        moves[fixed] = False
        self.fixed, self.free = fixed, np.flatnonzero(moves)
        row_of = np.full(M, -1)
        row_of[self.free] = np.arange(len(self.free))
        edges = weights.tocoo()
        is_free_row = moves[edges.row]
        self.row, self.column, self.weight = (
            row_of[edges.row[is_free_row]],
            edges.col[is_free_row],
            edges.data[is_free_row],
        )
        self.inner = moves[self.column]
        self.order = row_of[self.column[self.inner]]

    def equilibrium(self, scales: Float[Floats, " M"], places: Float[Floats, "R 2"]) -> Float[Floats, "M 2"]:
        """Positions (M, 2) where each free vertex is the weighted mean of its neighbours.

        Weights are multiplied by the ``scales`` of the neighbours.
        """
        N, result = len(self.free), np.zeros((len(scales), 2))
        result[self.fixed] = places
        if not N:
            return result
        weight = self.weight * scales[self.column]
        total = np.bincount(self.row, weight, N)
        total += 1e-9 * total.mean()  # keeps unconnected vertices solvable
        outer = weight[~self.inner, None] * result[self.column[~self.inner]]
        right = np.column_stack([np.bincount(self.row[~self.inner], outer[:, k], N) for k in range(2)])
        entries = np.concatenate([total, -weight[self.inner]])
        rows, columns = (np.concatenate([np.arange(N), each]) for each in (self.row[self.inner], self.order))
        if N <= _MAX_DENSE:
            matrix = np.zeros((N, N))
            matrix[rows, columns] = entries
            result[self.free] = np.linalg.solve(matrix, right)
        else:
            sparse = csc_array((entries, (rows, columns)), shape=(N, N))
            result[self.free] = factorize(sparse).solve(right)
        return result


def edge_connected_patches(
    surface: Int[Ints, "F 3"], inside: Bool[Bools, " F"], zone: Bool[Bools, " F"]
) -> list[Int[Ints, " N"]]:
    """Edge-connected groups of the faces ``inside``, each with the faces of ``zone`` that it encloses."""
    rest = np.flatnonzero(zone & ~inside)
    if len(rest):
        component = _edge_components(surface[rest])
        border = np.zeros(int(surface.max()) + 1, bool)
        border[edges_of(surface[zone]).open] = True
        reaches_border = np.bincount(component, border[surface[rest]].any(axis=1), len(rest)) > 0
        inside = inside.copy()
        inside[rest[~reaches_border[component]]] = True
    rows = np.flatnonzero(inside)
    component = _edge_components(surface[rows])
    order = np.argsort(component, kind="stable")
    return np.split(rows[order], np.flatnonzero(np.diff(component[order])) + 1) if len(rows) else []


def locate_points(
    places: Float[Floats, "M 2"], corners: Int[Ints, "F 3"], points: Float[Floats, "N 2"]
) -> tuple[Int[Ints, " N"], Float[Floats, "N 3"], Bool[Bools, " N"]]:
    """Locate points in triangles of the plane.

    Returns
    -------
    triangle
        (N,) the triangle that contains each point, or else the best of the nearest ones.
    weights
        (N, 3) barycentric weights there, clipped to be nonnegative.
    inside
        (N,) whether the point lies in its triangle.
    """
    candidates = (
        cKDTree(places[corners].mean(axis=1)).query(points, min(_CANDIDATES, len(corners)))[1].reshape(len(points), -1)
    )
    a, b, c = (places[corners[candidates, k]] for k in range(3))
    offsets = points[:, None] - a
    area = _cross(b - a, c - a)
    area = np.where(np.abs(area) < 1e-300, 1e-300, area)
    second, third = _cross(offsets, c - a) / area, _cross(b - a, offsets) / area
    weights = np.stack([1 - second - third, second, third], axis=2)
    best = np.arange(len(points)), weights.min(axis=2).argmax(axis=1)
    inside = weights[best].min(axis=1) >= -_INSIDE_TOLERANCE
    clipped = np.maximum(weights[best], 0.0)
    return candidates[best], clipped / clipped.sum(axis=1, keepdims=True), inside


def mean_values(verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"]) -> csr_array:
    """(V, V) mean value weights of each vertex's neighbours: positive, and reproducing a planar neighbourhood exactly."""
    entries, min_length = [], _MIN_EDGE * float(np.sqrt(triangle_areas(verts, faces).mean())) + 1e-300
    for k in range(3):
        corner, *others = (faces[:, (k + each) % 3] for each in range(3))
        sides = [verts[each] - verts[corner] for each in others]
        lengths = [np.maximum(np.sqrt(squared_lengths(each)), min_length) for each in sides]
        half = 0.5 * np.arccos(np.clip(dot(*sides) / (lengths[0] * lengths[1]), -1, 1))
        tangent = np.minimum(np.tan(half), _MAX_TANGENT)
        entries += [(corner, other, tangent / length) for other, length in zip(others, lengths, strict=True)]
    first, second, weight = (np.concatenate(each) for each in zip(*entries, strict=True))
    return csr_array((weight, (first, second)), shape=(len(verts),) * 2)


def _edge_components(faces: Int[Ints, "F 3"]) -> Int[Ints, " F"]:
    """(F,) the first face of the edge-connected component that each face is in."""
    keys = edge_keys(faces, int(faces.max()) + 1 if len(faces) else 1)
    order = np.argsort(keys, kind="stable")
    same = np.flatnonzero(np.diff(keys[order]) == 0)
    face = order % max(len(faces), 1)
    return component_minima(len(faces), face[same], face[same + 1])


def _circle(points: Float[Floats, "R 3"], area: float) -> Float[Floats, "R 2"]:
    """Positions on a circle of the given area, counterclockwise, spaced like the edges of a closed polyline."""
    length = np.sqrt(squared_lengths(np.roll(points, -1, axis=0) - points))
    angle = 2 * np.pi * np.concatenate([[0.0], np.cumsum(length)[:-1]]) / max(float(length.sum()), 1e-300)
    return np.asarray(np.sqrt(area / np.pi) * np.column_stack([np.cos(angle), np.sin(angle)]))


def _squared_stretch(
    verts: Float[Floats, "M 3"], places: Float[Floats, "M 2"], corners: Int[Ints, "F 3"], side: float
) -> tuple[Float[Floats, " F"], Bool[Bools, " F"]]:
    """Mean squared stretch of each triangle's map from the plane to the surface, and whether the triangle is flipped."""
    gram = []
    for each in (verts, places):
        first, second = (each[corners[:, k]] - each[corners[:, 0]] for k in (1, 2))
        gram.append((dot(first, first), dot(first, second), dot(second, second)))
    (a, b, c), (p, q, r) = gram
    flat, spatial = _cross(first, second), np.sqrt(np.maximum(a * c - b * b, 0.0))
    area = np.maximum(np.abs(flat), _MIN_AREA * spatial + 1e-140)
    return np.asarray((a * r - 2 * b * q + c * p) / (2 * area**2)), np.asarray(flat * side <= 0)


def _cross(first: Floats, second: Floats) -> Floats:
    return np.asarray(first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0])
