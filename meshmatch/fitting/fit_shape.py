"""Lay a model's template on a shape: orientation, network, refinement, verdict."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from meshmatch.fitting.candidates import CandidateScorer, averaged, choose, lying
from meshmatch.fitting.cloud_scale import settle, without_outliers
from meshmatch.fitting.completion import seen, seen_area
from meshmatch.fitting.fit import FAIR_RESIDUAL, Fit, axis_name
from meshmatch.fitting.fit_config import FitConfig, check_landmarks
from meshmatch.fitting.initial_frames import frames_of_part, frames_to_try, scan_frame
from meshmatch.fitting.latent import refine_code
from meshmatch.fitting.mirror import mirror_of
from meshmatch.fitting.network_fit import Candidate, lay_on, two_way_residual, variants
from meshmatch.fitting.nodes import refine_nodes
from meshmatch.fitting.orientation import Hypothesis
from meshmatch.fitting.part import cost, fit_part
from meshmatch.fitting.scan import Scan
from meshmatch.fitting.system import NodeSystem
from meshmatch.fitting.verdict import cloud_allowance, empty_share, judge, unexplained
from meshmatch.geometry.frames import Frame
from meshmatch.geometry.topology import open_edges
from meshmatch.shapes.normalise import sqrt_area_frame
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape

if TYPE_CHECKING:
    from meshmatch.models.trained import TrainedModel

Progress = Callable[[str, float], None]
_Laid = tuple[Frame, Scan, Candidate]

# A fit of the whole that leaves this share of the template without surface may be one of a part; that is believed
# if its residual is that much smaller. A mesh must be open for it, with a boundary of so many sqrt(area).
# A part lacks that much of the surface.
_LEFT, _CLOSER, _OPEN, _MISSING = 0.06, 0.85, 0.3, 0.03
# Frames of each share of a part that are laid on with care, at first and where that gave a poor fit.
_LAID, _MORE_LAID = 6, 16


@lru_cache(maxsize=4)
def node_system(model: TrainedModel) -> NodeSystem:
    """The least-squares system of a model's template and field, built once."""
    shape = model.template.shape
    return NodeSystem(shape, model.field(shape.verts))


def fit_shape(
    model: TrainedModel,
    shape: Shape,
    config: FitConfig | None = None,
    landmarks: tuple[np.ndarray, np.ndarray] | None = None,
    progress: Progress | None = None,
) -> Fit:
    """Lay the model's template on a repaired shape; a cloud's is laid on its points without the strays.

    Parameters
    ----------
    landmarks : (template vertices (N,), positions (N, 3) in the shape's file frame), optional
    progress : callable, optional
        Called with (what is going on, share done).

    Returns
    -------
    Fit

    Raises
    ------
    OptionError
        An axis that is none, or up and front along one axis; landmarks for a model without nodes.
    """
    if landmarks is not None:
        check_landmarks(model)
    config = (config or FitConfig()).suited(shape.roughness).possible(model)
    whole, shape = shape, without_outliers(shape)
    began = time.monotonic()
    tell = progress or (lambda what, share: None)
    rng = np.random.default_rng(config.seed)
    frame, scan = take_samples(shape, config.samples, rng, scan_frame(model, shape))
    laid, partial = _whole(model, shape, frame, scan, config, landmarks, rng, tell), False
    if landmarks is None and _try_part(model, shape, laid, config):
        part = _part(model, whole, frame, scan, config, tell)
        visible = _shown(frame, part)
        smaller = cost(part[2].residual, visible) < _CLOSER * laid[2].residual
        partial = smaller and visible < 1 - _MISSING
        laid = part if partial else laid
    return replace(_finish(model, whole, laid, config, partial), seconds=time.monotonic() - began)


