"""A curve through several fits of one template and beyond them, and how far its poses are from what they should be.

What the field does at every point is blended, limbs turn and keep their size. Blending node vectors would move every point
along a straight line, and a turning arm would shrink on its way. Here the deformation gradient of each fit is split into
a rotation and a stretch (polar decomposition). Stretches are blended by their logarithms. Rotations are taken from
neighbour to neighbour, along a spanning tree of the surface that prefers neighbours which turn alike: a forearm turns
about its elbow and the elbow goes where the upper arm takes it. Then follow the node vectors that fit the blended
gradients best (least squares), and a few rounds in which every point may choose its own rotation anew (local and global
steps of Sorkine and Alexa, 2007).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components, dijkstra, minimum_spanning_tree
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.errors import OptionError
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import Schedule
from meshmatch.fitting.solve.driver import Problem, minimise
from meshmatch.fitting.solve.priors import FixedGradient, RotatedReference
from meshmatch.fitting.solve.system import NodeSystem, node_system
from meshmatch.fitting.task import take_samples
from meshmatch.geometry.frames import Frame
from meshmatch.models.trained import TrainedModel
from meshmatch.shapes.shape import Shape

Way = Literal["field", "codes"]
"""What is blended between fits, see `Blend`."""
WAYS: tuple[Way, ...] = get_args(Way)
_SAMPLES = 2048  # of which a shape's code is read
# From the weights of the n key shapes to node vectors.
Path = Callable[[Float[Floats, " n"]], Float[Floats, "K 3"]]

_MIN_STRETCH = 1e-3  # smaller ones count as this: a logarithm must stay finite
_MAX_LOG = 5.0  # a stretch of 150, which only a far extrapolation reaches
# The first solve holds the blended gradients; in the rounds after it every point chooses its own rotation. Set by hand.
_FIRST = Schedule(steps=1, prior=(1.0, 1.0), damping=1e-7)
_ROUNDS = Schedule(steps=3, prior=(1.0, 1.0), damping=1e-4)
_MIN_COST = 1e-6  # of an edge over which rotations do not change: a graph drops edges of cost 0


@dataclass(frozen=True)
class Deviation:
    """How far a pose is from the stretch that it should have, and from the resting template; means over the surface.

    ``volume``: |det F - det S|, and ``arap``: |F^T F - S^T S| (Frobenius), S the stretch of the fits blended by
    logarithms: 0 at the fits. ``template_volume`` and ``template_arap``: the same for S = I, the paper's energies
    (without the square); they hold the shapes' own difference from the template.
    """

    volume: float
    arap: float
    template_volume: float
    template_arap: float


class Blend:
    """A curve through several fits of one template.

    Each quantity is blended with the same weights of the fits: linear between two fits, a natural cubic spline
    through more; straight on beyond the ends. The fits are met exactly: what the path lacks at them is
    blended and added. A path of codes lacks much, which is therefore blended in the frames of the parts that it moves,
    and turns with them.

    Parameters
    ----------
    fits : at least two, of the model's template
    times : (n,) increasing: when each fit is met; evenly from 0 to 1 by default
    shapes : the repaired shapes, for the way "codes" alone
    way : blend what the "field" does, or the "codes" that the network has for the shapes

    `OptionError` for fewer than two fits, fits of another template, times that do not increase, an unknown way, or the
    way "field" for a model without nodes.
    """

    def __init__(
        self,
        model: TrainedModel,
        fits: Sequence[Fit],
        times: Sequence[float] | None = None,
        shapes: Sequence[Shape] | None = None,
        way: Way = "field",
    ) -> None:
        if len(fits) < 2:
            raise OptionError("at least two shapes are needed to blend between them")
        for fit in fits:
            fit.check_template(model.template.hash)
        self.times = np.linspace(0, 1, len(fits)) if times is None else np.asarray(times, float)
        if self.times.shape != (len(fits),) or not (np.diff(self.times) > 0).all():
            raise OptionError(f"{len(fits)} shapes need as many times, each later than the one before")
        self._curve = CubicSpline(self.times, np.eye(len(fits)), bc_type="natural")
        self._keys = np.stack([fit.vectors for fit in fits])
        self._system = node_system(model)
        self._stretches = StretchBlend([polar(self._system.deformation_gradient(key))[1] for key in self._keys])
        if way == "field":
            if not model.has_nodes:
                raise OptionError(
                    f"model {model.card.name} is pointwise: it has no nodes that could blend what the field does",
                    "blend codes instead (--way codes), or use a model of another field",
                )
            self._path: Path = FieldPath(self._system, list(self._keys), model.template.core)
        elif way == "codes":
            if shapes is None or len(shapes) != len(fits):
                raise OptionError("blending codes needs the shape of each fit")
            self._path = _code_path(model, shapes, fits)
        else:
            raise OptionError(f"unknown way to blend {way!r}", f"choose one of {', '.join(WAYS)}")
        met = [self._path(row) for row in np.eye(len(fits))]
        self._correction = self._keys - np.stack(met)
        # At the template vertex beside each node the field is sure to have nodes enough around it.
        verts = model.template.shape.verts
        beside = verts[cKDTree(verts).query(model.template.nodes)[1]]
        self._node_field = model.field(beside) if way == "codes" and model.has_nodes else None
        if self._node_field is not None:
            turns = np.stack([polar(self._node_field.strain(vectors))[0] for vectors in met])
            self._correction = np.einsum("nkij,nki->nkj", turns, self._correction)
        self._turns = RotationBlend([fit.frame.turn[None] for fit in fits])
        self._scales = np.array([fit.frame.scale for fit in fits])
        self._centers = np.stack([fit.frame.center for fit in fits])

    def weights(self, time: float) -> Float[Floats, " n"]:
        """Weights of the n fits at a time; they sum to one."""
        inside = float(np.clip(time, self.times[0], self.times[-1]))
        near = self._curve(inside)
        if time == inside:
            met = np.flatnonzero(self.times == time)
            return np.eye(len(self.times))[met[0]] if len(met) else near
        return near + (time - inside) * self._curve(inside, 1)

    def vectors(self, time: float) -> Float[Floats, "K 3"]:
        """Node vectors at a time, core frame."""
        weights = self.weights(time)
        if weights.max() == 1.0:  # a fit itself
            return self._keys[weights.argmax()]
        there, correction = self._path(weights), np.tensordot(weights, self._correction, 1)
        if self._node_field is not None:
            correction = np.einsum("kij,kj->ki", polar(self._node_field.strain(there))[0], correction)
        return there + correction

    def points(self, vectors: Float[Floats, "K 3"]) -> Float[Floats, "V 3"]:
        """Template vertices of a pose, core frame."""
        return self._system.moved(vectors)

    def turns(self, vectors: Float[Floats, "K 3"]) -> Float[Floats, "V 3 3"]:
        """Rotations by which the field of a pose turns each template vertex."""
        return polar(self._system.field.strain(vectors))[0]

    def frame(self, time: float) -> Frame:
        """Between the frames of the fits: it turns, moves and grows from one to the next."""
        weights = self.weights(time)
        scale = float(np.exp(weights @ np.log(self._scales)))
        return Frame(scale, self._turns.at(weights)[0], weights @ self._centers)

    def deviation(self, time: float, vectors: Float[Floats, "K 3"]) -> Deviation:
        """How far a pose is from what it should be at a time."""
        F = self._system.deformation_gradient(vectors)
        S = self._stretches.at(self.weights(time))
        return Deviation(*_energies(F, S), *_energies(F, np.eye(3)[None]))


def _energies(F: Float[Floats, "G 3 3"], S: Float[Floats, "... 3 3"]) -> tuple[float, float]:
    """Means of |det F - det S| and of |F^T F - S^T S|."""
    volume = np.abs(np.linalg.det(F) - np.linalg.det(S)).mean()
    squares = F.transpose(0, 2, 1) @ F - S.transpose(0, 2, 1) @ S
    return float(volume), float(np.linalg.norm(squares, axis=(1, 2)).mean())


def _code_path(model: TrainedModel, shapes: Sequence[Shape], fits: Sequence[Fit]) -> Path:
    """Node vectors of blended codes; each code is that of samples of a shape in the core frame of its fit."""
    network = model.inference
    codes = []
    for shape, fit in zip(shapes, fits, strict=True):
        frame, samples = take_samples(shape, _SAMPLES, np.random.default_rng(fit.seed))
        codes.append(network.encode(fit.frame.apply(frame.undo(samples.points))))
    return lambda weights: network.decode(weights @ np.stack(codes))


class RotationBlend:
    """Weighted means of N rotations in each of several keys; exact at the keys.

    In the tangent space at the mean of the keys: for two keys that is the shortest turn from one to the other at
    constant speed. The order of the keys, each (N, 3, 3), does not matter.
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
        return (axes * np.exp(np.clip(values, -_MAX_LOG, _MAX_LOG))[:, None, :]) @ axes.transpose(0, 2, 1)


