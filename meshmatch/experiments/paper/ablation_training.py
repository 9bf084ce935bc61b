"""Ablation runs: their recipe, template and shapes; trained and measured on shapes that no run has seen; iterations under
the clock.

Simulating a scan costs several times what learning from it does in a small network. So a fixed number of shapes is
scanned a few times each beforehand, once for all runs, and a run that has fewer shapes has the first ones.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from meshmatch.arrays import Float
from meshmatch.errors import TemplateError
from meshmatch.experiments.makers.human_bodies import diameter, heavy
from meshmatch.experiments.paper.ablation_views import BASE, HEAVY, TABLE3, Run
from meshmatch.fields.field import Field, PointField, PointwiseField
from meshmatch.generators.bodies import human_source
from meshmatch.generators.generator import Source
from meshmatch.maps.evaluate import CM_PER_UNIT
from meshmatch.models.card import read_card
from meshmatch.models.deformer import Deformer
from meshmatch.models.layers import BasisEncoder
from meshmatch.models.network import NetworkConfig
from meshmatch.models.registry import CARD
from meshmatch.outputs import make_folder
from meshmatch.templates.make import NodeConfig, Strategy, lay_nodes
from meshmatch.templates.template import Template, read_template, template_radius
from meshmatch.threads import set_threads
from meshmatch.training.datasets import Batch
from meshmatch.training.loop import TrainConfig, Trainer
from meshmatch.training.losses import CorrespondenceLoss, LossPoints, held_out_error
from meshmatch.training.recipes import Recipe
from meshmatch.training.scans import ScanConfig
from meshmatch.training.train import CardFacts, build_dataset, build_deformer, build_loss_points, export

_BATCHES = 2
SCANS = 4
"""How often each shape is scanned."""
HELD_OUT_SHAPES = 64
_BLOCK = 50
_SEED, _UNSEEN = 17, 999_983

SMALL = Recipe(
    NetworkConfig(code=256, width=384, depth=2, basis=512, align_basis=0, corrections=0),
    TrainConfig(
        shapes=32,
        scans_per_shape=1,
        warm_up=20,
        decay=0.6,
        average=0.99,
        workers=0,
        loss=CorrespondenceLoss(volume=2e-3, arap=2e-3, blend=1e-3, robust=True),
    ),
    ScanConfig(points=1024, holes=0.0, outliers=0.0, partial=0.0),
    "smooth",
)
"""The recipe of all runs, for minutes of one core."""
STRAINED = 200
"""At how many of the loss points the energies of the regularisers are taken."""


Loss = Literal["paper", "ours"]


@dataclass(frozen=True)
class Setting:
    """What all runs share; plain values, so that a process of its own can be told.

    Parameters
    ----------
    batch : int, optional
        Shapes of a step; None for the recipe's.
    loss
        "ours", or "paper": mean squared distances, and the weights of its table 1 for lengths in the unit sphere.
    """

    threads: int = 1
    batch: int | None = None
    loss: Loss = "paper"

    def recipe(self, run: Run) -> Recipe:
        """`SMALL` with the run's choices; constraints that it does not have weigh nothing.

        No network has an aligner or learned corrections: the orientation is given, the same to all runs, and what is
        compared is the deformation.
        """
        given = SMALL.train.loss if self.loss == "ours" else _paper_loss(self.resting(run.pose))
        if run.constraint == TABLE3:
            given = replace(given, volume=1e-4, arap=1e-2, blend=1.0)
        loss = replace(
            given,
            volume=given.volume if "vol" in run.constraint else 0.0,
            arap=given.arap if "arap" in run.constraint else 0.0,
            blend=given.blend if "Z" in run.constraint else 0.0,
        )
        shapes = self.batch or SMALL.train.shapes
        train = replace(SMALL.train, loss=loss, shapes=shapes, threads=self.threads, seed=run.seed)
        return replace(SMALL, network=replace(SMALL.network, field=run.field), train=train, kernel=run.kernel)

    def template(self, run: Run) -> Template:
        """The template with the run's nodes, chosen by its `rule`: as many as it says, their radii grown where vertices
        lack some.

        Raises
        ------
        TemplateError
            Nodes of this number and radius do not carry it.
        """
        return self._chosen(run)[0]

    def rule(self, run: Run) -> Strategy:
        """By which rule its nodes are chosen: its own, or none ("uniform") where that one leaves too few."""
        return self._chosen(run)[1]

    def _chosen(self, run: Run) -> tuple[Template, Strategy]:
        resting = self.resting(run.pose)
        return _with_nodes(resting, run.nodes, run.radius * diameter(resting.shape), run.strategy)

    def resting(self, pose: str) -> Template:
        """The template in a pose, with the nodes that it came with; of other people in "T-heavy"."""
        return _resting(pose)

    def sources(self, pose: str) -> tuple[Source, Source]:
        """What draws shapes to learn from, and shapes of people that nobody learned from."""
        template = self.resting(pose)
        return human_source(template, 1024, 0), human_source(template, 64, 1)


def _paper_loss(template: Template) -> CorrespondenceLoss:
    """The paper's, for lengths in units of sqrt(area)."""
    return CorrespondenceLoss(reconstruction=1 / template_radius(template) ** 2)


@lru_cache(maxsize=4)
def _resting(pose: str) -> Template:
    template = read_template(f"human-{pose.removesuffix(HEAVY)}")
    return heavy(template) if pose.endswith(HEAVY) else template


@lru_cache(maxsize=32)
def _with_nodes(template: Template, K: int, radius: float, strategy: Strategy) -> tuple[Template, Strategy]:
    for rule in dict.fromkeys((strategy, "uniform")):
        try:
            laid = lay_nodes(template.shape, NodeConfig(rule, K, radius, grow=True), template.labels)
            return replace(template, nodes=laid.nodes, radius=laid.radius), rule
        except TemplateError:
            if rule == "uniform":
                raise
    raise AssertionError


