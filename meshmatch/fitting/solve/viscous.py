"""The least squares of a fit without a model.

The prior differs from that of a fit by a trained model, which keeps the template's stretch: here the deformation gradient
at every gradient point is held near the mean of its neighbours' in the step before (a viscous prior, as in meshmonk's
registration of surfaces).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from meshmatch.arrays import Float, Floats
from meshmatch.fitting.fit_config import Pairing, Schedule
from meshmatch.fitting.solve.driver import Problem, minimise
from meshmatch.fitting.solve.priors import ViscousGradient
from meshmatch.fitting.solve.system import NodeSystem
from meshmatch.fitting.solve.terms import RimTerm, terms_of
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.shapes.rims import RimPoints

_FINER = 5 / 3  # as many nodes; each has as many neighbours as before


@dataclass(frozen=True, kw_only=True)
class ViscousConfig(Pairing):
    """Nodes of a template, and the schedule of its fits; lengths in units of sqrt(area). Tuned on three hearts, ten
    femurs and generated knees; the last scale on nine femurs, ten hearts and generated
    knees; what concerns rims on other generated leaves than those of a benchmark."""

    nodes: int = 600
    radius: float = 0.085
    faces: int = 10_000  # of a template
    samples: int = 16_000  # of a shape
    schedule: Schedule = field(
        default=Schedule(steps=24, prior=(1e-4, 1e-6), scale=(0.1, 0.01), damping=1e-6, momentum=0.5)
    )
    point_share: float = 0.0003  # what is nearest says little of where a point belongs along the surface
    pair_normals: float = 0.012  # of normals in the search for pairs
    back_points: int = 8000
    rim_width: float = 0.005  # see `RimTerm`
    rim_outward: float = 0.1
    near: int = 5  # gradient points, itself included, whose gradients are averaged
    seed: int = 0

    @classmethod
    def choosing(cls) -> ViscousConfig:
        """To choose among poses: stiffer, and drawn to what is nearest, for the wrong ones to cost more."""
        stiffer = replace(cls().schedule, prior=(1e-3, 1e-6), scale=(0.1, 0.02), momentum=0.0)
        return cls(schedule=stiffer, point_share=0.01)

    @classmethod
    def folding(cls) -> ViscousConfig:
        """Stiffer yet, for shapes so unlike the template that it folds on them."""
        few = cls.choosing()
        return replace(few, schedule=replace(few.schedule, prior=(1e-2, 1e-4)))

    def rough(self) -> ViscousConfig:
        """For fits of which only the mean is asked."""
        return replace(self, samples=6000, back_points=4000, schedule=replace(self.schedule, steps=12))

    def finest(self) -> ViscousConfig:
        """With more nodes, for the last fits of a kind whose shapes stand alike: they gain what is local. Errors of twenty
        femurs, nine hearts and generated knees are 5 to 11 % less, of generated molars 8 % more.
        """
        return replace(self, nodes=round(_FINER * self.nodes), radius=self.radius / _FINER**0.5)


def viscous_vectors(
    system: NodeSystem,
    samples: OrientedPoints,
    config: ViscousConfig,
    start: Float[Floats, "K 3"] | None = None,
    partial: bool = False,
    rim: RimPoints | None = None,
) -> Float[Floats, "K 3"]:
    """Node vectors that move the template onto the shape of the samples, which may be a part of it, from ``start``, or from
    where it rests. The rim of the template is held on the ``rim`` of the shape (core frame), if
    one is given.
    """
    prior = ViscousGradient.over(system.verts[system.gradient_points], config.near)
    terms = terms_of(samples, config, one_sided="strictly" if partial else False)
    if rim is not None:
        terms.append(RimTerm(rim, config.rim_width, config.rim_outward))
    problem = Problem(system=system, terms=terms, schedule=config.schedule)
    return minimise(problem, prior, np.zeros((system.K, 3)) if start is None else start)
