"""What a training minimises: an `Objective` holds the weights of its terms and computes them for a batch.

A new loss is a subclass of `Objective` in a recipe. `CorrespondenceLoss` (here) knows where every template point belongs;
`meshmatch.training.chamfer.ChamferLoss` does not.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, Self

import torch

from meshmatch.arrays import Float
from meshmatch.fields.energies import arap_energy, volume_energy
from meshmatch.fields.field import PointField
from meshmatch.models.deformer import Deformer
from meshmatch.training.datasets import Batch

Terms = dict[str, torch.Tensor]


@dataclass(frozen=True, eq=False)
class LossPoints:
    """The supervised template points (M, 3) and the field there, with its gradient on the first G of them."""

    positions: Float[torch.Tensor, "M 3"]
    field: PointField

    def to(self, device: torch.device) -> Self:
        return type(self)(*(value.to(device) for value in vars(self).values()))

    def moved(self, rows: Float[torch.Tensor, "B R 3"]) -> Float[torch.Tensor, "B M 3"]:
        """Where what the decoder answers moves the points."""
        return self.positions + self.field.displacement(rows)

    def deformation_gradient(self, rows: Float[torch.Tensor, "B R 3"]) -> Float[torch.Tensor, "B G 3 3"]:
        return self.field.deformation_gradient(rows)


@dataclass(frozen=True)
class Objective(ABC):
    """Weights l1..l4 of the paper (its defaults for registered bodies), and of the learned corrections.

    ``blend`` (l4) is of volume and rigidity between two codes; corrections look at the first ``correct_points`` points
    of a scan.
    """

    reconstruction: float = 1.0
    volume: float = 5e-3
    arap: float = 1e-2
    blend: float = 5e-3
    correct: float = 1.0
    correct_points: int = 1024

    @abstractmethod
    def __call__(self, model: Deformer, batch: Any, points: Any, generator: torch.Generator) -> Terms:
        """Weighted terms by name; their sum under ``total``. Errors without weight start with ``error``."""

    def rigidity(self, F: Float[torch.Tensor, "B G 3 3"]) -> Terms:
        """Weighted volume and as-rigid-as-possible energies of deformation gradients."""
        return {"volume": self.volume * volume_energy(F).mean(), "arap": self.arap * arap_energy(F).mean()}

    def between(
        self,
        model: Deformer,
        code: Float[torch.Tensor, "B D"],
        shift: int,
        points: LossPoints,
        generator: torch.Generator,
    ) -> Terms:
        """The weighted energies of random blends of every code with the one ``shift`` places before it."""
        if not self.blend:
            return {}
        share = torch.rand(len(code), 1, generator=generator).to(code.device)
        F = points.deformation_gradient(model.decoder(share * code + (1 - share) * code.roll(shift, 0)))
        return {"blend": self.blend * (volume_energy(F).mean() + arap_energy(F).mean())}


@dataclass(frozen=True)
class CorrespondenceLoss(Objective):
    """Every template point is pulled to its place on the shape, which is known.

    ``align``: weight of the aligner's rotation and center. ``robust``: the mean distance instead of the paper's mean
    squared distance.
    """

    align: float = 0.3
    robust: bool = False

    def __call__(self, model: Deformer, batch: Batch, points: LossPoints, generator: torch.Generator) -> Terms:
        code = model.encoder(batch.encode_features)
        rows = model.decoder(code)
        moved = points.moved(rows)
        fit = distance(moved, batch.targets)
        squared = (moved - batch.targets).square().sum(-1).mean()
        terms = {"reconstruction": self.reconstruction * (fit if self.robust else squared)}
        terms |= self._rigidity(points, rows)
        errors = {"error_code": fit.detach()}
        # Half a batch apart: scans of one shape stand side by side, and between these there is nothing to learn.
        terms |= self.between(model, code, max(1, len(code) // 2), points, generator)
        if model.corrector is not None:
            scan = batch.points[:, : self.correct_points]
            current = rows.detach()
            steps = []
            for _ in range(model.config.corrections):
                current = model.correct(current, scan)
                steps.append(distance(points.moved(current), batch.targets))
                errors["error_corrected"] = steps[-1].detach()
                stiff = list(self._rigidity(points, current).values())
                steps += [stiff[0] + stiff[1]] if stiff else []
                current = current.detach()
            terms["correct"] = self.correct * torch.stack(steps).sum()
        if model.aligner is not None:
            assert batch.align_features is not None and batch.align_rotation is not None
            assert batch.align_center is not None
            R, t = model.align(batch.align_features)
            turn = (R - batch.align_rotation).square().sum((1, 2)).clamp_min(1e-12).sqrt().mean()
            terms["align"] = self.align * (turn + 3 * distance(t, batch.align_center))
            errors["error_align"] = turn.detach()
        return {"total": torch.stack(list(terms.values())).sum(), **terms, **errors}

    def _rigidity(self, points: LossPoints, rows: torch.Tensor) -> Terms:
        if not self.volume and not self.arap:
            return {}  # the gradient is not computed for nothing
        return self.rigidity(points.deformation_gradient(rows))


def distance(a: Float[torch.Tensor, "*N 3"], b: Float[torch.Tensor, "*N 3"]) -> Float[torch.Tensor, ""]:
    """Mean Euclidean distance of corresponding points."""
    return ((a - b).square().sum(-1) + 1e-8).sqrt().mean()


@torch.no_grad()
def validation_error(model: Deformer, batch: Batch, points: LossPoints) -> float:
    """Mean distance (units of sqrt(area)) on held-out scans, learned corrections included."""
    was = model.training
    model.eval()
    device = points.positions.device
    error = float(distance(points.moved(model(batch.points.to(device))), batch.targets.to(device)))
    model.train(was)
    return error
