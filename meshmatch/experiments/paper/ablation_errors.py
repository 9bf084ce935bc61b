"""How well an ablation run matches: pairs of a benchmark's set after different refinements; figure 6.

The orientation of every shape is given, the same to all runs: that of the fit of one model (--model). What is compared is
what the runs do from there.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree

from meshmatch.api.inputs import as_model, validated
from meshmatch.arrays import Float, Floats
from meshmatch.experiments.bench.scores import TruthDistances
from meshmatch.experiments.bench.sets import BenchSet
from meshmatch.experiments.paper.ablation_training import Setting
from meshmatch.experiments.paper.ablation_views import BASE, CODED, Run
from meshmatch.experiments.paper.learned_baselines import TransModel, load_transmatch
from meshmatch.experiments.runner import spread
from meshmatch.fitting.fit_config import FitConfig, NodeRefineConfig
from meshmatch.fitting.fitter import Fitter
from meshmatch.fitting.search.latent import LatentRefineConfig, refine_code
from meshmatch.fitting.search.predictor import Candidate, Predictor
from meshmatch.fitting.solve.nodes import refine_nodes
from meshmatch.fitting.solve.system import node_system
from meshmatch.geometry.frames import Frame, RigidPose, kabsch
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.maps.evaluate import CM_PER_UNIT, LOST_CM
from meshmatch.models.trained import TrainedModel
from meshmatch.shapes.normalise import sqrt_area_frame
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape
from meshmatch.templates.template import Template

METHODS = ("none", "code", "chamfer")
"""Refinements: none; of the code with the run's regularisers, or without. Figure 6 also has least squares on the nodes."""
TRANS_POINTS, TRANS_ROUNDS = 1024, 2  # each network is asked twice, the second time in the frame of its first answer
Refinement = LatentRefineConfig | NodeRefineConfig | None


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


def sampled(shape: Shape, frame: Frame, measure: Measure) -> OrientedPoints:
    """Samples of a shape in a frame."""
    samples = sample_surface(shape, measure.samples, np.random.default_rng(measure.seed))
    return samples.in_frame(frame)


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
    scan = sampled(validated(shape).shape, frame, measure)
    return Subject(name, frame, scan, shape.verts[landmarks[chosen]], cKDTree(shape.verts), distances)


def refinement_of(run: Run, method: str, measure: Measure) -> Refinement:
    """What a method does: the paper's weights at test time, without those of constraints that a run does not have."""
    if method == "none":
        return None
    if method == "nodes":
        return NodeRefineConfig()
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


def begin_body(model: TrainedModel, verts: Float[Floats, "V 3"], measure: Measure) -> Start:
    """The network's answer on a generated body, in the frame of the true core."""
    template = model.template
    shape = Shape(verts, template.shape.faces, "body")
    frame = sqrt_area_frame(shape)
    scan = sampled(shape, frame, measure)
    pose = kabsch(template.shape.verts[template.core], frame.apply(verts)[template.core])
    rng = np.random.default_rng(measure.seed)
    found = Predictor.of(model, rng).fit(scan, pose, rounds=1)
    return Start(frame.compose(found.pose.frame), scan.to_local(found.pose), found)


def refined(model: TrainedModel, start: Start, how: Refinement, seed: int) -> Float[Floats, "K 3"]:
    """Rows of the field after a refinement; what has no nodes keeps the network's where nodes are refined."""
    rows = start.candidate.vectors
    if how is None:
        return rows
    if isinstance(how, NodeRefineConfig):
        return refine_nodes(node_system(model), start.scan, rows, how) if model.has_nodes else rows
    return refine_code(model, start.scan, how, np.random.default_rng(seed), start=rows)


def errors_of(
    model: TrainedModel, run: Run, subjects: Sequence[Subject], reference: str, methods: Sequence[str], measure: Measure
) -> dict[str, dict[str, Any]]:
    """By method: mean and median geodesic error in cm over all landmarks of all ordered pairs, CPU seconds of refining.

    Maps are the paper's: the nearest vertex of one fitted template, the same vertex of the other, the nearest vertex of
    the target.
    """
    starts = [begin(model, one, reference, measure) for one in subjects]
    found = {}
    for method in methods:
        how = refinement_of(run, method, measure)
        began = time.process_time()
        rows = [refined(model, start, how, measure.seed) for start in starts]
        seconds = (time.process_time() - began) / len(subjects)
        fitted = [start.frame.undo(node_system(model).moved(each)) for start, each in zip(starts, rows, strict=True)]
        words = {"seconds": round(seconds, 4), "how": None if how is None else asdict(how)}
        found[method] = scored(subjects, fitted) | words
    return found


