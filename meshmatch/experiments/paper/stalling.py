"""Why the paper's own network stalls near the mean body: one thing of it changed at a time.

A network of the paper's kind, so many times narrower (--narrow), learns from generated bodies that are drawn and scanned
once, by the paper's loss, batch and rate, for the same number of steps. Each row changes one thing. Errors are of bodies
that no network has seen, in cm at 1.9 m2 of skin. "at work" is the error on the last training batches, with dropout and the
statistics of each batch; "spread" how much answers differ from one body to another, as a share of how much the bodies do: 0
where the answer is always the same. The mean body is the error of answering with the mean of all bodies, whatever the scan.

What is measured lies in the folder of --work, and a stopped command goes on with what is missing.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Any

import torch
from torch import Tensor, nn
from typer import Option

from meshmatch.arrays import Float
from meshmatch.experiments import runner
from meshmatch.generators.bodies import human_source
from meshmatch.maps.evaluate import CM_PER_UNIT
from meshmatch.models.deformer import Deformer
from meshmatch.models.layers import PointEncoder
from meshmatch.models.network import PAPER, NetworkConfig
from meshmatch.templates.template import Template, read_template, template_radius
from meshmatch.threads import set_threads
from meshmatch.training.datasets import Batch
from meshmatch.training.loop import Trainer
from meshmatch.training.losses import LossPoints
from meshmatch.training.recipes import Recipe, paper
from meshmatch.training.scans import yaw_rotations
from meshmatch.training.train import build_dataset, build_deformer, build_loss_points

_POINTS, _HELD_OUT, _BLOCK, _UNSEEN = 1024, 64, 50, 1
_LAST = 20  # batches
_COLUMNS = {"changed": "changed", "held out": "held_out:.2f", "at work": "at_work:.2f", "spread": "spread:.2f"}
_COLUMNS |= {"CPU ms a step": "cpu_ms:.0f"}


@dataclass(frozen=True)
class Change:
    """What is not as in the paper."""

    dropout: float = 0.3
    norms: bool = True
    waves: float = 1.0  # the frequencies' scale, in times that of the preset
    rate: float = 1e-3
    yaw: bool = True
    encoder: str = "point"
    decoder: str = "node"


CHANGES: Mapping[str, Change] = {
    "nothing": Change(),
    "no turns about the vertical": Change(yaw=False),
    "no dropout": Change(dropout=0.0),
    "no batch norms": Change(norms=False),
    "no dropout, no batch norms": Change(dropout=0.0, norms=False),
    "frequencies of a third": Change(waves=1 / 3),
    "three times the frequencies": Change(waves=3.0),
    "rate 3e-4": Change(rate=3e-4),
    "one decoder for all nodes": Change(decoder="flat"),
    "encoder by basis points": Change(encoder="basis"),
    "no dropout, no batch norms, no turns": Change(dropout=0.0, norms=False, yaw=False),
    "all but the loss": Change(encoder="basis", decoder="flat", yaw=False),
}


def encoder_of(change: Change, latent: int) -> type[PointEncoder]:
    """The paper's encoder with a change, and narrower."""

    class Changed(PointEncoder):
        def __init__(self, basis: Tensor, outputs: int) -> None:
            super().__init__(outputs, latent, dropout=change.dropout)
            self.frequencies *= change.waves
            if not change.norms:
                kept = [layer for layer in self.points if not isinstance(layer, nn.BatchNorm1d)]
                self.points = nn.Sequential(*kept)

    return Changed


