"""Draw training batches, either in worker processes on the CPU or on the device that trains."""

from __future__ import annotations

import signal
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import repeat
from typing import Any, Literal

import torch
from torch import Tensor

from meshmatch.arrays import Float
from meshmatch.generators.generator import source_on, to_device
from meshmatch.training.datasets import BatchDataset, CloudDataset, step_generator

Draw = Literal["auto", "cpu", "device"]
_PREFETCH = 4  # batches that each worker prepares in advance
_SCAN_SEED = 77_003  # seed offset of the scans where their shapes are drawn separately, on the CPU


def batches(
    data: torch.utils.data.Dataset[Any], steps: Sequence[int], device: torch.device, workers: int, draw: Draw = "auto"
) -> Iterator[Any]:
    """Yield the batches of the given steps, on a device.

    ``draw`` "cpu" draws them on the CPU, with ``workers`` processes. "device" draws those of a `BatchDataset` or
    `CloudDataset` on the device, whose random numbers differ from those of the CPU; a custom source still draws its shapes
    on the CPU, and only scans are simulated on the device. "auto" is "device" on CUDA, otherwise "cpu".
    """
    on_cpu = draw == "cpu" or (draw == "auto" and device.type != "cuda")
    if on_cpu or not isinstance(data, BatchDataset | CloudDataset):
        for batch in _load(data, steps, workers):
            yield batch.to(device)
        return
    device_data, seed = on_device(data, device), data.seed
    shapes: Iterable[tuple[Tensor, ...]] = repeat(())
    if isinstance(data, BatchDataset) and source_on(data.source, device) is None:
        shapes = ((verts.to(device),) for verts in _load(_Shapes(data), steps, workers))
        seed += _SCAN_SEED
    for step, shape_args in zip(steps, shapes, strict=False):
        generator = step_generator(seed, step, device)
        with device:  # default device of new tensors
            batch = device_data.batch(generator, *shape_args)
        yield batch


def on_device(data: Any, device: torch.device) -> Any:
    """Copy of a `BatchDataset` or `CloudDataset` with its tensors, and copies of its encoders, on a device."""
    if isinstance(data, CloudDataset):
        return to_device(data, device)
    source = data.source
    return replace(
        to_device(replace(data, source=_placeholder_source), device), source=source_on(source, device) or source
    )


def _placeholder_source(count: int, generator: torch.Generator) -> Tensor:
    raise AssertionError("placeholder for a source that is moved separately")


@dataclass(frozen=True, eq=False)
class _Shapes(torch.utils.data.Dataset[Tensor]):
    """Dataset whose item s is the shapes of training step s."""

    data: BatchDataset

    def __getitem__(self, step: int) -> Float[Tensor, "N V 3"]:
        return self.data.draw_shapes(step_generator(self.data.seed, step))


def _load(data: torch.utils.data.Dataset[Any], steps: Sequence[int], workers: int) -> Iterable[Any]:
    return torch.utils.data.DataLoader(
        data, batch_size=None, sampler=steps, num_workers=workers, prefetch_factor=_PREFETCH if workers else None,
        worker_init_fn=_start_worker,
    )  # fmt: skip


def _start_worker(_: int) -> None:
    """Set up a worker process: use one thread and ignore Ctrl-C.

    The main process ends its workers, after it has saved a checkpoint.
    """
    torch.set_num_threads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
