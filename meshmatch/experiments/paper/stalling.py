"""Why the paper's own network stalls near the mean body: a study that changes one setting at a time.

A network as in the paper, but narrower (--narrow), is trained on a fixed pool of scanned bodies, with the paper's loss,
batch and rate, for the same number of steps. Each row changes one setting. Errors are those of held-out bodies, in cm at
1.9 m2 of skin. "at work" is the error on the last training batches, with dropout and the statistics of each batch. "spread"
is the variation of the predictions relative to that of the bodies: 0 if all predictions are equal. The mean body is the
error of always predicting the mean of all bodies.

Results are kept in the folder of --work: an interrupted command continues with what is missing.
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
_LAST = 20  # number of last batches for the training error
_COLUMNS = {"changed": "changed", "held out": "held_out:.2f", "at work": "at_work:.2f", "spread": "spread:.2f"}
_COLUMNS |= {"CPU ms a step": "cpu_ms:.0f"}


@dataclass(frozen=True)
class Change:
    """Settings that may differ from the paper; the defaults are the paper's."""

    dropout: float = 0.3
    norms: bool = True
    waves: float = 1.0  # factor of the preset's frequencies
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
    """Class of the paper's encoder with a change and another width."""

    class Changed(PointEncoder):
        def __init__(self, basis: Tensor, outputs: int) -> None:
            super().__init__(outputs, latent, dropout=change.dropout)
            self.frequencies *= change.waves
            if not change.norms:
                layers = [layer for layer in self.points if not isinstance(layer, nn.BatchNorm1d)]
                self.points = nn.Sequential(*layers)

    return Changed