def polar(F: Float[Floats, "N 3 3"]) -> tuple[Float[Floats, "N 3 3"], Float[Floats, "N 3 3"]]:
    """Polar decomposition F = R S: the rotations R nearest to F, and the logarithms of the stretches S.

    Where F turns space inside out the smallest stretch would be negative; it counts as a very small one.
    """
    U, sizes, Vh = np.linalg.svd(F)
    flip = np.where(np.linalg.det(U @ Vh) < 0, -1.0, 1.0)
    U[:, :, 2] *= flip[:, None]
    sizes[:, 2] *= flip
    logs = np.log(np.maximum(sizes, _MIN_STRETCH))
    return U @ Vh, (Vh.transpose(0, 2, 1) * logs[:, None, :]) @ Vh


class FieldPath:
    """The poses between several fits of one template, by what the field does at its strain points.

    Keys are node vectors (K, 3) of the fits, each in its core frame; vertices of the core stay in the middle.
    """

    def __init__(self, system: NodeSystem, keys: Sequence[Floats], core: Int[Ints, " C"]) -> None:
        self._system, self._keys = system, np.stack(keys)
        parts = [polar(system.deformation_gradient(key)) for key in keys]
        rotations = [rotation for rotation, _ in parts]
        self.stretches = StretchBlend([logs for _, logs in parts])
        self._parent, self._levels = _spanning_order(system, rotations, core)
        child = np.flatnonzero(self._parent >= 0)
        relative = [rotation.copy() for rotation in rotations]  # to that of each point's parent; of roots as they are
        for own, whole in zip(relative, rotations, strict=True):
            own[child] = whole[self._parent[child]].transpose(0, 2, 1) @ whole[child]
        self._joints = RotationBlend(relative)
        self._core = np.asarray(system.phi[core].mean(0)).ravel()  # of the node vectors: how the core moves

    def __call__(self, weights: Float[Floats, " n"]) -> Float[Floats, "K 3"]:
        """Node vectors for weights of the keys that sum to one."""
        stretch = self.stretches.at(weights)
        straight = np.tensordot(weights, self._keys, 1)
        turned = self._joints.at(weights)
        for level in self._levels:
            turned[level] = turned[self._parent[level]] @ turned[level]

        def anchored(vectors: Float[Floats, "K 3"]) -> Float[Floats, "K 3"]:
            """The core goes where it goes on the straight way."""
            return vectors + self._core @ (straight - vectors)

        first, rounds = (
            Problem(system=self._system, terms=(), schedule=schedule, anchor=anchored) for schedule in (_FIRST, _ROUNDS)
        )
        vectors = minimise(first, FixedGradient(turned @ stretch), straight)
        return minimise(rounds, RotatedReference(stretch), vectors)


