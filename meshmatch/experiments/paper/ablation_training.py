"""Train ablation runs, measure them on held-out shapes, and time iterations.

Simulating a scan takes several times as long as training a small network on it. Therefore a fixed number of shapes is
scanned a few times each in advance, once for all runs; a run with fewer shapes uses the first ones.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
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
from meshmatch.generators.generator import Source, draw_any
from meshmatch.maps.evaluate import CM_PER_UNIT
from meshmatch.models.card import read_card
from meshmatch.models.deformer import Deformer
from meshmatch.models.layers import BasisEncoder
from meshmatch.models.network import NetworkConfig
from meshmatch.models.registry import CARD
from meshmatch.outputs import make_folder
from meshmatch.templates.make import NodeConfig, Strategy, place_nodes
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
"""Number of scans of each shape."""
HELD_OUT_SHAPES = 64
_BLOCK = 50
_SEED, _HELD_OUT_SEED = 17, 999_983

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
"""Base recipe of all runs, for minutes of one core."""
N_GRADIENT_POINTS = 200
"""Number of loss points at which the regularisers' energies are evaluated."""


Loss = Literal["paper", "ours"]


@dataclass(frozen=True)
class Setting:
    """Settings that all runs share, as plain values that can be serialised.

    Parameters
    ----------
    batch : int, optional
        Shapes in a step; None for the recipe's.
    loss
        "ours", or "paper": mean squared distances, with the weights of its table 1, which are for the unit sphere.
    """

    threads: int = 1
    batch: int | None = None
    loss: Loss = "paper"

    def recipe(self, run: Run) -> Recipe:
        """`SMALL` with the run's choices; the weights of constraints that it does not have are zero.

        Networks have no aligner and no learned corrections: the orientation is given and the same for all runs, to compare
        only the deformation.
        """
        base = SMALL.train.loss if self.loss == "ours" else _paper_loss(self.resting(run.pose))
        if run.constraint == TABLE3:
            base = replace(base, volume=1e-4, arap=1e-2, blend=1.0)
        loss = replace(
            base,
            volume=base.volume if "vol" in run.constraint else 0.0,
            arap=base.arap if "arap" in run.constraint else 0.0,
            blend=base.blend if "Z" in run.constraint else 0.0,
        )
        shapes = self.batch or SMALL.train.shapes
        train = replace(SMALL.train, loss=loss, shapes=shapes, threads=self.threads, seed=run.seed)
        return replace(SMALL, network=replace(SMALL.network, field=run.field), train=train, kernel=run.kernel)

    def template(self, run: Run) -> Template:
        """The template with the run's nodes, chosen by `rule`; radii are enlarged where vertices have too few nodes.

        Raises
        ------
        TemplateError
            This number of nodes with this radius does not cover the template.
        """
        return self._template_and_rule(run)[0]

    def rule(self, run: Run) -> Strategy:
        """The strategy by which the run's nodes are chosen: its own, or "uniform" if that one fails."""
        return self._template_and_rule(run)[1]

    def _template_and_rule(self, run: Run) -> tuple[Template, Strategy]:
        resting = self.resting(run.pose)
        return _place_nodes(resting, run.nodes, run.radius * diameter(resting.shape), run.strategy)

    def resting(self, pose: str) -> Template:
        """The template in a pose with its original nodes; "T-heavy" has the shape of heavier people."""
        return _resting(pose)

    def sources(self, pose: str) -> tuple[Source, Source]:
        """Sources of training shapes, and of shapes of other people for validation."""
        template = self.resting(pose)
        return human_source(template, 1024, 0), human_source(template, 64, 1)


def _paper_loss(template: Template) -> CorrespondenceLoss:
    """The paper's loss, converted from lengths in the unit sphere to units of sqrt(area)."""
    return CorrespondenceLoss(reconstruction=1 / template_radius(template) ** 2)


@lru_cache(maxsize=4)
def _resting(pose: str) -> Template:
    template = read_template(f"human-{pose.removesuffix(HEAVY)}")
    return heavy(template) if pose.endswith(HEAVY) else template


