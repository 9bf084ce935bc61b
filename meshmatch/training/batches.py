"""Where the batches of a training are drawn: by processes on the CPU, or on the device that learns from them."""

from __future__ import annotations

import signal
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import repeat
from typing import Any, Literal

import torch
from torch import Tensor

from meshmatch.arrays import Float
from meshmatch.generators.generator import moved, source_on
from meshmatch.training.datasets import BatchDataset, CloudDataset, step_generator

Draw = Literal["auto", "cpu", "device"]
_AHEAD = 4  # batches that a process keeps ready
_SCANS = 77_003  # sets the stream of scans apart from that of shapes that are drawn elsewhere


def batches(
    data: torch.utils.data.Dataset[Any], steps: Sequence[int], device: torch.device, workers: int, draw: Draw = "auto"
) -> Iterator[Any]:
    """The batches of some steps, on a device.

    "device" draws there what `BatchDataset` and `CloudDataset` hold, with random numbers of that sort of device; of a
    source of shapes that is not one of ours the shapes are drawn on the CPU, and scans made of them on the device. "auto"
    does so on a GPU of CUDA.
    """
    elsewhere = draw == "cpu" or (draw == "auto" and device.type != "cuda")
    if elsewhere or not isinstance(data, BatchDataset | CloudDataset):
        for batch in _loaded(data, steps, workers):
            yield batch.to(device)
        return
    here, seed = drawing_on(data, device), data.seed
    shapes: Iterable[tuple[Tensor, ...]] = repeat(())
    if isinstance(data, BatchDataset) and source_on(data.source, device) is None:
        shapes = ((verts.to(device),) for verts in _loaded(_Shapes(data), steps, workers))
        seed += _SCANS
    for step, given in zip(steps, shapes, strict=False):
        generator = step_generator(seed, step, device)
        with device:  # where new tensors are
            batch = here.batch(generator, *given)
        yield batch


def drawing_on(data: Any, device: torch.device) -> Any:
    """The same `BatchDataset` or `CloudDataset`, with all of its tensors and copies of its encoders on a device."""
    if isinstance(data, CloudDataset):
        return moved(data, device)
    source = data.source
    return replace(moved(replace(data, source=_nowhere), device), source=source_on(source, device) or source)


def _nowhere(count: int, generator: torch.Generator) -> Tensor:
    raise AssertionError("stands for a source that is moved by itself")


@dataclass(frozen=True, eq=False)
class _Shapes(torch.utils.data.Dataset[Tensor]):
    """Item s are the shapes of step s."""

    data: BatchDataset

    def __getitem__(self, step: int) -> Float[Tensor, "N V 3"]:
        return self.data.drawn(step_generator(self.data.seed, step))


def _loaded(data: torch.utils.data.Dataset[Any], steps: Sequence[int], workers: int) -> Iterable[Any]:
    return torch.utils.data.DataLoader(
        data, batch_size=None, sampler=steps, num_workers=workers, prefetch_factor=_AHEAD if workers else None,
        worker_init_fn=_begin,
    )  # fmt: skip


def _begin(_: int) -> None:
    """A process that draws batches: of one thread, and ended by the training, which has yet to save itself on Ctrl-C."""
    torch.set_num_threads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
