"""Train an ablation run for its budget and measure it on shapes that it has not seen; iterations under the clock."""

from __future__ import annotations

import contextlib
import multiprocessing
import resource
import statistics
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from meshmatch.arrays import Float
from meshmatch.experiments.paper.ablation_setting import Pool, Setting, pool_of
from meshmatch.experiments.paper.ablation_views import Run
from meshmatch.experiments.paper.learned_baselines import WORDS, load_transmatch
from meshmatch.fields.field import Field, PointField, PointwiseField
from meshmatch.maps.evaluate import CM_PER_UNIT
from meshmatch.models.deformer import Deformer
from meshmatch.models.layers import BasisEncoder
from meshmatch.models.registry import CARD, WEIGHTS, read_card
from meshmatch.outputs import make_folder
from meshmatch.threads import set_threads
from meshmatch.training.datasets import Batch
from meshmatch.training.loop import Trainer
from meshmatch.training.losses import LossPoints, held_out_error
from meshmatch.training.train import CardFacts, build_dataset, build_deformer, build_loss_points, export

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
    category = "human" if setting.folder is None else Path(setting.folder).name
    facts = CardFacts("run", category, f"{run.shapes} shapes, scanned beforehand", licence="")
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


def is_trained(folder: Path, found: dict[str, Any]) -> bool:
    """Whether the model folder is the one that a record tells of."""
    if not (folder / WEIGHTS).is_file() or not any((folder / each).is_file() for each in (CARD, WORDS)):
        return False
    if (folder / CARD).is_file():
        return read_card(folder / CARD).weights_sha256 == found.get("model")
    return load_transmatch(folder).words.get("weights_sha256") == found.get("model")


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


def planned(setting: Setting, runs: Sequence[Run], steps: int, rounds: int = 2) -> list[dict[str, Any]]:
    """What training the runs for so many steps takes, by what an iteration costs: rows with ``field``, ``constraint``,
    ``nodes``, ``runs``, ``cpu_ms`` of a step and ``minutes`` in all. Scans and errors come on top."""
    alike: dict[Run, int] = {}
    for run in runs:
        kind = Run(run.field, run.constraint, run.nodes)
        alike[kind] = alike.get(kind, 0) + 1
    rows = []
    for kind, count in alike.items():
        cost = timed(setting, [kind], rounds)[kind.name]["cpu_ms"]
        minutes = round(count * steps * cost / 60_000, 2)
        words = {"field": kind.field, "constraint": kind.constraint, "nodes": kind.nodes, "runs": count}
        rows.append({**words, "cpu_ms": cost, "minutes": minutes})
    return rows


def memory(setting: Setting, run: Run, iterations: int = 3) -> dict[str, Any]:
    """Megabytes that iterations of a run need besides network, optimizer and data, in a process of their own.

    Without a GPU: how far the resident set grows at its largest beyond what it was before the first iteration. With one:
    the most that tensors took there, network and optimizer included.
    """
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, context) as pool:
        grown, how = pool.submit(_grown, setting, run, iterations).result()
    return {"megabytes": round(grown / 1e6, 1), "how": how}


def _grown(setting: Setting, run: Run, iterations: int) -> tuple[float, str]:
    set_threads(setting.threads)
    trainer, batches = built(setting, run)
    before = _memory("VmRSS")
    with contextlib.suppress(OSError):  # let the kernel count the peak from now on, where it can
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    for number in range(iterations):
        trainer.iterate(batches[number % _BATCHES])
    _wait(trainer)
    peak = (
        torch.cuda.max_memory_allocated(trainer.device) if trainer.device.type == "cuda" else None
    )  # bytes of tensors
    if peak is not None:
        return float(peak), "allocated on the GPU, at most"
    return float(max(_memory("VmHWM") - before, 0)), "growth of the resident set, at most"


def _memory(what: str) -> int:
    """Bytes of this process in memory now (VmRSS) or at its largest (VmHWM); the latter where the system does not say."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
            if line.startswith(f"{what}:"):
                return 1024 * int(line.split()[1])
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
