"""Agreement of fits: several fits are refined together, so that each keeps the others from sliding along the surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from meshmatch.arrays import Float, Floats
from meshmatch.errors import ModelError
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.judge.reasons import Verdict
from meshmatch.fitting.judge.verdict import folded_by_agreement
from meshmatch.fitting.search.task import take_samples, without_interior
from meshmatch.fitting.solve.agreement import AgreeConfig, Member, agree
from meshmatch.fitting.solve.system import NodeSystem, node_system
from meshmatch.fitting.solve.terms import Landmarks
from meshmatch.models.trained import TrainedModel
from meshmatch.shapes.shape import Shape
from meshmatch.threads import parallel_map


def agreed_fits(
    model: TrainedModel,
    shapes: Sequence[Shape],
    fits: Sequence[Fit],
    config: FitConfig | None = None,
    landmarks: Sequence[Landmarks] | None = None,
    how: AgreeConfig | None = None,
    threads: int = 1,
) -> list[Fit]:
    """Refine the fits of several repaired shapes together, so that they agree on how the template stretches.

    ``landmarks`` are, for each shape, template vertices (N,) and positions (N, 3) in its file frame; ``how`` defaults to
    the settings in the model's card. Node vectors, points and vertex distances of the result are new; residual, trust and
    verdict are those of each fit alone, except that folds may lower the verdict (see `with_vectors`). The fits are returned
    unchanged if one of them is poor, as it would mislead the others, or if nodes are not refined (a pointwise model has
    none).
    """
    config = (config or FitConfig()).for_model(model)
    if any(fit.verdict == "poor" for fit in fits) or not config.moves_nodes:
        return list(fits)
    system = node_system(model)
    how = how or AgreeConfig.for_model(model)

    def member(number: int) -> Member:
        known = None if landmarks is None else landmarks[number]
        return make_member(system, shapes[number], fits[number], config, how, known)

    if model.pairs is not None and model.pairs.components.shape[1] != 6 * len(system.gradient_points):
        raise ModelError(
            f"the statistics of pairs of {model.card.name} are of another template", "fetch the model again"
        )
    members = parallel_map(member, range(len(fits)), threads=threads)
    refined = agree(system, members, threads, model.pairs)
    return [with_vectors(system, fit, vectors) for fit, vectors in zip(fits, refined, strict=True)]


def make_member(
    system: NodeSystem, shape: Shape, fit: Fit, config: FitConfig, how: AgreeConfig, landmarks: Landmarks | None = None
) -> Member:
    """Prepare a repaired shape and its fit for agreement; landmarks are in the shape's file frame."""
    local = None if landmarks is None else (landmarks[0], fit.frame.apply(landmarks[1]))
    own = config.for_noise(shape.roughness)
    frame, samples = take_samples(without_interior(shape, system), own.samples, np.random.default_rng(own.seed))
    points = fit.frame.apply(frame.undo(samples.points))
    normals = samples.normals @ frame.rotation @ fit.frame.rotation.T
    samples = replace(samples, points=points, normals=normals).facing(system.surface(fit.vectors))
    return Member(
        samples=samples,
        vectors=fit.vectors,
        config=how.for_noise(shape.roughness),
        landmarks=local,
        partial=fit.partial,
    )


def with_vectors(system: NodeSystem, fit: Fit, vectors: Float[Floats, "K 3"]) -> Fit:
    """Replace the node vectors of a fit, for example by those that agreement finds.

    Residual, trust and verdict are kept, but a good fit becomes fair if its deformation folds more than right ones do, or
    clearly more than before.
    """
    regularity = system.regularity(vectors)
    moved = replace(fit, vectors=vectors, points=system.moved(vectors), regularity=regularity)
    folded = folded_by_agreement(fit.regularity, regularity)
    if folded is None or any(reason.code == "folded" for reason in fit.reasons):
        return moved
    verdict: Verdict = "fair" if fit.verdict == "good" else fit.verdict
    return replace(moved, verdict=verdict, reasons=(*fit.reasons, folded))
