"""The aligner alone, before everything else learns: it sees a fixed set of scans, turned anew in every step.

A step costs a tenth of one of the whole network, and what it takes to know every orientation is steps.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from meshmatch.arrays import Float
from meshmatch.models.deformer import Deformer
from meshmatch.progress import Progress
from meshmatch.training import scans
from meshmatch.training.batches import Draw, batches
from meshmatch.training.datasets import BatchDataset, step_generator

_SEED = 424_243  # of the scans, which no other step draws
_BATCH, _POINTS, _SHAPES = 64, 1024, 2048
_RATE, _WARM_UP = 2e-3, 100


class _Unread(torch.nn.Module):
    """Stands for an aligner whose features are the points themselves."""

    def features(self, points: Float[Tensor, "B P 3"]) -> Float[Tensor, "B P 3"]:
        return points[:, :_POINTS]


def train_aligner(
    model: Deformer, data: BatchDataset, steps: int, progress: Progress | None = None, draw: Draw = "auto"
) -> float:
    """Train the aligner of a model in place, where the model is; the mean distance of its last rotations. A function of the
    data's seed and the sort of device."""
    aligner, device = model.aligner, model.nodes.device
    assert aligner is not None
    raw = replace(data, aligner=_Unread(), encoder=None, seed=data.seed + _SEED)  # type: ignore[arg-type]
    drawn = list(batches(raw, range(-(-_SHAPES // data.shapes)), device, 0, draw))
    points, rotation, center = (
        torch.cat([getattr(batch, name) for batch in drawn])
        for name in ("align_features", "align_rotation", "align_center")
    )
    optimiser = torch.optim.AdamW(aligner.parameters(), _RATE, betas=(0.9, 0.99), weight_decay=0.01)
    aligner.train()
    recent = torch.zeros((), device=device)
    for step in range(steps):
        generator = step_generator(data.seed + _SEED, step, device)
        torch.manual_seed(step)  # of dropout
        for group in optimiser.param_groups:
            group["lr"] = _RATE * min(1.0, (step + 1) / _WARM_UP) * 0.5 * (1 + np.cos(np.pi * step / steps))
        with device:
            rows = torch.randint(len(points), (_BATCH,), generator=generator)
            turn = scans.random_rotations(_BATCH, generator)
        turned = points[rows] @ turn.transpose(1, 2)
        middle = turned.mean(1, keepdim=True)
        with torch.no_grad():
            features = aligner.features(turned - middle)
        R, t = model.align(features)
        off = (R - turn @ rotation[rows]).square().sum((1, 2)).clamp_min(1e-12).sqrt().mean()
        wanted = (turn @ center[rows][..., None])[..., 0] - middle[:, 0]
        loss = off + 3 * (t - wanted).norm(dim=1).mean()
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
        recent = recent + (off.detach() - recent) / min(step + 1, 50)
        if progress is not None:
            progress((step + 1) / steps)
    return float(recent)
