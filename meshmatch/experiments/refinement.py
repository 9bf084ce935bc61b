"""Gauss-Newton on the nodes against the paper's refinement: ``python -m meshmatch.experiments.refinement``.

Both start from the same node vectors, the network's own answer in the orientation that `Fitter` finds, and see
the same samples of the same shapes, in one process with one thread, taking turns at going first.

- *code*: 2,000 Adam steps on the shape code, Chamfer distance (3,000 points each way) plus volume and rigidity with
  the paper's weights. Its neighbours come from KD-trees, only the code's gradient is computed, the template's shape
  functions and their transposes are kept, and the best step of all is returned: no cost is left in it that we know
  how to avoid.
- *nodes*: the Gauss-Newton steps that `meshmatch match` ends with, on all samples.

Measured is the refinement alone, after one warm-up of each; what is computed once per template is not counted for
either. Times are CPU seconds, which other programs on the machine disturb least; the clock's are in the JSON line.
Errors are in centimetres at 1.9 m2 of skin. On ``bodies`` (generated, of people that training never drew): the mean
distance of the fitted template's vertices from where they belong. On ``shrec19``, ``scape``, ``faust``: the mean
geodesic error of the maps between all ordered pairs of the shapes, through the fits. The energy is the paper's, of
both answers on the same points.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from meshmatch.errors import OptionError
from meshmatch.experiments.distances import default_folder
from meshmatch.experiments.protocols import load_set
from meshmatch.experiments.report import circumstances, status_of, wide_console
from meshmatch.experiments.scores import evaluate_set
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.fitter import Fitter
from meshmatch.fitting.latent import LatentRefineConfig, PaperEnergy, refine_code
from meshmatch.fitting.nodes import NodeRefineConfig, refine_nodes
from meshmatch.fitting.system import node_system
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.maps.evaluate import CM_PER_UNIT
from meshmatch.models.trained import TrainedModel
from meshmatch.pipeline import map_between, read_model, usable
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape
from meshmatch.threads import set_threads

METHODS = ("network", "code", "nodes")
BAR = 50.0
"""How many times faster than the search over codes the Gauss-Newton steps have to be, at a lower error."""


@dataclass(frozen=True, eq=False)
class Answer:
    """What one method made of one shape: node vectors (K, 3), seconds of CPU and on the clock, the paper's energy."""

    vectors: np.ndarray
    cpu: float
    wall: float
    energy: float


@dataclass(frozen=True, eq=False)
class Subject:
    """A shape, the network's fit of it, its samples in the fit's core frame, and what each method made of it."""

    shape: Shape
    fit: Fit
    answers: dict[str, Answer]


def refined(
    model: TrainedModel, shapes: Sequence[Shape], steps: int, seed: int, tell: Callable[[int], None]
) -> list[Subject]:
    """Every shape refined both ways from the same start; ``tell`` hears how many are done."""
    nodes, code = NodeRefineConfig(), LatentRefineConfig(steps=steps)
    system = node_system(model)
    subjects = []
    for number, shape in enumerate(shapes):
        fit, scan = _start(model, shape, seed)
        energy = PaperEnergy(model, scan, code, np.random.default_rng(seed))

        def by_nodes(config: NodeRefineConfig, scan: OrientedPoints = scan, fit: Fit = fit) -> np.ndarray:
            return refine_nodes(system, scan, fit.vectors, config)

        def by_code(config: LatentRefineConfig, scan: OrientedPoints = scan, fit: Fit = fit) -> np.ndarray:
            rng = np.random.default_rng(seed)
            return refine_code(model, scan, config, rng, start=fit.vectors)

        if number == 0:  # warm up
            by_nodes(replace(nodes, steps=2))
            by_code(replace(code, steps=2))
        timed = {"nodes": lambda by=by_nodes: by(nodes), "code": lambda by=by_code: by(code)}
        answers = {"network": Answer(fit.vectors, 0.0, 0.0, energy.value(fit.vectors))}
        for name in sorted(timed, reverse=number % 2 == 1):
            cpu, wall = time.process_time(), time.perf_counter()
            vectors = timed[name]()
            cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
            answers[name] = Answer(vectors, cpu, wall, energy.value(vectors))
        subjects.append(Subject(shape, fit, answers))
        tell(number + 1)
    return subjects