def transformer_errors(folder: Path, subjects: Sequence[Subject], reference: str, measure: Measure) -> dict[str, Any]:
    """Errors over all pairs, as `errors_of` tells them, in the orientation that the ``reference`` model finds."""
    model = load_transmatch(folder)
    began = time.process_time()
    fitted = [_fitted(model, one, reference, measure) for one in subjects]
    seconds = (time.process_time() - began) / len(subjects)
    return scored(subjects, fitted) | {"seconds": round(seconds, 4), "how": None}


def _fitted(model: TransModel, one: Subject, reference: str, measure: Measure) -> Float[Floats, "V 3"]:
    """Where the transformer puts the template on a subject, in its file's frame."""
    frame, scan = in_core_frame(model.template, one, reference)
    rest, core = model.template.shape.verts, model.template.core
    for round_ in range(TRANS_ROUNDS):
        points = scan.drawn(TRANS_POINTS, np.random.default_rng([measure.seed, round_]))
        with torch.inference_mode():
            at = torch.from_numpy(rest.astype(np.float32))
            there = (at + model.network(torch.from_numpy(points).float()[None], at)[0]).double().numpy()
        if round_ < TRANS_ROUNDS - 1:
            pose = kabsch(rest[core], there[core])
            frame, scan = frame.compose(pose.frame), scan.to_local(pose)
    return frame.undo(there)


def scored(subjects: Sequence[Subject], fitted: Sequence[Float[Floats, "V 3"]]) -> dict[str, Any]:
    """Errors in cm of the maps between subjects through fitted templates."""
    errors = pair_errors(subjects, fitted)
    return {
        "mean_cm": round(float(np.mean(errors)), 4),
        "median_cm": round(float(np.median(errors)), 4),
        "share_over_15cm": round(float((errors > LOST_CM).mean()), 4),
        "pair_cm": errors.mean(1).round(3).tolist(),
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


CODE_STEPS, NODE_STEPS = (0, 10, 30, 100, 300), (0, 1, 2, 4, 7, 10)
LINES = {
    "ours, nodes (least squares)": (BASE, "nodes", NODE_STEPS),
    "ours, code (Adam)": (BASE, "code", CODE_STEPS),
    "3D-CODED, code (Adam)": (CODED, "chamfer", CODE_STEPS),
}
"""The lines of figure 6: whose model, by which method, after how many steps."""


def _with_steps(how: LatentRefineConfig | NodeRefineConfig, steps: int) -> LatentRefineConfig | NodeRefineConfig:
    if isinstance(how, LatentRefineConfig):
        return replace(how, steps=steps)
    return replace(how, schedule=replace(how.schedule, steps=steps))


def descend(
    models: Mapping[Run, TrainedModel],
    setting: Setting,
    measure: Measure,
    bodies: int,
    lines: Mapping[str, tuple[Run, str, tuple[int, ...]]] = LINES,
) -> dict[str, Any]:
    """Figure 6: error against steps and seconds of refinement on bodies that nobody learned from.

    All start from their network's own answer in the frame of the true core. For each line ``steps``, ``seconds`` of the
    processor a body and, by step count, the error of each body: the mean distance of the template's vertices from where
    they belong, in cm at 1.9 m2 of skin.
    """
    found: dict[str, Any] = {}
    _, unseen = setting.sources(BASE.pose)
    drawn = unseen(bodies, torch.Generator().manual_seed(5)).double().numpy()
    for words, (run, method, counts) in lines.items():
        model = models[run]
        starts = [begin_body(model, verts, measure) for verts in drawn]
        how = refinement_of(run, method, measure)
        assert how is not None
        errors, seconds = [], []
        refined(model, starts[0], _with_steps(how, 1), measure.seed)  # what is made once is no step's
        for steps in counts:
            began = time.process_time()
            changed: Refinement = _with_steps(how, steps) if steps else None
            rows = [refined(model, start, changed, measure.seed) for start in starts]
            seconds.append(round((time.process_time() - began) / bodies, 4))
            off = [
                np.linalg.norm(node_system(model).moved(each) - start.frame.apply(verts), axis=1).mean()
                for each, start, verts in zip(rows, starts, drawn, strict=True)
            ]
            errors.append([round(float(each) * CM_PER_UNIT, 4) for each in off])
        found[words] = {"steps": list(counts), "seconds": seconds, "errors_cm": errors}
    return found
