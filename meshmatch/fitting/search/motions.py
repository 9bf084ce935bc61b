"""Rigid and affine motions between two simplified meshes, and rotational symmetries of one."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from scipy.spatial.transform import Rotation

from meshmatch.arrays import Float, Floats
from meshmatch.fitting.search.intrinsic import SimplifiedMesh
from meshmatch.geometry.closest_points import ClosestPoints
from meshmatch.geometry.frames import RigidPose
from meshmatch.geometry.oriented import OrientedPoints, feature_tree, with_normals

_SCALE = 0.1  # scale of the robust weight, in units of sqrt(area). Set by hand on 30 pairs of 15 kinds of shapes.
_N_QUERIES = 200  # points of each mesh that are paired with the closest point of the other
# A rotation is a symmetry if its residual (both ways, normals included; units of sqrt(area)) is below
# `_MAX_SYMMETRIC_RESIDUAL`, and if more than a share of `_MIN_MOVED_SHARE` of the vertices move farther than
# `_MIN_DISPLACEMENT`. Vertices of 2,400 triangles are never nearer than about 0.01. Bearings come to 0.01 to 0.02, tables
# to 0.015 to 0.025, pliers, which are turned over, to 0.024 to 0.029; of 90 shapes with a front the nearest, a plane, comes
# to 0.039.
_MAX_SYMMETRIC_RESIDUAL, _MIN_DISPLACEMENT, _MIN_MOVED_SHARE = 0.03, 0.1, 0.1
_FRACTIONS = 2, 3, 5, 7  # fractions of a full turn: any rotational symmetry includes one of these, or is of high order
_N_FRACTIONS = 24  # fractions of a full turn about a symmetry axis that are then tested
_STEPS = 3  # steps of closest points from rotations with at most `_NEAR` times that residual
_NEAR = 2.0
_MIN_ANGLE = 10.0  # degrees between two rotations that count as different


def principal_axes(mesh: SimplifiedMesh) -> Float[Floats, "3 3"]:
    """Principal axes of the surface, one in each column, right-handed."""
    axes = np.linalg.eigh(np.cov(mesh.verts.T, aweights=mesh.areas))[1]
    axes[:, 0] *= np.sign(np.linalg.det(axes))
    return axes


class Motions:
    """Rigid and affine motions of one simplified mesh onto another, about the centroid of each.

    Found by iterative closest points in both directions, with robust weights.
    """

    def __init__(self, source: SimplifiedMesh, target: SimplifiedMesh) -> None:
        self.middles = source.areas @ source.verts, target.areas @ target.verts
        self._own = OrientedPoints(source.verts - self.middles[0], source.normals)
        self._onto = OrientedPoints(target.verts - self.middles[1], target.normals)
        queries, onto_queries = (
            np.linspace(0, V - 1, min(_N_QUERIES, V)).astype(np.int64) for V in (len(source.verts), len(target.verts))
        )
        self._query_points = self._own.points[queries], self._onto.points[onto_queries]
        self._queries = queries, self._onto.features[onto_queries]
        self._rigid = ClosestPoints(self._onto, self._own, (onto_queries, queries))

    def rigid(self, starts: list[RigidPose], steps: int) -> list[RigidPose]:
        """Rigid motions of the source after some steps from the given starts."""
        return self._rigid.nearer(starts, steps)

    def residuals(self, motions: list[RigidPose]) -> Float[Floats, " N"]:
        """Mean capped distance in both directions, normals included, after each rigid motion."""
        return self._rigid.residuals(motions)

    def moves(self, motion: RigidPose) -> float:
        """Share (0..1) of the source's vertices that a motion clearly moves."""
        return float(
            (np.linalg.norm(motion.to_world(self._own.points) - self._own.points, axis=1) > _MIN_DISPLACEMENT).mean()
        )

    def moved(self, matrix: Floats, shift: Floats) -> Float[Floats, "V 3"]:
        """The source's vertices under an affine motion, relative to the target's centroid."""
        return np.asarray(self._own.points @ matrix.T + shift)

    def affine(self, start: RigidPose, steps: int) -> tuple[Floats, Floats]:
        """Matrix and translation of an affine motion of the source after some steps from a rigid one."""
        matrix, shift = start.rotation, start.center
        for _ in range(steps):
            normals = self._own.normals @ np.linalg.inv(matrix)
            normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
            features = with_normals(self.moved(matrix, shift), normals)
            forward = self._onto.tree.query(features[self._queries[0]])[1]
            backward = feature_tree(features).query(self._queries[1])[1]
            source = np.concatenate([self._query_points[0], self._own.points[backward]])
            goals = np.concatenate([self._onto.points[forward], self._query_points[1]])
            squared_distance = np.square(source @ matrix.T + shift - goals).sum(1)
            matrix, shift = _affine(source, goals, 1 / np.square(1 + squared_distance / _SCALE**2), matrix)
        return matrix, shift


def _affine(source: Floats, goal: Floats, weights: Floats, near: Floats) -> tuple[Floats, Floats]:
    """Weighted least-squares affine motion, regularised towards the rotation in ``near``."""
    U, _, Vh = np.linalg.svd(near)
    lifted = np.hstack([source, np.ones((len(source), 1))])
    held = np.diag([1e-3, 1e-3, 1e-3, 0]) * weights.sum()
    wanted = np.vstack([(U @ Vh).T, np.zeros(3)])
    weighted = weights[:, None] * lifted
    found = np.linalg.solve(lifted.T @ weighted + held, weighted.T @ goal + held @ wanted)
    return found[:3].T, found[3]


def turns_onto_itself(mesh: SimplifiedMesh, held: Float[Floats, "N 3"] | None = None) -> int:
    """Number of rotations that map a shape onto itself, including the identity: 2 for pliers, many for a bearing.

    Only rotations about principal axes are tried. If positions are ``held``, only rotations that leave them in place count.
    """
    motions, axes = Motions(mesh, mesh), principal_axes(mesh).T
    held = None if held is None else held - motions.middles[0]

    def is_symmetry(turn: RigidPose, residual: float) -> bool:
        if held is not None and (np.linalg.norm(turn.to_world(held) - held, axis=1) > _MIN_DISPLACEMENT).any():
            return False
        return residual < _MAX_SYMMETRIC_RESIDUAL and motions.moves(turn) > _MIN_MOVED_SHARE

    def symmetries(axis: Floats, shares: Iterable[float]) -> list[RigidPose]:
        """Symmetries near the given fractions of a full turn about an axis."""
        rotations = Rotation.from_rotvec(2 * np.pi * np.outer(list(shares), axis)).as_matrix()
        starts = [RigidPose(turn, np.zeros(3)) for turn in rotations]
        promising = [
            turn
            for turn, off in zip(starts, motions.residuals(starts), strict=True)
            if off <= _NEAR * _MAX_SYMMETRIC_RESIDUAL
        ]
        turns = motions.rigid(promising, _STEPS) if promising else []
        return (
            [turn for turn, off in zip(turns, motions.residuals(turns), strict=True) if is_symmetry(turn, off)]
            if turns
            else []
        )

    found = [RigidPose.identity()]
    for axis in axes:
        first = symmetries(axis, (1 / parts for parts in _FRACTIONS))
        if not first:
            continue
        for turn in (*first, *symmetries(axis, (number / _N_FRACTIONS for number in range(1, _N_FRACTIONS)))):
            if all(turn.angle_to(other) > _MIN_ANGLE for other in found):
                found.append(turn)
    return len(found)
