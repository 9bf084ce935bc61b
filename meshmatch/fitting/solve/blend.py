"""Interpolation between several fits of one template, by the deformation gradients at its gradient points.

Limbs rotate and keep their size. If node vectors were blended, every point would move along a straight line, and a rotating
arm would shrink on its way. Instead, the deformation gradient of each fit is split into a rotation and a stretch (polar
decomposition). Stretches are blended by their logarithms. Rotations are blended relative to a neighbour's, along a spanning
tree of the surface that prefers neighbours with similar rotations: a forearm rotates about its elbow, and the elbow follows
the upper arm. Then the node vectors are found that fit the blended gradients best (least squares), followed by a few rounds
in which every point may change its rotation (local and global steps of Sorkine and Alexa, 2007).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components, dijkstra, minimum_spanning_tree
from scipy.spatial.transform import Rotation

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.fitting.fit_config import Schedule
from meshmatch.fitting.solve.driver import Problem, minimise
from meshmatch.fitting.solve.priors import FixedGradient, RotatedReference, signed_svd
from meshmatch.fitting.solve.system import NodeSystem

_MIN_STRETCH = 1e-3  # smaller stretches are raised to this, so that logarithms are finite
_MAX_LOG = 5.0  # a stretch of 150, which only distant extrapolation reaches
# The first solve fits the blended gradients; in the following rounds every point may change its rotation. Set by hand.
_FIRST = Schedule(steps=1, prior=(1.0, 1.0), damping=1e-7)
_ROUNDS = Schedule(steps=3, prior=(1.0, 1.0), damping=1e-4)
_MIN_COST = 1e-6  # cost of an edge without a change of rotation; sparse graphs drop edges of cost 0


class RotationBlend:
    """Weighted means of N rotations in each of several keys; exact at the keys.

    Computed in the tangent space at the mean of the keys; for two keys this is the shortest rotation from one to the other
    at constant speed. The order of the keys, each (N, 3, 3), does not matter.
    """

    def __init__(self, keys: Sequence[Floats]) -> None:
        quaternions = np.stack([Rotation.from_matrix(key).as_quat() for key in keys])  # n N 4
        # A quaternion and its negative are one rotation; their outer products are the same.
        outer = np.einsum("kni,knj->nij", quaternions, quaternions)
        self._mean = Rotation.from_quat(np.linalg.eigh(outer)[1][:, :, -1])
        back = self._mean.inv()
        self._logs = np.stack([(back * Rotation.from_matrix(key)).as_rotvec() for key in keys])

    def at(self, weights: Float[Floats, " n"]) -> Float[Floats, "N 3 3"]:
        """Rotations for weights that sum to one."""
        return (self._mean * Rotation.from_rotvec(np.tensordot(weights, self._logs, 1))).as_matrix()


class StretchBlend:
    """Weighted means of symmetric stretches, given by their logarithms (N, 3, 3)."""

    def __init__(self, keys: Sequence[Floats]) -> None:
        self._logs = np.stack(keys)

    def at(self, weights: Float[Floats, " n"]) -> Float[Floats, "N 3 3"]:
        """Stretches for weights that sum to one."""
        values, axes = np.linalg.eigh(np.tensordot(weights, self._logs, 1))
        return np.asarray((axes * np.exp(np.clip(values, -_MAX_LOG, _MAX_LOG))[:, None, :]) @ axes.transpose(0, 2, 1))


def polar(F: Float[Floats, "N 3 3"]) -> tuple[Float[Floats, "N 3 3"], Float[Floats, "N 3 3"]]:
    """Polar decomposition F = R S: the rotations R nearest to F, and the logarithms of the stretches S.

    If F inverts orientation, the smallest stretch would be negative; it is raised to a very small one.
    """
    U, sizes, Vh = signed_svd(F)
    logs = np.log(np.maximum(sizes, _MIN_STRETCH))
    return U @ Vh, (Vh.transpose(0, 2, 1) * logs[:, None, :]) @ Vh


class FieldPath:
    """Poses between several fits of one template, by the deformation gradients at its gradient points.

    Keys are node vectors (K, 3) of the fits, each in its core frame; the core's mean displacement is blended linearly.
    """

    def __init__(self, system: NodeSystem, keys: Sequence[Floats], core: Int[Ints, " C"]) -> None:
        self._system, self._keys = system, np.stack(keys)
        parts = [polar(system.deformation_gradient(key)) for key in keys]
        rotations = [rotation for rotation, _ in parts]
        self.stretches = StretchBlend([logs for _, logs in parts])
        self._parent, self._levels = _spanning_order(system, rotations, core)
        child = np.flatnonzero(self._parent >= 0)
        # relative to the rotation of each point's parent; absolute for roots
        relative = [rotation.copy() for rotation in rotations]
        for own, whole in zip(relative, rotations, strict=True):
            own[child] = whole[self._parent[child]].transpose(0, 2, 1) @ whole[child]
        self._joints = RotationBlend(relative)
        # weights of the node vectors in the core's mean displacement
        self._core = np.asarray(system.phi[core].mean(0)).ravel()

    def __call__(self, weights: Float[Floats, " n"]) -> Float[Floats, "K 3"]:
        """Node vectors for weights of the keys that sum to one."""
        stretch = self.stretches.at(weights)
        linear = np.tensordot(weights, self._keys, 1)
        rotations = self._joints.at(weights)
        for level in self._levels:
            rotations[level] = rotations[self._parent[level]] @ rotations[level]

        def anchored(vectors: Float[Floats, "K 3"]) -> Float[Floats, "K 3"]:
            """Translate so that the core moves as under linearly blended node vectors."""
            return vectors + self._core @ (linear - vectors)

        first, rounds = (
            Problem(system=self._system, terms=(), schedule=schedule, anchor=anchored) for schedule in (_FIRST, _ROUNDS)
        )
        vectors = minimise(first, FixedGradient(rotations @ stretch), linear)
        return minimise(rounds, RotatedReference(stretch), vectors)


def _spanning_order(
    system: NodeSystem, rotations: Sequence[Floats], core: Int[Ints, " C"]
) -> tuple[Int[Ints, " G"], list[Ints]]:
    """Parents (G,) of the gradient points, -1 for roots, and the other points level by level below their roots.

    Each connected part has one spanning tree, along the edges over which the rotations change least. Its root is the point
    nearest to the center of the core.
    """
    at = system.verts[system.gradient_points]
    G = len(at)
    a, b = _neighbours(system)
    jump = np.full(len(a), _MIN_COST)
    for R in rotations:
        jump += np.linalg.norm(R[a] - R[b], axis=(1, 2))
    tree = minimum_spanning_tree(coo_matrix((jump, (a, b)), (G, G)).tocsr())
    part = connected_components(tree, directed=False)[1]
    away = np.linalg.norm(at - system.verts[core].mean(0), axis=1)
    parent, depth = np.full(G, -1), np.zeros(G, int)
    for number in range(part.max() + 1):
        members = np.flatnonzero(part == number)
        order, before = breadth_first_order(tree, members[away[members].argmin()], directed=False)
        for point in order[1:]:
            parent[point] = before[point]
            depth[point] = depth[before[point]] + 1
    by_depth = np.argsort(depth, kind="stable")
    levels = np.split(by_depth, np.cumsum(np.bincount(depth))[:-1])
    return parent, levels[1:]


def _neighbours(system: NodeSystem) -> tuple[Ints, Ints]:
    """Pairs (a < b) of gradient points whose regions on the surface touch."""
    V, G = len(system.verts), len(system.gradient_points)
    edges = np.concatenate([system.faces[:, [0, 1]], system.faces[:, [1, 2]], system.faces[:, [2, 0]]])
    length = np.linalg.norm(system.verts[edges[:, 0]] - system.verts[edges[:, 1]], axis=1)
    graph = csr_matrix((np.maximum(length, 1e-12), (edges[:, 0], edges[:, 1])), (V, V))
    found = dijkstra(graph, directed=False, indices=system.gradient_points, min_only=True, return_predecessors=True)
    number = np.full(V + 1, -1)
    number[system.gradient_points] = np.arange(G)
    # Number of the nearest gradient point along the surface for each vertex; -1 if none is connected.
    region = number[np.where(found[2] < 0, V, found[2])]
    pairs = region[edges]
    pairs = np.sort(pairs[(pairs >= 0).all(axis=1) & (pairs[:, 0] != pairs[:, 1])], axis=1)
    code = np.unique(pairs[:, 0] * G + pairs[:, 1])
    return code // G, code % G
