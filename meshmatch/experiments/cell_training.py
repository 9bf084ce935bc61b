"""Train a cell for its budget, and measure it on shapes that it has not seen."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from meshmatch.experiments.cells import Cell, Setting
from meshmatch.experiments.pool import Pool, pool_of
from meshmatch.fields.field import Field
from meshmatch.maps.evaluate import CM_PER_UNIT
from meshmatch.models.deformer import Deformer
from meshmatch.models.encoder import BasisEncoder
from meshmatch.models.registry import CARD, WEIGHTS, read_card
from meshmatch.outputs import make_folder
from meshmatch.threads import set_threads
from meshmatch.training.loop import Trainer
from meshmatch.training.losses import LossPoints, validation_error
from meshmatch.training.setup import build_deformer, build_loss_points
from meshmatch.training.train import CardFacts, export


def train_cell(
    cell: Cell, setting: Setting, folder: Path, *, minutes: float = 0.0, steps: int = 0
) -> dict[str, Any]:
    """Train from the beginning, write a model folder, and say how it went.

    The budget is time or a number of steps. Time is the processor's where the network is on it, so that what else the
    machine does costs little; else the clock's. What is slow then learns less. The rate falls to 0 at the end of the
    budget.

    Returns
    -------
    dict
        ``steps``, ``seconds`` (of ``clock``), ``held_out_cm`` (the network alone), ``nodes``, ``rule``, ``model``
        (what tells its weights from others).
    """
    set_threads(setting.threads)
    template, recipe = setting.template(cell), setting.recipe(cell)
    pool = pool_of(setting, cell.pose)
    model = new_network(cell, setting, pool)
    points = build_loss_points(template, recipe.kernel, model, strained=setting.strained)
    trainer = Trainer(model, fewer(points, cell.supervised), recipe.train)
    on_cpu = trainer.device.type == "cpu"
    clock = time.process_time if on_cpu else time.monotonic
    model.train()
    began, spent = clock(), 0.0
    while trainer.step < steps if steps else spent < 60 * minutes:
        whole = steps or max(trainer.step + 1, round(trainer.step * 60 * minutes / max(spent, 1e-3)))
        trainer.config = replace(recipe.train, steps=whole)
        batch = pool.batch(trainer.step, recipe.train.shapes, cell.shapes, cell.seed, model.encoder)
        trainer.iterate(replace(batch, targets=batch.targets[:, : cell.supervised]))
        trainer.wait()
        spent = clock() - began
    trainer.seconds = spent
    trainer.config = recipe.train
    model.load_state_dict(trainer.averaged_state())
    held_out = validation_error(model, pool.held_out, points.to(trainer.device))
    make_folder(folder)
    category = "human" if setting.folder is None else Path(setting.folder).name
    facts = CardFacts("cell", category, f"{cell.shapes} shapes, scanned beforehand", licence="")
    export(trainer, template, folder, replace(recipe, storage="float16"), facts, held_out)
    return {
        "steps": trainer.step,
        "seconds": round(spent, 2),
        "clock": "processor" if on_cpu else "wall",
        "device": str(trainer.device),
        "held_out_cm": round(held_out * CM_PER_UNIT, 4),
        "nodes": template.K,
        "rule": setting.rule(cell),
        "model": read_card(folder / CARD).weights_sha256,
    }


def new_network(cell: Cell, setting: Setting, pool: Pool) -> Deformer:
    """A cell's untrained network; its encoder's basis points are those of the pool, whatever the seed."""
    template, recipe = setting.template(cell), setting.recipe(cell)
    model = build_deformer(template, pool.source, recipe.network, recipe.scan, recipe.kernel, cell.seed)
    if isinstance(model.encoder, BasisEncoder):
        with torch.no_grad():
            model.encoder.basis.copy_(pool.basis)
    return model


def fewer(points: LossPoints, supervised: int) -> LossPoints:
    """The first loss points alone, of a linear field; regularised where all would be."""
    if supervised >= len(points.positions):
        return points
    field = points.field
    assert isinstance(field, Field)
    return LossPoints(points.positions[:supervised], Field(field.phi[:supervised], field.gradient))


def is_trained(folder: Path, found: dict[str, Any]) -> bool:
    """Whether the model folder is the one that a record tells of."""
    if not (folder / CARD).is_file() or not (folder / WEIGHTS).is_file():
        return False
    return read_card(folder / CARD).weights_sha256 == found.get("model")
