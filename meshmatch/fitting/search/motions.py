"""Rigid and affine motions between two thin meshes, and turns that bring one onto itself."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from meshmatch.arrays import Float, Floats, Ints
from meshmatch.fitting.search.intrinsic import ThinMesh
from meshmatch.geometry.frames import kabsch
from meshmatch.geometry.oriented import feature_tree, with_normals
from meshmatch.geometry.trees import cKDTree

# Of normals in the search for closest points; then, in units of sqrt(area), the scale of their robust weight, and the
# distance from which on a point counts as far. Set by hand on 30 pairs of 15 kinds of shapes.
_NORMAL_WEIGHT, _SCALE, _CAP = 0.15, 0.1, 0.2
_SOME = 200  # points of each mesh that look for their closest
_LEAF = 64  # points are asked from far away: larger leaves of a tree than usual take half the time
# A shape is the same after a turn that leaves it so near, both ways and normals included (vertices of 2,400 triangles are
# never nearer than about 0.02), and takes a share of `_MOVED` of it `_APART` from where it was. Bearings come to 0.02 to
# 0.04, tables to 0.03 to 0.05, pliers, which are turned over, to 0.048 to 0.058; of 90 shapes that have a front the nearest,
# a plane, to 0.079.
_SAME, _APART, _MOVED = 0.06, 0.1, 0.1
_PARTS = 2, 3, 5, 7  # of a full turn: whatever symmetry an axis has, one of these is in it, or it has many
_COUNTED = 24  # parts of a full turn about such an axis that are counted
_STEPS = 3  # of closest points, from a turn that leaves the shape at most `_NEAR` times as far off
_NEAR = 2.0
_OTHER = np.cos(np.radians(10.0))  # of the angle between two that count as two


def principal_axes(mesh: ThinMesh) -> Float[Floats, "3 3"]:
    """Of the surface, one in each column, right-handed."""
    axes = np.linalg.eigh(np.cov(mesh.verts.T, aweights=mesh.areas))[1]
    axes[:, 0] *= np.sign(np.linalg.det(axes))
    return axes


class ClosestPoints:
    """Iterative closest points between two thin meshes, both ways, with robust weights; about the middle of each."""

    def __init__(self, source: ThinMesh, target: ThinMesh) -> None:
        self.middles = source.areas @ source.verts, target.areas @ target.verts
        self._points, self._onto = source.verts - self.middles[0], target.verts - self.middles[1]
        self._normals, self._onto_normals = source.normals, target.normals
        self._some, self._some_onto = (
            np.linspace(0, V - 1, min(_SOME, V)).astype(np.int64) for V in (len(self._points), len(self._onto))
        )
        self._tree = cKDTree(with_normals(self._points, self._normals, _NORMAL_WEIGHT), leafsize=_LEAF)
        self._features_onto = with_normals(self._onto, self._onto_normals, _NORMAL_WEIGHT)
        self._tree_onto = cKDTree(self._features_onto, leafsize=_LEAF)

    def moved(self, matrix: Floats, shift: Floats) -> Float[Floats, "V 3"]:
        """The source's vertices under a motion, about the middle of the target."""
        return np.asarray(self._points @ matrix.T + shift)

    def moves(self, matrix: Floats, shift: Floats) -> float:
        """Share (0..1) of the source's vertices that a motion takes clearly elsewhere."""
        return float((np.linalg.norm(self.moved(matrix, shift) - self._points, axis=1) > _APART).mean())

    def _pairs(self, matrix: Floats, shift: Floats) -> tuple[Ints, Floats, Ints, Floats]:
        """After a rigid motion, of some vertices of the source those of the target that are closest, and how far; and of
        some of the target the same. These are moved back, so that no tree has to be made."""
        own, onto = self._some, self._some_onto
        there = with_normals(self._points[own] @ matrix.T + shift, self._normals[own] @ matrix.T, _NORMAL_WEIGHT)
        back = with_normals((self._onto[onto] - shift) @ matrix, self._onto_normals[onto] @ matrix, _NORMAL_WEIGHT)
        (far, forth), (far_back, home) = self._tree_onto.query(there), self._tree.query(back)
        return forth, far, home, far_back

    def _affine_pairs(self, matrix: Floats, shift: Floats) -> tuple[Ints, Ints]:
        """Which vertices are closest after an affine motion."""
        normals = self._normals @ np.linalg.inv(matrix)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        features = with_normals(self.moved(matrix, shift), normals, _NORMAL_WEIGHT)
        forth = self._tree_onto.query(features[self._some])[1]
        return forth, feature_tree(features).query(self._features_onto[self._some_onto])[1]

    def residual(self, matrix: Floats, shift: Floats) -> float:
        """Mean capped distance both ways, normals included, after a rigid motion."""
        _, there, _, back = self._pairs(matrix, shift)
        return float(np.minimum(there, _CAP).mean() + np.minimum(back, _CAP).mean())

    def motion(self, matrix: Floats, shift: Floats, steps: int, affine: bool = False) -> tuple[Floats, Floats]:
        """A rigid or an affine motion after some steps from another one."""
        for _ in range(steps):
            forth, home = self._affine_pairs(matrix, shift) if affine else self._pairs(matrix, shift)[::2]
            source = np.concatenate([self._points[self._some], self._points[home]])
            goal = np.concatenate([self._onto[forth], self._onto[self._some_onto]])
            off = np.square(source @ matrix.T + shift - goal).sum(1)
            weights = 1 / np.square(1 + off / _SCALE**2)
            if affine:
                matrix, shift = _affine(source, goal, weights, matrix)
            else:
                pose = kabsch(source, goal, weights)
                matrix, shift = pose.rotation, pose.center
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


def turns_onto_itself(mesh: ThinMesh, held: Float[Floats, "N 3"] | None = None) -> int:
    """How many turns bring a shape onto itself, that by nothing included: 2 of pliers, many of a bearing.

    Turns are about its principal axes. Where positions are ``held``, only those count that leave them where they are.
    """
    cloud, axes = ClosestPoints(mesh, mesh), principal_axes(mesh).T
    held = None if held is None else held - cloud.middles[0]

    def nearest(axis: Floats, share: float) -> Floats | None:
        """A turn near a part of a full one that brings the shape onto itself, if there is one."""
        matrix, shift = Rotation.from_rotvec(2 * np.pi * share * axis).as_matrix(), np.zeros(3)
        if cloud.residual(matrix, shift) > _NEAR * _SAME:
            return None
        matrix, shift = cloud.motion(matrix, shift, _STEPS)
        if held is not None and (np.linalg.norm(held @ matrix.T + shift - held, axis=1) > _APART).any():
            return None
        return matrix if cloud.residual(matrix, shift) < _SAME and cloud.moves(matrix, shift) > _MOVED else None

    found = [np.eye(3)]
    for axis in axes:
        first = [nearest(axis, 1 / parts) for parts in _PARTS]
        if all(each is None for each in first):
            continue
        for turn in (*first, *(nearest(axis, number / _COUNTED) for number in range(1, _COUNTED))):
            if turn is not None and all((np.trace(turn.T @ other) - 1) / 2 < _OTHER for other in found):
                found.append(turn)
    return len(found)
