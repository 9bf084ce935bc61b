"""The driver for all least-squares fits of node vectors: a schedule, terms and a prior, step by step.

In each step the pairs and robust weights of the terms are frozen, and so are the targets of the prior (rotations, for
example); then one linear system is solved. This is iteratively reweighted least squares with local/global rotations, that
is, iterative closest points with an as-rigid-as-possible prior (Sorkine and Alexa, 2007). Refinement of one fit, agreement
of several, fits without a model and interpolation differ only in their terms, priors and schedules.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from meshmatch.arrays import Float, Floats
from meshmatch.fitting.fit_config import Schedule
from meshmatch.fitting.solve.priors import Prior
from meshmatch.fitting.solve.system import NodeSystem
from meshmatch.fitting.solve.terms import Quadratic, Term
from meshmatch.threads import parallel_map

JointPrior = Callable[[Sequence[Float[Floats, "G 3 3"]]], Sequence[Prior]]
"""Maps the current deformation gradients of several fits to the prior of each fit in the next step."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Problem:
    """The least-squares problem of one fit, without its prior.

    ``anchor``, if given, corrects the node vectors after each step, for example by a translation if no term determines it.
    """

    system: NodeSystem
    terms: Sequence[Term]
    schedule: Schedule
    anchor: Callable[[Float[Floats, "K 3"]], Float[Floats, "K 3"]] | None = None

    def step(
        self, number: int, start: Float[Floats, "K 3"], F: Float[Floats, "G 3 3"], prior: Prior
    ) -> Float[Floats, "K 3"]:
        """Node vectors after one step of the schedule from ``start``, where the deformation gradients are F."""
        system, schedule = self.system, self.schedule
        weights, pulls = self._sum(start, schedule.scale_at(number))
        targets = prior.targets(F)
        held = schedule.prior_at(number) * (1.0 / len(targets))
        found = system.solve(weights, pulls, held, targets, schedule.damping / system.K, start)
        return found if self.anchor is None else self.anchor(found)

    def _sum(self, vectors: Float[Floats, "K 3"], scale: float) -> Quadratic:
        """Sum of the quadratic forms of all terms."""
        V = len(self.system.verts)
        weights, pulls = np.zeros((V, 6)), np.zeros((V, 3))
        for term in self.terms:
            more_weights, more_pulls = term.quadratic(self.system, vectors, scale)
            weights += more_weights
            pulls += more_pulls
        return weights, pulls

    def start(self, now: Float[Floats, "K 3"], before: Float[Floats, "K 3"]) -> Float[Floats, "K 3"]:
        """Starting point of a step: ``now``, extrapolated from ``before`` by the momentum."""
        return now + self.schedule.momentum * (now - before) if self.schedule.momentum else now


def minimise(problem: Problem, prior: Prior, vectors: Float[Floats, "K 3"]) -> Float[Floats, "K 3"]:
    """Node vectors of one fit after all steps of the schedule."""
    return minimise_together([problem], lambda _: [prior], [vectors])[0]


def minimise_together(
    problems: Sequence[Problem], joint_prior: JointPrior, vectors: Sequence[Float[Floats, "K 3"]], threads: int = 1
) -> list[Float[Floats, "K 3"]]:
    """Node vectors of several fits after all steps of the first one's schedule; up to ``threads`` fits in parallel."""
    now = before = list(vectors)
    for number in range(problems[0].schedule.steps):
        starts = [each.start(*path) for each, *path in zip(problems, now, before, strict=True)]
        gradients = [each.system.deformation_gradient(start) for each, start in zip(problems, starts, strict=True)]
        steps, priors = [number] * len(problems), joint_prior(gradients)
        before, now = now, parallel_map(Problem.step, problems, steps, starts, gradients, priors, threads=threads)
    return now
