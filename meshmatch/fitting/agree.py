"""Fits of several shapes that agree on how the template stretches: what slides along one surface is held by the others."""

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

    if model.pairs is not None and model.pairs.components.shape[1] != 6 * len(system.gradient_points):
        raise ModelError(
            f"the statistics of pairs of {model.card.name} are of another template", "fetch the model again"
        )
    members = parallel_map(member, range(len(fits)), threads=threads)
    refined = agree(system, members, threads, model.pairs)
    return [with_vectors(system, fit, vectors) for fit, vectors in zip(fits, refined, strict=True)]


def member_of(
    system: NodeSystem, shape: Shape, fit: Fit, config: FitConfig, how: AgreeConfig, landmarks: Landmarks | None = None
) -> Member:
    """What agreement needs of a repaired shape and its fit; landmarks are in the shape's file frame."""
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
    """The same fit with other node vectors, such as agreement finds.

    Residual, trust and verdict stay those that it had, but a deformation that folds more than right ones do, or clearly more
    than before, is not good.
    """
    regularity = system.regularity(vectors)
    moved = replace(fit, vectors=vectors, points=system.moved(vectors), regularity=regularity)
    folded = folded_by_agreement(fit.regularity, regularity)
    if folded is None or any(reason.code == "folded" for reason in fit.reasons):
        return moved
    verdict: Verdict = "fair" if fit.verdict == "good" else fit.verdict
    return replace(moved, verdict=verdict, reasons=(*fit.reasons, folded))