def _whole(model, shape, frame, scan, config, landmarks, rng, tell) -> _Laid:
    """The template on a shape that is taken for a whole."""
    system = node_system(model)
    tell("orientation", 0.0)
    guesses = frames_to_try(model, scan, config)
    coarse = scan.first(config.coarse_samples)
    rough = []
    # A cloud's residual tells little before its core frame is found; asking twice does.
    care = 2 if shape.is_cloud else 1
    for number, guess in enumerate(guesses):
        rough.append(_lay(model, system, coarse, guess, rng, rounds=care, draws=care, stride=1))
        tell("orientation", 0.7 * (number + 1) / len(guesses))
    rough.sort(key=lambda candidate: candidate.residual)
    if shape.is_cloud:
        frame, scan, coarse, rough = _settled(model, system, frame, scan, rough[: config.laid], config, rng)
    candidates = [_lay(model, system, scan, guess, rng) for guess in rough[: config.laid]]
    candidates.sort(key=lambda candidate: candidate.residual)
    if config.refine == "nodes":
        candidates = _readings(model, system, scan, coarse, candidates, config, rng)
    tell("orientation", 1.0)
    rough = shape.roughness
    return frame, scan, _refine(model, system, scan, frame, candidates, config, landmarks, rough, rng, tell)


def _part(model, shape, frame, scan, config, tell) -> _Laid:
    """The template on a shape that is taken for a part; where that is poor, more orientations are tried."""
    found = _sought(model, frame, scan, config, False, tell)
    if _finish(model, shape, found, config, partial=True).verdict != "poor":
        return found
    wider = replace(config, copies=2 * config.copies, hypotheses=4 * config.hypotheses)
    again = _sought(model, frame, scan, wider, True, tell)
    return min(found, again, key=lambda laid: cost(laid[2].residual, _shown(frame, laid)))


def _shown(frame: Frame, laid: _Laid) -> float:
    """The share (0..1) of the whole that a fit of a part takes a shape to be."""
    return (frame.scale / laid[0].scale) ** 2


def _sought(model, frame, scan, config, wide: bool, tell) -> _Laid:
    """The best fit of a part that a search finds."""
    scale, sized, best = fit_part(
        model,
        node_system(model),
        scan,
        lambda part: frames_of_part(model, part, config, wide),
        config.nodes,
        np.random.default_rng(config.seed),
        laid=_MORE_LAID if wide else _LAID,
        variants_count=config.variants,
        tilt=config.tilt,
        screening=config.screening,
        refine=config.refine == "nodes",
        tell=lambda share: tell("fitting as a part", share),
    )
    return frame.compose(Frame(scale, np.eye(3), np.zeros(3))), sized, best


def _finish(model, shape, laid: _Laid, config, partial: bool) -> Fit:
    """The noun, with its verdict."""
    frame, scan, best = laid
    system = node_system(model)
    core_frame = frame.compose(Frame(1.0, best.rotation.T, best.center))
    points = system.moved(best.vectors)
    local = scan.turned(best.rotation, best.center)
    allowance = _allowance(model, shape, local, best, config)
    unseen = 1 - seen_area(system, seen(system, local, best.vectors)) if partial else None
    verdict, reasons = judge(best.residual, local, points, allowance, partial, unseen)
    return Fit(
        template_hash=model.template.hash,
        frame=core_frame,
        points=points,
        vectors=best.vectors,
        resting=system.verts,
        faces=system.faces,
        residual=best.residual,
        vertex_distance=cKDTree(points).query(core_frame.apply(shape.verts))[0],
        verdict=verdict,
        reasons=reasons,
        up=axis_name(core_frame.rotation[1]),
        front=axis_name(core_frame.rotation[2]),
        seconds=0.0,
        seed=config.seed,
        partial=partial,
    )


def _allowance(model, shape: Shape, local: Scan, best: Candidate, config: FitConfig) -> float:
    if not shape.is_cloud:
        return 0.0
    return cloud_allowance(node_system(model), local, shape.V, best.vectors, config.seed)


def _try_part(model, shape: Shape, laid: _Laid, config: FitConfig) -> bool:
    """Whether a fit of a part is worth its time: asked for, or an open shape that a whole fits badly or leaves bare."""
    if config.partial != "auto" or config.refine == "latent":
        return config.partial == "yes"
    if not shape.is_cloud and boundary_length(shape) < _OPEN * np.sqrt(shape.area):
        return False
    _, scan, best = laid
    local, points = scan.turned(best.rotation, best.center), node_system(model).moved(best.vectors)
    if shape.is_cloud:  # its residual says how sparse and noisy it is, not that something is missing
        return empty_share(local, points) > _LEFT
    allowance = _allowance(model, shape, local, best, config)
    return unexplained(best.residual, allowance) > FAIR_RESIDUAL or empty_share(local, points) > _LEFT