def network_of(change: Change, narrow: int) -> NetworkConfig:
    """The paper's network with a change, ``narrow`` times narrower."""
    config = replace(PAPER, code=PAPER.code // narrow, width=PAPER.width // narrow)
    if change.encoder == "basis":
        return replace(config, encoder="basis", decoder=change.decoder)  # type: ignore[arg-type]
    return replace(config, encoder=encoder_of(change, 1024 // narrow), decoder=change.decoder)  # type: ignore[arg-type]


@dataclass(frozen=True, eq=False)
class Scans:
    """Scans of bodies, one each: points, and the correct places of the template's loss points.

    The last `_HELD_OUT` of them are other people, for validation.
    """

    points: Float[Tensor, "N P 3"]
    targets: Float[Tensor, "N M 3"]

    @property
    def learned(self) -> int:
        """Number of training scans."""
        return len(self.points) - _HELD_OUT

    def batch(self, model: Deformer, at: Tensor, turns: Float[Tensor, "B 3 3"] | None = None) -> Batch:
        """Batch of the scans with indices ``at``, optionally rotated."""
        points, targets = self.points[at], self.targets[at]
        if turns is not None:
            points, targets = points @ turns.mT, targets @ turns.mT
        with torch.no_grad():
            return Batch(points, targets, model.encoder.features(points))


def scans_of(template: Template, count: int, sphere: bool = True) -> Scans:
    """Draw and scan bodies: upright and clean, without rotation, in the unit sphere as in the paper, or with area 1."""
    recipe = replace(paper().scan, points=_POINTS, yaw=False, sphere=sphere)
    training_source, held_out_source = (
        human_source(template, people, seed) for people, seed in ((1024, 0), (64, _UNSEEN))
    )
    points, targets = [], []
    for source, total in ((training_source, count), (held_out_source, _HELD_OUT)):
        for first in range(0, total, _BLOCK):
            size = min(_BLOCK, total - first)
            batch = build_dataset(template, source, None, recipe, size, 1, first)[0]
            points.append(batch.points)
            targets.append(batch.targets)
    return Scans(torch.cat(points), torch.cat(targets))


def _distance(a: Tensor, b: Tensor) -> float:
    return float(CM_PER_UNIT * (a - b).norm(dim=-1).mean())


@dataclass(frozen=True, eq=False)
class TrainedNetwork:
    """A trained network: trainer, loss points and recipe.

    ``at_work`` are the errors of the last batches in cm; ``curve`` are held-out errors during training, by step; ``seconds``
    is the CPU time of all steps.
    """

    trainer: Trainer
    points: LossPoints
    recipe: Recipe
    at_work: list[float]
    curve: dict[int, float]
    seconds: float


def train_network(
    change: Change, template: Template, scans: Scans, narrow: int, steps: int, seed: int, every: int = 0
) -> TrainedNetwork:
    """Train from scratch, with the paper's settings and schedule except for the change.

    The held-out error is computed after ``every`` so many steps, if that is not 0.
    """
    recipe = replace(paper(), network=network_of(change, narrow))
    source = human_source(template, 1024, 0)
    model = build_deformer(template, source, recipe.network, recipe.scan, recipe.kernel, seed)
    points: LossPoints = build_loss_points(template, recipe.kernel, model)
    loss = replace(recipe.train.loss, reconstruction=1 / template_radius(template) ** 2)
    config = replace(recipe.train, loss=loss, steps=steps, rate=change.rate, seed=seed, workers=0)
    trainer, generator, last_errors, seconds = (
        Trainer(model, points, config),
        torch.Generator().manual_seed(seed),
        [],
        0.0,
    )
    curve: dict[int, float] = {}
    model.train()
    for step in range(steps):
        at = torch.randint(scans.learned, (config.shapes,), generator=generator)
        batch = scans.batch(model, at, yaw_rotations(len(at), generator) if change.yaw else None)
        if step >= steps - _LAST:
            with torch.no_grad():
                last_errors.append(
                    _distance(points.moved(model.decoder(model.encoder(batch.encode_features))), batch.targets)
                )
        cpu_start = time.process_time()
        trainer.iterate(batch)
        seconds += time.process_time() - cpu_start
        if every and (step + 1) % every == 0:
            curve[step + 1] = _distance(*predict_held_out(model, points, scans, change))
            model.train()
            runner.log(f"step {step + 1}: {curve[step + 1]:.2f} cm held out")
    return TrainedNetwork(trainer, points, replace(recipe, train=config), last_errors, curve, seconds)


def predict_held_out(model: Deformer, points: LossPoints, scans: Scans, change: Change) -> tuple[Tensor, Tensor]:
    """Predicted and correct places of the loss points on held-out bodies."""
    model.eval()
    at = torch.arange(scans.learned, len(scans.points))
    held_out = scans.batch(model, at, yaw_rotations(len(at), torch.Generator().manual_seed(1)) if change.yaw else None)
    with torch.no_grad():
        return points.moved(model(held_out.points)), held_out.targets


def measure(change: Change, template: Template, scans: Scans, narrow: int, steps: int, seed: int) -> dict[str, Any]:
    """Train a network from scratch and return its row of the table."""
    learned = train_network(change, template, scans, narrow, steps, seed)
    predicted, truth = predict_held_out(learned.trainer.model, learned.points, scans, change)
    spread = float((predicted - predicted.mean(0)).norm(dim=-1).mean() / (truth - truth.mean(0)).norm(dim=-1).mean())
    row = {"held_out": _distance(predicted, truth), "at_work": statistics.fmean(learned.at_work), "spread": spread}
    return row | {"mean_body": _distance(truth.mean(0), truth), "cpu_ms": 1e3 * learned.seconds / steps}


@runner.command
def main(
    steps: Annotated[int, Option(min=_LAST, help="training steps")] = 1000,
    narrow: Annotated[int, Option(min=1, max=16, help="factor by which the network is narrower than the paper's")] = 4,
    bodies: Annotated[int, Option(min=1, help="number of training bodies")] = 1000,
    work: runner.Work = None,
    threads: runner.Threads = 1,
    seed: runner.Seed = 0,
) -> runner.Report:
    set_threads(threads)
    template, rows = read_template("human-T-300"), []
    scans = scans_of(template, bodies)
    for name, change in CHANGES.items():
        runner.log(f"{name}: {steps} steps")
        measure_change = partial(measure, change, template, scans, narrow, steps, seed)
        asked = {"change": vars(change), "narrow": narrow, "steps": steps, "bodies": bodies, "seed": seed}
        rows.append({"changed": name, **runner.cached_in(work, name.replace(" ", "-"), asked, measure_change)})
    means = {change.yaw: row["mean_body"] for row, change in zip(rows, CHANGES.values(), strict=True)}
    notes = [f"Mean body: {means[True]:.2f} cm, {means[False]:.2f} without turns"]
    title = f"The paper's network, {narrow} times narrower, after {steps} steps; errors in cm"
    return runner.Report({"rows": rows}, [runner.table(title, rows, _COLUMNS)], notes)
