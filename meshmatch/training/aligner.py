"""Train the aligner on its own, before the whole network: on a fixed set of scans, rotated anew in every step.

A step takes a tenth of the time of one of the whole network, and learning all orientations takes many steps.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from meshmatch.arrays import Float
from meshmatch.errors import ModelError
from meshmatch.models.deformer import Deformer
from meshmatch.outputs import replace_on_success
from meshmatch.progress import Progress
from meshmatch.training import scans
from meshmatch.training.batches import Draw, batches
from meshmatch.training.datasets import BatchDataset, step_generator

_SEED = 424_243  # seed offset of the scans, so that no other step draws the same ones
_BATCH, _POINTS, _SHAPES = 64, 1024, 2048
_RATE, _WARM_UP = 2e-3, 100


class _PointFeatures(torch.nn.Module):
    """Placeholder for an aligner, with the points themselves as features."""

    def features(self, points: Float[Tensor, "B P 3"]) -> Float[Tensor, "B P 3"]:
        return points[:, :_POINTS]


@dataclass(frozen=True)
class Aligned:
    """Result of training the aligner.

    ``done`` is whether all steps are done; ``seconds`` is the time of this run, ``total_seconds`` that of all runs;
    ``error`` is a running mean of the Frobenius distance between predicted and correct rotations.
    """

    done: bool = True
    seconds: float = 0.0
    total_seconds: float = 0.0
    error: float = math.nan


def train_aligner(
    model: Deformer,
    data: BatchDataset,
    steps: int,
    progress: Progress | None = None,
    draw: Draw = "auto",
    minutes: float | None = None,
    checkpoint: Path | None = None,
) -> Aligned:
    """Train the aligner of a model in place, on the model's device; the result depends on the data's seed and the kind of
    device.

    After ``minutes`` it stops and writes ``checkpoint``, from which the next call resumes (`ModelError` if it belongs to
    another training).
    """
    aligner, device, start = model.aligner, model.nodes.device, time.monotonic()
    assert aligner is not None
    raw = replace(data, aligner=_PointFeatures(), encoder=None, seed=data.seed + _SEED)  # type: ignore[arg-type]
    scan_batches = list(batches(raw, range(-(-_SHAPES // data.shapes)), device, 0, draw))
    points, rotation, center = (
        torch.cat([getattr(batch, name) for batch in scan_batches])
        for name in ("align_features", "align_rotation", "align_center")
    )
    optimiser = torch.optim.AdamW(aligner.parameters(), _RATE, betas=(0.9, 0.99), weight_decay=0.01)
    first_step, seconds_before = 0, 0.0
    if checkpoint is not None and checkpoint.is_file():
        first_step, seconds_before = _load(
            checkpoint, aligner, optimiser, {"seed": str(data.seed), "steps": str(steps)}
        )
    aligner.train()
    recent_error = torch.zeros((), device=device)
    for step in range(first_step, steps):
        generator = step_generator(data.seed + _SEED, step, device)
        torch.manual_seed(step)  # for dropout
        for group in optimiser.param_groups:
            group["lr"] = _RATE * min(1.0, (step + 1) / _WARM_UP) * 0.5 * (1 + np.cos(np.pi * step / steps))
        with device:
            rows = torch.randint(len(points), (_BATCH,), generator=generator)
            rotations = scans.random_rotations(_BATCH, generator)
        rotated = points[rows] @ rotations.transpose(1, 2)
        middle = rotated.mean(1, keepdim=True)
        with torch.no_grad():
            features = aligner.features(rotated - middle)
        R, t = model.align(features)
        rotation_error = (R - rotations @ rotation[rows]).square().sum((1, 2)).clamp_min(1e-12).sqrt().mean()
        true_center = (rotations @ center[rows][..., None])[..., 0] - middle[:, 0]
        loss = rotation_error + 3 * (t - true_center).norm(dim=1).mean()
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
        recent_error = recent_error + (rotation_error.detach() - recent_error) / min(step - first_step + 1, 50)
        if progress is not None:
            progress((step + 1) / steps)
        seconds = time.monotonic() - start
        if minutes is not None and seconds > 60 * minutes and step + 1 < steps:
            if checkpoint is not None:
                metadata = {"step": str(step + 1), "seconds": f"{seconds_before + seconds:.1f}"}
                _save(checkpoint, aligner, optimiser, metadata | {"seed": str(data.seed), "steps": str(steps)})
            return Aligned(False, seconds, seconds_before + seconds, float(recent_error))
    seconds = time.monotonic() - start
    return Aligned(True, seconds, seconds_before + seconds, float(recent_error))


def _save(path: Path, aligner: torch.nn.Module, optimiser: torch.optim.Optimizer, metadata: dict[str, str]) -> None:
    arrays = {f"aligner.{name}": tensor for name, tensor in aligner.state_dict().items()}
    for index, state in optimiser.state_dict()["state"].items():
        arrays |= {f"optimiser.{index}.{name}": torch.as_tensor(tensor) for name, tensor in state.items()}
    with replace_on_success(path) as temporary:
        save_file(
            {name: each.detach().cpu().contiguous().clone() for name, each in arrays.items()}, temporary, metadata
        )


def _load(
    path: Path, aligner: torch.nn.Module, optimiser: torch.optim.Optimizer, expected: dict[str, str]
) -> tuple[int, float]:
    """Restore the state that `_save` wrote; return the next step, and seconds of all previous runs."""
    parts: dict[str, dict[str, Tensor]] = {"aligner": {}}
    try:
        with safe_open(str(path), framework="pt") as file:
            metadata = file.metadata() or {}
            step, seconds = int(metadata["step"]), float(metadata["seconds"])
            for name in file.keys():  # noqa: SIM118 (it is no dictionary)
                part, _, key = name.rpartition(".") if name.startswith("optimiser.") else name.partition(".")
                parts.setdefault(part, {})[key] = file.get_tensor(name)
        if any(metadata[name] != value for name, value in expected.items()) or not 0 < step < int(expected["steps"]):
            raise ValueError("of another training")
        aligner.load_state_dict(parts.pop("aligner"))
        state = {int(part.removeprefix("optimiser.")): each for part, each in parts.items()}
        optimiser.load_state_dict({"state": state, "param_groups": optimiser.state_dict()["param_groups"]})
    except (SafetensorError, OSError, LookupError, ValueError, RuntimeError) as error:
        hint = "train into another folder, or start afresh"
        raise ModelError(f"{path} is not a checkpoint of this training", hint) from error
    return step, seconds
