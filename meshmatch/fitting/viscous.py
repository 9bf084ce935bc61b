"""A template fitted without a network, to a shape that stands as it does: one of a collection of scans.

Node vectors are found by the least squares of `meshmatch.fitting.solve.driver`. The prior differs from that of a fit by a
trained model, which keeps the template's stretch: here the deformation gradient at every gradient point is held near the
mean of its neighbours' in the step before (a viscous prior, as in meshmonk's registration of surfaces).
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from meshmatch.arrays import Float, Floats
from meshmatch.fields.shape_functions import build_field
from meshmatch.fitting.fit import Fit, Reason, axis_name
from meshmatch.fitting.fit_config import Pairing, Schedule
from meshmatch.fitting.network_fit import two_way_residual
from meshmatch.fitting.signs import signs_of
from meshmatch.fitting.solve.driver import Problem, minimise
from meshmatch.fitting.solve.priors import ViscousGradient
from meshmatch.fitting.solve.system import NodeSystem
from meshmatch.fitting.solve.terms import PairTerm
from meshmatch.fitting.task import take_samples
from meshmatch.fitting.verdict import EVEN_TRUST, judge
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.shapes.normalise import align
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape
from meshmatch.templates.make import NodeConfig, low_mesh, make_template
from meshmatch.templates.template import Template

NO_MODEL = "none"
"""In place of a model's name."""
_ALIGNED_BY = 2400  # samples
_TURNED = (
    0.12  # a residual (units of sqrt(area)) beyond which a shape does not stand as the template does: it is turned
)


@dataclass(frozen=True, kw_only=True)
class ViscousConfig(Pairing):
    """Nodes of a template, and the schedule of its fits; lengths in units of sqrt(area). Tuned on three hearts."""

    nodes: int = 600
    radius: float = 0.085
    faces: int = 10_000  # of a template
    samples: int = 16_000  # of a shape
    steps: int = 24
    strain_first: float = 1e-3
    strain_last: float = 1e-6
    scale_first: float = 0.1  # of the robust weight
    scale_last: float = 0.02
    point_share: float = 0.01
    pair_normals: float = 0.012  # of normals in the search for pairs
    back_points: int = 8000
    near: int = 5  # gradient points, itself included, whose gradients are averaged
    damping: float = 1e-6
    seed: int = 0

    @property
    def schedule(self) -> Schedule:
        """The same as the driver of the least squares takes it."""
        return Schedule(
            steps=self.steps,
            prior=(self.strain_first, self.strain_last),
            scale=(self.scale_first, self.scale_last),
            damping=self.damping,
        )


def template_of(shape: Shape, name: str, config: ViscousConfig) -> Template:
    """A template of one shape, with nodes anywhere near its surface."""
    nodes = NodeConfig("uniform", config.nodes, config.radius, 0.01, seed=config.seed)
    return make_template(shape, name, nodes, low=low_mesh(shape, config.faces))


def viscous_system(template: Template) -> NodeSystem:
    """The least-squares system of a template without a model."""
    verts = template.shape.verts
    return NodeSystem(template.shape, build_field(verts, template.nodes, template.radius, "smooth"))


def viscous_vectors(system: NodeSystem, samples: OrientedPoints, config: ViscousConfig) -> Float[Floats, "K 3"]:
    """Node vectors that move the template onto the shape of the samples, which stands as it does."""
    prior = ViscousGradient.over(system.verts[system.strain_points], config.near)
    problem = Problem(system=system, terms=[PairTerm(samples, config)], schedule=config.schedule)
    return minimise(problem, prior, np.zeros((system.K, 3)))


def fit_viscously(template: Template, system: NodeSystem, shape: Shape, config: ViscousConfig | None = None) -> Fit:
    """Fit a template to a repaired shape, turned to it if they do not stand alike; a mesh, or a cloud.

    Such a fit is fair at best, for nothing was learned of what corresponds.
    """
    config, began = config or ViscousConfig(), time.monotonic()
    frame, samples = take_samples(shape, config.samples, np.random.default_rng(config.seed + 1))
    resting = sample_surface(template.shape, _ALIGNED_BY, np.random.default_rng(config.seed))
    (found,) = align(samples.first(_ALIGNED_BY), resting, "near")
    if found.residual > _TURNED:
        found = align(samples.first(_ALIGNED_BY), resting, "rigid")[0]
    core = frame.compose(found.pose.frame)
    local = samples.to_local(found.pose).facing(system.surface(np.zeros((system.K, 3))))
    vectors = viscous_vectors(system, local, config)
    points = system.moved(vectors)
    residual = two_way_residual(system, local, vectors)
    judged = judge(signs_of(system, vectors, local, residual, template.labels))
    unsure = Reason("unsupervised", "fitted without a trained model: surfaces that lie close need not correspond")
    return Fit(
        template_hash=template.hash,
        frame=core,
        points=points,
        vectors=vectors,
        resting=system.verts,
        faces=system.faces,
        residual=residual,
        verts=shape.verts,
        verdict="fair" if judged.verdict == "good" else judged.verdict,
        reasons=(*judged.reasons, unsure),
        trust=min(judged.trust, EVEN_TRUST),
        signs=judged.signs,
        regularity=system.regularity(vectors),
        up=axis_name(core.rotation[1]),
        front=axis_name(core.rotation[2]),
        seconds=time.monotonic() - began,
        seed=config.seed,
        model=NO_MODEL,
    )
