"""Landmarks are pushed forward: from their places on the source to exact places on the target."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.errors import InputError
from meshmatch.geometry.triangles import interpolate
from meshmatch.maps.map_checks import corners_of
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.mapped_mesh import MappedMesh, discontinuous_faces, known_normals

# A landmark this far from the surface, in diagonals of the shape, belongs to another shape.
_ELSEWHERE = 0.25


@dataclass(frozen=True, eq=False)
class Landmarks:
    """Named points on a shape.

    Parameters
    ----------
    names : (N,) tuple of str
    points : (N, 3) float64
        In the shape's own frame and unit.
    vertex : (N,) int64
        The vertex itself, or the heaviest corner of the face.
    face : (N,) int64
        -1 where the point is the vertex itself (always on a cloud).
    barycentric : (N, 3) float64
        Weights of the face's corners; (1, 0, 0) where the face is -1.
    confidence : (N,) float64
        0 (a guess) to 1 (certain).
    """

    names: tuple[str, ...]
    points: Float[Floats, "N 3"]
    vertex: Int[Ints, " N"]
    face: Int[Ints, " N"]
    barycentric: Float[Floats, "N 3"]
    confidence: Float[Floats, " N"]

    def rows(self, rows: Ints) -> Landmarks:
        """Some of them, in this order."""
        names = tuple(self.names[k] for k in rows.tolist())
        face, weights, confidence = self.face[rows], self.barycentric[rows], self.confidence[rows]
        return Landmarks(names, self.points[rows], self.vertex[rows], face, weights, confidence)


def at_vertices(shape: Shape, vertex: Int[Ints, " N"], names: tuple[str, ...] = ()) -> Landmarks:
    """Landmarks that are vertices (N,) of `shape`.

    Raises
    ------
    InputError
        A vertex that the shape does not have.
    """
    vertex = np.asarray(vertex, np.int64)
    names = names or _numbered(len(vertex))
    bad = np.flatnonzero((vertex < 0) | (vertex >= shape.V))
    if len(bad):
        raise InputError(
            f"landmark {names[bad[0]]} is vertex {vertex[bad[0]]}, but {shape.name or 'the source'} has "
            f"{shape.V} vertices",
            "vertices are counted from 0; are they landmarks of the source?",
        )
    N = len(vertex)
    weights = np.tile([1.0, 0.0, 0.0], (N, 1))
    return Landmarks(names, shape.verts[vertex], vertex, np.full(N, -1), weights, np.ones(N))


def at_points(
    shape: Shape, points: Float[Floats, "N 3"], names: tuple[str, ...] = ()
) -> tuple[Landmarks, Float[Floats, " N"]]:
    """Landmarks at the points of a surface (or cloud) nearest to points (N, 3) of its frame.

    Returns
    -------
    landmarks : Landmarks
    distance : (N,) float64
        From each given point to the surface.

    Raises
    ------
    InputError
        A point is not finite, or lies far from the shape.
    """
    points = np.asarray(points, np.float64).reshape(-1, 3)
    names = names or _numbered(len(points))
    bad = np.flatnonzero(~(np.abs(points) < 1e60).all(axis=1))
    if len(bad):
        raise InputError(f"landmark {names[bad[0]]} has no position: {points[bad[0]].tolist()}")
    places = MappedMesh.of(shape).query(points)
    far = np.flatnonzero(places.distance > _ELSEWHERE * max(shape.diagonal, 1e-30))
    if len(far):
        raise InputError(
            f"landmark {names[far[0]]} lies {places.distance[far[0]]:.4g} away from "
            f"{shape.name or 'the source'}, whose size is {shape.diagonal:.4g}",
            "landmarks must be in the frame and unit of the source's file",
        )
    found = _on_surface(shape, names, places.vertex, places.face, places.barycentric, np.ones(len(points)))
    return found, places.distance


def at_faces(
    shape: Shape, face: Int[Ints, " N"], barycentric: Float[Floats, "N 3"], names: tuple[str, ...] = ()
) -> Landmarks:
    """Landmarks in faces (N,), by the weights (N, 3) of their corners.

    Raises
    ------
    InputError
        A face that the shape does not have, or weights that do not sum to 1.
    """
    face, weights = np.asarray(face, np.int64), np.asarray(barycentric, np.float64).reshape(-1, 3)
    names = names or _numbered(len(face))
    bad = np.flatnonzero((face < 0) | (face >= shape.F))
    if len(bad):
        raise InputError(
            f"landmark {names[bad[0]]} is in face {face[bad[0]]}, but {shape.name or 'the source'} has {shape.F} faces",
            "faces are counted from 0; are they landmarks of the source?",
        )
    bad = np.flatnonzero(~((weights >= -1e-9).all(axis=1) & (np.abs(weights.sum(axis=1) - 1.0) < 1e-4)))
    if len(bad):
        raise InputError(
            f"landmark {names[bad[0]]}: its weights {weights[bad[0]].tolist()} do not sum to 1",
            "the weights of a face's corners are 0 or more",
        )
    weights = np.clip(weights, 0.0, None)
    weights /= weights.sum(axis=1, keepdims=True)
    vertex = shape.faces[face, weights.argmax(axis=1)]
    return _on_surface(shape, names, vertex, face, weights, np.ones(len(face)))


def joined(parts: list[Landmarks]) -> Landmarks:
    """Landmarks of one shape, one after the other."""
    arrays: list[NDArray] = [
        np.concatenate([getattr(part, name) for part in parts])
        for name in ("points", "vertex", "face", "barycentric", "confidence")
    ]
    return Landmarks(tuple(name for part in parts for name in part.names), *arrays)


def push_landmarks(forward: VertexMap, source: Shape, target: Shape, landmarks: Landmarks) -> Landmarks:
    """Landmarks of the source on the target, exactly on its surface.

    A vertex goes where the map puts it. A point of a face goes to the surface nearest to the mean of where its
    corners go; where the map is discontinuous there, with its heaviest corner.

    Parameters
    ----------
    forward : VertexMap
        From source to target.
    """
    at = landmarks.vertex
    vertex, face = forward.index[at].copy(), forward.face[at].copy()
    weights = forward.barycentric[at].copy()
    confidence = forward.confidence[at].astype(np.float64)
    points = forward.points(target)
    inside = np.flatnonzero((landmarks.face >= 0) & (landmarks.barycentric.max(axis=1) < 1.0 - 1e-9))
    if len(inside):
        discontinuous = discontinuous_faces(forward, source, target)
        inside = inside[~discontinuous[landmarks.face[inside]]]
    if len(inside):
        corners = source.faces[landmarks.face[inside]]
        share = landmarks.barycentric[inside]
        mean = interpolate(points, corners, share)
        facing = interpolate(known_normals(target), forward.index[corners], share)
        places = MappedMesh.of(target).query(mean, facing)
        vertex[inside], face[inside], weights[inside] = places.vertex, places.face, places.barycentric
        confidence[inside] = np.einsum("nk,nk->n", share, forward.confidence[corners])
    return _on_surface(target, landmarks.names, vertex, face, weights, np.clip(confidence, 0, 1))


def _on_surface(
    shape: Shape, names: tuple[str, ...], vertex: Ints, face: Ints, weights: Floats, confidence: Floats
) -> Landmarks:
    points = interpolate(shape.verts, corners_of(shape.faces, face, vertex), weights)
    return Landmarks(names, points, vertex, face, weights, confidence)


def _numbered(count: int) -> tuple[str, ...]:
    return tuple(str(k) for k in range(count))