@dataclass(frozen=True, eq=False)
class Pool:
    """Scans of N shapes, `SCANS` each, one after the other.

    Parameters
    ----------
    features : of the basis encoder
    targets : where the template's loss points belong
    basis : basis points of every run's encoder, whose features these are
    held_out : a batch of shapes that no run learns from
    source : draws such shapes as there are in the pool
    """

    features: Float[Tensor, "N M 3"]
    targets: Float[Tensor, "N 1000 3"]
    basis: Float[Tensor, "M 3"]
    held_out: Batch
    source: Source

    def batch(self, step: int, count: int, shapes: int, seed: int) -> Batch:
        """The batch of a step, of the scans of the first ``shapes``: a function of its arguments. The encoder reads features
        alone, so that there are no points."""
        generator = torch.Generator().manual_seed((seed * 2_654_435_761 + step) % (2**63))
        chosen = torch.randint(min(shapes * SCANS, len(self.targets)), (count,), generator=generator)
        return Batch(torch.zeros(count, 0, 3), self.targets[chosen], self.features[chosen])


@lru_cache(maxsize=8)
def pool_of(setting: Setting, pose: str, shapes: int = BASE.shapes) -> Pool:
    """The pool of a template pose, drawn once in a process."""
    template, recipe = setting.resting(pose), setting.recipe(Run(pose=pose))
    source, unseen = setting.sources(pose)
    generator = torch.Generator().manual_seed(_SEED)
    drawn = torch.cat([source(min(_BLOCK, shapes - at), generator) for at in range(0, shapes, _BLOCK)])

    def some(count: int, generator: torch.Generator) -> Tensor:
        return drawn[torch.randint(len(drawn), (count,), generator=generator)]

    model = build_deformer(template, some, recipe.network, recipe.scan, recipe.kernel, _SEED)
    data = build_dataset(template, some, model, recipe.scan, _BLOCK, SCANS, _SEED)
    features, targets = [], []
    for number, block in enumerate(drawn.split(_BLOCK)):
        batch = replace(data, source=lambda *_, block=block: block, shapes=len(block))[number]
        features.append(batch.encode_features)
        targets.append(batch.targets)
    held_out = replace(data, source=unseen, shapes=HELD_OUT_SHAPES, scans_per_shape=1, seed=_UNSEEN)[0]
    assert isinstance(model.encoder, BasisEncoder)
    return Pool(torch.cat(features), torch.cat(targets), model.encoder.basis.clone(), held_out, some)


def train_run(run: Run, setting: Setting, folder: Path, steps: int) -> dict[str, Any]:
    """Train, write a model folder, and say how it went. The rate falls to 0 at the last step.

    On the way a checkpoint lies beside the folder; a training that was stopped goes on from it, exactly.

    Returns
    -------
    dict
        ``steps``, ``seconds``, ``held_out_cm`` (the network alone), ``bodies_cm`` (of each body), ``nodes``, ``rule``,
        ``model`` (what tells its weights from others).
    """
    set_threads(setting.threads)
    template, recipe = setting.template(run), setting.recipe(run)
    pool = pool_of(setting, run.pose)
    model = new_network(run, setting, pool)
    points = build_loss_points(template, recipe.kernel, model, gradients=STRAINED)
    trainer = Trainer(model, fewer(points, run.supervised), replace(recipe.train, steps=steps))
    make_folder(folder.parent)
    checkpoint = folder.parent / f"checkpoint-{steps}.safetensors"
    if checkpoint.is_file():
        trainer.load(checkpoint)
    model.train()
    spent, began = trainer.seconds, time.monotonic()
    saved = began
    while trainer.step < steps:
        batch = pool.batch(trainer.step, recipe.train.shapes, run.shapes, run.seed)
        trainer.iterate(replace(batch, targets=batch.targets[:, : run.supervised]))
        trainer.seconds = spent + time.monotonic() - began
        if time.monotonic() - saved > 60 * recipe.train.checkpoint_minutes:
            trainer.save(checkpoint)
            saved = time.monotonic()
    trainer.config = recipe.train
    model.load_state_dict(trainer.averaged_state())
    loss_points = points.to(trainer.device)
    held_out = held_out_error(model, pool.held_out, loss_points)
    bodies = CM_PER_UNIT * body_errors(model, pool.held_out, loss_points)
    make_folder(folder)
    facts = CardFacts("run", "human", f"{run.shapes} shapes, scanned beforehand", licence="")
    export(trainer, template, folder, replace(recipe, storage="float16"), facts, held_out)
    checkpoint.unlink(missing_ok=True)
    return {
        "steps": trainer.step,
        "seconds": round(trainer.seconds, 2),
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
    result: Tensor = off.double().norm(dim=-1).mean(1).cpu()
    return result


def _wait(trainer: Trainer) -> None:
    """Until a GPU has done what it was asked: it works on while Python does, and clocks must not."""
    if trainer.device.type == "cuda":
        torch.cuda.synchronize(trainer.device)


def new_network(run: Run, setting: Setting, pool: Pool) -> Deformer:
    """A run's untrained network; its encoder's basis points are those of the pool, whatever the seed."""
    template, recipe = setting.template(run), setting.recipe(run)
    model = build_deformer(template, pool.source, recipe.network, recipe.scan, recipe.kernel, run.seed)
    assert isinstance(model.encoder, BasisEncoder)
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
    points = build_loss_points(template, chosen.kernel, model, gradients=STRAINED)
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
