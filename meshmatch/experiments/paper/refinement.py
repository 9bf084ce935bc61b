"""Least squares on the nodes against the paper's refinement.

Both start from the same node vectors, the network's own answer in the orientation that a fit finds, and see the same
samples of the same shapes, in one process with one thread, taking turns at going first.

- code: 2,000 Adam steps on the shape code, Chamfer distance (3,000 points each way) plus volume and rigidity with the
  paper's weights. Its neighbors come from KD-trees, only the code's gradient is computed, the template's shape functions
  and their transposes are kept, and the best step of all is returned: no cost is left in it that we know how to avoid.
- nodes: the steps of least squares that `meshmatch match` ends with, on all samples; also fewer of them, for the race to
  equal error: the fewest that are no worse than the search over codes.

Measured is the refinement alone, after one warm-up of each; what is computed once per template is not counted for
either. Times are CPU seconds, which other programs on the machine disturb least; the clock's are in the JSON line.
Errors are in centimeters at 1.9 m2 of skin. On bodies (generated, of people that training never drew): the mean distance
of the fitted template's vertices from where they belong. On shrec19, scape, faust: the mean geodesic error of the maps
between all ordered pairs of the shapes, through the fits. The energy is the paper's, of both answers on the same points.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import permutations
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from typer import Option

from meshmatch.api.inputs import as_model
from meshmatch.api.matching import Matcher
from meshmatch.api.results import shape_of
from meshmatch.arrays import Float, Floats
from meshmatch.errors import OptionError
from meshmatch.experiments import runner
from meshmatch.experiments.bench.scores import evaluate_set
from meshmatch.experiments.bench.sets import SET_NAMES, load_set
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import FitConfig, NodeRefineConfig
from meshmatch.fitting.search.latent import LatentRefineConfig, PaperEnergy, refine_code
from meshmatch.fitting.solve.nodes import refine_nodes
from meshmatch.fitting.solve.system import node_system
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.maps.evaluate import CM_PER_UNIT
from meshmatch.models.trained import TrainedModel
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape

FEWER = {"nodes, 1 step": 1, "nodes, 2 steps": 2, "nodes, 4 steps": 4}
METHODS = ("network", "code", *FEWER, "nodes")
BAR = 50.0
"""How many times faster than the search over codes the steps of least squares have to be, at a lower error."""
COLUMNS = {
    **{"set": "set", "method": "method", "CPU s a shape": "cpu:.3f", "mean error, cm": "error_cm:.2f"},
    **{"paper's energy": "energy:.6f", "times as fast": "times_as_fast:.0f", "race": "race"},
}


@dataclass(frozen=True, eq=False)
class Answer:
    """What one method made of one shape: node vectors, seconds of CPU and on the clock, the paper's energy."""

    vectors: Float[Floats, "K 3"]
    cpu: float
    wall: float
    energy: float


@dataclass(frozen=True, eq=False)
class Subject:
    """A shape, the network's fit of it, and what each method made of it."""

    shape: Shape
    fit: Fit
    answers: dict[str, Answer]


def refined(model: TrainedModel, shapes: Sequence[Shape], steps: int, seed: int) -> list[Subject]:
    """Every shape refined both ways from the same start."""
    nodes, code = NodeRefineConfig(), LatentRefineConfig(steps=steps)
    system = node_system(model)
    subjects = []
    for number, shape in enumerate(runner.track(shapes, "refining")):
        fit, scan = _start(model, shape, seed)
        energy = PaperEnergy(model, scan, code, np.random.default_rng(seed))

        def refine(
            config: NodeRefineConfig | LatentRefineConfig, scan: OrientedPoints = scan, start: Floats = fit.vectors
        ) -> Floats:
            if isinstance(config, NodeRefineConfig):
                return refine_nodes(system, scan, start, config)
            return refine_code(model, scan, config, np.random.default_rng(seed), start=start)

        if number == 0:  # warm up
            refine(replace(nodes, steps=2))
            refine(replace(code, steps=2))
        answers = {"network": Answer(fit.vectors, 0.0, 0.0, energy.value(fit.vectors))}
        order = [("code", code), ("nodes", nodes), *((name, replace(nodes, steps=k)) for name, k in FEWER.items())]
        for name, config in order[:: -1 if number % 2 else 1]:
            cpu, wall = time.process_time(), time.perf_counter()
            vectors = refine(config)  # type: ignore[arg-type]
            cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
            answers[name] = Answer(vectors, cpu, wall, energy.value(vectors))
        subjects.append(Subject(shape, fit, answers))
    return subjects


def _start(model: TrainedModel, shape: Shape, seed: int) -> tuple[Fit, OrientedPoints]:
    """The network's own fit, and samples of the shape in its core frame."""
    config = FitConfig(refine="none", seed=seed)
    fit = Matcher(model, config).fit(shape)
    samples = sample_surface(shape_of(fit).shape, config.samples, np.random.default_rng(seed))
    return fit, samples.in_frame(fit.frame)


