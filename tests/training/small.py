"""A tiny template, a source of bent eggs, and a network that trains on them in seconds."""

from functools import cache
from pathlib import Path

import numpy as np
import torch

from meshmatch.api.prepare import PrepareConfig, prepare
from meshmatch.generators.generator import Source
from meshmatch.geometry.kernels import Kernel
from meshmatch.models.deformer import Deformer
from meshmatch.models.network import NetworkConfig
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.shape import Shape
from meshmatch.templates.make import NodeConfig, make_template
from meshmatch.templates.template import Template
from meshmatch.training.datasets import BatchDataset
from meshmatch.training.losses import LossPoints
from meshmatch.training.scans import ScanConfig
from meshmatch.training.train import build_dataset, build_deformer, build_loss_points
from tests.conftest import icosphere

NETWORK = NetworkConfig(
    code=16, width=32, depth=1, basis=24, align_basis=16, align_width=16, corrections=2, correct_width=16
)
# The paper's architecture, but narrow.
POINTS = NetworkConfig(encoder="point", decoder="node", code=16, width=32, align_basis=0, corrections=0)
SCAN = ScanConfig(points=96, noise=0.012, outliers=0, partial=0)
UPRIGHT = ScanConfig(points=96, noise=0, holes=0, outliers=0, partial=0, density=0, bumps=0, scale=0, upright=True)


@cache
def egg_template() -> Template:
    """The template: an egg with three different axes, 162 vertices and 36 nodes."""
    ball = icosphere(2)
    egg = Shape(ball.verts * [0.8, 1.5, 1.0], ball.faces, "egg")
    config = NodeConfig(strategy="uniform", K=36, radius=0.45, depth=0.05)
    return make_template(egg, "egg", config, core=np.flatnonzero(ball.verts[:, 1] > 0))


def bent_eggs(template: Template) -> Source:
    """Return a source of shapes: the template under random affine maps and bends."""
    rest = torch.from_numpy(np.array(template.shape.verts)).float()

    def draw(count: int, generator: torch.Generator) -> torch.Tensor:
        affine = torch.eye(3) + 0.15 * torch.randn(count, 3, 3, generator=generator)
        bend = 0.8 * torch.randn(count, 1, generator=generator)
        verts = (rest @ affine.transpose(1, 2)).clone()
        verts[..., 0] += bend * verts[..., 1] ** 2
        return 3.0 * verts  # the unit is arbitrary

    return draw


def small_network(
    template: Template, network: NetworkConfig = NETWORK, scan: ScanConfig = SCAN, kernel: Kernel = "smooth"
) -> Deformer:
    return build_deformer(template, bent_eggs(template), network, scan, kernel, seed=0)


def small_data(
    template: Template, model: Deformer, scan: ScanConfig = SCAN, seed: int = 0, length: int = 40
) -> BatchDataset:
    return build_dataset(template, bent_eggs(template), model, scan, 4, 2, seed, length)


def small_points(template: Template, kernel: Kernel = "smooth", model: Deformer | None = None) -> LossPoints:
    return build_loss_points(template, kernel, model or small_network(template))


def registered_eggs(folder: Path, count: int) -> Path:
    """Write ``count`` registered eggs to a folder."""
    rng, egg = np.random.default_rng(0), egg_template().shape
    folder.mkdir()
    for n in range(count):
        save_shape(folder / f"egg{n}.ply", Shape(egg.verts @ (np.eye(3) + 0.1 * rng.normal(size=(3, 3))), egg.faces))
    return folder


def prepared_eggs(root: Path, count: int) -> Path:
    """Write registered eggs to the folder "in" and prepare them in the folder "out", which is returned."""
    nodes = NodeConfig(strategy="uniform", K=36, radius=0.45, depth=0.05)
    prepare(registered_eggs(root / "in", count), root / "out", PrepareConfig(nodes))
    return root / "out"