def _settled(model, system, frame, scan, rough, config, rng) -> tuple[Frame, Scan, Scan, list[Candidate]]:
    """Frame, samples and candidates of a cloud, its scale and its stray points settled by the best candidate."""

    def lay(part: Scan, start: Candidate) -> Candidate:
        return _lay(model, system, part, start, rng, rounds=2, draws=2, stride=1)

    settled = [settle(system, scan, candidate, lay) for candidate in rough]
    scale, scan, best = min(settled, key=lambda each: each[2].residual)
    others = [Candidate(c.rotation, c.center / scale, c.vectors, c.residual) for c in rough]
    coarse = scan.first(config.coarse_samples)
    return frame.compose(Frame(scale, np.eye(3), np.zeros(3))), scan, coarse, [best, *others]


def _readings(model, system, scan, coarse, candidates, config, rng) -> list[Candidate]:
    """The candidates and tilted readings of the best one, best first on the coarse scan."""
    best = candidates[0]
    here, near = (part.turned(best.rotation, best.center) for part in (scan, coarse))
    mirror = mirror_of(model)
    pool = variants(model.network, system, here, near, best, rng, config.variants, config.tilt, mirror)
    for other in candidates:
        there = coarse.turned(other.rotation, other.center)
        residual = two_way_residual(system, there, other.vectors, 1)
        pool.append(Candidate(other.rotation, other.center, other.vectors, residual))
    return sorted(pool, key=lambda candidate: candidate.residual)


def _lay(
    model: TrainedModel, system: NodeSystem, scan: Scan, guess: Hypothesis | Candidate, rng, **how
) -> Candidate:
    return lay_on(model.network, system, model.template.core, scan, guess.rotation, guess.center, rng, **how)


def take_samples(
    shape: Shape, P: int, rng: np.random.Generator, frame: Frame | None = None
) -> tuple[Frame, Scan]:
    """Frame of a shape (area 1, centroid 0, if no other is given) and samples of it in that frame."""
    frame = sqrt_area_frame(shape) if frame is None else frame
    samples = sample_surface(without_outliers(shape), P, rng)
    return frame, Scan(frame.apply(samples.points), samples.normals @ frame.rotation.T, not shape.is_cloud)


def _refine(model, system, scan, frame, candidates, config, landmarks, rough, rng, tell) -> Candidate:
    if config.refine == "none":
        return candidates[0]
    if config.refine == "latent":
        best = candidates[0]
        local = scan.turned(best.rotation, best.center)
        vectors = refine_code(
            model, _facing(system, local, best), config.latent, rng, lambda k, n: tell("refinement", k / n)
        )
        return Candidate(best.rotation, best.center, vectors, two_way_residual(system, local, vectors))

    # A few steps tell which readings the surface agrees with; the prior of the full run stays the network's.
    screen = replace(config.nodes, steps=config.screening)

    def fitted(candidate: Candidate, whole: bool) -> Candidate:
        if whole:
            candidate = averaged(system, candidate, candidates)
        local = scan.turned(candidate.rotation, candidate.center)
        fixed = None
        if landmarks is not None:
            fixed = (landmarks[0], (frame.apply(landmarks[1]) - candidate.center) @ candidate.rotation)
        facing = _facing(system, local, candidate)
        vectors = refine_nodes(system, facing, candidate.vectors, config.nodes if whole else screen, fixed)
        return Candidate(
            candidate.rotation, candidate.center, vectors, two_way_residual(system, local, vectors)
        )

    judge = CandidateScorer(system, scan, rough)
    return choose(
        candidates,
        config.finalists,
        fitted,
        lambda found: judge.score(scan.turned(found.rotation, found.center), found),
        lambda found: lying(system, found),
        lambda share: tell("refinement", share),
    )


def _facing(system, local: Scan, candidate: Candidate) -> Scan:
    moved = system.moved(candidate.vectors)
    return local.facing(moved, system.normals(moved))


def boundary_length(shape: Shape) -> float:
    """Length of the edges with one face, in the unit of the file."""
    ends = shape.verts[open_edges(shape.faces)]  # N 2 3
    return float(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).sum())
