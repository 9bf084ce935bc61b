"""The paper's refinement: Adam on the shape code, Chamfer plus volume and as-rigid-as-possible energies."""

from __future__ import annotations

import numpy as np
import torch

from meshmatch.arrays import Float, Floats
from meshmatch.derived import derived
from meshmatch.fields.field import Field, PointField, arap_energy, volume_energy
from meshmatch.fields.shape_functions import ShapeFunctions
from meshmatch.fitting.fit_config import LatentRefineConfig
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.geometry.trees import cKDTree
from meshmatch.models.trained import TrainedModel, torch_network
from meshmatch.progress import Progress
from meshmatch.shapes.sampling import farthest_points
from meshmatch.templates.template import template_radius


class PaperEnergy:
    """The paper's energy of decoded node vectors: Chamfer distance to points drawn from samples, plus volume and rigidity.

    Samples are in the core frame. The energy is computed on a device of torch.
    """

    def __init__(
        self,
        model: TrainedModel,
        samples: OrientedPoints,
        config: LatentRefineConfig,
        rng: np.random.Generator,
        device: str = "cpu",
    ) -> None:
        self.config, self.network = config, torch_network(model, device)
        # The paper's weights are for shapes scaled to the unit sphere, as models with scale "sphere" have them.
        sphere = template_radius(model.template) if model.card.frame["scale"] == "sphere" else 1.0
        self._chamfer_weight = config.chamfer / sphere**2
        drawn = samples.drawn(config.points, rng)
        self.points = torch.from_numpy(drawn).float().to(device)
        self._tree = cKDTree(drawn)
        self._template = _on_template(model, min(config.points, model.template.shape.V), device)

    def __call__(self, vectors: torch.Tensor) -> torch.Tensor:
        """Energy (a scalar tensor) of a batch of one (1, R, 3), such as node vectors, in the core frame."""
        verts, field = self._template
        moved = verts + field.displacement(vectors)[0]
        chamfer = self._chamfer_weight * _chamfer(moved, self.points, self._tree)
        if not self.config.volume and not self.config.arap:
            return chamfer
        F = field.deformation_gradient(vectors)[0]
        stiff: torch.Tensor = self.config.volume * volume_energy(F).mean() + self.config.arap * arap_energy(F).mean()
        return chamfer + stiff

    def value(self, vectors: Float[Floats, "K 3"]) -> float:
        """The energy of an array of node vectors."""
        with torch.no_grad():
            return float(self(torch.from_numpy(vectors).float()[None].to(self.points.device)))


def refine_code(
    model: TrainedModel,
    samples: OrientedPoints,
    config: LatentRefineConfig,
    rng: np.random.Generator,
    progress: Progress | None = None,
    start: Float[Floats, "K 3"] | None = None,
    device: str = "cpu",
) -> Float[Floats, "K 3"]:
    """Node vectors of the code that fits samples (core frame) best, found by Adam.

    The best of all visited codes is returned, so the final energy is never above the initial one. The search starts from
    the network's own prediction, or from given node vectors. The difference between these and the decoder's output for the
    encoder's code (learned corrections, if the model has them) is kept as a constant offset.
    """
    energy_of = PaperEnergy(model, samples, config, rng, device)
    network = energy_of.network
    with torch.no_grad():
        code = network.encoder(network.encoder.features(energy_of.points[None]))
        first = network(energy_of.points[None]) if start is None else torch.from_numpy(start).float()[None].to(device)
        offset = first - network.decoder(code)
    code = code.detach().clone().requires_grad_(True)
    optimiser = torch.optim.Adam([code], lr=config.rate)
    best, best_vectors = np.inf, None
    for step in range(config.steps):
        vectors = network.decoder(code) + offset
        energy = energy_of(vectors)
        if float(energy.detach()) < best:
            best, best_vectors = float(energy.detach()), vectors.detach()[0]
        # The gradient of the code only: those of the decoder's weights would cost more than everything else.
        (code.grad,) = torch.autograd.grad(energy, code)
        optimiser.step()
        if progress is not None and (step % 20 == 0 or step == config.steps - 1):
            progress((step + 1) / config.steps)
    assert best_vectors is not None
    return np.asarray(best_vectors.double().cpu().numpy())


@derived
def _on_template(model: TrainedModel, P: int, device: str) -> tuple[torch.Tensor, PointField]:
    """Points (P, 3) of the template, and the field at these points."""
    verts = model.template.shape.verts
    verts = verts[farthest_points(verts, P)]
    at = torch.from_numpy(verts).float().to(device)
    if not model.has_nodes:
        return at, torch_network(model, device).pointwise_field(verts).to(device)
    field = model.field(verts)
    assert isinstance(field, ShapeFunctions)
    return at, Field.of(field).to(device).for_descent()


def _chamfer(moved: torch.Tensor, points: torch.Tensor, tree: cKDTree) -> torch.Tensor:
    """Mean squared nearest distances in both directions.

    Neighbours are found by trees; gradients pass through the distances.
    """
    here = moved.detach().cpu().numpy()
    forward = torch.from_numpy(tree.query(here)[1])
    back = torch.from_numpy(cKDTree(here).query(points.cpu().numpy())[1])
    return (moved - points[forward]).square().sum(1).mean() + (moved[back] - points).square().sum(1).mean()
