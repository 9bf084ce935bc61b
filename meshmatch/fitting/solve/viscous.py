"""Least squares of a fit without a model.

A trained model's prior keeps the template's stretch. Here the deformation gradient at every gradient point is instead held
near the mean of its neighbours' gradients in the previous step (a viscous prior, as in the surface registration of
MeshMonk).
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

_FINER = 5 / 3  # factor for the number of nodes; radii shrink so that each node keeps its number of neighbours


@dataclass(frozen=True, kw_only=True)
class ViscousConfig(Pairing):
    """Nodes of a template, and the schedule of its fits; lengths in units of sqrt(area).

    Tuned on three hearts, ten femurs and generated knees; the last scale on nine femurs, ten hearts and generated knees;
    settings of rims on generated leaves other than those of the benchmark.
    """

    nodes: int = 600
    radius: float = 0.085
    faces: int = 10_000  # triangles of a template
    samples: int = 16_000  # samples of a shape
    schedule: Schedule = field(
        default=Schedule(steps=24, prior=(1e-4, 1e-6), scale=(0.1, 0.01), damping=1e-6, momentum=0.5)
    )
    point_share: float = 0.0003  # small, as the nearest point says little about the position along the surface
    pair_normals: float = 0.012
    back_points: int = 8000
    rim_width: float = 0.005  # see `RimTerm`
    rim_outward: float = 0.1
    near: int = 5  # number of gradient points, including the point itself, over which the prior averages
    seed: int = 0

    @classmethod
    def choosing(cls) -> ViscousConfig:
        """Settings for choosing among poses.

        They are stiffer and have more weight along the surface, so that wrong poses cost more.
        """
        stiffer = replace(cls().schedule, prior=(1e-3, 1e-6), scale=(0.1, 0.02), momentum=0.0)
        return cls(schedule=stiffer, point_share=0.01)

    @classmethod
    def folding(cls) -> ViscousConfig:
        """Still stiffer settings, for shapes so unlike the template that it would fold."""
        few = cls.choosing()
        return replace(few, schedule=replace(few.schedule, prior=(1e-2, 1e-4)))

    def rough(self) -> ViscousConfig:
        """Faster settings, for fits of which only the mean is used."""
        return replace(self, samples=6000, back_points=4000, schedule=replace(self.schedule, steps=12))

    def finest(self) -> ViscousConfig:
        """Settings with more nodes, which add local detail in the final fits of shapes in the same pose.

        Errors of twenty femurs, nine hearts and generated knees are 5 to 11 % smaller, of generated molars 8 % larger.
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
    """Node vectors that move the template onto the samples of a shape, starting from ``start`` or from the rest template.

    If ``partial``, the shape may be a part. If ``rim`` is given (core frame), the template's rim is held on it.
    """
    prior = ViscousGradient.over(system.verts[system.gradient_points], config.near)
    terms = terms_of(samples, config, one_sided="strictly" if partial else False)
    if rim is not None:
        terms.append(RimTerm(rim, config.rim_width, config.rim_outward))
    problem = Problem(system=system, terms=terms, schedule=config.schedule)
    return minimise(problem, prior, np.zeros((system.K, 3)) if start is None else start)
