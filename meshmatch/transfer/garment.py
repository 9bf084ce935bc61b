"""What sits on one body, such as clothes, hair or a hat, carried to another body.

Each vertex of the garment is bound to the vertices of the body that are nearest to it and face as the nearest does. Around
each of these the map turns and scales the body, and the offset of the garment's vertex with it; both are averaged over
the surface around, so that an error of the map at one vertex does not dent the cloth. The garment then keeps its edges as
they are turned and scaled there, as far as that leaves it near where it is bound: the deformation is smoothed, and not the
garment. Where it would sink deeper below the skin than before, it is pushed out, and what is around it follows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import diags_array

from meshmatch.arrays import Bools, Float, Floats, Int, Ints
from meshmatch.errors import InputError
from meshmatch.fitting.solve.priors import nearest_rotations
from meshmatch.geometry.smoothing import laplacian, solved
from meshmatch.geometry.trees import cKDTree
from meshmatch.geometry.triangles import dot, edge_lengths, edges_of, interpolate, same_rows, unit
from meshmatch.maps.mapped_mesh import MappedMesh, length_of
from meshmatch.maps.named_places import corners_of
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.repair import turned_outwards
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.local_frames import local_frames

# All set by hand; lengths in units of sqrt(area).
# Vertices of the body that one of the garment is bound to; those count that are not further away than the nearest by more
# than this share of its distance.
_NEAREST, _BLEND = 16, 0.3
# What it counts to be where it is bound, compared with an edge that keeps its shape; and where it was pushed out.
_BOUND, _PUSHED = 3.0, 30.0
# How far a vertex stays above the skin if it was not closer before, and at least; how much less is let pass; rounds.
_CLEAR, _LEAST, _SLACK, _ROUNDS = 0.0015, 2e-5, 1e-5, 4
# A garment whose middle vertex is further from the body does not sit on it.
_FURTHEST = 0.5
# Nor does one of which more is below the skin, or so far off: at most 0.16 and 0.02 are of 80 garments of generated people,
# and mostly more than 0.3 of the garments of others.
_FAR, _MOST_BELOW, _MOST_FAR = 0.05, 0.25, 0.25
_CHUNK = 16_384


@dataclass(frozen=True, eq=False)
class Carried:
    """A garment on another body.

    ``verts`` (V, 3) in the frame and unit of that body; ``turns`` (V, 3, 3) how each vertex was turned; ``pushed`` (V,)
    which were pushed out, and ``sunk`` (V,) which are under the skin and were not before. ``below`` and ``far`` are shares
    (0..1) of its vertices below the source's skin, and far from it.
    """

    verts: Float[Floats, "V 3"]
    turns: Float[Floats, "V 3 3"]
    pushed: Int[Ints, " N"]
    sunk: Int[Ints, " M"]
    below: float
    far: float

    @property
    def sits(self) -> bool:
        """Whether it seems to sit on the source, in the source's pose."""
        return self.below <= _MOST_BELOW and self.far <= _MOST_FAR


def carry_garment(garment: Shape, forward: VertexMap, source: Shape, target: Shape, workers: int = 1) -> Carried:
    """Carry a garment along a map from the body that it sits on to another one.

    `InputError`: the garment is not on the source, or the source is a point cloud. `OptionError`: the map turns the
    source inside out.
    """
    if source.is_cloud:
        raise InputError(f"{source.name or 'the source'} is a point cloud: nothing can be bound to it", "give a mesh")
    bound, jacobians = _Body(forward, source, target).bind(garment, workers)
    turns = nearest_rotations(jacobians, np.broadcast_to(np.eye(3), jacobians.shape))
    own, back = np.unique(same_rows(garment.verts), return_inverse=True)  # seams are closed
    cloth = _Cloth(garment.verts[own], back[garment.faces], jacobians[own])
    places = bound[own]
    before = _Skin(turned_outwards(source)).heights(cloth.at(cloth.rest), workers)[0]
    at = before[: len(own)][back]
    sits = float((at < 0).mean()), float((at > _FAR * length_of(source)).mean())
    if target.is_cloud:
        verts, none = cloth.solve(places, np.full(len(own), _BOUND)), np.empty(0, np.int64)
        return Carried(verts[back], turns, none, none, *sits)
    scale = np.cbrt(np.abs(np.linalg.det(jacobians[own])))
    before = before * cloth.at(scale[:, None])[:, 0]
    least = np.minimum(before, _CLEAR * length_of(target))
    least[before > 0] = np.maximum(least[before > 0], _LEAST * length_of(target))
    verts, pushed, heights = _pushed_out(cloth, places, least, _Skin(turned_outwards(target)), workers)
    sunk = (heights < 0) & (before[: len(own)] > 0)
    return Carried(verts[back], turns, np.flatnonzero(pushed[back]), np.flatnonzero(sunk[back]), *sits)