@lru_cache(maxsize=32)
def _place_nodes(template: Template, K: int, radius: float, strategy: Strategy) -> tuple[Template, Strategy]:
    for rule in dict.fromkeys((strategy, "uniform")):
        try:
            chosen = place_nodes(template.shape, NodeConfig(rule, K, radius, grow=True), template.labels)
            return replace(template, nodes=chosen.nodes, radius=chosen.radius), rule
        except TemplateError:
            if rule == "uniform":
                raise
    raise AssertionError


@dataclass(frozen=True, eq=False)
class Pool:
    """A fixed pool of N scans: `SCANS` of each shape, one after the other.

    Parameters
    ----------
    features : features of the basis encoder
    targets : correct places of the template's loss points
    basis : basis points of the encoder, the same for all runs
    held_out : a batch of shapes that are not used in training
    source : draws shapes of the pool
    """

    features: Float[Tensor, "N M 3"]
    targets: Float[Tensor, "N 1000 3"]
    basis: Float[Tensor, "M 3"]
    held_out: Batch
    source: Source

    def batch(self, step: int, count: int, shapes: int, seed: int) -> Batch:
        """Batch of a step from the scans of the first ``shapes``, determined by the arguments.

        It has no points, as the encoder needs only the features.
        """
        generator = torch.Generator().manual_seed((seed * 2_654_435_761 + step) % (2**63))
        chosen = torch.randint(min(shapes * SCANS, len(self.targets)), (count,), generator=generator)
        return Batch(torch.zeros(count, 0, 3), self.targets[chosen], self.features[chosen])


@lru_cache(maxsize=8)
def pool_of(setting: Setting, pose: str, shapes: int = BASE.shapes) -> Pool:
    """The pool of a template pose, drawn once per process."""
    template, recipe = setting.resting(pose), setting.recipe(Run(pose=pose))
    source, held_out_source = setting.sources(pose)
    generator = torch.Generator().manual_seed(_SEED)
    shapes_drawn = torch.cat([source(min(_BLOCK, shapes - at), generator) for at in range(0, shapes, _BLOCK)])
    draw = partial(draw_any, shapes_drawn)
    model = build_deformer(template, draw, recipe.network, recipe.scan, recipe.kernel, _SEED)
    data = build_dataset(template, draw, model, recipe.scan, _BLOCK, SCANS, _SEED)
    features, targets = [], []
    for number, block in enumerate(shapes_drawn.split(_BLOCK)):
        batch = replace(data, source=lambda *_, block=block: block, shapes=len(block))[number]
        features.append(batch.encode_features)
        targets.append(batch.targets)
    held_out = replace(data, source=held_out_source, shapes=HELD_OUT_SHAPES, scans_per_shape=1, seed=_HELD_OUT_SEED)[0]
    assert isinstance(model.encoder, BasisEncoder)
    return Pool(torch.cat(features), torch.cat(targets), model.encoder.basis.clone(), held_out, draw)


def train_run(run: Run, setting: Setting, folder: Path, steps: int) -> dict[str, Any]:
    """Train a run, write a model folder, and return a summary. The learning rate decays to 0 at the last step.

    A checkpoint next to the folder allows an interrupted training to resume exactly.

    Returns
    -------
    dict
        ``steps``, ``seconds``, ``held_out_cm`` (without refinement), ``bodies_cm`` (for each body), ``nodes``, ``rule``,
        ``model`` (hash of its weights).
    """
    set_threads(setting.threads)
    template, recipe = setting.template(run), setting.recipe(run)
    pool = pool_of(setting, run.pose)
    model = new_network(run, setting, pool)
    points = build_loss_points(template, recipe.kernel, model, gradients=N_GRADIENT_POINTS)
    trainer = Trainer(model, keep_first_points(points, run.supervised), replace(recipe.train, steps=steps))
    make_folder(folder.parent)
    checkpoint = folder.parent / f"checkpoint-{steps}.safetensors"
    if checkpoint.is_file():
        trainer.load(checkpoint)
    model.train()
    seconds_before, start = trainer.seconds, time.monotonic()
    saved = start
    while trainer.step < steps:
        batch = pool.batch(trainer.step, recipe.train.shapes, run.shapes, run.seed)
        trainer.iterate(replace(batch, targets=batch.targets[:, : run.supervised]))
        trainer.seconds = seconds_before + time.monotonic() - start
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
    """Mean distance of the template's points from their correct places for each body, units of sqrt(area), float64."""
    was_training = model.training
    model.eval()
    batch = batch.to(points.positions.device)
    offsets = points.moved(model(batch.points)) - batch.targets
    model.train(was_training)
    result: Tensor = offsets.double().norm(dim=-1).mean(1).cpu()
    return result


