"""How well an ablation run matches: pairs of a benchmark's set after different refinements.

The orientation of every shape is given, the same to all runs: that of the fit of one model (--model). What is compared is
what the runs do from there.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np

from meshmatch.api.inputs import as_model, validated
from meshmatch.arrays import Float, Floats
from meshmatch.experiments.bench.scores import TruthDistances
from meshmatch.experiments.bench.sets import BenchSet
from meshmatch.experiments.paper.ablation_views import Run
from meshmatch.experiments.runner import spread
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
"""Refinements: none; of the code with the run's regularisers, or without."""


@dataclass(frozen=True)
class Measure:
    """How errors are measured.

    Parameters
    ----------
    shapes : of each set, evenly spread; all ordered pairs of them are measured
    landmarks : of each pair, evenly spread
    code_steps, code_rate, code_points : of the search over codes and its Chamfer distance
    samples : of a shape's surface
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
    """A shape of a set, seen from the core frame of the model that said its orientation.

    Parameters
    ----------
    frame : that frame
    scan : samples in it
    marks : landmarks in the file's frame
    tree : of all vertices in the file's frame
    distances : from the landmarks along the surface, in units of sqrt(area)
    """

    name: str
    frame: Frame
    scan: OrientedPoints
    marks: Float[Floats, "N 3"]
    tree: cKDTree
    distances: Float[np.ndarray, "N V"]


def oriented(shape: Shape, model: str, measure: Measure) -> Frame:
    """From the file to the core frame that a model finds."""
    config = FitConfig(seed=measure.seed, partial="no")
    return Fitter(as_model(model), config).fit(validated(shape).shape).frame


def chosen_names(bench: BenchSet, measure: Measure) -> list[str]:
    """Shapes of a set, evenly spread over those that are the target of some pair."""
    targets = {target for _, target in bench.pairs}
    return spread([name for name in bench.shapes if name in targets], measure.shapes)


def subject(bench: BenchSet, name: str, frame: Frame, measure: Measure, cache: Path | None) -> Subject:
    """A shape whose core frame is known, sampled, with its landmarks and the distances from them."""
    shape, landmarks = bench.seen(name), bench.landmarks(name)
    chosen = np.array(spread(range(len(landmarks)), measure.landmarks))
    distances = TruthDistances(bench.shape(name), landmarks[chosen], cache).of(np.arange(len(chosen)))
    samples = sample_surface(validated(shape).shape, measure.samples, np.random.default_rng(measure.seed))
    return Subject(
        name, frame, samples.in_frame(frame), shape.verts[landmarks[chosen]], cKDTree(shape.verts), distances
    )


def refinement_of(run: Run, method: str, measure: Measure) -> LatentRefineConfig | None:
    """What a method does: the paper's weights at test time, without those of constraints that a run does not have."""
    if method == "none":
        return None
    latent = LatentRefineConfig(steps=measure.code_steps, rate=measure.code_rate, points=measure.code_points)
    volume = method == "code" and "vol" in run.constraint
    arap = method == "code" and "arap" in run.constraint
    return replace(latent, volume=latent.volume * volume, arap=latent.arap * arap)


@dataclass(frozen=True, eq=False)
class Start:
    """The network's own answer on a shape: the way into the run's core frame, samples there, rows of the field."""

    frame: Frame
    scan: OrientedPoints
    candidate: Candidate


def in_core_frame(template: Template, one: Subject, reference: str) -> tuple[Frame, OrientedPoints]:
    """A subject, whose frame is that of the ``reference`` model, in the core frame of a template."""
    theirs, turn = as_model(reference).template, Frame.identity()
    if theirs.shape.V == template.shape.V and np.array_equal(theirs.core, template.core):
        turn = kabsch(template.shape.verts[template.core], theirs.shape.verts[theirs.core]).frame
    return one.frame.compose(turn), one.scan.in_frame(turn)


def begin(model: TrainedModel, one: Subject, reference: str, measure: Measure) -> Start:
    """The network's answer on a subject, whose frame is that of the ``reference`` model."""
    frame, scan = in_core_frame(model.template, one, reference)
    rng = np.random.default_rng(measure.seed)
    found = Predictor.of(model, rng).fit(scan, RigidPose.identity())
    return Start(frame.compose(found.pose.frame), scan.to_local(found.pose), found)


def errors_of(
    model: TrainedModel, run: Run, subjects: Sequence[Subject], reference: str, method: str, measure: Measure
) -> dict[str, Any]:
    """Mean and median geodesic error in cm over all landmarks of all ordered pairs, CPU seconds of refining a shape.

    Maps are the paper's: the nearest vertex of one fitted template, the same vertex of the other, the nearest vertex of
    the target.
    """
    starts = [begin(model, one, reference, measure) for one in subjects]
    how = refinement_of(run, method, measure)
    began = time.process_time()
    rows = [start.candidate.vectors for start in starts]
    if how is not None:
        rows = [
            refine_code(model, start.scan, how, np.random.default_rng(measure.seed), start=each)
            for start, each in zip(starts, rows, strict=True)
        ]
    seconds = (time.process_time() - began) / len(subjects)
    fitted = [start.frame.undo(node_system(model).moved(each)) for start, each in zip(starts, rows, strict=True)]
    errors = pair_errors(subjects, fitted)
    return {
        "mean_cm": round(float(np.mean(errors)), 4),
        "median_cm": round(float(np.median(errors)), 4),
        "share_over_15cm": round(float((errors > LOST_CM).mean()), 4),
        "pair_cm": errors.mean(1).round(3).tolist(),
        "seconds": round(seconds, 4),
        "how": None if how is None else asdict(how),
    }


def pair_errors(subjects: Sequence[Subject], fitted: Sequence[Float[Floats, "V 3"]]) -> Float[Floats, "pairs N"]:
    """Errors in cm of the maps through templates that were fitted to shapes, in their files' frames."""
    errors = []
    nearest = [cKDTree(points).query(one.marks)[1] for one, points in zip(subjects, fitted, strict=True)]
    for source, target in permutations(range(len(subjects)), 2):
        there = subjects[target].tree.query(fitted[target][nearest[source]])[1]
        along = subjects[target].distances[np.arange(len(there)), there]
        errors.append(along.astype(np.float64) * CM_PER_UNIT)
    return np.array(errors)
