"""A template fitted without a network, to a shape that stands as it does: one of a collection of scans."""

from __future__ import annotations

import time

import numpy as np

from meshmatch.derived import derived
from meshmatch.fields.shape_functions import build_field
from meshmatch.fitting.fit import Fit, judged_fit
from meshmatch.fitting.fitter import cap_verdict
from meshmatch.fitting.judge.features import compute_features
from meshmatch.fitting.judge.reasons import Reason
from meshmatch.fitting.judge.verdict import judge
from meshmatch.fitting.search.predictor import two_way_residual
from meshmatch.fitting.search.task import take_samples
from meshmatch.fitting.solve.system import NodeSystem
from meshmatch.fitting.solve.viscous import ViscousConfig, viscous_vectors
from meshmatch.models.registry import NO_MODEL
from meshmatch.shapes.normalise import align
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape
from meshmatch.templates.make import NodeConfig, low_mesh, make_template
from meshmatch.templates.template import Template

_ALIGNED_BY = 2400  # samples
# With a residual beyond this (units of sqrt(area)) a shape does not stand as the template does: it is turned.
_TURNED = 0.12


def template_of(shape: Shape, name: str, config: ViscousConfig) -> Template:
    """A template of one shape, with nodes anywhere near its surface."""
    nodes = NodeConfig("uniform", config.nodes, config.radius, 0.01, seed=config.seed)
    return make_template(shape, name, nodes, low=low_mesh(shape, config.faces))


@derived
def viscous_system(template: Template) -> NodeSystem:
    """The least-squares system of a template without a model."""
    verts = template.shape.verts
    return NodeSystem(template.shape, build_field(verts, template.nodes, template.radius, "smooth"))


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
    local = samples.to_local(found.pose).facing(system.surface(np.zeros((system.K, 3))))
    vectors = viscous_vectors(system, local, config)
    residual = two_way_residual(system, local, vectors)
    judged = judge(compute_features(system, vectors, local, residual, template.labels))
    unsure = Reason("unsupervised", "fitted without a trained model: surfaces that lie close need not correspond")
    fit = judged_fit(
        judged,
        system,
        frame.compose(found.pose.frame),
        vectors,
        template_hash=template.hash,
        residual=residual,
        verts=shape.verts,
        seconds=time.monotonic() - began,
        seed=config.seed,
        model=NO_MODEL,
    )
    return cap_verdict(fit, [unsure])
