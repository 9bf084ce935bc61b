"""Transfer of what a body wears, such as clothes, hair or a hat, to another body.

Each vertex of the garment is bound to the vertices of the body that are nearest to it and have similar normals. Around each
of these the map rotates and scales the body, and the offset of the garment's vertex with it; rotation and scale are averaged
over the surface around, so that an error of the map at one vertex does not dent the cloth. The garment then keeps its edges,
rotated and scaled likewise, as far as it stays near its bound positions: this smooths the deformation, not the garment.
Where it would sink deeper below the skin than before, it is pushed out, and its surroundings follow.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import diags_array

from meshmatch.arrays import Bools, Float, Floats, Int, Ints
from meshmatch.errors import InputError
from meshmatch.fitting.solve.priors import nearest_rotations
from meshmatch.geometry.smoothing import laplacian, solve_positive_definite
from meshmatch.geometry.trees import cKDTree
from meshmatch.geometry.triangles import dot, edge_lengths, edges_of, interpolate, normalized, same_rows
from meshmatch.maps.indices import corners_of
from meshmatch.maps.mapped_mesh import MappedMesh, length_of
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.repair import oriented_outwards
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.local_frames import local_frames

# All set by hand; lengths in units of sqrt(area).
# Vertices of the body that one vertex of the garment is bound to; weights fall beyond the nearest one's distance over this
# share of it.
_N_NEAREST, _BLEND = 16, 0.3
# Weights of bound positions, and of pushed-out ones, relative to that of an edge that keeps its shape.
_BOUND_WEIGHT, _PUSHED_WEIGHT = 3.0, 30.0
# Height that vertices above the skin keep: at most, and at least; tolerance; rounds.
_CLEARANCE, _MIN_HEIGHT, _SLACK, _ROUNDS = 0.0015, 2e-5, 1e-5, 4
# A garment whose median vertex is farther from the body is not on it.
_MAX_MEDIAN_DISTANCE = 0.5
# Nor is one with a larger share of vertices below the skin, or this far off. On 80 garments of generated people the shares
# are at most 0.16 and 0.02; on garments of other people mostly more than 0.3.
_FAR, _MAX_BELOW, _MAX_FAR = 0.05, 0.25, 0.25
_CHUNK = 16_384


@dataclass(frozen=True, eq=False)
class Carried:
    """A garment on another body.

    ``verts`` (V, 3) in the body's frame and unit; ``turns`` (V, 3, 3) rotation of each vertex; ``pushed`` (N,) vertices that
    were pushed out; ``sunk`` (M,) vertices below the skin that were not before. ``below`` and ``far`` are the shares (0..1)
    of the garment's vertices below the source's skin, and far from it.
    """

    verts: Float[Floats, "V 3"]
    turns: Float[Floats, "V 3 3"]
    pushed: Int[Ints, " N"]
    sunk: Int[Ints, " M"]
    below: float
    far: float

    @property
    def sits(self) -> bool:
        """Whether the garment seems to be on the source, in the source's pose."""
        return self.below <= _MAX_BELOW and self.far <= _MAX_FAR


def carry_garment(garment: Shape, forward: VertexMap, source: Shape, target: Shape, workers: int = 1) -> Carried:
    """Transfer a garment along a map from the body that it is on to another one.

    `InputError`: the garment is not on the source, or the source is a point cloud. `OptionError`: the map turns the source
    inside out.
    """
    if source.is_cloud:
        raise InputError(f"{source.name or 'the source'} is a point cloud: nothing can be bound to it", "give a mesh")
    bound, jacobians = _Body(forward, source, target).bind(garment, workers)
    turns = nearest_rotations(jacobians, np.broadcast_to(np.eye(3), jacobians.shape))
    first, back = np.unique(same_rows(garment.verts), return_inverse=True)  # welded, so that seams stay closed
    cloth = _Cloth(garment.verts[first], back[garment.faces], jacobians[first])
    places = bound[first]
    heights_before = _Skin(oriented_outwards(source)).heights(cloth.at_points(cloth.rest), workers)[0]
    at = heights_before[: len(first)][back]
    sits = float((at < 0).mean()), float((at > _FAR * length_of(source)).mean())
    if target.is_cloud:
        verts, none = cloth.solve(places, np.full(len(first), _BOUND_WEIGHT)), np.empty(0, np.int64)
        return Carried(verts[back], turns, none, none, *sits)
    scale = np.cbrt(np.abs(np.linalg.det(jacobians[first])))
    heights_before = heights_before * cloth.at_points(scale[:, None])[:, 0]
    min_heights = np.minimum(heights_before, _CLEARANCE * length_of(target))
    min_heights[heights_before > 0] = np.maximum(min_heights[heights_before > 0], _MIN_HEIGHT * length_of(target))
    verts, pushed, heights = _push_out(cloth, places, min_heights, _Skin(oriented_outwards(target)), workers)
    sunk = (heights < 0) & (heights_before[: len(first)] > 0)
    return Carried(verts[back], turns, np.flatnonzero(pushed[back]), np.flatnonzero(sunk[back]), *sits)


