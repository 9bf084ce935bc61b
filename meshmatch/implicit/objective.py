"""Loss of implicit models: DIF-Net's terms, and the energies of the reduced field."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import torch

from meshmatch.arrays import Float, Int
from meshmatch.fields.field import arap_energy, volume_energy
from meshmatch.implicit.network import Evaluated, ImplicitNetwork, ReducedDeformation
from meshmatch.implicit.samples import FAR
from meshmatch.training.datasets import OnDevice
from meshmatch.training.losses import Objective, Terms

_BLEND_STRIDE = 4  # stride through the points for the energies between codes
_MAX_SDF = 0.5  # bound on signed distances with ``published``


@dataclass(frozen=True, eq=False)
class ImplicitBatch(OnDevice):
    """Indices of B shapes, and samples of each."""

    shape: Int[torch.Tensor, " B"]
    rows: Float[torch.Tensor, "B P 7"]


@dataclass(frozen=True)
class ImplicitLoss(Objective):
    """Weights of DIF-Net's terms (docs/method.md); ``volume``, ``arap`` and ``blend`` (L_Z) are for the reduced field only.

    At points without a distance (NaN), only ``off``, ``eikonal`` and the regularisers act. With ``published`` the terms are
    exactly DIF-Net's: distances are clamped, smoothness is the mean over the rows of F - I, and the distance of every
    second point off the surface is not used.
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
    published: bool = False

    def __call__(self, model: Any, batch: ImplicitBatch, points: None, generator: torch.Generator | None) -> Terms:
        return self.of(model, model.codes[batch.shape], batch.rows, generator)

    def of(
        self,
        model: ImplicitNetwork,
        code: Float[torch.Tensor, "B D"],
        rows: Float[torch.Tensor, "B P 7"],
        generator: torch.Generator | None,
    ) -> Terms:
        """Compute the weighted terms for samples of shapes with these codes, and their sum, ``total``."""
        at, distance, normals = rows.split((3, 1, 3), -1)
        has_distance = distance[..., 0].isfinite()
        truth = distance[..., 0].nan_to_num(nan=1.0)
        found = model(at, code)
        terms = (self._published_terms if self.published else self._default_terms)(
            found, code, truth, has_distance, normals
        )
        if isinstance(model.deformation, ReducedDeformation):
            share = torch.rand(len(code), 1, generator=generator).to(code)
            between = model.deformation.vectors(share * code + (1 - share) * code.roll(1, 0))
            F = torch.eye(3).to(rows) + model.deformation.at(at[:, ::_BLEND_STRIDE]).jacobian(between)
            terms |= self.rigidity(found.F)
            terms["blend"] = self.blend * (volume_energy(F).mean() + arap_energy(F).mean())
        return {"total": torch.stack(list(terms.values())).sum(), **terms}

    def _default_terms(
        self,
        found: Evaluated,
        code: torch.Tensor,
        truth: torch.Tensor,
        has_distance: torch.Tensor,
        normals: torch.Tensor,
    ) -> Terms:
        known = normals.square().sum(-1) > 0
        angles = (
            2 - sum(torch.cosine_similarity(g, normals, -1) for g in (found.gradient, found.template_gradient))
        ) * known
        far = (truth.abs() > FAR) * torch.exp(-100 * found.distance.abs())
        deviation = found.F - torch.eye(3).to(found.F)
        return {
            "sdf": self.sdf * ((found.distance - truth).abs() * has_distance).sum() / has_distance.sum().clamp_min(1),
            "normal": self.normal * angles.sum() / known.sum().clamp_min(1),
            "eikonal": self.eikonal * ((found.gradient.square().sum(-1) + 1e-12).sqrt() - 1).abs().mean(),
            "off": self.off * far.mean(),
            "smooth": self.smooth * (deviation.square().sum((-1, -2)) + 1e-12).sqrt().mean(),
            "correct": self.correct * found.correction.abs().mean(),
            "prior": self.prior * code.square().sum(-1).mean(),
        }

    def _published_terms(
        self,
        found: Evaluated,
        code: torch.Tensor,
        truth: torch.Tensor,
        has_distance: torch.Tensor,
        normals: torch.Tensor,
    ) -> Terms:
        half = has_distance.shape[1] // 2  # the first half lies on the surface
        has_distance = has_distance.clone()
        has_distance[:, half::2] = False
        near, goal = (each.clamp(-_MAX_SDF, _MAX_SDF) for each in (found.distance, truth))
        angles = sum(1 - torch.cosine_similarity(g, normals, -1) for g in (found.gradient, found.template_gradient))
        deviation = found.F - torch.eye(3).to(found.F)
        return {
            "sdf": self.sdf * ((near - goal).abs() * has_distance).mean(),
            "normal": self.normal * (angles * (normals.square().sum(-1) > 0)).mean(),
            "eikonal": self.eikonal * ((found.gradient.square().sum(-1) + 1e-12).sqrt() - 1).abs().mean(),
            "off": self.off * (torch.exp(-100 * found.distance.abs()) * ~has_distance).mean(),
            "smooth": self.smooth * (deviation.square().sum(-1) + 1e-12).sqrt().mean(),
            "correct": self.correct * found.correction.abs().mean(),
            "prior": self.prior * code.square().mean(),
        }


PUBLISHED = ImplicitLoss(off=0.5, prior=1e3, published=True)
"""DIF-Net's terms and relative weights."""
