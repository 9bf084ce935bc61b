"""The paper's refinement: Adam on the shape code, Chamfer plus volume and as-rigid-as-possible energies."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree

from meshmatch.fields.energies import arap_energy, volume_energy
from meshmatch.fields.mls import build_field
from meshmatch.fitting.scan import Scan
from meshmatch.models.deformer import Deformer
from meshmatch.shapes.sampling import farthest_points
from meshmatch.templates.template import Template


@dataclass(frozen=True)
class LatentRefineConfig:
    """The paper's test-time weights L1..L3, steps and rate."""

    steps: int = 2000
    rate: float = 1e-3
    chamfer: float = 1.0
    volume: float = 1e-4
    arap: float = 1e-3
    points: int = 3000


def refine_code(
    model: Deformer,
    template: Template,
    scan: Scan,
    config: LatentRefineConfig,
    rng: np.random.Generator,
    progress: Callable[[int, int], None] | None = None,
) -> np.ndarray:
    """Node vectors (K, 3) of the code that fits a scan (core frame) best.

    The learned corrections of the first code, where the model has them, stay as a constant offset.
    The best code seen is returned, so the energy never ends higher than it began.
    """
    chosen = rng.choice(len(scan.points), min(config.points, len(scan.points)), replace=False)
    points = torch.from_numpy(scan.points[chosen]).float()
    tree = cKDTree(scan.points[chosen])
    at = farthest_points(template.shape.verts, min(config.points, template.shape.V))
    verts = torch.from_numpy(template.shape.verts[at]).float()
    field = build_field(template.shape.verts[at], template.nodes, template.radius)
    with torch.no_grad():
        code = model.encoder(model.encoder.features(points[None]))
        offset = model(points[None]) - model.decoder(code)
    code = code.detach().clone().requires_grad_(True)
    optimiser = torch.optim.Adam([code], lr=config.rate)
    best, best_vectors = np.inf, None
    for step in range(config.steps):
        vectors = model.decoder(code) + offset
        moved = verts + field.displacement(vectors)[0]
        F = field.deformation_gradient(vectors)
        energy = (
            config.chamfer * _chamfer(moved, points, tree)
            + config.volume * volume_energy(F).mean()
            + config.arap * arap_energy(F).mean()
        )
        if float(energy) < best:
            best, best_vectors = float(energy), vectors.detach()[0]
        optimiser.zero_grad()
        energy.backward()
        optimiser.step()
        if progress is not None and (step % 20 == 0 or step == config.steps - 1):
            progress(step + 1, config.steps)
    assert best_vectors is not None
    return best_vectors.double().numpy()


def _chamfer(moved: torch.Tensor, points: torch.Tensor, tree: cKDTree) -> torch.Tensor:
    """Mean squared nearest distances both ways; neighbours from trees, gradients through the distances."""
    here = moved.detach().numpy()
    forward = torch.from_numpy(tree.query(here)[1])
    back = torch.from_numpy(cKDTree(here).query(points.numpy())[1])
    return (moved - points[forward]).square().sum(1).mean() + (moved[back] - points).square().sum(1).mean()
