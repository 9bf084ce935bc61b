"""The objective without correspondence: a robust Chamfer distance, the paper's regularisers, known points."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from meshmatch.arrays import Float
from meshmatch.fields.field import PointField
from meshmatch.models.deformer import Deformer
from meshmatch.models.neighbours import nearest_index
from meshmatch.training.clouds import CloudBatch, deformed_normals
from meshmatch.training.losses import LossPoints, Objective, Terms

NORMAL_WEIGHT = 0.15
"""How far a normal that points the other way (2 units) pushes a neighbour away, units of sqrt(area); set by hand."""
_ROBUST = 0.25  # distances far beyond it no longer pull harder, units of sqrt(area); set by hand


@dataclass(frozen=True, eq=False)
class SurfacePoints(LossPoints):
    """Template points with unit normals (M, 3), and the template's known points (L, 3) with the field there."""

    normals: Float[torch.Tensor, "M 3"]
    landmarks: Float[torch.Tensor, "L 3"]
    landmark_field: PointField


@dataclass(frozen=True)
class ChamferLoss(Objective):
    """The template is pulled to the nearest points of a shape, and they to it; ``landmarks`` weighs known points."""

    landmarks: float = 1.0

    def __call__(self, model: Deformer, batch: CloudBatch, points: SurfacePoints, generator: torch.Generator) -> Terms:
        code = model.encoder(batch.encode_features)
        rows = model.decoder(code)
        terms, fit = self._energies(rows, batch, points)
        # Neighbours are of different shapes: each is drawn once before one comes again, and scanned once.
        terms |= self.between(model, code, 1, points, generator)
        if model.corrector is not None:
            current = rows.detach()
            correct: torch.Tensor | float = 0.0
            for _ in range(model.config.corrections):
                current = model.correct(current, batch.points[:, : self.correct_points])
                again, fit = self._energies(current, batch, points)
                correct = correct + self.correct * torch.stack(list(again.values())).sum()
                current = current.detach()
            assert isinstance(correct, torch.Tensor)
            terms["correct"] = correct
        return {"total": torch.stack(list(terms.values())).sum(), **terms, "error": fit}

    def _energies(
        self, rows: Float[torch.Tensor, "B R 3"], batch: CloudBatch, points: SurfacePoints
    ) -> tuple[Terms, Float[torch.Tensor, ""]]:
        """Weighted terms of node vectors, and the mean distance both ways."""
        moved = points.moved(rows)
        F = points.deformation_gradient(rows)
        normals = deformed_normals(F.detach(), points.normals)
        there, back = chamfer(moved, normals, batch.points, batch.normals)
        terms = {"reconstruction": self.reconstruction * (robust(there).mean() + robust(back).mean())}
        terms |= self.rigidity(F)
        known = ~batch.landmarks.isnan().any(-1)
        if self.landmarks and known.any():
            placed = points.landmarks + points.landmark_field.displacement(rows)
            apart = (placed[known] - batch.landmarks[known]).square().sum(-1)
            terms["landmarks"] = self.landmarks * apart.mean()
        with torch.no_grad():
            fit = 0.5 * ((there + 1e-12).sqrt().mean() + (back + 1e-12).sqrt().mean())
        return terms, fit


def chamfer(
    moved: Float[torch.Tensor, "B M 3"],
    normals: Float[torch.Tensor, "B M 3"],
    points: Float[torch.Tensor, "B P 3"],
    point_normals: Float[torch.Tensor, "B P 3"],
) -> tuple[Float[torch.Tensor, "B M"], Float[torch.Tensor, "B P"]]:
    """Squared distances of the moved points to the nearest of the others, and back.

    Neighbours are nearest in position and a share of the normal; the distance is of positions alone, and gradients
    flow through it into ``moved``.
    """
    with torch.no_grad():
        a = torch.cat([moved, NORMAL_WEIGHT * normals], -1).float()
        b = torch.cat([points, NORMAL_WEIGHT * point_normals], -1).float()
        forward, back = nearest_index(a, b), nearest_index(b, a)
    nearest = torch.gather(points, 1, forward[..., None].expand(-1, -1, 3))
    partner = torch.gather(moved, 1, back[..., None].expand(-1, -1, 3))
    return (moved - nearest).square().sum(-1), (partner - points).square().sum(-1)


def robust(squared: Float[torch.Tensor, "*N"]) -> Float[torch.Tensor, "*N"]:
    """Geman and McClure's function of squared distances: d^2 / (1 + d^2 / s^2), near d^2 for small ones."""
    return squared / (1 + squared / _ROBUST**2)


@torch.no_grad()
def surface_error(model: Deformer, batch: CloudBatch, points: SurfacePoints) -> float:
    """Mean distance both ways between the fitted template and held-out draws of the shapes, units of sqrt(area)."""
    was = model.training
    model.eval()
    batch = batch.to(points.positions.device)
    terms = ChamferLoss(blend=0.0)(model, batch, points, torch.Generator())
    model.train(was)
    return float(terms["error"])