class _Body:
    """The source, with the rotation and scale of the map around each vertex."""

    def __init__(self, forward: VertexMap, source: Shape, target: Shape) -> None:
        self.verts, self.normals = source.verts, source.vertex_normals
        self.image = forward.points(target)
        self.size, self.name = length_of(source), source.name or "the source"
        turns, scale = local_frames(forward, source, target)
        self.jacobians = turns * scale[:, None, None]
        self.trust = forward.assumed_confidence + 1e-3
        edges = source.edges.vertices
        self.step = float(np.median(edge_lengths(source.verts, edges)))
        self.usable = np.flatnonzero(source.valid & (np.bincount(edges.ravel(), minlength=source.V) > 0))
        self.tree = cKDTree(self.verts[self.usable])

    def bind(self, garment: Shape, workers: int) -> tuple[Floats, Floats]:
        """Bound positions (V, 3) of the garment's vertices on the target, and the map's Jacobian at each (V, 3, 3)."""
        median = float(np.median(self.tree.query(garment.verts[garment.valid], workers=workers)[0]))
        if median > _MAX_MEDIAN_DISTANCE * self.size:
            problem = f"{garment.name or 'the garment'} is not on {self.name}: it is {median:.4g} away from it"
            raise InputError(
                problem, f"both need the same place and unit; the sqrt(area) of {self.name} is {self.size:.4g}"
            )
        places, jacobians = np.empty((garment.V, 3)), np.empty((garment.V, 3, 3))
        for low in range(0, garment.V, _CHUNK):
            queries = garment.verts[low : low + _CHUNK]
            found = self.tree.query(queries, min(_N_NEAREST, len(self.usable)), workers=workers)
            distance, rows = (each.reshape(len(queries), -1) for each in found)
            near = self.usable[rows]
            reach = _BLEND * distance[:, :1] + self.step
            weight = np.exp((distance[:, :1] ** 2 - distance**2) / (2 * reach**2)) * self.trust[near]
            facing = np.einsum("nkd,nd->nk", self.normals[near], self.normals[near[:, 0]])
            weight *= np.maximum(facing, 0.0)  # so that the chest is not bound to the arm next to it
            weight[:, 0] += 1e-9
            weight /= weight.sum(axis=1, keepdims=True)
            local_jacobians = self.jacobians[near]
            images = self.image[near] + np.einsum("nkij,nkj->nki", local_jacobians, queries[:, None] - self.verts[near])
            places[low : low + _CHUNK] = np.einsum("nk,nkd->nd", weight, images)
            jacobians[low : low + _CHUNK] = np.einsum("nk,nkij->nij", weight, local_jacobians)
        return places, jacobians


class _Cloth:
    """A garment whose edges keep their shape; its points are its vertices and the centers of its faces."""

    def __init__(self, rest: Floats, faces: Ints, jacobians: Floats) -> None:
        self.rest = rest
        self.corners = np.concatenate([np.repeat(np.arange(len(rest))[:, None], 3, axis=1), faces])
        edges = edges_of(faces).vertices.astype(np.int64)
        start, end = edges.T
        target_edges = np.einsum("nij,nj->ni", 0.5 * (jacobians[start] + jacobians[end]), rest[end] - rest[start])
        self._pull = np.zeros_like(rest)
        np.add.at(self._pull, end, target_edges)
        np.add.at(self._pull, start, -target_edges)
        self._laplacian = laplacian(edges, np.ones(len(edges)), len(rest))

    def at_points(self, values: Floats) -> Floats:
        """Values (V, D) of the vertices, averaged at all points."""
        return np.asarray(values[self.corners].mean(axis=1))

    def solve(self, places: Floats, weights: Floats) -> Floats:
        """Vertices near places (V, 3) with weights (V,), with edges of nearly their shape (a sparse linear system)."""
        matrix = (self._laplacian + diags_array(weights)).tocsr()
        return solve_positive_definite(matrix, self._pull + weights[:, None] * places, places)


class _Skin:
    """A body's surface, with signed distances."""

    def __init__(self, body: Shape) -> None:
        self._body, self._mesh = body, MappedMesh.of(body)
        self.slack = _SLACK * length_of(body)

    def heights(self, points: Floats, workers: int) -> tuple[Floats, Floats]:
        """Signed distances (N,) from the surface, negative below it; and directions out of the surface (N, 3)."""
        found = self._mesh.query(points, workers=workers)
        corners = corners_of(self._body.faces, found.face, found.vertex)
        foot = interpolate(self._body.verts, corners, found.barycentric)
        outwards = normalized(interpolate(self._body.vertex_normals, corners, found.barycentric))
        below = dot(points - foot, outwards) < 0
        return np.where(below, -1.0, 1.0) * found.distance, outwards


def _push_out(
    cloth: _Cloth, bound: Floats, min_heights: Floats, skin: _Skin, workers: int
) -> tuple[Floats, Bools, Floats]:
    """Push points out to their least heights above the skin; vertices, which were pushed, and their heights."""
    places, weights = bound.copy(), np.full(len(bound), _BOUND_WEIGHT)
    verts = cloth.solve(places, weights)
    pushed = np.zeros(len(verts), bool)
    for _ in range(_ROUNDS):
        heights, outwards = skin.heights(cloth.at_points(verts), workers)
        low = np.flatnonzero(heights < min_heights - skin.slack)
        if not len(low):
            return verts, pushed, heights[: len(verts)]
        low = low[
            np.argsort((min_heights - heights)[low], kind="stable")
        ]  # per vertex the largest step comes last and counts
        corners = cloth.corners[low]
        places[corners] = verts[corners] + ((min_heights - heights)[low, None] * outwards[low])[:, None]
        weights[corners] = _PUSHED_WEIGHT
        pushed[corners] = True
        verts = cloth.solve(places, weights)
    heights, outwards = skin.heights(verts, workers)
    low = np.flatnonzero(heights < min_heights[: len(verts)])
    verts[low] += (min_heights[low] - heights[low])[:, None] * outwards[low]  # the rest, without moving others
    return verts, pushed, skin.heights(verts, workers)[0]
