"""Log-Euclidean co-registration: several fits of one template are refined to agree on how it stretches.

A fit sees only its own surface, and is free to slide along it. Shapes of one kind, or one shape in two poses, stretch the
template alike. A few more least-squares steps for each fit therefore pull its stretch at every gradient point towards the
mean over all. The mean is taken of logarithms, so that doubling and halving cancel (the log-Euclidean mean of Arsigny,
Fillard, Pennec and Ayache, *Log-Euclidean metrics for fast and simple calculus on diffusion tensors*, 2006). Pairs of
points pull across the surface more than along it, where the stretch decides.

Shapes that are not alike, such as people in different clothes, do not stretch the template alike: the more the fits differ,
the more each keeps its own stretch.

If a model knows how fits of its kind differ (`meshmatch.models.pair_statistics`), two fits are tested for being of one
individual. If they are, the common stretch follows them freely. Otherwise it is held, and each fit keeps the part of their
difference that is expected to be true.
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
from meshmatch.geometry.symmetric import exponential, logarithm, to_entries, to_matrices
from meshmatch.models.pair_statistics import PairStatistics
from meshmatch.models.trained import TrainedModel

_MIN_STRETCH = 1e-3  # smaller stretches are raised to this, so that logarithms are finite
_LIKENESS_EXPONENT = 8  # steepness of `likeness`; set by hand
_SAME = 0.99  # shapes with more than this likeness share the stretch entirely
_KNOWN_STEPS = 12  # number of steps if the statistics of pairs are used


@dataclass(frozen=True, kw_only=True)
class AgreeConfig(Pairing):
    """How fits are refined together.

    Set by hand on 24 to 30 pairs each of SCAPE and FAUST; ``alike`` on generated people in clothes.
    """

    # The prior is the common stretch. Fits have to move far along the surface, hence the momentum.
    schedule: Schedule = field(default=Schedule(steps=8, prior=(1e-4, 1e-4), scale=(0.05, 0.05), momentum=0.6))
    drift: float = 0.4  # how much (0..1) the common stretch follows the current fits, rather than the initial ones
    alike: float = 0.4  # two fits whose logarithms of stretch are this far apart (median) follow their mean halfway
    known: float = 0.0  # how much (0..1) the model's statistics of pairs are used, with the next four settings
    drift_same: float = 1.0  # ``drift`` for one individual
    drift_different: float = 0.6  # and for two
    alike_different: float = 1.5  # factor of ``alike`` for two individuals
    differ: float = 0.5  # share of the expected difference that two individuals keep
    point_share: float = 0.01
    pair_normals: float = 0.012
    back_points: int = 8000

    @classmethod
    def for_model(cls, model: TrainedModel) -> AgreeConfig:
        """Settings with the stiffness in the model's card, which use the model's statistics of pairs if it has them."""
        stiff = model.card.stiffness
        return cls(schedule=cls.schedule.scaled_by(1, prior=(stiff, stiff)), known=float(model.pairs is not None))

    @classmethod
    def for_collection(cls, model: TrainedModel) -> AgreeConfig:
        """Settings for many shapes.

        Their mean hardly moves, so they need more steps to reach it than two fits that meet halfway.
        """
        own = cls.for_model(model)
        return replace(own, schedule=replace(own.schedule, steps=12))

    def between(self, known: float, different: float) -> AgreeConfig:
        """Settings for two shapes that are of different individuals with the probability ``different``.

        ``known`` (0..1) is how much this is taken into account.
        """
        steps = round(self.schedule.steps + known * (_KNOWN_STEPS - self.schedule.steps))
        drift = different * self.drift_different + (1 - different) * self.drift_same
        alike = self.alike * (1 + known * different * (self.alike_different - 1))
        schedule = replace(self.schedule, steps=steps)
        return replace(self, schedule=schedule, drift=self.drift + known * (drift - self.drift), alike=alike)

    def for_noise(self, roughness: float) -> AgreeConfig:
        """Settings for a cloud with the given ``roughness`` (0..1, see `Shape.roughness`).

        These use all samples, shared pairs and a stiffer template.
        """
        schedule = self.schedule.scaled_by(roughness, prior=(80, 80))
        return replace(
            self,
            schedule=replace(schedule, momentum=schedule.momentum * (1 - roughness)),
            known=self.known * (1 - roughness),
            alike=self.alike / max(1 - roughness, 1e-9),  # noise changes the stretch too
            point_share=geometric_between(self.point_share, max(self.point_share, 3.0), roughness),
            pair_normals=geometric_between(self.pair_normals, 5 * self.pair_normals, roughness),
            back_points=round(self.back_points * (1 + roughness)),
            shared=max(self.shared, roughness),
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class Member:
    """One of several fits that are to agree."""

    samples: OrientedPoints  # of the shape, in the fit's core frame
    vectors: Float[Floats, "K 3"]  # node vectors of the fit
    config: AgreeConfig  # all members take as many steps as the first
    landmarks: Landmarks | None = None  # template vertices (N,), positions (N, 3) in the core frame
    partial: bool = False  # the shape shows a part only

    def problem(self, system: NodeSystem) -> Problem:
        """The least-squares problem of this fit."""
        terms = terms_of(self.samples, self.config, self.landmarks, self.partial)
        return Problem(system=system, terms=terms, schedule=self.config.schedule)


def agree(
    system: NodeSystem, members: Sequence[Member], threads: int = 1, pairs: PairStatistics | None = None
) -> list[Float[Floats, "K 3"]]:
    """Refine the fits of several shapes together, up to ``threads`` in parallel; return new node vectors for each.

    For two fits, the statistics ``pairs`` are used if given.
    """
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
    """Settings for two fits with the given logarithms of stretch, by the statistics of pairs.

    Also returns what each fit is expected to keep of its difference from their mean.
    """
    apart = logs[0] - logs[1]
    known = min(config.known for config in configs) * pairs.concern(apart)
    different = pairs.different(apart)
    keep = 0.5 * known * different * configs[0].differ * pairs.expected(apart)
    return [config.between(known, different) for config in configs], [keep, -keep]


class CommonStretch:
    """The joint prior of fits that agree: each is pulled to the mean stretch of all, as far as it is like the others.

    ``logs`` are the logarithms of the fits' stretches before they agree; ``own`` is the difference from the mean that each
    fit is expected to keep, if known.
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
        mean = damped_mean(self._first, mean_log([log_stretch(F) for F in gradients]), self._config)
        return [
            RotatedReference(stretch_of(mean + own if share > _SAME else log + share * (mean + own - log)))
            for log, share, own in zip(self._logs, self._follow, self._own, strict=True)
        ]