def _wait(trainer: Trainer) -> None:
    """Wait until the GPU has finished, as required for timing."""
    if trainer.device.type == "cuda":
        torch.cuda.synchronize(trainer.device)


def new_network(run: Run, setting: Setting, pool: Pool) -> Deformer:
    """Build a run's untrained network; the basis points of its encoder are those of the pool for every seed."""
    template, recipe = setting.template(run), setting.recipe(run)
    model = build_deformer(template, pool.source, recipe.network, recipe.scan, recipe.kernel, run.seed)
    assert isinstance(model.encoder, BasisEncoder)
    with torch.no_grad():
        model.encoder.basis.copy_(pool.basis)
    return model


def keep_first_points(points: LossPoints, supervised: int) -> LossPoints:
    """Keep only the first loss points; the regularisers' points do not change."""
    if supervised >= len(points.positions):
        return points
    field: PointField = points.field
    if isinstance(field, PointwiseField):
        field = replace(field, points=field.points[:supervised])
    else:
        field = Field(field.phi[:supervised], field.gradient)
    return LossPoints(points.positions[:supervised], field)


def build_trainer(setting: Setting, run: Run) -> tuple[Trainer, list[Any]]:
    """Build a trainer at its first step, and batches for it."""
    recipe, template, source = setting.recipe(run), setting.template(run), setting.sources(run.pose)[0]
    train = recipe.train
    model = build_deformer(template, source, recipe.network, recipe.scan, recipe.kernel, train.seed)
    points = build_loss_points(template, recipe.kernel, model, gradients=N_GRADIENT_POINTS)
    trainer = Trainer(model, keep_first_points(points, run.supervised), train)
    data = build_dataset(
        template, source, model, recipe.scan, train.shapes, train.scans_per_shape, train.seed, _BATCHES
    )
    trainer.model.train()
    batches = [data[number].to(trainer.device) for number in range(_BATCHES)]
    return trainer, [replace(each, targets=each.targets[:, : run.supervised]) for each in batches]


def time_iterations(setting: Setting, runs: Sequence[Run], rounds: int) -> dict[str, dict[str, Any]]:
    """Milliseconds per iteration (forward, backward, optimiser step; without drawing batches), by the name of the run.

    All runs are timed in one process. In each round every run does one iteration, and each round begins with another run,
    so that other load on the machine affects all runs equally. One round before the first is a warm-up.
    """
    set_threads(setting.threads)
    prepared = [(run, *build_trainer(setting, run)) for run in runs]
    wall: dict[str, list[float]] = {run.name: [] for run in runs}
    cpu: dict[str, list[float]] = {run.name: [] for run in runs}
    for round_ in range(-1, rounds):
        first = max(round_, 0) % len(prepared)
        for run, trainer, batches in prepared[first:] + prepared[:first]:
            _wait(trainer)
            wall_start, cpu_start = time.perf_counter(), time.process_time()
            trainer.iterate(batches[round_ % _BATCHES])
            _wait(trainer)
            if round_ >= 0:
                wall[run.name].append(1e3 * (time.perf_counter() - wall_start))
                cpu[run.name].append(1e3 * (time.process_time() - cpu_start))
    device = str(prepared[0][1].device)
    return {
        run.name: {
            "ms": round(statistics.median(wall[run.name]), 3),
            "cpu_ms": round(statistics.median(cpu[run.name]), 3),
            "rounds": rounds,
            "device": device,
        }
        for run in runs
    }
