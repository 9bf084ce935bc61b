"""Refinement of nodes against the paper's search over codes.

Both start from the same node vectors, the network's own answer in the orientation that a fit finds, and see the same
samples of generated bodies of people that no training drew, in one process with one thread, taking turns at going first.

- code: 2,000 Adam steps on the shape code, Chamfer distance (3,000 points each way) plus volume and rigidity with the
  paper's weights; the best step of all is returned.
- nodes: the steps of least squares that `meshmatch match` ends with, on all samples; also fewer of them.

Measured is the refinement alone, in CPU seconds, after one warm-up of each; what is computed once per template is counted
for neither. The error is the mean distance of the fitted template's vertices from where they belong, in centimeters at
1.9 m2 of skin.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Any

import numpy as np
from typer import Option

from meshmatch.api.inputs import as_model
from meshmatch.api.matching import Matcher
from meshmatch.api.results import shape_of
from meshmatch.arrays import Floats
from meshmatch.experiments import runner
from meshmatch.experiments.makers.human_bodies import unseen_bodies
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import FitConfig, NodeRefineConfig
from meshmatch.fitting.search.latent import LatentRefineConfig, refine_code
from meshmatch.fitting.solve.nodes import refine_nodes
from meshmatch.fitting.solve.system import node_system
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.maps.evaluate import CM_PER_UNIT
from meshmatch.models.trained import TrainedModel
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape

FEWER = {"nodes, 1 step": 1, "nodes, 2 steps": 2, "nodes, 4 steps": 4}
COLUMNS = {"refinement": "method", "CPU s a shape": "cpu:.3f", "mean error cm": "error_cm:.2f", "times": "times:.0f"}
Refinement = NodeRefineConfig | LatentRefineConfig | None


def refined(model: TrainedModel, how: Refinement, scan: OrientedPoints, start: Floats, seed: int) -> Floats:
    """Node vectors after a refinement; the given ones after none."""
    if how is None:
        return start
    if isinstance(how, NodeRefineConfig):
        return refine_nodes(node_system(model), scan, start, how)
    return refine_code(model, scan, how, np.random.default_rng(seed), start=start)


def started(model: TrainedModel, shape: Shape, seed: int) -> tuple[Fit, OrientedPoints]:
    """The network's own fit, and samples of the shape in its core frame."""
    config = FitConfig(refine="none", seed=seed)
    fit = Matcher(model, config).fit(shape)
    samples = sample_surface(shape_of(fit).shape, config.samples, np.random.default_rng(seed))
    return fit, samples.in_frame(fit.frame)


def measured(model: TrainedModel, shapes: Sequence[Shape], steps: int, seed: int) -> list[dict[str, Any]]:
    """A row for each method, means over bodies that have the template's vertices; ``times``: as fast as the code's."""
    nodes, code = NodeRefineConfig(), LatentRefineConfig(steps=steps)
    ways: dict[str, Refinement] = {"network": None, "code": code}
    ways |= {name: replace(nodes, steps=few) for name, few in FEWER.items()} | {"nodes": nodes}
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in ways}
    for number, shape in enumerate(runner.track(shapes, "refining")):
        fit, scan = started(model, shape, seed)
        if number == 0:  # warm up
            for short in (replace(nodes, steps=2), replace(code, steps=2)):
                refined(model, short, scan, fit.vectors, seed)
        for name in list(ways)[:: -1 if number % 2 else 1]:
            began = time.process_time()
            vectors = refined(model, ways[name], scan, fit.vectors, seed)
            seconds = time.process_time() - began
            off = np.linalg.norm(node_system(model).moved(vectors) - fit.frame.apply(shape.verts), axis=1)
            found[name].append((seconds, CM_PER_UNIT * float(off.mean())))
    rows = [dict(zip(("cpu", "error_cm"), np.mean(each, axis=0).tolist(), strict=True)) for each in found.values()]
    return [
        {"method": name, **row, "times": rows[1]["cpu"] / row["cpu"] if number > 1 else None}
        for number, (name, row) in enumerate(zip(ways, rows, strict=True))
    ]


@runner.command
def main(
    shapes: Annotated[int, Option(min=1, help="generated bodies")] = 5,
    steps: Annotated[int, Option(min=1, help="Adam steps on the code")] = LatentRefineConfig().steps,
    model: runner.Model = "human",
    seed: runner.Seed = 0,
) -> runner.Report:
    loaded = as_model(model)
    template = loaded.template
    bodies = unseen_bodies(template, shapes, loaded.card.seed, seed)
    rows = measured(loaded, [Shape(verts, template.shape.faces, "body") for verts in bodies], steps, seed)
    return runner.Report({"rows": rows}, [runner.table("Refinement from the same start, one thread", rows, COLUMNS)])


if __name__ == "__main__":
    sys.exit(main())