def _spanning_order(
    system: NodeSystem, rotations: Sequence[Floats], core: Int[Ints, " C"]
) -> tuple[Int[Ints, " G"], list[Ints]]:
    """Parents (G,) of the strain points, -1 for roots, and the other points level by level below their roots.

    One tree for each connected part, along the edges over which the rotations change least. Its root is the point
    nearest to the middle of the core.
    """
    at = system.verts[system.strain_points]
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
    """Pairs (a < b) of strain points whose regions of the surface touch."""
    V, G = len(system.verts), len(system.strain_points)
    edges = np.concatenate([system.faces[:, [0, 1]], system.faces[:, [1, 2]], system.faces[:, [2, 0]]])
    length = np.linalg.norm(system.verts[edges[:, 0]] - system.verts[edges[:, 1]], axis=1)
    graph = csr_matrix((np.maximum(length, 1e-12), (edges[:, 0], edges[:, 1])), (V, V))
    found = dijkstra(graph, directed=False, indices=system.strain_points, min_only=True, return_predecessors=True)
    number = np.full(V + 1, -1)
    number[system.strain_points] = np.arange(G)
    region = number[np.where(found[2] < 0, V, found[2])]  # the nearest strain point along the surface, -1 out of reach
    pairs = region[edges]
    pairs = np.sort(pairs[(pairs >= 0).all(axis=1) & (pairs[:, 0] != pairs[:, 1])], axis=1)
    code = np.unique(pairs[:, 0] * G + pairs[:, 1])
    return code // G, code % G