def _start(model: TrainedModel, shape: Shape, seed: int) -> tuple[Fit, OrientedPoints]:
    """The network's own fit, and samples of the shape in its core frame."""
    clean = usable(shape).shape
    config = FitConfig(refine="none", seed=seed)
    fit = Fitter(model, config).fit(clean)
    samples = sample_surface(clean, config.samples, np.random.default_rng(seed))
    return fit, samples.in_frame(fit.frame)


def choose_shapes(model: TrainedModel, name: str, count: int, seed: int, data: Path) -> list[Shape]:
    """Generated bodies, or shapes of a set, evenly spread over its list.

    Raises
    ------
    OptionError
        There is no such set, or no pair of it is among so few shapes.
    """
    if name == "bodies":
        return draw_bodies(model, count, seed)
    bench = load_set(name, data)
    spread = np.linspace(0, len(bench.shapes) - 1, min(count, len(bench.shapes))).round().astype(int)
    chosen = [bench.shapes[k] for k in spread]
    if not set(permutations(chosen, 2)) & set(bench.pairs):
        raise OptionError(f"{name} has no pair among {', '.join(chosen)}", "take more with --shapes")
    return [bench.shape(shape) for shape in chosen]


def draw_bodies(model: TrainedModel, count: int, seed: int) -> list[Shape]:
    """Generated bodies that share the template's vertices."""
    from meshmatch.training.bodies import unseen_bodies

    bodies = unseen_bodies(model.template, count, model.card.seed, seed)
    return [Shape(verts, model.template.shape.faces, f"body {k}") for k, verts in enumerate(bodies)]


def body_errors(model: TrainedModel, subjects: Sequence[Subject]) -> dict[str, float]:
    """Mean distance (cm) of the fitted template's vertices from their own places on generated bodies."""
    system = node_system(model)
    errors: dict[str, list[float]] = {name: [] for name in METHODS}
    for subject in subjects:
        places = subject.fit.frame.apply(subject.shape.verts)
        for name in METHODS:
            apart = np.linalg.norm(system.moved(subject.answers[name].vectors) - places, axis=1)
            errors[name].append(float(apart.mean()) * CM_PER_UNIT)  # the frame's unit is sqrt(area)
    return {name: float(np.mean(values)) for name, values in errors.items()}


def pair_errors(
    model: TrainedModel, subjects: Sequence[Subject], name: str, data: Path, cache: Path | None
) -> dict[str, float]:
    """Mean geodesic error (cm) of the maps between all ordered pairs of the subjects, for each method."""
    bench, system = load_set(name, data), node_system(model)
    by_name = {Path(subject.shape.name).stem: subject for subject in subjects}
    errors = {}
    for method in METHODS:
        fits = {}
        for key, subject in by_name.items():
            vectors = subject.answers[method].vectors
            fits[key] = replace(subject.fit, vectors=vectors, points=system.moved(vectors))
        pairs = [pair for pair in permutations(by_name, 2) if pair in set(bench.pairs)]
        maps = {
            (a, b): map_between(by_name[a].shape, fits[a], by_name[b].shape, fits[b]).index for a, b in pairs
        }
        scores = evaluate_set(bench, maps, cache=cache or default_folder(), pairs=pairs)
        errors[method] = scores.joined.mean_cm
    return errors


