"""Training losses: reconstruction and the regularisers of the paper."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import torch

from meshmatch.fields.energies import arap_energy, volume_energy
from meshmatch.fields.field import PointField
from meshmatch.models.deformer import Deformer
from meshmatch.training.datasets import Batch


@dataclass(frozen=True)
class LossConfig:
    """Weights l1..l4 of the paper, and of the parts that go past it.

    ``robust``: reconstruct with the mean distance instead of the paper's mean squared distance. ``landmarks``: of known
    points, where there is no other correspondence.
    """

    reconstruction: float = 1.0
    volume: float = 5e-3
    arap: float = 1e-2
    blend: float = 5e-3
    align: float = 0.3
    correct: float = 1.0
    robust: bool = False
    correct_points: int = 1024
    landmarks: float = 1.0


@dataclass(frozen=True, eq=False)
class LossPoints:
    """The supervised template points (M, 3) and the field there, with its gradient on G of them."""

    positions: torch.Tensor
    field: PointField

    def to(self, device: torch.device) -> Self:
        return type(self)(*(value.to(device) for value in vars(self).values()))

    def moved(self, vectors: torch.Tensor) -> torch.Tensor:
        """What the decoder answers (B, R, 3) -> moved points (B, M, 3)."""
        return self.positions + self.field.displacement(vectors)

    def deformation_gradient(self, vectors: torch.Tensor) -> torch.Tensor:
        """What the decoder answers (B, R, 3) -> F (B, G, 3, 3)."""
        return self.field.deformation_gradient(vectors)


def distance(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Mean Euclidean distance of corresponding points."""
    return ((a - b).square().sum(-1) + 1e-8).sqrt().mean()


def rigidity(points: LossPoints, vectors: torch.Tensor, config: LossConfig) -> dict[str, torch.Tensor]:
    """Weighted volume and rigidity of what the decoder answers; nothing is computed for what has no weight."""
    if not config.volume and not config.arap:
        return {}
    F = points.deformation_gradient(vectors)
    return {
        "volume": config.volume * volume_energy(F).mean(),
        "arap": config.arap * arap_energy(F).mean(),
    }


def losses(
    model: Deformer, batch: Batch, points: LossPoints, config: LossConfig, generator: torch.Generator
) -> dict[str, torch.Tensor]:
    """Weighted terms by name; their sum under ``total``. Errors without weight start with ``error``."""
    code = model.encoder(batch.encode_features)
    vectors = model.decoder(code)
    moved = points.moved(vectors)
    fit = distance(moved, batch.targets)
    squared = (moved - batch.targets).square().sum(-1).mean()
    terms = {
        "reconstruction": config.reconstruction * (fit if config.robust else squared),
    }
    terms |= rigidity(points, vectors, config)
    errors = {"error_code": fit.detach()}
    if config.blend:
        share = torch.rand(len(code), 1, generator=generator).to(code.device)
        # Half a batch apart: scans of one shape stand side by side, and between these there is nothing to learn.
        other = code.roll(max(1, len(code) // 2), 0)
        F = points.deformation_gradient(model.decoder(share * code + (1 - share) * other))
        terms["blend"] = config.blend * (volume_energy(F).mean() + arap_energy(F).mean())
    if model.corrector is not None:
        scan = batch.points[:, : config.correct_points]
        current = vectors.detach()
        steps = []
        for _ in range(model.config.corrections):
            current = model.correct(current, scan)
            steps.append(distance(points.moved(current), batch.targets))
            errors["error_corrected"] = steps[-1].detach()
            stiff = list(rigidity(points, current, config).values())
            steps += [stiff[0] + stiff[1]] if stiff else []
            current = current.detach()
        terms["correct"] = config.correct * torch.stack(steps).sum()
    if model.aligner is not None:
        assert batch.align_features is not None and batch.align_rotation is not None
        assert batch.align_centre is not None
        R, t = model.align(batch.align_features)
        turn = (R - batch.align_rotation).square().sum((1, 2)).clamp_min(1e-12).sqrt().mean()
        terms["align"] = config.align * (turn + 3 * distance(t, batch.align_centre))
        errors["error_align"] = turn.detach()
    return {"total": torch.stack(list(terms.values())).sum(), **terms, **errors}
