"""TransMatch as an ablation run: its transformer learns from the scans that all runs have, in as many steps.

Nothing is refined, for it has no code; like every other network it is asked twice, from where its first answer puts the core
frame the second time.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from meshmatch.arrays import Float, Floats
from meshmatch.experiments.paper.ablation_errors import Measure, Subject, in_core_frame, scored
from meshmatch.experiments.paper.ablation_setting import Setting, pool_of
from meshmatch.experiments.paper.ablation_views import Run
from meshmatch.experiments.paper.learned_baselines import (
    TARGETS,
    TransBatch,
    TransModel,
    load_transmatch,
    train_transmatch,
)
from meshmatch.experiments.paper.transformer import TransConfig
from meshmatch.geometry.frames import kabsch
from meshmatch.maps.evaluate import CM_PER_UNIT
from meshmatch.threads import set_threads
from meshmatch.training.datasets import step_generator
from meshmatch.training.train import loss_vertices

_POINTS, _ROUNDS = 1024, 2


def train_transformer(
    run: Run, setting: Setting, folder: Path, *, steps: int, config: TransConfig | None = None
) -> dict[str, Any]:
    """Train, or go on exactly where it was stopped, write a folder of TransMatch, and say how it went, as `train_run` does.

    ``seconds`` are those of this call alone.
    """
    set_threads(setting.threads)
    template, train = setting.resting(run.pose), replace(setting.recipe(run).train, steps=steps)
    pool, supervised = pool_of(setting, run.pose, read_points=True), torch.from_numpy(loss_vertices(template))

    def draw(step: int) -> TransBatch:
        scans = pool.rows(step, train.shapes, run.shapes, run.seed)
        told = torch.randperm(min(run.supervised, len(supervised)), generator=step_generator(run.seed, step))[:TARGETS]
        return TransBatch(pool.points[scans], supervised[told], pool.targets[scans][:, told])

    clock = time.monotonic if torch.cuda.is_available() else time.process_time
    began = clock()
    words = train_transmatch(folder, template, draw, train, config, {"run": asdict(run), "setting": asdict(setting)})
    seconds = clock() - began
    model = load_transmatch(folder)
    rest = torch.from_numpy(template.shape.verts.astype(np.float32))[supervised]
    with torch.inference_mode():
        off = (rest + model.network(pool.held_out.points, rest) - pool.held_out.targets).double().norm(dim=-1).mean(1)
    bodies = CM_PER_UNIT * off
    return {
        "steps": words["steps"],
        "seconds": round(seconds, 2),
        "clock": "wall" if torch.cuda.is_available() else "processor",
        "held_out_cm": round(float(bodies.mean()), 4),
        "bodies_cm": bodies.round(decimals=3).tolist(),
        "model": words["weights_sha256"],
    }


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
    for round_ in range(_ROUNDS):
        points = scan.drawn(_POINTS, np.random.default_rng([measure.seed, round_]))
        with torch.inference_mode():
            at = torch.from_numpy(rest.astype(np.float32))
            there = (at + model.network(torch.from_numpy(points).float()[None], at)[0]).double().numpy()
        if round_ < _ROUNDS - 1:
            pose = kabsch(rest[core], there[core])
            frame, scan = frame.compose(pose.frame), scan.to_local(pose)
    return frame.undo(there)
