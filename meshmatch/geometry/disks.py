"""Pieces of surfaces without holes, laid flat one to one.

A convex border and positive weights let no triangle turn over (Tutte, *How to draw a graph*, 1963; Floater, *Mean value
coordinates*, 2003). What that shrinks, such as the tip of a finger, gets its room back by weights that follow the stretch
(Yoshizawa, Belyaev and Seidel, *A fast and simple stretch-minimizing mesh parameterization*, 2004).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csc_array, csr_array

from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints
from meshmatch.geometry.smoothing import factors
from meshmatch.geometry.trees import cKDTree
from meshmatch.geometry.triangles import (
    dot,
    edge_keys,
    edges_of,
    share_areas,
    squared_lengths,
    together,
    triangle_areas,
)

# All set by hand.
_SHORT = 1e-6  # of the usual edge: shorter ones count as so long
_STIFFEST = 50.0  # a sliver's sides count no more
_EVENED = 4  # rounds of weights that follow the stretch; ten gain little more
_SMALLEST = 1e-8  # of a triangle's area in the plane
_STRETCHES = 1e-2, 1e4  # of what lies around a vertex, as the weights see it
_TURNED = 1e12  # what a triangle that is turned over counts, against squares of stretches
_DENSE = 300  # vertices: of fewer a sparse matrix takes longer
_INSIDE = 1e-9  # the weights that a point on the border of a triangle may have
_NEAR = 24  # triangles that a point in the plane may lie in: those whose centres are nearest


@dataclass(frozen=True, eq=False)
class Disk:
    """Faces of a surface that have one border and no hole."""

    faces: Int[Ints, " F"]  # which of the surface
    vertices: Int[Ints, " M"]  # of the surface
    corners: Int[Ints, "F 3"]  # of these vertices
    rim: Int[Ints, " R"]  # of these vertices, along the border, as the faces run

    @classmethod
    def of(cls, surface: Int[Ints, "F_surface 3"], faces: Int[Ints, " F"]) -> Disk | None:
        """Those faces of a surface, if they are a disk."""
        vertices, corners = np.unique(surface[faces], return_inverse=True)
        corners, M = corners.reshape(-1, 3), len(vertices)
        keys, first, count = np.unique(edge_keys(corners, M), return_index=True, return_counts=True)
        face, side = first[count == 1] % len(faces), first[count == 1] // len(faces)
        start, end = corners[face, side], corners[face, (side + 1) % 3]
        after = dict(zip(start.tolist(), end.tolist(), strict=True))
        if count.max() > 2 or M - len(keys) + len(faces) != 1 or not len(start):
            return None
        rim = [int(start[0])]
        while (following := after.get(rim[-1])) is not None and following != rim[0] and len(rim) <= len(start):
            rim.append(following)
        return cls(faces, vertices, corners, np.array(rim)) if len(rim) == len(start) else None

    def laid_flat(
        self, verts: Float[Floats, "V 3"], rim: Float[Floats, "R 2"] | None = None, side: float = 1.0
    ) -> Float[Floats, "M 2"] | None:
        """Its vertices in the plane: one to one if the border is convex, as even as it can be otherwise.

        Parameters
        ----------
        verts
            Of the surface.
        rim
            Where the border lies; by default on a circle.
        side
            -1 where the border runs clockwise.

        Returns
        -------
        places
            None where the faces have no area, or nothing holds some vertices.
        """
        own = verts[self.vertices]
        areas = triangle_areas(own, self.corners)
        if not areas.sum() > 0:
            return None
        around = np.maximum(share_areas(areas, self.corners, len(own)), 1e-300)
        rim = _circle(own[self.rim], float(areas.sum())) if rim is None else rim
        best, least, scales = None, np.inf, np.ones(len(own))
        springs = _Springs(mean_values(own, self.corners), self.rim)
        for _ in range(_EVENED):
            try:
                places = springs.balanced(scales, rim)
            except (RuntimeError, np.linalg.LinAlgError):  # nothing holds some vertices
                return best
            squared, turned = _squared_stretch(own, places, self.corners, side)
            total = float((areas * np.where(turned, _TURNED, np.minimum(squared, _STRETCHES[1] ** 2))).sum())
            if not total < least:
                break
            best, least = places, total
            mean = share_areas(areas * squared, self.corners, len(own)) / around
            scales = scales / np.clip(np.sqrt(np.maximum(mean, 0.0)), *_STRETCHES)
        return best


class _Springs:
    """Weights (M, M) that pull each vertex to its neighbours, with some vertices held."""

    def __init__(self, weights: csr_array, held: Int[Ints, " R"]) -> None:
        M = weights.shape[0]
        moves = np.ones(M, bool)
        moves[held] = False
        self.held, self.free = held, np.flatnonzero(moves)
        number = np.full(M, -1)
        number[self.free] = np.arange(len(self.free))
        edges = weights.tocoo()
        own = moves[edges.row]
        self.row, self.column, self.weight = number[edges.row[own]], edges.col[own], edges.data[own]
        self.inner = moves[self.column]
        self.order = number[self.column[self.inner]]

    def balanced(self, scales: Float[Floats, " M"], places: Float[Floats, "R 2"]) -> Float[Floats, "M 2"]:
        """All vertices at the means of their neighbours, weighted by these scales too, but for those that are held."""
        N, result = len(self.free), np.zeros((len(scales), 2))
        result[self.held] = places
        if not N:
            return result
        weight = self.weight * scales[self.column]
        total = np.bincount(self.row, weight, N)
        total += 1e-9 * total.mean()  # what hangs by nothing stays solvable
        outer = weight[~self.inner, None] * result[self.column[~self.inner]]
        right = np.column_stack([np.bincount(self.row[~self.inner], outer[:, k], N) for k in range(2)])
        entries = np.concatenate([total, -weight[self.inner]])
        rows, columns = (np.concatenate([np.arange(N), each]) for each in (self.row[self.inner], self.order))
        if N <= _DENSE:
            matrix = np.zeros((N, N))
            matrix[rows, columns] = entries
            result[self.free] = np.linalg.solve(matrix, right)
        else:
            sparse = csc_array((entries, (rows, columns)), shape=(N, N))
            result[self.free] = factors(sparse).solve(right)
        return result


def patches(surface: Int[Ints, "F 3"], inside: Bool[Bools, " F"], zone: Bool[Bools, " F"]) -> list[Int[Ints, " N"]]:
    """The faces inside by the pieces that they hang together in, by edges; with what these enclose within a zone around."""
    rest = np.flatnonzero(zone & ~inside)
    if len(rest):
        part = _parts(surface[rest])
        border = np.zeros(int(surface.max()) + 1, bool)
        border[edges_of(surface[zone]).open] = True
        leaves = np.bincount(part, border[surface[rest]].any(axis=1), len(rest)) > 0
        inside = inside.copy()
        inside[rest[~leaves[part]]] = True
    rows = np.flatnonzero(inside)
    part = _parts(surface[rows])
    order = np.argsort(part, kind="stable")
    return np.split(rows[order], np.flatnonzero(np.diff(part[order])) + 1) if len(rows) else []


def found_in(
    places: Float[Floats, "M 2"], corners: Int[Ints, "F 3"], points: Float[Floats, "N 2"]
) -> tuple[Int[Ints, " N"], Float[Floats, "N 3"], Bool[Bools, " N"]]:
    """The triangles of the plane that points lie in, or nearly, their weights there, none of them negative; and which
    points do lie in one.
    """
    near = cKDTree(places[corners].mean(axis=1)).query(points, min(_NEAR, len(corners)))[1].reshape(len(points), -1)
    a, b, c = (places[corners[near, k]] for k in range(3))
    own = points[:, None] - a
    whole = _cross(b - a, c - a)
    whole = np.where(np.abs(whole) < 1e-300, 1e-300, whole)
    second, third = _cross(own, c - a) / whole, _cross(b - a, own) / whole
    weights = np.stack([1 - second - third, second, third], axis=2)
    best = np.arange(len(points)), weights.min(axis=2).argmax(axis=1)
    inside = weights[best].min(axis=1) >= -_INSIDE
    found = np.maximum(weights[best], 0.0)
    return near[best], found / found.sum(axis=1, keepdims=True), inside


def mean_values(verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"]) -> csr_array:
    """(V, V) weights of the neighbours of each vertex: positive, and those whose mean keeps what is flat."""
    entries, least = [], _SHORT * float(np.sqrt(triangle_areas(verts, faces).mean())) + 1e-300
    for k in range(3):
        corner, *others = (faces[:, (k + each) % 3] for each in range(3))
        sides = [verts[each] - verts[corner] for each in others]
        lengths = [np.maximum(np.sqrt(squared_lengths(each)), least) for each in sides]
        half = 0.5 * np.arccos(np.clip(dot(*sides) / (lengths[0] * lengths[1]), -1, 1))
        tangent = np.minimum(np.tan(half), _STIFFEST)
        entries += [(corner, other, tangent / length) for other, length in zip(others, lengths, strict=True)]
    first, second, weight = (np.concatenate(each) for each in zip(*entries, strict=True))
    return csr_array((weight, (first, second)), shape=(len(verts),) * 2)


def _parts(faces: Int[Ints, "F 3"]) -> Int[Ints, " F"]:
    """(F,) the first face of the piece that each is in: those that share an edge are in one."""
    keys = edge_keys(faces, int(faces.max()) + 1 if len(faces) else 1)
    order = np.argsort(keys, kind="stable")
    same = np.flatnonzero(np.diff(keys[order]) == 0)
    face = order % max(len(faces), 1)
    return together(len(faces), face[same], face[same + 1])


def _circle(points: Float[Floats, "R 3"], area: float) -> Float[Floats, "R 2"]:
    """A closed line on a circle of an area, counterclockwise, by its lengths."""
    length = np.sqrt(squared_lengths(np.roll(points, -1, axis=0) - points))
    angle = 2 * np.pi * np.concatenate([[0.0], np.cumsum(length)[:-1]]) / max(float(length.sum()), 1e-300)
    return np.asarray(np.sqrt(area / np.pi) * np.column_stack([np.cos(angle), np.sin(angle)]))


def _squared_stretch(
    verts: Float[Floats, "M 3"], places: Float[Floats, "M 2"], corners: Int[Ints, "F 3"], side: float
) -> tuple[Float[Floats, " F"], Bool[Bools, " F"]]:
    """(F,) mean square by which the way from the plane to the surface stretches lengths; and which faces are turned over."""
    gram = []
    for each in (verts, places):
        first, second = (each[corners[:, k]] - each[corners[:, 0]] for k in (1, 2))
        gram.append((dot(first, first), dot(first, second), dot(second, second)))
    (a, b, c), (p, q, r) = gram
    flat, whole = _cross(first, second), np.sqrt(np.maximum(a * c - b * b, 0.0))
    area = np.maximum(np.abs(flat), _SMALLEST * whole + 1e-140)
    return np.asarray((a * r - 2 * b * q + c * p) / (2 * area**2)), np.asarray(flat * side <= 0)


def _cross(first: Floats, second: Floats) -> Floats:
    return np.asarray(first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0])