def likeness(log: Float[Floats, "G 3 3"], others: Sequence[Float[Floats, "G 3 3"]], half: float) -> float:
    """How much (0..1) one of several shapes is like the others, by the logarithms of their stretches.

    It is 0.5 if the median over the template of twice its difference from their mean is ``half``; for two shapes, that
    is their difference from each other.
    """
    apart = 2 * (log - mean_log(others))
    distance = float(np.median(np.linalg.norm(apart.reshape(len(log), -1), axis=1)))
    return 1 / (1 + (distance / half) ** _LIKENESS_EXPONENT)


def agree_step(
    system: NodeSystem,
    member: Member,
    vectors: Float[Floats, "K 3"],
    F: Float[Floats, "G 3 3"],
    common: Float[Floats, "G 3 3"],
) -> Float[Floats, "K 3"]:
    """One step of one fit from node vectors with the deformation gradients F, towards the common stretch."""
    return member.problem(system).step(0, vectors, F, RotatedReference(common))


def damped_mean(
    first: Float[Floats, "G 3 3"], now: Float[Floats, "G 3 3"], config: AgreeConfig
) -> Float[Floats, "G 3 3"]:
    """Logarithm of the common stretch: between the mean of the fits before agreement and their current mean.

    Pairs hold fits across the surface only. If the mean were free, all fits could slide together until a nose or a finger
    is flat.
    """
    return first + config.drift * (now - first)


def mean_log(logs: Sequence[Float[Floats, "G 3 3"]]) -> Float[Floats, "G 3 3"]:
    """Mean of logarithms of stretches; its exponential is the log-Euclidean mean."""
    total = np.zeros_like(logs[0])
    for log in logs:
        total += log
    return total / len(logs)


def log_stretch(F: Float[Floats, "G 3 3"]) -> Float[Floats, "G 3 3"]:
    """Logarithm of the right stretch sqrt(F^T F)."""
    return to_matrices(0.5 * logarithm(to_entries(F.transpose(0, 2, 1) @ F), _MIN_STRETCH**2))


def stretch_of(logs: Float[Floats, "G 3 3"]) -> Float[Floats, "G 3 3"]:
    """The stretch with the given logarithm."""
    return to_matrices(exponential(to_entries(logs)))
