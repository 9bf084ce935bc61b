"""Geodesic errors of an ablation run on pairs of a benchmark set, after different refinements.

The orientation of every shape is given and the same for all runs: that of the fit of one model (--model).
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np

from meshmatch.api.inputs import as_model, repair_or_raise
from meshmatch.arrays import Float, Floats
from meshmatch.experiments.bench.scores import TruthDistances
from meshmatch.experiments.bench.sets import BenchSet
from meshmatch.experiments.paper.ablation_views import Run
from meshmatch.experiments.runner import evenly_spread
from meshmatch.fitting.fit_config import FitConfig, LatentRefineConfig
from meshmatch.fitting.fitter import Fitter
from meshmatch.fitting.search.latent import refine_code
from meshmatch.fitting.search.predictor import Candidate, Predictor
from meshmatch.fitting.solve.system import node_system
from meshmatch.geometry.frames import Frame, RigidPose, kabsch
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.geometry.trees import cKDTree
from meshmatch.maps.evaluate import CM_PER_UNIT, LOST_CM
from meshmatch.models.trained import TrainedModel
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape
from meshmatch.templates.template import Template

METHODS = ("none", "code", "chamfer")
"""Refinements: none; of the latent code with the run's regularisers; of the code by the Chamfer distance alone."""


@dataclass(frozen=True)
class Measure:
    """Settings of the evaluation.

    Parameters
    ----------
    shapes : number of shapes of each set, evenly spread; all their ordered pairs are evaluated
    landmarks : number of landmarks of each pair, evenly spread
    code_steps, code_rate, code_points : settings of the search over codes and of its Chamfer distance
    samples : number of samples of a shape's surface
    """

    shapes: int = 6
    landmarks: int = 500
    code_steps: int = 100
    code_rate: float = 5e-3
    code_points: int = 1500
    samples: int = 6000
    seed: int = 0


@dataclass(frozen=True, eq=False)
class Subject:
    """A shape of a set, with the core frame that the reference model found.

    Parameters
    ----------
    frame : the core frame
    scan : surface samples in the core frame
    marks : landmarks in the file's frame
    tree : k-d tree of all vertices in the file's frame
    distances : geodesic distances from the landmarks, in units of sqrt(area)
    """

    name: str
    frame: Frame
    scan: OrientedPoints
    marks: Float[Floats, "N 3"]
    tree: cKDTree
    distances: Float[np.ndarray, "N V"]


def find_core_frame(shape: Shape, model: str, measure: Measure) -> Frame:
    """Find the core frame of a shape by fitting a model."""
    config = FitConfig(seed=measure.seed, partial="no")
    return Fitter(as_model(model), config).fit(repair_or_raise(shape).shape).frame


def chosen_names(bench: BenchSet, measure: Measure) -> list[str]:
    """Names of the evaluated shapes: evenly spread over those that are the target of some pair."""
    targets = {target for _, target in bench.pairs}
    return evenly_spread([name for name in bench.shapes if name in targets], measure.shapes)


def build_subject(bench: BenchSet, name: str, frame: Frame, measure: Measure, cache: Path | None) -> Subject:
    """Sample a shape with a known core frame, and compute the distances from its landmarks."""
    shape, landmarks = bench.seen(name), bench.landmarks(name)
    chosen = np.array(evenly_spread(range(len(landmarks)), measure.landmarks))
    distances = TruthDistances(bench.shape(name), landmarks[chosen], cache).of(np.arange(len(chosen)))
    samples = sample_surface(repair_or_raise(shape).shape, measure.samples, np.random.default_rng(measure.seed))
    return Subject(
        name, frame, samples.in_frame(frame), shape.verts[landmarks[chosen]], cKDTree(shape.verts), distances
    )


def refinement_of(run: Run, method: str, measure: Measure) -> LatentRefineConfig | None:
    """Settings of a method: the paper's weights at test time, or zero for the constraints that a run does not have."""
    if method == "none":
        return None
    latent = LatentRefineConfig(steps=measure.code_steps, rate=measure.code_rate, points=measure.code_points)
    volume = method == "code" and "vol" in run.constraint
    arap = method == "code" and "arap" in run.constraint
    return replace(latent, volume=latent.volume * volume, arap=latent.arap * arap)


@dataclass(frozen=True, eq=False)
class Start:
    """The network's prediction for a shape: the frame of its core, samples in it, and the predicted node vectors."""

    frame: Frame
    scan: OrientedPoints
    candidate: Candidate


def in_core_frame(template: Template, one: Subject, reference: str) -> tuple[Frame, OrientedPoints]:
    """Transform a subject from the core frame of the ``reference`` model to that of a template."""
    reference_template, frame = as_model(reference).template, Frame.identity()
    if reference_template.shape.V == template.shape.V and np.array_equal(reference_template.core, template.core):
        frame = kabsch(
            template.shape.verts[template.core], reference_template.shape.verts[reference_template.core]
        ).frame
    return one.frame.compose(frame), one.scan.in_frame(frame)


def predict_start(model: TrainedModel, one: Subject, reference: str, measure: Measure) -> Start:
    """Predict the fit of a subject, whose frame is that of the ``reference`` model."""
    frame, scan = in_core_frame(model.template, one, reference)
    rng = np.random.default_rng(measure.seed)
    candidate = Predictor.of(model, rng).fit(scan, RigidPose.identity())
    return Start(frame.compose(candidate.pose.frame), scan.to_local(candidate.pose), candidate)


def errors_of(
    model: TrainedModel, run: Run, subjects: Sequence[Subject], reference: str, method: str, measure: Measure
) -> dict[str, Any]:
    """Mean and median geodesic error in cm over all landmarks of all ordered pairs, and CPU seconds to refine a shape.

    Maps are those of the paper: to the nearest vertex of the fitted template, the same vertex of the other fitted template,
    and the nearest vertex of the target.
    """
    starts = [predict_start(model, one, reference, measure) for one in subjects]
    config = refinement_of(run, method, measure)
    start_time = time.process_time()
    rows = [start.candidate.vectors for start in starts]
    if config is not None:
        rows = [
            refine_code(model, start.scan, config, np.random.default_rng(measure.seed), start=each)
            for start, each in zip(starts, rows, strict=True)
        ]
    seconds = (time.process_time() - start_time) / len(subjects)
    fitted = [start.frame.undo(node_system(model).moved(each)) for start, each in zip(starts, rows, strict=True)]
    errors = pair_errors(subjects, fitted)
    return {
        "mean_cm": round(float(np.mean(errors)), 4),
        "median_cm": round(float(np.median(errors)), 4),
        "share_over_15cm": round(float((errors > LOST_CM).mean()), 4),
        "pair_cm": errors.mean(1).round(3).tolist(),
        "seconds": round(seconds, 4),
        "how": None if config is None else asdict(config),
    }


def pair_errors(subjects: Sequence[Subject], fitted: Sequence[Float[Floats, "V 3"]]) -> Float[Floats, "pairs N"]:
    """Errors in cm, for all ordered pairs and landmarks, of the maps through fitted templates (in their files' frames)."""
    errors = []
    nearest = [cKDTree(points).query(one.marks)[1] for one, points in zip(subjects, fitted, strict=True)]
    for source, target in permutations(range(len(subjects)), 2):
        matched = subjects[target].tree.query(fitted[target][nearest[source]])[1]
        distances = subjects[target].distances[np.arange(len(matched)), matched]
        errors.append(distances.astype(np.float64) * CM_PER_UNIT)
    return np.array(errors)
