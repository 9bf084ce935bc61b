"""Proposals of where the vertices of one shape belong on another, made without a model, before any fit.

There are rigid and affine motions (iterative closest points); maps between Laplacian eigenfunctions (functional maps,
Ovsjanikov et al. 2012, refined by ZoomOut, Melzi et al. 2019); and maps that send extremities to extremities. Each kind
suits some shapes and fails for others, so each proposal is fitted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, product
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.fitting.search.intrinsic import Intrinsic, SimplifiedMesh
from meshmatch.fitting.search.motions import Motions, principal_axes
from meshmatch.geometry.frames import RigidPose, kabsch
from meshmatch.geometry.triangles import triangle_vectors

Kind = Literal["rigid", "affine", "spectral", "extremities", "guess"]


@dataclass(frozen=True, eq=False)
class Proposal:
    """Where vertices of the source's simplified mesh (V,) may belong.

    Attributes
    ----------
    kind : how the proposal was made
    points : (N, 3) positions, in the frame of the target
    at : (N,) the vertices that belong there; None for all vertices
    """

    kind: Kind
    points: Float[Floats, "N 3"]
    at: Int[Ints, " N"] | None = None


@dataclass(frozen=True, kw_only=True)
class ProposalSettings:
    """How many proposals are made, and how. Set by hand on 30 pairs of 15 kinds of shapes; lengths in units of sqrt(area).

    Attributes
    ----------
    n_rigid : rigid motions that are kept, each with an affine one
    closest_point_steps, affine_steps : steps of iterative closest points for each
    min_angle : smallest angle in degrees between two rigid motions
    n_signed : number of eigenfunctions whose signs are tried in all combinations, and whose order is varied
    n_refined : how many of these maps are refined from ``n_first_functions`` to ``n_functions``
    n_functions, n_first_functions : number of eigenfunctions of a map at the end, and after the first stage
    functions_per_step : how many eigenfunctions are added in each step
    n_maps : maximum number of spectral maps
    n_assignments_kept : maximum number of assignments of extremities
    beam_width, n_per_beam_search : partial assignments that a beam search keeps, and complete ones that it returns
    n_per_cyclic_search : cyclic assignments that each search keeps
    skip_cost : cost of an extremity without counterpart
    min_changed_share : share of vertices by which two maps must differ
    changed_distance : a vertex differs if the maps send it to places farther apart than this
    bend_weight : weight of the distance that the best rotation of limbs onto limbs leaves, relative to the error of
        distances
    leftover_weight : weight of the share of the limbs' length without counterpart
    """

    n_rigid: int = 10
    closest_point_steps: int = 6
    affine_steps: int = 10
    min_angle: float = 20.0
    n_signed: int = 5
    n_refined: int = 32
    n_first_functions: int = 14
    n_functions: int = 40
    functions_per_step: int = 5
    n_maps: int = 16
    n_assignments_kept: int = 14
    beam_width: int = 400
    n_per_beam_search: int = 50
    n_per_cyclic_search: int = 8
    skip_cost: float = 0.12
    min_changed_share: float = 0.02
    changed_distance: float = 0.1
    bend_weight: float = 0.15
    leftover_weight: float = 0.05


SETTINGS = ProposalSettings()


def rigid_proposals(source: SimplifiedMesh, target: SimplifiedMesh) -> list[Proposal]:
    """The best rigid motions by iterative closest points from 48 starts, each with an affine motion."""
    motions = Motions(source, target)
    middle = motions.middles[1]
    turns = Rotation.create_group("O").as_matrix()
    axes = [principal_axes(mesh) for mesh in (source, target)]
    starts = [*turns, *(axes[1] @ turn @ axes[0].T for turn in turns)]
    found = motions.rigid([RigidPose(start, np.zeros(3)) for start in starts], SETTINGS.closest_point_steps)
    chosen: list[RigidPose] = []
    for best in np.argsort(motions.residuals(found), kind="stable"):
        if all(found[best].angle_to(other) > SETTINGS.min_angle for other in chosen):
            chosen.append(found[best])
    proposals = []
    for motion in chosen[: SETTINGS.n_rigid]:
        proposals.append(Proposal("rigid", motions.moved(motion.rotation, motion.center) + middle))
        matrix, shift = motions.affine(motion, SETTINGS.affine_steps)
        if np.linalg.det(matrix) > 0.1:
            proposals.append(Proposal("affine", motions.moved(matrix, shift) + middle))
    return proposals


def spectral_proposals(source: Intrinsic, target: Intrinsic) -> list[Proposal]:
    """Maps by eigenfunctions, whose signs and order are unknown.

    Many combinations are refined by ZoomOut, and the most isometric maps are kept.
    """
    landmarks, their_landmarks = source.landmarks, target.landmarks
    own, theirs = source.functions[landmarks], target.functions[their_landmarks]
    last = min(SETTINGS.n_functions, own.shape[1], theirs.shape[1])
    first = min(SETTINGS.n_first_functions, last)
    count = min(SETTINGS.n_signed, first - 1)
    initial = []
    for order in _near_orders(count):
        for signs in product((1.0, -1.0), repeat=count):
            C = np.zeros((count + 1, count + 1))
            C[0, 0] = 1.0
            C[np.arange(1, count + 1), 1 + np.array(order)] = signs
            initial.append(C)
    found, nearest = _zoom_out(np.stack(initial), own, theirs, first, SETTINGS.functions_per_step)
    own_distances, their_distances = source.landmark_distances, target.landmark_distances
    errors = [_distance_error(own_distances, their_distances, each) for each in nearest]
    best = np.argsort(errors, kind="stable")[: SETTINGS.n_refined]
    maps = []
    for C, near in zip(*_zoom_out(found[best], own, theirs, last, SETTINGS.functions_per_step), strict=True):
        vertex = _nearest(source.functions[:, :last] @ C.T, target.functions[:, :last])
        maps.append((_distance_error(own_distances, their_distances, near), vertex))
    return _select_maps("spectral", source, target, maps)


def _near_orders(count: int) -> list[tuple[int, ...]]:
    """The order of eigenfunctions as given, and with two neighbours exchanged."""
    plain = tuple(range(count))
    swapped = [(*plain[:k], plain[k + 1], plain[k], *plain[k + 2 :]) for k in range(count - 1)]
    return [plain, *swapped]


def _zoom_out(C: Floats, own: Floats, theirs: Floats, last: int, more: int) -> tuple[Floats, Ints]:
    """Refine functional maps (N, K, K) by ZoomOut to ``last`` functions.

    Each functional map gives a map of points, and that a functional map with ``more`` functions. Returns the final
    functional maps, and for each the nearest rows (N, L) of ``theirs`` to all of ``own`` (L, F).
    """
    size = C.shape[1]
    while True:
        turned = own[:, :size] @ C.transpose(0, 2, 1)
        nearest = np.stack([_nearest(each, theirs[:, :size]) for each in turned])
        if size >= last:
            return C, nearest
        size = min(size + more, last)
        C = (np.linalg.pinv(own[:, :size]) @ theirs[nearest, :size]).transpose(0, 2, 1)


def _nearest(points: Floats, among: Floats) -> Ints:
    """Index of the nearest row for each point, by brute force: these spaces have too many dimensions for a tree."""
    lifted = np.column_stack([points, np.ones(len(points))])
    return np.asarray((lifted @ np.column_stack([among, -0.5 * np.square(among).sum(1)]).T).argmax(1))


def _distance_error(known: Float[Floats, "L L"], distances: Float[Floats, "U U"], nearest: Int[Ints, " L"]) -> float:
    """Mean change of the known distances between landmarks that are mapped to ``nearest``, given the distances there."""
    return float(np.abs(known - distances[np.ix_(nearest, nearest)]).mean())


def _orientation_agreement(source: Intrinsic, target: Intrinsic, vertex: Int[Ints, " V"]) -> float:
    """Share of the mapped area that keeps its orientation minus the share that reverses it; -1 for a mirrored map."""
    mesh = target.mesh
    mapped = triangle_vectors(mesh.verts[vertex], source.mesh.faces)
    dots = (mapped * mesh.normals[vertex][source.mesh.faces].sum(1)).sum(1)
    area = np.linalg.norm(mapped, axis=1)
    return float((area * np.sign(dots)).sum() / max(area.sum(), 1e-12))


def extremity_proposals(source: Intrinsic, target: Intrinsic) -> list[Proposal]:
    """Maps of limbs that send extremities to extremities, found by beam searches and cyclic searches.

    Assignments are compared by the distances between extremities, by how much of the paths from the center to two of them
    is shared, by the order in which these paths lie around the shape, and by how well a rotation takes limbs to limbs.
    Lengths of limbs may differ.
    """
    if min(len(source.extremities), len(target.extremities)) < 2:
        return []
    assignments = Assignments(source, target)
    found = dict.fromkeys(each for search_results in assignments.candidates() for each in search_results)
    return [assignments.limbs(each) for each in sorted(found, key=assignments.cost)[: SETTINGS.n_assignments_kept]]


Assignment = tuple[int, ...]
"""For each extremity of the source the corresponding one of the target, or -1."""


class Assignments:
    """Assignments of the extremities of two shapes, and their costs."""

    def __init__(self, source: Intrinsic, target: Intrinsic) -> None:
        self._source, self._target = source, target
        (reach, along), (target_reach, target_along) = source.limbs, target.limbs
        ends, target_ends = source.extremities, target.extremities
        self._counts = len(ends), len(target_ends)
        profiles = np.abs(source.profiles[:, None] - target.profiles[None]).mean(2)
        end_costs = 0.5 * (profiles + 0.3 * np.abs(reach[:, None] - target_reach))
        distances = source.from_extremities[:, ends], target.from_extremities[:, target_ends]
        shared_paths = along[ends] * reach, target_along[target_ends] * target_reach
        # Costs of assigning i to j, and of assigning i, k to j, l; in three variants.
        length_costs = 0.5 * _pairwise_changes(*distances) + 2.0 * _pairwise_changes(*shared_paths)
        order_costs = [
            0.2 * _pairwise_changes(rescale(source.spread), rescale(target.spread)) for rescale in (np.asarray, _ranks)
        ]
        self._costs = [(end_costs, length_costs), *((0.2 * end_costs, each) for each in order_costs)]
        self._along = (
            np.column_stack([along, source.eccentricity])[source.landmarks[::2]],
            np.column_stack([target_along, target.eccentricity])[target.landmarks],
        )
        self._apart = source.landmark_distances[::2, ::2], target.landmark_distances
        self._shares = reach / reach.sum(), target_reach / target_reach.sum()

    def candidates(self) -> list[list[Assignment]]:
        """The best assignments of each beam search and of each cyclic search; one list per search."""
        return [self._beam_search(*costs) for costs in self._costs] + self._cyclic_assignments()

    def _cyclic_assignments(self) -> list[list[Assignment]]:
        """Assignments that rotate one tour of the extremities onto the other, in both directions.

        They assign as many extremities as possible, or all but one.
        """
        n_shared = min(self._counts)
        tours = [[k for k in tour if k < n_shared + 2] for tour in (self._source.tour, self._target.tour)]
        found = []
        for size in (n_shared, n_shared - 1):
            if size < 3:
                break
            own, theirs = (np.array(list(combinations(tour, size))) for tour in tours)
            turns = np.array([np.roll(range(size)[::step], by) for step in (1, -1) for by in range(size)])
            theirs = theirs[:, turns].reshape(-1, size)
            own, theirs = (np.repeat(own, len(theirs), 0), np.tile(theirs, (len(own), 1)))
            for end_costs, pair_costs in self._costs:
                pairs = (own[:, :, None], own[:, None], theirs[:, :, None], theirs[:, None])
                cost = end_costs[own, theirs].mean(1) + pair_costs[pairs].mean((1, 2))
                best = np.argsort(cost, kind="stable")[: SETTINGS.n_per_cyclic_search]
                found.append([self._with_best_leftover(own[k], theirs[k], end_costs) for k in best])
        return found

    def _with_best_leftover(
        self, own: Int[Ints, " N"], theirs: Int[Ints, " N"], end_costs: Float[Floats, "T U"]
    ) -> Assignment:
        """Complete an assignment by the most similar pair of the extremities that are left over."""
        chosen = np.full(self._counts[0], -1)
        chosen[own] = theirs
        rest = np.flatnonzero(chosen < 0), np.setdiff1d(np.arange(self._counts[1]), theirs)
        if len(rest[0]) and len(rest[1]):
            i, j = np.unravel_index(end_costs[np.ix_(*rest)].argmin(), (len(rest[0]), len(rest[1])))
            chosen[rest[0][i]] = rest[1][j]
        return tuple(chosen.tolist())

    def _beam_search(self, end_costs: Float[Floats, "T U"], pair_costs: Float[Floats, "T T U U"]) -> list[Assignment]:
        """Beam search, in order of the extremities' prominence."""
        beam: list[tuple[float, Assignment]] = [(0.0, ())]
        for i in range(self._counts[0]):
            extended = []
            for cost, partial in beam:
                extended.append((cost + SETTINGS.skip_cost, (*partial, -1)))
                known = [(k, other) for k, other in enumerate(partial) if other >= 0]
                for j in set(range(self._counts[1])).difference(partial):
                    pairs = sum(pair_costs[i, k, j, other] for k, other in known) / max(len(known), 1)
                    extended.append((cost + end_costs[i, j] + pairs, (*partial, j)))
            beam = sorted(extended)[: SETTINGS.beam_width]
        found = [each for _, each in beam[: SETTINGS.n_per_beam_search]]
        return [each for each in found if sum(j >= 0 for j in each) >= 2]

    def cost(self, assignment: Assignment) -> float:
        """Distance of an assignment from an isometry that hardly bends limbs."""
        own_limbs, their_limbs = _pairs(assignment)
        nearest = _nearest(self._along[0][:, [*own_limbs, -1]], self._along[1][:, [*their_limbs, -1]])
        error = _distance_error(*self._apart, nearest)
        joints, goals = self._joints(own_limbs, their_limbs)
        bending = np.sqrt(np.square(kabsch(joints, goals).to_world(joints) - goals).sum(1).mean())
        leftover = 2 - self._shares[0][own_limbs].sum() - self._shares[1][their_limbs].sum()
        return float(error + SETTINGS.bend_weight * bending + SETTINGS.leftover_weight * leftover)

    def limbs(self, assignment: Assignment) -> Proposal:
        """The proposal of an assignment: where it moves the rings around the source's limbs.

        Rings are moved to those of the target, with one rotation for all.
        """
        own, theirs = _pairs(assignment)
        joints, goals = self._joints(own, theirs)
        rotation, verts = kabsch(joints, goals).rotation, self._source.mesh.verts
        rings = [ring for limb in own for ring in self._source.rings[limb]]
        points = [
            goal + (verts[ring] - joint) @ rotation.T for ring, joint, goal in zip(rings, joints, goals, strict=True)
        ]
        return Proposal("extremities", np.concatenate(points), np.concatenate(rings))

    def _joints(self, own: list[int], theirs: list[int]) -> tuple[Float[Floats, "N 3"], Float[Floats, "N 3"]]:
        """Centers of the rings of some limbs, of the source and of the target."""
        return self._source.skeleton[own].reshape(-1, 3), self._target.skeleton[theirs].reshape(-1, 3)