def run(
    sets: Sequence[str],
    *,
    shapes: int,
    steps: int,
    model: str,
    seed: int,
    data: Path,
    cache: Path | None = None,
) -> dict[str, Any]:
    """Refine, measure, print a table and a JSON line; the line's record is returned too."""
    set_threads(1)
    loaded = read_model(model)
    console = Console(stderr=True)
    table = Table(title="Refinement from the same start, one thread", title_justify="left")
    for name in ("set", "method", "CPU s a shape", "mean error, cm", "paper's energy", "times as fast"):
        table.add_column(name, justify="left" if name in ("set", "method") else "right")
    records: dict[str, Any] = {}
    # all sets are found before the first long work
    for each, chosen in [(each, choose_shapes(loaded, each, shapes, seed, data)) for each in sets]:
        with console.status(f"{each}: refining {len(chosen)} shapes, half a minute each") as status:

            def tell(done: int, status: Any = status, each: str = each) -> None:
                status.update(f"{each}: refined {done} shapes")

            subjects = refined(loaded, chosen, steps, seed, tell)
            status.update(f"{each}: measuring")
            bodies = each == "bodies"
            errors = (
                body_errors(loaded, subjects) if bodies else pair_errors(loaded, subjects, each, data, cache)
            )
        record = records[each] = _record(subjects, errors)
        for method in METHODS:
            part = record[method]
            numbers = f"{part['cpu']:.3f}", f"{part['error_cm']:.2f}", f"{part['energy']:.6f}"
            faster = f"{record['times_as_fast']:.0f}" if method == "nodes" else ""
            table.add_row(each if method == "network" else "", method, *numbers, faster)
    wide_console().print(table)
    whole = {
        "benchmark": "refinement",
        **circumstances(threads=1, jobs=1),
        "model": model,
        "seed": seed,
        "steps": {"nodes": NodeRefineConfig().steps, "code": steps},
        "bar": BAR,
        "sets": records,
    }
    print(json.dumps(whole), flush=True)
    return whole


def _record(subjects: Sequence[Subject], errors: dict[str, float]) -> dict[str, Any]:
    """Means over the shapes, the ratio of the total times, and whether the bar is met."""
    record: dict[str, Any] = {"shapes": [subject.shape.name for subject in subjects]}
    for name in METHODS:
        answers = [subject.answers[name] for subject in subjects]
        record[name] = {
            "cpu": float(np.mean([answer.cpu for answer in answers])),
            "wall": float(np.mean([answer.wall for answer in answers])),
            "energy": float(np.mean([answer.energy for answer in answers])),
            "error_cm": errors[name],
        }
    record["times_as_fast"] = record["code"]["cpu"] / record["nodes"]["cpu"]
    record["met"] = record["times_as_fast"] >= BAR and errors["nodes"] < errors["code"]
    return record


def main(words: Sequence[str] | None = None) -> int:
    """Run the benchmark; 0 when it ran, 1 when the data or the choice stopped it."""
    parser = argparse.ArgumentParser("python -m meshmatch.experiments.refinement", description=__doc__)
    parser.add_argument(
        "--sets", default="bodies,faust,scape", help="of bodies, shrec19, scape, faust; %(default)s"
    )
    parser.add_argument("--shapes", type=int, default=5, help="of each set, evenly spread")
    parser.add_argument(
        "--steps", type=int, default=LatentRefineConfig().steps, help="Adam steps on the code"
    )
    parser.add_argument("--model", default="human")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--data", type=Path, default=Path("../shared/bench"), help="the benchmark's data")
    parser.add_argument("--cache", type=Path, help="folder of kept geodesic distances")
    options = parser.parse_args(words)
    if options.shapes < 2 or options.steps < 1 or options.seed < 0:
        parser.error("at least two shapes, one step and a seed of 0 or more are needed")
    return status_of(
        lambda: run(
            options.sets.split(","),
            shapes=options.shapes,
            steps=options.steps,
            model=options.model,
            seed=options.seed,
            data=options.data,
            cache=options.cache,
        )
    )


if __name__ == "__main__":
    sys.exit(main())
