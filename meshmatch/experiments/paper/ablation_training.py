"""Ablation runs: their recipe, template and shapes; trained for a budget and measured on shapes that no run has seen;
iterations under the clock.

Simulating a scan costs several times what learning from it does in a small network. So a fixed number of shapes is
scanned a few times each beforehand, once for all runs, and a run that has fewer shapes has the first ones.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from meshmatch.arrays import Float, Int
from meshmatch.errors import TemplateError
from meshmatch.experiments.makers.human_bodies import diameter, heavy
from meshmatch.experiments.paper.ablation_views import BASE, HEAVY, Run
from meshmatch.experiments.paper.learned_baselines import (
    TARGETS,
    TransBatch,
    TransConfig,
    load_transmatch,
    train_transmatch,
)
from meshmatch.fields.field import Field, PointField, PointwiseField
from meshmatch.generators.bodies import human_source
from meshmatch.generators.generator import Source
from meshmatch.maps.evaluate import CM_PER_UNIT
from meshmatch.models.deformer import Deformer
from meshmatch.models.layers import BasisEncoder, PointEncoder
from meshmatch.models.network import NetworkConfig
from meshmatch.models.registry import CARD, read_card
from meshmatch.outputs import make_folder
from meshmatch.templates.make import NodeConfig, Strategy, lay_nodes
from meshmatch.templates.template import Template, read_template
from meshmatch.threads import set_threads
from meshmatch.training.datasets import Batch, step_generator
from meshmatch.training.loop import TrainConfig, Trainer
from meshmatch.training.losses import CorrespondenceLoss, LossPoints, held_out_error
from meshmatch.training.recipes import Recipe, recipe_for
from meshmatch.training.scans import ScanConfig
from meshmatch.training.train import CardFacts, build_dataset, build_deformer, build_loss_points, export, loss_vertices

_BATCHES = 2
Preset = Literal["small", "default", "paper"]
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
"""The recipe of the preset "small", for minutes of one core."""
STRAINED = 200
"""At how many of the loss points the energies of the regularisers are taken."""


@dataclass(frozen=True)
class Setting:
    """What all runs share; plain values, so that a process of its own can be told.

    Parameters
    ----------
    preset : {"small", "default", "paper"}
        The recipe: network, losses, scans.
    batch : int, optional
        Shapes of a step; None for the recipe's.
    """

    preset: Preset = "small"
    threads: int = 1
    batch: int | None = None

    def recipe(self, run: Run) -> Recipe:
        """The preset's recipe with the run's choices; constraints that it does not have weigh nothing.

        No network has an aligner or learned corrections: the orientation is given, the same to all runs, and what is
        compared is the deformation.
        """
        chosen = SMALL if self.preset == "small" else recipe_for(preset=self.preset)
        given = chosen.train.loss
        loss = replace(
            given,
            volume=given.volume if "vol" in run.constraint else 0.0,
            arap=given.arap if "arap" in run.constraint else 0.0,
            blend=given.blend if "Z" in run.constraint else 0.0,
        )
        network = replace(chosen.network, align_basis=0, corrections=0)
        if run.field != "transmatch":  # which has a network of its own
            network = replace(network, field=run.field)
        train = replace(
            chosen.train,
            loss=loss,
            shapes=self.batch or chosen.train.shapes * chosen.train.scans_per_shape,
            scans_per_shape=1,
            workers=0,
            threads=self.threads,
            seed=run.seed,
        )
        return Recipe(network, train, replace(chosen.scan, upright=False, sphere=False), run.kernel)

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
    points : without points (P = 0) unless they are read
    features : of a network that reads the points themselves (N, 0, 3)
    targets : where the template's loss points belong
    basis : basis points of every run's encoder, whose features these are
    held_out : a batch of shapes that no run learns from
    source : draws such shapes as there are in the pool
    """

    points: Float[Tensor, "N P 3"]
    features: Float[Tensor, "N M 3"]
    targets: Float[Tensor, "N 1000 3"]
    basis: Float[Tensor, "M 3"]
    held_out: Batch
    source: Source

    def batch(self, step: int, count: int, shapes: int, seed: int, encoder: BasisEncoder | PointEncoder) -> Batch:
        """The batch of a step, of the scans of the first ``shapes``: a function of its arguments."""
        chosen = self.rows(step, count, shapes, seed)
        points = self.points[chosen]
        features = self.features[chosen] if self.features.shape[1] else encoder.features(points)
        return Batch(points, self.targets[chosen], features)

    def rows(self, step: int, count: int, shapes: int, seed: int) -> Int[Tensor, " count"]:
        """Which scans a step sees."""
        generator = torch.Generator().manual_seed((seed * 2_654_435_761 + step) % (2**63))
        return torch.randint(min(shapes * SCANS, len(self.targets)), (count,), generator=generator)


@lru_cache(maxsize=8)
def pool_of(setting: Setting, pose: str, shapes: int = BASE.shapes, read_points: bool = False) -> Pool:
    """The pool of a template pose, drawn once in a process; the same scans whether or not their points are kept."""
    template, recipe = setting.resting(pose), setting.recipe(Run(pose=pose))
    source, unseen = setting.sources(pose)
    generator = torch.Generator().manual_seed(_SEED)
    drawn = torch.cat([source(min(_BLOCK, shapes - at), generator) for at in range(0, shapes, _BLOCK)])

    def some(count: int, generator: torch.Generator) -> Tensor:
        return drawn[torch.randint(len(drawn), (count,), generator=generator)]

    model = build_deformer(template, some, recipe.network, recipe.scan, recipe.kernel, _SEED)
    data = build_dataset(template, some, model, recipe.scan, _BLOCK, SCANS, _SEED)
    encodes = recipe.network.encoder != "point"
    blocks = []
    for number, block in enumerate(drawn.split(_BLOCK)):
        batch = replace(data, source=lambda *_, block=block: block, shapes=len(block))[number]
        none = torch.zeros(len(batch.points), 0, 3)
        points = none if encodes and not read_points else batch.points
        blocks.append((points, batch.encode_features if encodes else none, batch.targets))
    points, features, targets = (torch.cat(part) for part in zip(*blocks, strict=True))
    held_out = replace(data, source=unseen, shapes=HELD_OUT_SHAPES, scans_per_shape=1, seed=_UNSEEN)[0]
    encoder = model.encoder
    basis = encoder.basis.clone() if isinstance(encoder, BasisEncoder) else torch.zeros(1, 3)
    return Pool(points, features, targets, basis, held_out, some)


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
    points = build_loss_points(template, recipe.kernel, model, gradients=STRAINED)
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
