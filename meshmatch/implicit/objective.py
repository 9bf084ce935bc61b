"""What a training of implicit surfaces minimises: DIF-Net's terms, and the energies of the reduced field."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import torch

from meshmatch.arrays import Float, Int
from meshmatch.fields.field import arap_energy, volume_energy
from meshmatch.implicit.network import ImplicitNetwork, ReducedDeformation
from meshmatch.implicit.samples import FAR
from meshmatch.training.datasets import OnDevice
from meshmatch.training.losses import Objective, Terms

_BLENDED = 4  # every so many-th point for the energies between codes


@dataclass(frozen=True, eq=False)
class ImplicitBatch(OnDevice):
    """Which B of the shapes, and samples of each."""

    shape: Int[torch.Tensor, " B"]
    rows: Float[torch.Tensor, "B P 7"]


@dataclass(frozen=True)
class ImplicitLoss(Objective):
    """DIF-Net's terms (docs/method.md); volume, arap and blend (L_Z) are of the reduced field alone.

    Where a distance is not known (NaN), only ``off`` and ``eikonal`` act.
    """

    needs_correspondence: ClassVar[bool] = False
    volume: float = 1e-3
    arap: float = 2e-3
    blend: float = 1e-3
    correct: float = 0.1
    sdf: float = 3.0
    normal: float = 0.1
    eikonal: float = 0.05
    off: float = 0.1
    smooth: float = 5e-3
    prior: float = 1e-3

    def __call__(self, model: Any, batch: ImplicitBatch, points: None, generator: torch.Generator) -> Terms:
        return self.of(model, model.codes[batch.shape], batch.rows, generator)

    def of(
        self,
        model: ImplicitNetwork,
        code: Float[torch.Tensor, "B D"],
        rows: Float[torch.Tensor, "B P 7"],
        generator: torch.Generator,
    ) -> Terms:
        """The weighted terms for samples of shapes with these codes; their sum under ``total``."""
        eye = torch.eye(3).to(rows)
        at, distance, normals = rows.split((3, 1, 3), -1)
        said = distance[..., 0].isfinite()
        truth = distance[..., 0].nan_to_num(nan=1.0)
        found = model(at, code)
        known = normals.square().sum(-1) > 0
        angles = (
            2 - sum(torch.cosine_similarity(g, normals, -1) for g in (found.gradient, found.template_gradient))
        ) * known
        far = (truth.abs() > FAR) * torch.exp(-100 * found.distance.abs())
        terms = {
            "sdf": self.sdf * ((found.distance - truth).abs() * said).sum() / said.sum().clamp_min(1),
            "normal": self.normal * angles.sum() / known.sum().clamp_min(1),
            "eikonal": self.eikonal * ((found.gradient.square().sum(-1) + 1e-12).sqrt() - 1).abs().mean(),
            "off": self.off * far.mean(),
            "smooth": self.smooth * ((found.F - eye).square().sum((-1, -2)) + 1e-12).sqrt().mean(),
            "correct": self.correct * found.correction.abs().mean(),
            "prior": self.prior * code.square().sum(-1).mean(),
        }
        if isinstance(model.deformation, ReducedDeformation):
            share = torch.rand(len(code), 1, generator=generator).to(code)
            between = model.deformation.vectors(share * code + (1 - share) * code.roll(1, 0))
            F = eye + model.deformation.at(at[:, ::_BLENDED]).jacobian(between)
            terms |= self.rigidity(found.F)
            terms["blend"] = self.blend * (volume_energy(F).mean() + arap_energy(F).mean())
        return {"total": torch.stack(list(terms.values())).sum(), **terms}
