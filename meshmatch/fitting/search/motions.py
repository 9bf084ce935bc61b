"""Rigid and affine motions between two thin meshes, and turns that bring one onto itself."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from scipy.spatial.transform import Rotation

from meshmatch.arrays import Float, Floats
from meshmatch.fitting.search.intrinsic import DecimatedMesh
from meshmatch.geometry.closest_points import ClosestPoints
from meshmatch.geometry.frames import RigidPose
from meshmatch.geometry.oriented import OrientedPoints, feature_tree, with_normals

_SCALE = 0.1  # of the robust weight, in units of sqrt(area). Set by hand on 30 pairs of 15 kinds of shapes.
_SOME = 200  # points of each mesh that look for their closest
# A shape is the same after a turn that leaves it so near, both ways and normals included (vertices of 2,400 triangles are
# never nearer than about 0.01), and takes a share of `_MOVED` of it `_APART` from where it was. Bearings come to 0.01 to
# 0.02, tables to 0.015 to 0.025, pliers, which are turned over, to 0.024 to 0.029; of 90 shapes that have a front the
# nearest, a plane, to 0.039.
_SAME, _APART, _MOVED = 0.03, 0.1, 0.1
_PARTS = 2, 3, 5, 7  # of a full turn: whatever symmetry an axis has, one of these is in it, or it has many
_COUNTED = 24  # parts of a full turn about such an axis that are counted
_STEPS = 3  # of closest points, from a turn that leaves the shape at most `_NEAR` times as far off
_NEAR = 2.0
_OTHER = 10.0  # degrees between two that count as two


def principal_axes(mesh: DecimatedMesh) -> Float[Floats, "3 3"]:
    """Of the surface, one in each column, right-handed."""
    axes = np.linalg.eigh(np.cov(mesh.verts.T, aweights=mesh.areas))[1]
    axes[:, 0] *= np.sign(np.linalg.det(axes))
    return axes


class Motions:
    """Rigid and affine motions of one thin mesh onto another by iterative closest points, both ways, with robust weights;
    about the middle of each."""

    def __init__(self, source: DecimatedMesh, target: DecimatedMesh) -> None:
        self.middles = source.areas @ source.verts, target.areas @ target.verts
        self._own = OrientedPoints(source.verts - self.middles[0], source.normals)
        self._onto = OrientedPoints(target.verts - self.middles[1], target.normals)
        some, some_onto = (
            np.linspace(0, V - 1, min(_SOME, V)).astype(np.int64) for V in (len(source.verts), len(target.verts))
        )
        self._some = self._own.points[some], self._onto.points[some_onto]
        self._asking = some, self._onto.features[some_onto]
        self._rigid = ClosestPoints(self._onto, self._own, (some_onto, some))

    def rigid(self, starts: list[RigidPose], steps: int) -> list[RigidPose]:
        """Rigid motions of the source after some steps from others."""
        return self._rigid.nearer(starts, steps)

    def residuals(self, motions: list[RigidPose]) -> Float[Floats, " N"]:
        """Mean capped distance there and back, normals included, after each rigid motion."""
        return self._rigid.residuals(motions)

    def moves(self, motion: RigidPose) -> float:
        """Share (0..1) of the source's vertices that a motion takes clearly elsewhere."""
        return float((np.linalg.norm(motion.to_world(self._own.points) - self._own.points, axis=1) > _APART).mean())

    def moved(self, matrix: Floats, shift: Floats) -> Float[Floats, "V 3"]:
        """The source's vertices under a motion, about the middle of the target."""
        return np.asarray(self._own.points @ matrix.T + shift)

    def affine(self, start: RigidPose, steps: int) -> tuple[Floats, Floats]:
        """Matrix and shift of an affine motion of the source after some steps from a rigid one."""
        matrix, shift = start.rotation, start.center
        for _ in range(steps):
            normals = self._own.normals @ np.linalg.inv(matrix)
            normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
            features = with_normals(self.moved(matrix, shift), normals)
            forth = self._onto.tree.query(features[self._asking[0]])[1]
            home = feature_tree(features).query(self._asking[1])[1]
            source = np.concatenate([self._some[0], self._own.points[home]])
            goal = np.concatenate([self._onto.points[forth], self._some[1]])
            off = np.square(source @ matrix.T + shift - goal).sum(1)
            matrix, shift = _affine(source, goal, 1 / np.square(1 + off / _SCALE**2), matrix)
        return matrix, shift


def _affine(source: Floats, goal: Floats, weights: Floats, near: Floats) -> tuple[Floats, Floats]:
    """The affine motion of weighted least squares, held near the rotation in ``near`` where points do not say."""
    U, _, Vh = np.linalg.svd(near)
    lifted = np.hstack([source, np.ones((len(source), 1))])
    held = np.diag([1e-3, 1e-3, 1e-3, 0]) * weights.sum()
    wanted = np.vstack([(U @ Vh).T, np.zeros(3)])
    weighted = weights[:, None] * lifted
    found = np.linalg.solve(lifted.T @ weighted + held, weighted.T @ goal + held @ wanted)
    return found[:3].T, found[3]


def turns_onto_itself(mesh: DecimatedMesh, held: Float[Floats, "N 3"] | None = None) -> int:
    """How many turns bring a shape onto itself, that by nothing included: 2 of pliers, many of a bearing.

    Turns are about its principal axes. Where positions are ``held``, only those count that leave them where they are.
    """
    motions, axes = Motions(mesh, mesh), principal_axes(mesh).T
    held = None if held is None else held - motions.middles[0]

    def same(turn: RigidPose, residual: float) -> bool:
        if held is not None and (np.linalg.norm(turn.to_world(held) - held, axis=1) > _APART).any():
            return False
        return residual < _SAME and motions.moves(turn) > _MOVED

    def nearest(axis: Floats, shares: Iterable[float]) -> list[RigidPose]:
        """Turns near parts of a full one that bring the shape onto itself."""
        about = Rotation.from_rotvec(2 * np.pi * np.outer(list(shares), axis)).as_matrix()
        starts = [RigidPose(turn, np.zeros(3)) for turn in about]
        near = [turn for turn, off in zip(starts, motions.residuals(starts), strict=True) if off <= _NEAR * _SAME]
        turns = motions.rigid(near, _STEPS) if near else []
        return (
            [turn for turn, off in zip(turns, motions.residuals(turns), strict=True) if same(turn, off)]
            if turns
            else []
        )

    found = [RigidPose.identity()]
    for axis in axes:
        first = nearest(axis, (1 / parts for parts in _PARTS))
        if not first:
            continue
        for turn in (*first, *nearest(axis, (number / _COUNTED for number in range(1, _COUNTED)))):
            if all(turn.angle_to(other) > _OTHER for other in found):
                found.append(turn)
    return len(found)
