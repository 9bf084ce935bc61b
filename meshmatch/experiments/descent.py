"""Figure 6: error against steps and seconds of refinement, ours and 3D-CODED's, on bodies that nobody learned from.

All start from their network's own answer in the frame of the true core. Errors are mean distances of the template's
vertices from where they belong, in cm at 1.9 m2 of skin; seconds are of the processor.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from meshmatch.experiments.ablation_cells import CODED
from meshmatch.experiments.cell_errors import Measure, Start, refined, refinement_of
from meshmatch.experiments.cells import BASE, Cell, Setting
from meshmatch.fitting.latent import LatentRefineConfig
from meshmatch.fitting.network_fit import Predictor
from meshmatch.fitting.nodes import NodeRefineConfig
from meshmatch.fitting.system import node_system
from meshmatch.geometry.frames import kabsch
from meshmatch.maps.evaluate import CM_PER_UNIT
from meshmatch.models.trained import TrainedModel
from meshmatch.shapes.normalise import sqrt_area_frame
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape

CODE_STEPS = (0, 10, 30, 100, 300)
NODE_STEPS = (0, 1, 2, 4, 7, 10)


@dataclass(frozen=True)
class Line:
    """One line of the figure: words, whose model, by which method, after how many steps."""

    words: str
    cell: Cell
    method: str
    steps: tuple[int, ...]


LINES = (
    Line("ours, nodes (Gauss-Newton)", BASE, "nodes", NODE_STEPS),
    Line("ours, code (Adam)", BASE, "code", CODE_STEPS),
    Line("3D-CODED, code (Adam)", CODED, "chamfer", CODE_STEPS),
)


def descend(
    models: dict[Cell, TrainedModel],
    setting: Setting,
    measure: Measure,
    bodies: int,
    lines: Sequence[Line] = LINES,
) -> dict[str, Any]:
    """For each line ``steps``, ``seconds`` a body and, by step count, the error of each body in cm."""
    found: dict[str, Any] = {}
    _, unseen = setting.sources(BASE.pose)
    drawn = unseen(bodies, torch.Generator().manual_seed(5)).double().numpy()
    for line in lines:
        model = models[line.cell]
        starts = [_start(model, verts, measure) for verts in drawn]
        how = refinement_of(line.cell, line.method, measure)
        assert how is not None
        errors, seconds = [], []
        for steps in line.steps:
            began = time.process_time()
            rows = [_after(model, start, how, steps, measure.seed) for start, _ in starts]
            seconds.append(round((time.process_time() - began) / bodies, 4))
            errors.append([_error(model, each, true) for each, (_, true) in zip(rows, starts, strict=True)])
        found[line.words] = {"steps": list(line.steps), "seconds": seconds, "errors_cm": errors}
    return found


def _after(model: TrainedModel, start: Start, how: Any, steps: int, seed: int) -> np.ndarray:
    if steps == 0:
        return start.candidate.vectors
    changed: LatentRefineConfig | NodeRefineConfig = replace(how, steps=steps)
    return refined(model, start, changed, seed)


def _start(model: TrainedModel, verts: np.ndarray, measure: Measure) -> tuple[Start, np.ndarray]:
    """The network's own answer, and where the template's vertices (V, 3) belong in its frame."""
    template = model.template
    shape = Shape(verts, template.shape.faces, "body")
    frame = sqrt_area_frame(shape)
    places = frame.apply(verts)
    samples = sample_surface(shape, measure.samples, np.random.default_rng(measure.seed))
    scan = samples.in_frame(frame)
    pose = kabsch(template.shape.verts[template.core], places[template.core])
    rng = np.random.default_rng(measure.seed)
    found = Predictor.of(model, rng).fit(scan, pose, rounds=1)
    local = scan.to_local(found.pose)
    return Start(frame, local, found), found.pose.to_local(places)


def _error(model: TrainedModel, rows: np.ndarray, true: np.ndarray) -> float:
    apart = np.linalg.norm(node_system(model).moved(rows) - true, axis=1)
    return round(float(apart.mean()) * CM_PER_UNIT, 4)
