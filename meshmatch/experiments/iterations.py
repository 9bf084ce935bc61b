"""Iterations of training under the clock: several cells taking turns in one process, and each one's memory."""

from __future__ import annotations

import contextlib
import multiprocessing
import resource
import statistics
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

from meshmatch.experiments.cell_training import fewer
from meshmatch.experiments.cells import Cell, Setting
from meshmatch.threads import set_threads
from meshmatch.training.loop import Trainer
from meshmatch.training.setup import build_dataset, build_deformer, build_loss_points

_BATCHES = 2


def built(setting: Setting, cell: Cell) -> tuple[Trainer, list[Any]]:
    """A trainer at its first step, and batches for it."""
    chosen, template, source = setting.recipe(cell), setting.template(cell), setting.sources(cell.pose)[0]
    train = chosen.train
    model = build_deformer(template, source, chosen.network, chosen.scan, chosen.kernel, train.seed)
    points = build_loss_points(template, chosen.kernel, model, strained=setting.strained)
    trainer = Trainer(model, fewer(points, cell.supervised), train)
    data = build_dataset(
        template, source, model, chosen.scan, train.shapes, train.scans_per_shape, train.seed, _BATCHES
    )
    trainer.model.train()
    batches = [data[number].to(trainer.device) for number in range(_BATCHES)]
    return trainer, [replace(each, targets=each.targets[:, : cell.supervised]) for each in batches]


def timed(
    setting: Setting, cells: Sequence[Cell], rounds: int, tell: Callable[[int], None] = lambda done: None
) -> dict[str, dict[str, Any]]:
    """Milliseconds of an iteration, by cell: forward, backward and the optimiser's step, batches at hand.

    All cells are in one process and take turns: in each round every cell does one iteration, each round beginning with
    another cell, so that what else the machine does disturbs all alike. One round before the first does not count.
    """
    set_threads(setting.threads)
    ready = [(cell, *built(setting, cell)) for cell in cells]
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
    trainer, batches = built(setting, cell)
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