def _pairs(assignment: Assignment) -> tuple[list[int], list[int]]:
    """Assigned extremities of the source, and their counterparts."""
    own = [number for number, other in enumerate(assignment) if other >= 0]
    return own, [assignment[number] for number in own]


def _pairwise_changes(own: Float[Floats, "T T"], theirs: Float[Floats, "U U"]) -> Float[Floats, "T T U U"]:
    return np.abs(own[:, :, None, None] - theirs)


def _ranks(table: Float[Floats, "T T"]) -> Float[Floats, "T T"]:
    """Rank of each pair in a symmetric table, from 0 to 1."""
    above = np.triu_indices(len(table), 1)
    ranks = np.zeros(table.shape)
    ranks[above] = np.argsort(np.argsort(table[above], kind="stable"), kind="stable") / max(len(above[0]) - 1, 1)
    return ranks + ranks.T


def _select_maps(kind: Kind, source: Intrinsic, target: Intrinsic, maps: list[tuple[float, Ints]]) -> list[Proposal]:
    """The best maps that differ from each other, without those that reverse most triangles."""
    best = [vertex for _, vertex in sorted(maps, key=lambda each: each[0])]
    chosen = [vertex for vertex in _distinct(target, best) if _orientation_agreement(source, target, vertex) >= 0]
    return [Proposal(kind, target.mesh.verts[vertex]) for vertex in chosen]


def _distinct(target: Intrinsic, maps: Sequence[Ints]) -> list[Ints]:
    """Maps that differ from all previous ones, at most as many as the settings allow."""
    verts, kept = target.mesh.verts, list[Ints]()
    for vertex in maps:
        if len(kept) == SETTINGS.n_maps:
            break
        if all(changed_share(verts[vertex], verts[other]) > SETTINGS.min_changed_share for other in kept):
            kept.append(vertex)
    return kept


def changed_share(points: Float[Floats, "V 3"], others: Float[Floats, "V 3"]) -> float:
    """Share (0..1) of vertices that are clearly in different places."""
    return float((np.linalg.norm(points - others, axis=1) > SETTINGS.changed_distance).mean())
