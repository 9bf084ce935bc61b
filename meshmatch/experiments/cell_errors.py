"""How well a trained cell matches: pairs of a benchmark's set after different refinements.

The orientation of every shape is given, the same to all cells: that of the fit of one model (``--model``). What is
compared is what the cells do from there.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from meshmatch.errors import OptionError
from meshmatch.experiments.cells import Cell
from meshmatch.experiments.distances import TruthDistances
from meshmatch.experiments.protocols import BenchSet
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.fitter import Fitter
from meshmatch.fitting.latent import LatentRefineConfig, refine_code
from meshmatch.fitting.network_fit import Candidate, Predictor
from meshmatch.fitting.nodes import NodeRefineConfig, refine_nodes
from meshmatch.fitting.system import node_system
from meshmatch.geometry.frames import Frame, RigidPose, kabsch
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.maps.evaluate import CM_PER_UNIT, LOST_CM
from meshmatch.models.trained import TrainedModel
from meshmatch.pipeline import read_model, usable
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape

METHODS = ("none", "code", "chamfer", "nodes")
"""Refinements: none; of the code with the cell's regularisers, or without; Gauss-Newton on the nodes."""


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

    name : str
    frame : that frame
    scan : samples in it
    marks : (N, 3) landmarks in the file's frame
    tree : of all vertices in the file's frame
    distances : (N, V) from the landmarks along the surface, in units of sqrt(area)
    """

    name: str
    frame: Frame
    scan: OrientedPoints
    marks: np.ndarray
    tree: cKDTree
    distances: np.ndarray


def oriented(shape: Shape, model: str, measure: Measure) -> Frame:
    """From the file to the core frame that a model finds."""
    config = FitConfig(seed=measure.seed, partial="no")
    return Fitter(read_model(model), config).fit(usable(shape).shape).frame


def chosen_names(bench: BenchSet, measure: Measure) -> list[str]:
    """Shapes of a set, evenly spread over those that are the target of some pair."""
    targets = {target for _, target in bench.pairs}
    names = [name for name in bench.shapes if name in targets]
    spread = np.linspace(0, len(names) - 1, min(measure.shapes, len(names))).round().astype(int)
    return [names[k] for k in spread]


def subject(bench: BenchSet, name: str, frame: Frame, measure: Measure, cache: Path) -> Subject:
    """A shape whose core frame is known, sampled, with its landmarks and the distances from them."""
    shape, landmarks = bench.seen(name), bench.landmarks(name)
    samples = sample_surface(usable(shape).shape, measure.samples, np.random.default_rng(measure.seed))
    scan = samples.in_frame(frame)
    count = min(measure.landmarks, len(landmarks))
    chosen = np.linspace(0, len(landmarks) - 1, count).round().astype(int)
    distances = TruthDistances(bench.shape(name), landmarks, cache).of(chosen)
    return Subject(name, frame, scan, shape.verts[landmarks[chosen]], cKDTree(shape.verts), distances)


def refinement_of(cell: Cell, method: str, measure: Measure) -> LatentRefineConfig | NodeRefineConfig | None:
    """What a method does: the paper's weights at test time, without those of constraints that a cell does not have.

    Raises
    ------
    OptionError
        There is no such method.
    """
    if method not in METHODS:
        raise OptionError(f"no refinement {method!r}", f"choose from {', '.join(METHODS)}")
    if method == "none":
        return None
    if method == "nodes":
        return NodeRefineConfig()
    latent = LatentRefineConfig(steps=measure.code_steps, rate=measure.code_rate, points=measure.code_points)
    volume = method == "code" and "vol" in cell.constraint
    arap = method == "code" and "arap" in cell.constraint
    return replace(latent, volume=latent.volume * volume, arap=latent.arap * arap)


@dataclass(frozen=True, eq=False)
class Start:
    """The network's own answer on a subject: the way into the cell's core frame, samples there, rows of the field."""

    frame: Frame
    scan: OrientedPoints
    candidate: Candidate


def begin(model: TrainedModel, one: Subject, reference: str, measure: Measure) -> Start:
    """Lay the network's answer on a subject, whose frame is that of the ``reference`` model."""
    theirs, ours = read_model(reference).template, model.template
    turn = Frame(1.0, np.eye(3), np.zeros(3))
    if theirs.shape.V == ours.shape.V and np.array_equal(theirs.core, ours.core):
        turn = kabsch(ours.shape.verts[ours.core], theirs.shape.verts[theirs.core]).frame
    scan = one.scan.in_frame(turn)
    rng = np.random.default_rng(measure.seed)
    found = Predictor.of(model, rng).fit(scan, RigidPose.identity())
    frame = one.frame.compose(turn).compose(found.pose.frame)
    return Start(frame, scan.to_local(found.pose), found)


def refined(
    model: TrainedModel, start: Start, how: LatentRefineConfig | NodeRefineConfig | None, seed: int
) -> np.ndarray:
    """Rows of the field after a refinement; what has no nodes keeps the network's where nodes are refined."""
    rows = start.candidate.vectors
    if isinstance(how, NodeRefineConfig):
        return refine_nodes(node_system(model), start.scan, rows, how) if model.has_nodes else rows
    if how is None:
        return rows
    return refine_code(model, start.scan, how, np.random.default_rng(seed), start=rows)


def errors_of(
    model: TrainedModel,
    cell: Cell,
    subjects: Sequence[Subject],
    reference: str,
    methods: Sequence[str],
    measure: Measure,
) -> dict[str, dict[str, Any]]:
    """By method: mean and median geodesic error in cm over all landmarks of all ordered pairs, CPU seconds of refining.

    Maps are the paper's: the nearest vertex of one fitted template, the same vertex of the other, the nearest vertex of
    the target.
    """
    starts = [begin(model, one, reference, measure) for one in subjects]
    found = {}
    for method in methods:
        how = refinement_of(cell, method, measure)
        began = time.process_time()
        rows = [refined(model, start, how, measure.seed) for start in starts]
        seconds = (time.process_time() - began) / len(subjects)
        laid = [
            start.frame.undo(node_system(model).moved(each)) for start, each in zip(starts, rows, strict=True)
        ]
        errors = pair_errors(subjects, laid)
        found[method] = {
            "mean_cm": round(float(np.mean(errors)), 4),
            "median_cm": round(float(np.median(errors)), 4),
            "share_over_15cm": round(float((errors > LOST_CM).mean()), 4),
            "pair_cm": errors.mean(1).round(3).tolist(),
            "seconds": round(seconds, 4),
            "how": None if how is None else asdict(how),
        }
    return found


def pair_errors(subjects: Sequence[Subject], laid: Sequence[np.ndarray]) -> np.ndarray:
    """Errors (pairs, N) in cm of the maps through templates (V, 3) laid on shapes in their files' frames."""
    errors = []
    nearest = [cKDTree(points).query(one.marks)[1] for one, points in zip(subjects, laid, strict=True)]
    for source, target in permutations(range(len(subjects)), 2):
        there = subjects[target].tree.query(laid[target][nearest[source]])[1]
        along = subjects[target].distances[np.arange(len(there)), there]
        errors.append(along.astype(np.float64) * CM_PER_UNIT)
    return np.array(errors)
