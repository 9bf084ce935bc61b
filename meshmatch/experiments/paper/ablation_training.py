"""Train an ablation run for its budget and measure it on shapes that it has not seen; iterations under the clock."""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from meshmatch.arrays import Float
from meshmatch.experiments.paper.ablation_setting import Pool, Setting, pool_of
from meshmatch.experiments.paper.ablation_views import Run
from meshmatch.experiments.paper.learned_baselines import (
    TARGETS,
    TransBatch,
    TransConfig,
    load_transmatch,
    train_transmatch,
)
from meshmatch.fields.field import Field, PointField, PointwiseField
from meshmatch.maps.evaluate import CM_PER_UNIT
from meshmatch.models.deformer import Deformer
from meshmatch.models.layers import BasisEncoder
from meshmatch.models.registry import CARD, read_card
from meshmatch.outputs import make_folder
from meshmatch.threads import set_threads
from meshmatch.training.datasets import Batch, step_generator
from meshmatch.training.loop import Trainer
from meshmatch.training.losses import LossPoints, held_out_error
from meshmatch.training.train import CardFacts, build_dataset, build_deformer, build_loss_points, export, loss_vertices

_BATCHES = 2


def train_run(run: Run, setting: Setting, folder: Path, *, minutes: float = 0.0, steps: int = 0) -> dict[str, Any]:
    """Train from the beginning, write a model folder, and say how it went.

    The budget is time or a number of steps. Time is the processor's where the network is on it, so that what else the
    machine does costs little; else the clock's. What is slow then learns less. The rate falls to 0 at the end of the
    budget.

    Returns
    -------
    dict
        ``steps``, ``seconds`` (of ``clock``), ``held_out_cm`` (the network alone), ``bodies_cm`` (of each body),
        ``nodes``, ``rule``, ``model`` (what tells its weights from others).
    """
    set_threads(setting.threads)
    template, recipe = setting.template(run), setting.recipe(run)
    pool = pool_of(setting, run.pose)
    model = new_network(run, setting, pool)
    points = build_loss_points(template, recipe.kernel, model, gradients=setting.strained)
    trainer = Trainer(model, fewer(points, run.supervised), recipe.train)
    on_cpu = trainer.device.type == "cpu"
    clock = time.process_time if on_cpu else time.monotonic
    model.train()
    began, spent = clock(), 0.0
    while trainer.step < steps if steps else spent < 60 * minutes:
        whole = steps or max(trainer.step + 1, round(trainer.step * 60 * minutes / max(spent, 1e-3)))
        trainer.config = replace(recipe.train, steps=whole)
        batch = pool.batch(trainer.step, recipe.train.shapes, run.shapes, run.seed, model.encoder)
        trainer.iterate(replace(batch, targets=batch.targets[:, : run.supervised]))
        _wait(trainer)
        spent = clock() - began
    trainer.seconds = spent
    trainer.config = recipe.train
    model.load_state_dict(trainer.averaged_state())
    loss_points = points.to(trainer.device)
    held_out = held_out_error(model, pool.held_out, loss_points)
    bodies = CM_PER_UNIT * body_errors(model, pool.held_out, loss_points)
    make_folder(folder)
    facts = CardFacts("run", "human", f"{run.shapes} shapes, scanned beforehand", licence="")
    export(trainer, template, folder, replace(recipe, storage="float16"), facts, held_out)
    return {
        "steps": trainer.step,
        "seconds": round(spent, 2),
        "clock": "processor" if on_cpu else "wall",
        "device": str(trainer.device),
        "held_out_cm": round(held_out * CM_PER_UNIT, 4),
        "bodies_cm": bodies.round(decimals=3).tolist(),
        "nodes": template.K,
        "rule": setting.rule(run),
        "model": read_card(folder / CARD).weights_sha256,
    }


@torch.no_grad()
def body_errors(model: Deformer, batch: Batch, points: LossPoints) -> Float[torch.Tensor, " B"]:
    """Mean distance of the template's points from their places on each body (units of sqrt(area)), float64."""
    was = model.training
    model.eval()
    batch = batch.to(points.positions.device)
    off = points.moved(model(batch.points)) - batch.targets
    model.train(was)
    return off.double().norm(dim=-1).mean(1).cpu()


def _wait(trainer: Trainer) -> None:
    """Until a GPU has done what it was asked: it works on while Python does, and clocks must not."""
    if trainer.device.type == "cuda":
        torch.cuda.synchronize(trainer.device)


def new_network(run: Run, setting: Setting, pool: Pool) -> Deformer:
    """A run's untrained network; its encoder's basis points are those of the pool, whatever the seed."""
    template, recipe = setting.template(run), setting.recipe(run)
    model = build_deformer(template, pool.source, recipe.network, recipe.scan, recipe.kernel, run.seed)
    if isinstance(model.encoder, BasisEncoder):
        with torch.no_grad():
            model.encoder.basis.copy_(pool.basis)
    return model


def fewer(points: LossPoints, supervised: int) -> LossPoints:
    """The first loss points alone; regularised where all would be."""
    if supervised >= len(points.positions):
        return points
    field: PointField = points.field
    if isinstance(field, PointwiseField):
        field = replace(field, points=field.points[:supervised])
    else:
        field = Field(field.phi[:supervised], field.gradient)
    return LossPoints(points.positions[:supervised], field)


def built(setting: Setting, run: Run) -> tuple[Trainer, list[Any]]:
    """A trainer at its first step, and batches for it."""
    chosen, template, source = setting.recipe(run), setting.template(run), setting.sources(run.pose)[0]
    train = chosen.train
    model = build_deformer(template, source, chosen.network, chosen.scan, chosen.kernel, train.seed)
    points = build_loss_points(template, chosen.kernel, model, gradients=setting.strained)
    trainer = Trainer(model, fewer(points, run.supervised), train)
    data = build_dataset(
        template, source, model, chosen.scan, train.shapes, train.scans_per_shape, train.seed, _BATCHES
    )
    trainer.model.train()
    batches = [data[number].to(trainer.device) for number in range(_BATCHES)]
    return trainer, [replace(each, targets=each.targets[:, : run.supervised]) for each in batches]


def timed(setting: Setting, runs: Sequence[Run], rounds: int) -> dict[str, dict[str, Any]]:
    """Milliseconds of an iteration, by name of the run: forward, backward and the optimizer's step, batches at hand.

    All are in one process and take turns: in each round every run does one iteration, each round beginning with another,
    so that what else the machine does disturbs all alike. One round before the first does not count.
    """
    set_threads(setting.threads)
    ready = [(run, *built(setting, run)) for run in runs]
    wall: dict[str, list[float]] = {run.name: [] for run in runs}
    cpu: dict[str, list[float]] = {run.name: [] for run in runs}
    for turn in range(-1, rounds):
        first = max(turn, 0) % len(ready)
        for run, trainer, batches in ready[first:] + ready[:first]:
            _wait(trainer)
            began, worked = time.perf_counter(), time.process_time()
            trainer.iterate(batches[turn % _BATCHES])
            _wait(trainer)
            if turn >= 0:
                wall[run.name].append(1e3 * (time.perf_counter() - began))
                cpu[run.name].append(1e3 * (time.process_time() - worked))
    device = str(ready[0][1].device)
    return {
        run.name: {
            "ms": round(statistics.median(wall[run.name]), 3),
            "cpu_ms": round(statistics.median(cpu[run.name]), 3),
            "rounds": rounds,
            "device": device,
        }
        for run in runs
    }


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
