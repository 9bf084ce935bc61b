"""The objective without correspondence: a robust Chamfer distance, the paper's regularisers, known points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree

from meshmatch.fields.energies import arap_energy, volume_energy
from meshmatch.fields.field import PointField
from meshmatch.fields.mls import Kernel
from meshmatch.models.deformer import Deformer
from meshmatch.models.neighbours import every_pair
from meshmatch.templates.template import Template
from meshmatch.training.clouds import CloudBatch, turned_normals
from meshmatch.training.losses import LossConfig, LossPoints
from meshmatch.training.setup import loss_vertices

NORMAL_WEIGHT = 0.15
"""How far a normal that points the other way (2 units) pushes a neighbour away, units of sqrt(area)."""
_ROBUST = 0.25  # distances far beyond it no longer pull harder, units of sqrt(area)


@dataclass(frozen=True, eq=False)
class SurfacePoints(LossPoints):
    """Template points with unit normals (M, 3), and the template's known points (L, 3) with the field there."""

    normals: torch.Tensor
    landmarks: torch.Tensor
    landmark_field: PointField


def build_surface_points(
    template: Template, kernel: Kernel, model: Deformer, landmarks: np.ndarray, count: int = 1200
) -> SurfacePoints:
    """Evenly spread template vertices with what the objective needs of them."""
    chosen = loss_vertices(template, count)
    at = np.concatenate([chosen, landmarks]).astype(np.int64)
    verts = template.shape.verts[at]
    field = model.field(verts, template.nodes, template.radius, kernel).for_training()
    M = len(chosen)
    return SurfacePoints(
        torch.from_numpy(verts[:M]).float(),
        field.part(0, M),
        torch.from_numpy(template.shape.vertex_normals[chosen]).float(),
        torch.from_numpy(verts[M:]).float(),
        field.part(M, len(at)),
    )


def chamfer(
    moved: torch.Tensor, normals: torch.Tensor, points: torch.Tensor, theirs: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Squared distances to the nearest of the other set, with normals: (B, M) of the moved points, (B, P) back.

    Neighbours are nearest in position and a share of the normal; the distance is of positions alone, and gradients
    flow through it into ``moved``.
    """
    with torch.no_grad():
        a = torch.cat([moved, NORMAL_WEIGHT * normals], -1).float()
        b = torch.cat([points, NORMAL_WEIGHT * theirs], -1).float()
        forward, back = _nearest(a, b), _nearest(b, a)
    nearest = torch.gather(points, 1, forward[..., None].expand(-1, -1, 3))
    partner = torch.gather(moved, 1, back[..., None].expand(-1, -1, 3))
    return (moved - nearest).square().sum(-1), (partner - points).square().sum(-1)


def _nearest(queries: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    """Index (B, Q) of the nearest of ``points`` (B, P, D): trees on a CPU, where comparing all pairs is far slower."""
    if queries.is_cuda:
        return every_pair(queries, points)
    found = [
        cKDTree(there, balanced_tree=False, compact_nodes=False).query(here)[1]
        for here, there in zip(queries.numpy(), points.numpy(), strict=True)
    ]
    return torch.from_numpy(np.stack(found))


def robust(squared: torch.Tensor) -> torch.Tensor:
    """Geman and McClure's function of squared distances: d^2 / (1 + d^2 / s^2), near d^2 for small ones."""
    return squared / (1 + squared / _ROBUST**2)


def chamfer_losses(
    model: Deformer, batch: CloudBatch, points: SurfacePoints, config: LossConfig, generator: torch.Generator
) -> dict[str, torch.Tensor]:
    """Weighted terms by name; their sum under ``total``. Errors without weight start with ``error``."""
    code = model.encoder(batch.encode_features)
    vectors = model.decoder(code)
    shape, fit = _energies(vectors, batch, points, config)
    terms = dict(shape)
    if config.blend:
        share = torch.rand(len(code), 1, generator=generator).to(code.device)
        # Neighbours are of different shapes: each is drawn once before one comes again, and scanned once.
        F = points.deformation_gradient(model.decoder(share * code + (1 - share) * code.roll(1, 0)))
        terms["blend"] = config.blend * (volume_energy(F).mean() + arap_energy(F).mean())
    if model.corrector is not None:
        current = vectors.detach()
        for _ in range(model.config.corrections):
            current = model.correct(current, batch.points[:, : config.correct_points])
            again, fit = _energies(current, batch, points, config)
            terms["correct"] = (
                terms.get("correct", 0.0) + config.correct * torch.stack(list(again.values())).sum()
            )
            current = current.detach()
    return {"total": torch.stack(list(terms.values())).sum(), **terms, "error": fit}


def _energies(
    vectors: torch.Tensor, batch: CloudBatch, points: SurfacePoints, config: LossConfig
) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
    """Weighted terms of node vectors, and the mean distance both ways."""
    moved = points.moved(vectors)
    F = points.deformation_gradient(vectors)
    there, back = chamfer(moved, turned_normals(F.detach(), points.normals), batch.points, batch.normals)
    terms = {
        "reconstruction": config.reconstruction * (robust(there).mean() + robust(back).mean()),
        "volume": config.volume * volume_energy(F).mean(),
        "arap": config.arap * arap_energy(F).mean(),
    }
    known = ~batch.landmarks.isnan().any(-1)
    if config.landmarks and known.any():
        placed = points.landmarks + points.landmark_field.displacement(vectors)
        terms["landmarks"] = (
            config.landmarks * (placed[known] - batch.landmarks[known]).square().sum(-1).mean()
        )
    with torch.no_grad():
        fit = 0.5 * ((there + 1e-12).sqrt().mean() + (back + 1e-12).sqrt().mean())
    return terms, fit
