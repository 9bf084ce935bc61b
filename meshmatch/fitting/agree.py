"""Two fits of one template that agree: what slides along one surface is held by the other.

A fit sees its own surface alone, so it is free to slide along it. Shapes of one kind, or one shape in two poses,
stretch the template alike: a few more Gauss-Newton steps on each fit pull its stretch at every strain point to the
mean of all. The mean is taken of logarithms, so that doubling and halving cancel (the log-Euclidean mean of Arsigny,
Fillard, Pennec and Ayache, 2006). Pairs of points hold tighter across the surface than along it, where the stretch
decides.

Shapes that are not alike, such as people in different clothes, do not stretch the template alike: the more the fits
differ, the more each keeps the stretch that it had alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from meshmatch.arrays import Float, Floats
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import FitConfig, NodeRefineConfig, geometric_between
from meshmatch.fitting.nodes import add_landmarks, nearest_rotations, pair_terms
from meshmatch.fitting.system import NodeSystem, node_system
from meshmatch.fitting.task import Landmarks, take_samples, without_inside
from meshmatch.fitting.verdict import with_vectors
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.geometry.symmetric import entries_of, exponential, logarithm, matrices_of
from meshmatch.models.trained import TrainedModel
from meshmatch.shapes.shape import Shape

_PAIRING = ("point_share", "pair_normals", "back_points", "shared")
_MIN_STRETCH = 1e-3  # smaller ones count as this: a logarithm must stay finite
_STEEP = 8  # how suddenly shapes cease to be alike; set by hand
_SAME = 0.99  # shapes so much alike share the stretch


@dataclass(frozen=True)
class AgreeConfig:
    """How fits are refined together. Set by hand, on 24 pairs each of SCAPE and FAUST, ``alike`` on generated people in
    clothes; the last four as in `NodeRefineConfig`.
    """

    steps: int = 8
    strain: float = 0.0001  # weight of the common stretch
    scale: float = 0.05  # of the robust weight (units of sqrt(area))
    momentum: float = 0.6  # how far each step goes on along the last: what slides along the surface has far to go
    drift: float = 0.4  # how far the common stretch follows the fits as they move, against where they began
    alike: float = 0.4  # two whose logarithms of stretch lie so far apart (median) follow their mean half way
    point_share: float = 0.01
    pair_normals: float = 0.012
    back_points: int = 8000
    shared: float = 0.0

    @classmethod
    def for_model(cls, model: TrainedModel) -> AgreeConfig:
        """As stiff as the model's card says."""
        return cls(strain=cls.strain * model.card.stiffness)

    @classmethod
    def for_collection(cls, model: TrainedModel) -> AgreeConfig:
        """The same for many shapes, whose mean hardly moves: they come to it later than a pair meets half way."""
        return replace(cls.for_model(model), steps=12)

    def for_noise(self, roughness: float) -> AgreeConfig:
        """The same for a cloud of a ``roughness`` (0..1, see `Shape.roughness`): all samples, shared, a stiffer template."""
        return replace(
            self,
            strain=geometric_between(self.strain, 80 * self.strain, roughness),
            momentum=self.momentum * (1 - roughness),
            alike=self.alike / max(1 - roughness, 1e-9),  # noise stretches too
            point_share=geometric_between(self.point_share, max(self.point_share, 3.0), roughness),
            pair_normals=geometric_between(self.pair_normals, 5 * self.pair_normals, roughness),
            back_points=round(self.back_points * (1 + roughness)),
            shared=max(self.shared, roughness),
        )


def agreed_fits(
    model: TrainedModel,
    shapes: Sequence[Shape],
    fits: Sequence[Fit],
    config: FitConfig | None = None,
    landmarks: Sequence[Landmarks] | None = None,
    how: AgreeConfig | None = None,
    threads: int = 1,
) -> list[Fit]:
    """Let the fits of several repaired shapes agree on how the template stretches; by default as the card says how much.

    ``landmarks`` are template vertices (N,) and positions (N, 3) in the shape's file frame, for each shape. Node vectors,
    points and vertex distances of the result are new; residual and verdict stay those that each fit had alone. The fits
    are as given if one of them is poor, for it has nothing to say about the others, or if nodes are not refined (a
    pointwise model has none).
    """
    config = (config or FitConfig()).for_model(model)
    if any(fit.verdict == "poor" for fit in fits) or not config.moves_nodes:
        return list(fits)
    system = node_system(model)
    how = how or AgreeConfig.for_model(model)

    def member(number: int) -> Member:
        known = None if landmarks is None else landmarks[number]
        return member_of(system, shapes[number], fits[number], config, how, known)

    with ThreadPoolExecutor(threads) as pool:
        members = list(pool.map(member, range(len(fits))))
    refined = agree(system, members, config.nodes, threads)
    return [with_vectors(system, fit, vectors) for fit, vectors in zip(fits, refined, strict=True)]