class _Body:
    """The source, and how the map turns and scales it around each vertex."""

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
        """Where the garment's vertices (V, 3) are carried, and what the map does around each (V, 3, 3)."""
        away = float(np.median(self.tree.query(garment.verts[garment.valid], workers=workers)[0]))
        if away > _FURTHEST * self.size:
            far = f"{garment.name or 'the garment'} is not on {self.name}: it is {away:.4g} away from it"
            raise InputError(
                far, f"both need the same place and unit; the sqrt(area) of {self.name} is {self.size:.4g}"
            )
        places, jacobians = np.empty((garment.V, 3)), np.empty((garment.V, 3, 3))
        for low in range(0, garment.V, _CHUNK):
            asked = garment.verts[low : low + _CHUNK]
            found = self.tree.query(asked, min(_NEAREST, len(self.usable)), workers=workers)
            distance, rows = (each.reshape(len(asked), -1) for each in found)
            near = self.usable[rows]
            reach = _BLEND * distance[:, :1] + self.step
            weight = np.exp((distance[:, :1] ** 2 - distance**2) / (2 * reach**2)) * self.trust[near]
            facing = np.einsum("nkd,nd->nk", self.normals[near], self.normals[near[:, 0]])
            weight *= np.maximum(facing, 0.0)  # not the arm beside the chest
            weight[:, 0] += 1e-9
            weight /= weight.sum(axis=1, keepdims=True)
            own = self.jacobians[near]
            moved = self.image[near] + np.einsum("nkij,nkj->nki", own, asked[:, None] - self.verts[near])
            places[low : low + _CHUNK] = np.einsum("nk,nkd->nd", weight, moved)
            jacobians[low : low + _CHUNK] = np.einsum("nk,nkij->nij", weight, own)
        return places, jacobians


class _Cloth:
    """A garment whose edges keep their shape as well as they can; its points are its vertices and the middles of faces."""

    def __init__(self, rest: Floats, faces: Ints, jacobians: Floats) -> None:
        self.rest = rest
        self.corners = np.concatenate([np.repeat(np.arange(len(rest))[:, None], 3, axis=1), faces])
        edges = edges_of(faces).vertices.astype(np.int64)
        start, end = edges.T
        kept = np.einsum("nij,nj->ni", 0.5 * (jacobians[start] + jacobians[end]), rest[end] - rest[start])
        self._pull = np.zeros_like(rest)
        np.add.at(self._pull, end, kept)
        np.add.at(self._pull, start, -kept)
        self._laplacian = laplacian(edges, np.ones(len(edges)), len(rest))

    def at(self, values: Floats) -> Floats:
        """Values (V, D) of the vertices at all points."""
        return np.asarray(values[self.corners].mean(axis=1))

    def solve(self, places: Floats, weights: Floats) -> Floats:
        """Vertices near places (V, 3) that count so much (V,)."""
        matrix = (self._laplacian + diags_array(weights)).tocsr()
        return solved(matrix, self._pull + weights[:, None] * places, places)


class _Skin:
    """A body that things can be above or below."""

    def __init__(self, body: Shape) -> None:
        self._body, self._mesh = body, MappedMesh.of(body)
        self.slack = _SLACK * length_of(body)

    def heights(self, points: Floats, workers: int) -> tuple[Floats, Floats]:
        """Distances (N,) from the surface, negative below it; and the directions out of it (N, 3)."""
        found = self._mesh.query(points, workers=workers)
        corners = corners_of(self._body.faces, found.face, found.vertex)
        foot = interpolate(self._body.verts, corners, found.barycentric)
        outwards = unit(interpolate(self._body.vertex_normals, corners, found.barycentric))
        below = dot(points - foot, outwards) < 0
        return np.where(below, -1.0, 1.0) * found.distance, outwards


def _pushed_out(cloth: _Cloth, bound: Floats, least: Floats, skin: _Skin, workers: int) -> tuple[Floats, Bools, Floats]:
    """Vertices, which of them were pushed, and how high they are, once all points are at least so high above the skin."""
    places, weights = bound.copy(), np.full(len(bound), _BOUND)
    verts = cloth.solve(places, weights)
    pushed = np.zeros(len(verts), bool)
    for _ in range(_ROUNDS):
        heights, outwards = skin.heights(cloth.at(verts), workers)
        low = np.flatnonzero(heights < least - skin.slack)
        if not len(low):
            return verts, pushed, heights[: len(verts)]
        low = low[np.argsort((least - heights)[low], kind="stable")]  # the largest step of each vertex is the last
        corners = cloth.corners[low]
        places[corners] = verts[corners] + ((least - heights)[low, None] * outwards[low])[:, None]
        weights[corners] = _PUSHED
        pushed[corners] = True
        verts = cloth.solve(places, weights)
    heights, outwards = skin.heights(verts, workers)
    low = np.flatnonzero(heights < least[: len(verts)])
    verts[low] += (least[low] - heights[low])[:, None] * outwards[low]  # the rest alone
    return verts, pushed, skin.heights(verts, workers)[0]