def choose_shapes(model: TrainedModel, name: str, count: int, seed: int, data: Path) -> list[Shape]:
    """Generated bodies that share the template's vertices, or shapes of a set, evenly spread over its list.

    Raises
    ------
    OptionError
        No pair of the set is among so few shapes.
    """
    if name == "bodies":
        from meshmatch.experiments.makers.human_bodies import unseen_bodies

        bodies = unseen_bodies(model.template, count, model.card.seed, seed)
        return [Shape(verts, model.template.shape.faces, f"body {k}") for k, verts in enumerate(bodies)]
    bench = load_set(name, data)
    chosen = runner.spread(bench.shapes, count)
    if not set(permutations(chosen, 2)) & set(bench.pairs):
        raise OptionError(f"{name} has no pair among {', '.join(chosen)}", "take more with --shapes")
    return [bench.shape(shape) for shape in chosen]


def body_errors(model: TrainedModel, subjects: Sequence[Subject]) -> dict[str, float]:
    """Mean distance (cm) of the fitted template's vertices from their own places on generated bodies."""
    system = node_system(model)
    errors = {}
    for name in subjects[0].answers:
        distances = [
            np.linalg.norm(system.moved(each.answers[name].vectors) - each.fit.frame.apply(each.shape.verts), axis=1)
            for each in subjects
        ]
        errors[name] = float(np.mean([float(far.mean()) * CM_PER_UNIT for far in distances]))
    return errors


def pair_errors(
    model: TrainedModel, subjects: Sequence[Subject], name: str, data: Path, cache: Path | None
) -> dict[str, float]:
    """Mean geodesic error (cm) of the maps between all ordered pairs of the subjects, for each method."""
    bench, system, matcher = load_set(name, data), node_system(model), Matcher(model)
    by_name = {Path(subject.shape.name).stem: subject for subject in subjects}
    pairs = [pair for pair in permutations(by_name, 2) if pair in set(bench.pairs)]
    errors = {}
    for method in subjects[0].answers:
        fits = {}
        for key, subject in by_name.items():
            vectors = subject.answers[method].vectors
            fits[key] = replace(subject.fit, vectors=vectors, points=system.moved(vectors))
        maps = {(a, b): matcher.map(fits[a], fits[b], agree=False).index for a, b in pairs}
        errors[method] = evaluate_set(bench, maps, pairs=pairs, cache=cache).joined.mean_cm
    return errors


def rows_of(name: str, subjects: Sequence[Subject], errors: dict[str, float]) -> list[dict[str, Any]]:
    """A row for each method: means over the shapes; for nodes the ratio of times, and whether the bar is met; ``race`` marks
    the fewest steps that are no worse than the code.
    """
    rows: list[dict[str, Any]] = []
    for method in (name for name in METHODS if name in errors):
        answers = [subject.answers[method] for subject in subjects]
        means = {key: float(np.mean([getattr(each, key) for each in answers])) for key in ("cpu", "wall", "energy")}
        rows.append({"set": name, "method": method, "error_cm": errors[method], **means})
    code, *steps = rows[1:]
    for row in steps:
        row["times_as_fast"] = code["cpu"] / row["cpu"]
    nodes = steps[-1]
    nodes["met"] = nodes["times_as_fast"] >= BAR and nodes["error_cm"] < code["error_cm"]
    if winner := next((row for row in steps if row["error_cm"] <= code["error_cm"]), None):
        winner["race"] = "equal error"
    return rows


@runner.command
def main(
    sets: Annotated[str, Option(help="of bodies, shrec19, scape, faust")] = "bodies,faust,scape",
    shapes: Annotated[int, Option(min=2, help="of each set, evenly spread")] = 5,
    steps: Annotated[int, Option(min=1, help="Adam steps on the code")] = LatentRefineConfig().steps,
    model: runner.Model = "human",
    seed: runner.Seed = 0,
    data: runner.Data = runner.DATA,
    cache: runner.Cache = None,
) -> runner.Report:
    loaded = as_model(model)
    names = runner.names_of(sets, ("bodies", *SET_NAMES), "set")
    chosen = {name: choose_shapes(loaded, name, shapes, seed, data) for name in names}  # before the long work
    rows = []
    for name, some in chosen.items():
        subjects = refined(loaded, some, steps, seed)
        bodies = name == "bodies"
        errors = body_errors(loaded, subjects) if bodies else pair_errors(loaded, subjects, name, data, cache)
        rows += rows_of(name, subjects, errors)
    record = {"steps": {"nodes": NodeRefineConfig().steps, "code": steps}, "bar": BAR, "rows": rows}
    return runner.Report(record, [runner.table("Refinement from the same start, one thread", rows, COLUMNS)])


if __name__ == "__main__":
    sys.exit(main())