def member_of(
    system: NodeSystem, shape: Shape, fit: Fit, config: FitConfig, how: AgreeConfig, landmarks: Landmarks | None = None
) -> Member:
    """What agreement needs of a repaired shape and its fit; landmarks are in the shape's file frame."""
    local = None if landmarks is None else (landmarks[0], fit.frame.apply(landmarks[1]))
    own = config.for_noise(shape.roughness)
    frame, samples = take_samples(without_inside(shape, system), own.samples, np.random.default_rng(own.seed))
    points = fit.frame.apply(frame.undo(samples.points))
    normals = samples.normals @ frame.rotation @ fit.frame.rotation.T
    samples = replace(samples, points=points, normals=normals).facing(system.surface(fit.vectors))
    return Member(samples, fit.vectors, how.for_noise(shape.roughness), local, fit.partial)


@dataclass(frozen=True, eq=False)
class Member:
    """One of several fits that agree."""

    samples: OrientedPoints  # of the shape, in the fit's core frame
    vectors: Float[Floats, "K 3"]  # node vectors of the fit
    config: AgreeConfig  # all members take as many steps as the first
    landmarks: Landmarks | None = None  # template vertices (N,), positions (N, 3) in the core frame
    partial: bool = False  # the shape shows a part only


def agree(
    system: NodeSystem, members: Sequence[Member], nodes: NodeRefineConfig, threads: int = 1
) -> list[Float[Floats, "K 3"]]:
    """Refine the fits of several shapes together, so many beside each other: better node vectors for each.

    ``nodes`` says how pairs of points are found and weighed, where a member's own configuration does not.
    """

    refined = before = [member.vectors for member in members]
    own = [log_stretch(system.deformation_gradient(vectors)) for vectors in refined]
    first = mean_log(own)
    follows = [likeness(log, own, member.config.alike) for log, member in zip(own, members, strict=True)]
    with ThreadPoolExecutor(threads) as pool:
        for _ in range(members[0].config.steps):
            paths = zip(members, refined, before, strict=True)
            before, refined = refined, [now + each.config.momentum * (now - last) for each, now, last in paths]
            gradients = [system.deformation_gradient(vectors) for vectors in refined]
            mean = held_mean(first, mean_log([log_stretch(F) for F in gradients]), members[0].config)
            shared = stretch_of(mean)
            wanted = [
                shared if share > _SAME else stretch_of(log + share * (mean - log))
                for log, share in zip(own, follows, strict=True)
            ]
            refined = list(
                pool.map(lambda *each: agree_step(system, nodes, *each), members, refined, gradients, wanted)
            )
    return [system.unfolded(vectors) for vectors in refined]


def likeness(log: Float[Floats, "G 3 3"], others: Sequence[Float[Floats, "G 3 3"]], half: float) -> float:
    """How much (0..1) one of several shapes is like all of them, by the logarithms of their stretches.

    It is a half where it differs by ``half``, at the median over the template; of two, their distance from one another.
    """
    apart = 2 * (log - mean_log(others))
    distance = float(np.median(np.linalg.norm(apart.reshape(len(log), -1), axis=1)))
    return 1 / (1 + (distance / half) ** _STEEP)


def agree_step(
    system: NodeSystem,
    nodes: NodeRefineConfig,
    member: Member,
    vectors: Float[Floats, "K 3"],
    F: Float[Floats, "G 3 3"],
    common: Float[Floats, "G 3 3"],
) -> Float[Floats, "K 3"]:
    """One step of one fit, from node vectors with the deformation gradients F towards the common stretch."""
    config = member.config
    pairing = replace(nodes, **{name: getattr(config, name) for name in _PAIRING})
    terms = pair_terms(system, member.samples, vectors, config.scale, pairing, member.partial)
    if member.landmarks is not None:
        add_landmarks(terms, member.landmarks, nodes.landmark_weight)
    targets = nearest_rotations(F, common) @ common
    return system.solve(*terms, config.strain / len(F), targets, nodes.damping / system.K, vectors)


def held_mean(
    first: Float[Floats, "G 3 3"], now: Float[Floats, "G 3 3"], config: AgreeConfig
) -> Float[Floats, "G 3 3"]:
    """Logarithm of the common stretch: between the mean of the fits before they agreed and their mean now.

    Pairs hold fits across the surface alone. If nothing held the mean, all fits could slide together until a nose or a
    finger is flat.
    """
    return first + config.drift * (now - first)


def mean_log(logs: Sequence[Float[Floats, "G 3 3"]]) -> Float[Floats, "G 3 3"]:
    """Mean of logarithms of stretches; its exponential is the log-Euclidean mean of the stretches."""
    total = np.zeros_like(logs[0])
    for log in logs:
        total += log
    return total / len(logs)


def log_stretch(F: Float[Floats, "G 3 3"]) -> Float[Floats, "G 3 3"]:
    """Logarithm of the right stretch sqrt(F^T F)."""
    return matrices_of(0.5 * logarithm(entries_of(F.transpose(0, 2, 1) @ F), _MIN_STRETCH**2))


def stretch_of(logs: Float[Floats, "G 3 3"]) -> Float[Floats, "G 3 3"]:
    """The stretch of a logarithm."""
    return matrices_of(exponential(entries_of(logs)))
