"""An untrained model of eggs: small, fast, and complete enough for fitting."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import torch

from meshmatch.geometry.kernels import Kernel
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.models.card import write_card
from meshmatch.models.checkpoint import save_weights
from meshmatch.models.inference import NetworkConfig
from meshmatch.models.trained import TrainedModel
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape
from meshmatch.templates.template import save_template
from tests.models.small_model import small_card
from tests.training.small import NETWORK, bent_eggs, egg_template, small_network


@cache
def egg_model(kernel: Kernel = "smooth", network: NetworkConfig = NETWORK) -> TrainedModel:
    template = egg_template()
    card = small_card(
        name="egg",
        category="eggs",
        template=template.name,
        template_hash=template.hash,
        network=network.to_dict(),
        field={"kernel": kernel, "radius": template.radius, "nodes": template.K},
        seed=0,
    )
    return TrainedModel.of(card, template, small_network(template, network, kernel=kernel).eval())


def write_model(model: TrainedModel, folder: Path) -> Path:
    """Write a model as a model folder."""
    folder.mkdir(parents=True)
    save_template(model.template, folder / "template.safetensors")
    digest = save_weights(model.network.state_dict(), folder / "weights.safetensors", storage="float32")
    write_card(replace(model.card, weights_sha256=digest), folder / "card.json")
    return folder


def bent_egg(model: TrainedModel, seed: int = 0) -> Shape:
    """Draw a shape of the category, with the template's triangles."""
    drawn = bent_eggs(model.template)(1, torch.Generator().manual_seed(seed))[0].double().numpy()
    return Shape(drawn, model.template.shape.faces, f"egg {seed}")


def scan_of(shape: Shape, P: int = 800, seed: int = 0) -> OrientedPoints:
    """Sample a shape, in its own coordinates."""
    samples = sample_surface(shape, P, np.random.default_rng(seed))
    return OrientedPoints(samples.points, samples.normals)


def gentle_vectors(model: TrainedModel, size: float = 0.04) -> np.ndarray:
    """Return node vectors (K, 3) of a smooth deformation."""
    x, y, z = model.template.nodes.T
    return size * np.stack([np.sin(4 * y), 2 * x * y, np.cos(4 * y) * z * 4], 1)
