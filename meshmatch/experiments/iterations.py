"""Iterations of training under the clock: several cells taking turns in one process, and each one's memory.

A cell is a representation of the deformation and the constraints with which it is trained; everything else is the same
for all: data, encoder, batch, template.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import resource
import statistics
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from meshmatch.config import set_threads
from meshmatch.fields.choice import FieldName
from meshmatch.templates.template import Template
from meshmatch.training.datasets import Source
from meshmatch.training.loop import Trainer
from meshmatch.training.run import Preset, Recipe, folder_source, human_source, read_template, recipe
from meshmatch.training.setup import build_dataset, build_deformer, build_loss_points

CONSTRAINTS = ("none", "vol+arap", "vol+arap+Z")
_BATCHES = 2


@dataclass(frozen=True)
class Cell:
    """A representation, and one of `CONSTRAINTS`."""

    field: FieldName
    constraint: str

    @property
    def name(self) -> str:
        """Of its files."""
        return f"{self.field}-{self.constraint.replace('+', '-')}"


@dataclass(frozen=True)
class Setting:
    """What all cells share; plain values, so that a process of its own can be told.

    ``shapes``: a folder that `meshmatch prepare` made; None for generated bodies on ``template``. ``batch``: shapes in a
    batch, None for the preset's. ``width``, ``code``: of the network, None for the preset's.
    """

    preset: Preset = "paper"
    template: str = "human-T"
    shapes: str | None = None
    identities: int = 4096
    batch: int | None = None
    code: int | None = None
    width: int | None = None
    threads: int = 1
    seed: int = 0

    def material(self) -> tuple[Template, Source]:
        """The template, and what draws shapes."""
        if self.shapes is None:
            made = read_template(self.template)
            return made, human_source(made, self.identities, self.seed)
        made = read_template(Path(self.shapes) / "template.safetensors")
        return made, folder_source(self.shapes, made)[0]

    def recipe(self, cell: Cell) -> Recipe:
        """The preset's recipe with the cell's representation; constraints that it does not have weigh nothing."""
        chosen = recipe(self.preset)
        loss = chosen.train.loss
        if cell.constraint == "none":
            loss = replace(loss, volume=0.0, arap=0.0)
        if cell.constraint != "vol+arap+Z":
            loss = replace(loss, blend=0.0)
        network = replace(
            chosen.network,
            field=cell.field,
            code=self.code or chosen.network.code,
            width=self.width or chosen.network.width,
        )
        train = replace(
            chosen.train,
            loss=loss,
            shapes=self.batch or chosen.train.shapes,
            threads=self.threads,
            seed=self.seed,
        )
        return replace(chosen, network=network, train=train)


def built(setting: Setting, cell: Cell, template: Template, source: Source) -> tuple[Trainer, list[Any]]:
    """A trainer at its first step, and batches for it."""
    chosen = setting.recipe(cell)
    train = chosen.train
    model = build_deformer(template, source, chosen.network, chosen.scan, chosen.kernel, train.seed)
    trainer = Trainer(model, build_loss_points(template, chosen.kernel, model), train)
    data = build_dataset(
        template, source, model, chosen.scan, train.shapes, train.scans_per_shape, train.seed, _BATCHES
    )
    trainer.model.train()
    return trainer, [data[number].to(trainer.device) for number in range(_BATCHES)]


def timed(
    setting: Setting, cells: Sequence[Cell], rounds: int, tell: Callable[[int], None] = lambda done: None
) -> dict[str, dict[str, Any]]:
    """Milliseconds of an iteration, by cell: forward, backward and the optimiser's step, batches at hand.

    All cells are in one process and take turns: in each round every cell does one iteration, each round beginning with
    another cell, so that what else the machine does disturbs all alike. One round before the first does not count.
    """
    set_threads(setting.threads)
    template, source = setting.material()
    ready = [(cell, *built(setting, cell, template, source)) for cell in cells]
    wall: dict[str, list[float]] = {cell.name: [] for cell in cells}
    cpu: dict[str, list[float]] = {cell.name: [] for cell in cells}
    for turn in range(-1, rounds):
        first = max(turn, 0) % len(ready)
        for cell, trainer, batches in ready[first:] + ready[:first]:
            trainer.wait()
            began, worked = time.perf_counter(), time.process_time()
            trainer.iterate(batches[turn % _BATCHES])
            trainer.wait()
            if turn >= 0:
                wall[cell.name].append(1e3 * (time.perf_counter() - began))
                cpu[cell.name].append(1e3 * (time.process_time() - worked))
        tell(turn + 1)
    device = str(ready[0][1].device)
    return {
        cell.name: {
            "ms": round(statistics.median(wall[cell.name]), 3),
            "cpu_ms": round(statistics.median(cpu[cell.name]), 3),
            "ms_all": [round(each, 3) for each in wall[cell.name]],
            "rounds": rounds,
            "device": device,
        }
        for cell in cells
    }


def memory(setting: Setting, cell: Cell, iterations: int = 3) -> dict[str, Any]:
    """Megabytes that iterations of a cell need besides network, optimiser and data, in a process of their own.

    Without a GPU: how far the resident set grows at its largest beyond what it was before the first iteration. With one:
    the most that tensors took there, network and optimiser included.
    """
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, context) as pool:
        grown, how = pool.submit(_grown, setting, cell, iterations).result()
    return {"megabytes": round(grown / 1e6, 1), "how": how}


def _grown(setting: Setting, cell: Cell, iterations: int) -> tuple[float, str]:
    set_threads(setting.threads)
    trainer, batches = built(setting, cell, *setting.material())
    before = _resident()
    _forget_peak()
    for number in range(iterations):
        trainer.iterate(batches[number % _BATCHES])
    trainer.wait()
    peak = trainer.device_peak()
    if peak is not None:
        return float(peak), "allocated on the GPU, at most"
    return float(max(_peak() - before, 0)), "growth of the resident set, at most"


def _resident() -> int:
    """Bytes of this process in memory now; its peak where the system does not say."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    except OSError:
        return _peak()
    return pages * resource.getpagesize()


def _forget_peak() -> None:
    """Let the kernel count the peak from now on, where it can."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


def _peak() -> int:
    """Bytes of this process in memory at its largest."""
    try:
        for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
            if line.startswith("VmHWM:"):
                return 1024 * int(line.split()[1])
    except OSError:
        pass
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
