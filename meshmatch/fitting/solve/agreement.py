"""Log-Euclidean co-registration: several fits of one template that agree on how it stretches.

A fit sees its own surface alone, so it is free to slide along it. Shapes of one kind, or one shape in two poses,
stretch the template alike: a few more steps of least squares on each fit pull its stretch at every gradient point to the
mean of all. The mean is taken of logarithms, so that doubling and halving cancel (the log-Euclidean mean of Arsigny,
Fillard, Pennec and Ayache, *Log-Euclidean metrics for fast and simple calculus on diffusion tensors*, 2006).
Pairs of points hold tighter across the surface than along it, where the stretch decides.

Shapes that are not alike, such as people in different clothes, do not stretch the template alike: the more the fits
differ, the more each keeps the stretch that it had alone.

Where a model knows how fits of its kind differ (`meshmatch.models.pair_statistics`), two fits are asked whether they are
of one individual. If so, their common stretch follows them freely; if not, it is held, and each keeps of their difference
what is expected to be true.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from meshmatch.arrays import Float, Floats
from meshmatch.fitting.fit_config import Pairing, Schedule, geometric_between
from meshmatch.fitting.solve.driver import Problem, minimise_together
from meshmatch.fitting.solve.priors import Prior, RotatedReference
from meshmatch.fitting.solve.system import NodeSystem
from meshmatch.fitting.solve.terms import Landmarks, terms_of
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.geometry.symmetric import entries_of, exponential, logarithm, matrices_of
from meshmatch.models.pair_statistics import PairStatistics
from meshmatch.models.trained import TrainedModel

_MIN_STRETCH = 1e-3  # smaller ones count as this: a logarithm must stay finite
_STEEP = 8  # how suddenly shapes cease to be alike; set by hand
_SAME = 0.99  # shapes so much alike share the stretch
_KNOWN_STEPS = 12


@dataclass(frozen=True, kw_only=True)
class AgreeConfig(Pairing):
    """How fits are refined together. Set by hand, on 24 to 30 pairs each of SCAPE and FAUST, ``alike`` on generated people
    in clothes.
    """

    # The prior is the common stretch. What slides along the surface has far to go, hence the momentum.
    schedule: Schedule = field(default=Schedule(steps=8, prior=(1e-4, 1e-4), scale=(0.05, 0.05), momentum=0.6))
    drift: float = 0.4  # how far the common stretch follows the fits as they move, against where they began
    alike: float = 0.4  # two whose logarithms of stretch lie so far apart (median) follow their mean half way
    known: float = 0.0  # how far (0..1) what the model knows of pairs is followed: the next four
    drift_same: float = 1.0  # of one individual, instead of ``drift``
    drift_different: float = 0.6
    alike_different: float = 1.5  # times ``alike``, of two individuals
    differ: float = 0.5  # how much of the expected difference two individuals keep
    point_share: float = 0.01
    pair_normals: float = 0.012
    back_points: int = 8000

    @classmethod
    def for_model(cls, model: TrainedModel) -> AgreeConfig:
        """As stiff as the model's card says, and by what the model knows of pairs."""
        stiff = model.card.stiffness
        return cls(schedule=cls.schedule.scaled_by(1, prior=(stiff, stiff)), known=float(model.pairs is not None))

    @classmethod
    def for_collection(cls, model: TrainedModel) -> AgreeConfig:
        """The same for many shapes, whose mean hardly moves: they come to it later than a pair meets half way."""
        own = cls.for_model(model)
        return replace(own, schedule=replace(own.schedule, steps=12))

    def between(self, known: float, different: float) -> AgreeConfig:
        """The same for two shapes that are of different individuals with such a chance, as far as that is followed."""
        steps = round(self.schedule.steps + known * (_KNOWN_STEPS - self.schedule.steps))
        drift = different * self.drift_different + (1 - different) * self.drift_same
        alike = self.alike * (1 + known * different * (self.alike_different - 1))
        schedule = replace(self.schedule, steps=steps)
        return replace(self, schedule=schedule, drift=self.drift + known * (drift - self.drift), alike=alike)

    def for_noise(self, roughness: float) -> AgreeConfig:
        """The same for a cloud of a ``roughness`` (0..1, see `Shape.roughness`): all samples, shared, a stiffer template."""
        schedule = self.schedule.scaled_by(roughness, prior=(80, 80))
        return replace(
            self,
            schedule=replace(schedule, momentum=schedule.momentum * (1 - roughness)),
            known=self.known * (1 - roughness),
            alike=self.alike / max(1 - roughness, 1e-9),  # noise stretches too
            point_share=geometric_between(self.point_share, max(self.point_share, 3.0), roughness),
            pair_normals=geometric_between(self.pair_normals, 5 * self.pair_normals, roughness),
            back_points=round(self.back_points * (1 + roughness)),
            shared=max(self.shared, roughness),
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class Member:
    """One of several fits that agree."""

    samples: OrientedPoints  # of the shape, in the fit's core frame
    vectors: Float[Floats, "K 3"]  # node vectors of the fit
    config: AgreeConfig  # all members take as many steps as the first
    landmarks: Landmarks | None = None  # template vertices (N,), positions (N, 3) in the core frame
    partial: bool = False  # the shape shows a part only

    def problem(self, system: NodeSystem) -> Problem:
        """The least squares of this fit."""
        terms = terms_of(self.samples, self.config, self.landmarks, self.partial)
        return Problem(system=system, terms=terms, schedule=self.config.schedule)


def agree(
    system: NodeSystem, members: Sequence[Member], threads: int = 1, pairs: PairStatistics | None = None
) -> list[Float[Floats, "K 3"]]:
    """Refine the fits of several shapes together, so many beside each other: better node vectors for each. Of two, by what
    is known of ``pairs``."""
    vectors = [member.vectors for member in members]
    logs = [log_stretch(system.deformation_gradient(each)) for each in vectors]
    configs = [member.config for member in members]
    if pairs is not None and len(members) == 2:
        configs, own = as_pair(logs, configs, pairs)
        members = [replace(member, config=config) for member, config in zip(members, configs, strict=True)]
        prior = CommonStretch(logs, configs, own)
    else:
        prior = CommonStretch(logs, configs)
    found = minimise_together([member.problem(system) for member in members], prior, vectors, threads)
    return [system.unfolded(each) for each in found]


def as_pair(
    logs: Sequence[Float[Floats, "G 3 3"]], configs: Sequence[AgreeConfig], pairs: PairStatistics
) -> tuple[list[AgreeConfig], list[Float[Floats, "G 3 3"]]]:
    """How two fits with such logarithms of stretch agree, by what is known of pairs; and what each is expected to keep
    against the mean of both."""
    apart = logs[0] - logs[1]
    known = min(config.known for config in configs) * pairs.concern(apart)
    different = pairs.different(apart)
    keep = 0.5 * known * different * configs[0].differ * pairs.expected(apart)
    return [config.between(known, different) for config in configs], [keep, -keep]


class CommonStretch:
    """The joint prior of fits that agree: each keeps to the mean stretch of all, as far as it is like them.

    ``logs`` are the logarithms of the fits' stretches before they agree; ``own`` what each is expected to keep against the
    mean, if anything.
    """

    def __init__(
        self,
        logs: Sequence[Float[Floats, "G 3 3"]],
        configs: Sequence[AgreeConfig],
        own: Sequence[Float[Floats, "G 3 3"]] | None = None,
    ) -> None:
        self._own = [np.zeros_like(log) for log in logs] if own is None else own
        self._logs, self._config, self._first = logs, configs[0], mean_log(logs)
        self._follow = [likeness(log, logs, config.alike) for log, config in zip(logs, configs, strict=True)]

    def __call__(self, gradients: Sequence[Float[Floats, "G 3 3"]]) -> list[Prior]:
        mean = held_mean(self._first, mean_log([log_stretch(F) for F in gradients]), self._config)
        return [
            RotatedReference(stretch_of(mean + own if share > _SAME else log + share * (mean + own - log)))
            for log, share, own in zip(self._logs, self._follow, self._own, strict=True)
        ]


def likeness(log: Float[Floats, "G 3 3"], others: Sequence[Float[Floats, "G 3 3"]], half: float) -> float:
    """How much (0..1) one of several shapes is like all of them, by the logarithms of their stretches.

    It is a half where it differs by ``half``, at the median over the template; of two, their distance from one another.
    """
    apart = 2 * (log - mean_log(others))
    distance = float(np.median(np.linalg.norm(apart.reshape(len(log), -1), axis=1)))
    return 1 / (1 + (distance / half) ** _STEEP)


def agree_step(
    system: NodeSystem,
    member: Member,
    vectors: Float[Floats, "K 3"],
    F: Float[Floats, "G 3 3"],
    common: Float[Floats, "G 3 3"],
) -> Float[Floats, "K 3"]:
    """One step of one fit, from node vectors with the deformation gradients F towards the common stretch."""
    return member.problem(system).step(0, vectors, F, RotatedReference(common))


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