def network_of(change: Change, narrow: int) -> NetworkConfig:
    """The paper's network with a change, so many times narrower."""
    config = replace(PAPER, code=PAPER.code // narrow, width=PAPER.width // narrow)
    if change.encoder == "basis":
        return replace(config, encoder="basis", decoder=change.decoder)  # type: ignore[arg-type]
    return replace(config, encoder=encoder_of(change, 1024 // narrow), decoder=change.decoder)  # type: ignore[arg-type]


@dataclass(frozen=True, eq=False)
class Scans:
    """Bodies, each scanned once: points, and where the template's loss points belong. The last are of other people."""

    points: Float[Tensor, "N P 3"]
    targets: Float[Tensor, "N M 3"]

    @property
    def learned(self) -> int:
        """How many are learned from."""
        return len(self.points) - _HELD_OUT

    def batch(self, model: Deformer, at: Tensor, turns: Float[Tensor, "B 3 3"] | None = None) -> Batch:
        """Some of them, turned where asked for."""
        points, targets = self.points[at], self.targets[at]
        if turns is not None:
            points, targets = points @ turns.mT, targets @ turns.mT
        with torch.no_grad():
            return Batch(points, targets, model.encoder.features(points))


def scans_of(template: Template, count: int, sphere: bool = True) -> Scans:
    """Upright and clean, in the unit sphere, as the paper's, or of area 1; turned by nothing."""
    recipe = replace(paper().scan, points=_POINTS, yaw=False, sphere=sphere)
    seen, unseen = (human_source(template, people, seed) for people, seed in ((1024, 0), (64, _UNSEEN)))
    points, targets = [], []
    for source, wanted in ((seen, count), (unseen, _HELD_OUT)):
        for first in range(0, wanted, _BLOCK):
            size = min(_BLOCK, wanted - first)
            batch = build_dataset(template, source, None, recipe, size, 1, first)[0]
            points.append(batch.points)
            targets.append(batch.targets)
    return Scans(torch.cat(points), torch.cat(targets))


def _distance(a: Tensor, b: Tensor) -> float:
    return float(CM_PER_UNIT * (a - b).norm(dim=-1).mean())


@dataclass(frozen=True, eq=False)
class Learned:
    """A network that was trained: its trainer, the loss points, and the recipe that it was made by; ``at_work`` are errors
    of the last batches in cm, ``curve`` held-out ones now and then on the way, by steps; CPU seconds of all steps.
    """

    trainer: Trainer
    points: LossPoints
    recipe: Recipe
    at_work: list[float]
    curve: dict[int, float]
    seconds: float


def learn(
    change: Change, template: Template, scans: Scans, narrow: int, steps: int, seed: int, every: int = 0
) -> Learned:
    """Train from the beginning, with the rate falling to nothing at the last step as `paper` says. The error of bodies that
    it has not seen is asked after ``every`` so many steps."""
    recipe = replace(paper(), network=network_of(change, narrow))
    source = human_source(template, 1024, 0)
    model = build_deformer(template, source, recipe.network, recipe.scan, recipe.kernel, seed)
    points: LossPoints = build_loss_points(template, recipe.kernel, model)
    loss = replace(recipe.train.loss, reconstruction=1 / template_radius(template) ** 2)
    config = replace(recipe.train, loss=loss, steps=steps, rate=change.rate, seed=seed, workers=0)
    trainer, generator, last, spent = Trainer(model, points, config), torch.Generator().manual_seed(seed), [], 0.0
    curve: dict[int, float] = {}
    model.train()
    for step in range(steps):
        at = torch.randint(scans.learned, (config.shapes,), generator=generator)
        batch = scans.batch(model, at, yaw_rotations(len(at), generator) if change.yaw else None)
        if step >= steps - _LAST:
            with torch.no_grad():
                last.append(_distance(points.moved(model.decoder(model.encoder(batch.encode_features))), batch.targets))
        worked = time.process_time()
        trainer.iterate(batch)
        spent += time.process_time() - worked
        if every and (step + 1) % every == 0:
            curve[step + 1] = _distance(*unseen(model, points, scans, change))
            model.train()
            runner.tell(f"step {step + 1}: {curve[step + 1]:.2f} cm held out")
    return Learned(trainer, points, replace(recipe, train=config), last, curve, spent)


def unseen(model: Deformer, points: LossPoints, scans: Scans, change: Change) -> tuple[Tensor, Tensor]:
    """Where a network puts the loss points on bodies that it has not seen, and where they belong."""
    model.eval()
    at = torch.arange(scans.learned, len(scans.points))
    held_out = scans.batch(model, at, yaw_rotations(len(at), torch.Generator().manual_seed(1)) if change.yaw else None)
    with torch.no_grad():
        return points.moved(model(held_out.points)), held_out.targets


def measure(change: Change, template: Template, scans: Scans, narrow: int, steps: int, seed: int) -> dict[str, Any]:
    """A row: how far a network is, trained from the beginning."""
    learned = learn(change, template, scans, narrow, steps, seed)
    found, truth = unseen(learned.trainer.model, learned.points, scans, change)
    spread = float((found - found.mean(0)).norm(dim=-1).mean() / (truth - truth.mean(0)).norm(dim=-1).mean())
    row = {"held_out": _distance(found, truth), "at_work": statistics.fmean(learned.at_work), "spread": spread}
    return row | {"mean_body": _distance(truth.mean(0), truth), "cpu_ms": 1e3 * learned.seconds / steps}


@runner.command
def main(
    steps: Annotated[int, Option(min=_LAST, help="of training")] = 1000,
    narrow: Annotated[int, Option(min=1, max=16, help="by how much the network is narrower than the paper's")] = 4,
    bodies: Annotated[int, Option(min=1, help="that are learned from")] = 1000,
    work: runner.Work = None,
    threads: runner.Threads = 1,
    seed: runner.Seed = 0,
) -> runner.Report:
    set_threads(threads)
    template, rows = read_template("human-T-300"), []
    scans = scans_of(template, bodies)
    for name, change in CHANGES.items():
        runner.tell(f"{name}: {steps} steps")
        call = partial(measure, change, template, scans, narrow, steps, seed)
        asked = {"change": vars(change), "narrow": narrow, "steps": steps, "bodies": bodies, "seed": seed}
        rows.append({"changed": name, **runner.at_work(work, name.replace(" ", "-"), asked, call)})
    means = {change.yaw: row["mean_body"] for row, change in zip(rows, CHANGES.values(), strict=True)}
    words = [f"Mean body: {means[True]:.2f} cm, {means[False]:.2f} without turns"]
    title = f"The paper's network, {narrow} times narrower, after {steps} steps; errors in cm"
    return runner.Report({"rows": rows}, [runner.table(title, rows, _COLUMNS)], words)
