"""Runs of eggs: a prepared folder, and a recipe that costs nothing."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from meshmatch.experiments.paper import ablation_training
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.shape import Shape
from meshmatch.templates.make import NodeConfig, make_template
from meshmatch.templates.prepare import PrepareConfig, prepare
from meshmatch.templates.prepared_folder import read_registered
from meshmatch.templates.template import read_template
from meshmatch.training.datasets import registered_source
from tests.conftest import icosphere
from tests.training.small import NETWORK, bent_eggs

TINY = replace(
    ablation_training.SMALL,
    network=replace(NETWORK, align_basis=0, corrections=0),
    train=replace(ablation_training.SMALL.train, shapes=4),
    scan=replace(ablation_training.SMALL.scan, points=64),
)


def prepare_eggs(root: Path) -> Path:
    """Six registered eggs, ready to learn from."""
    (root / "eggs").mkdir()
    ball = icosphere(3)  # as many vertices as the most nodes, and more
    egg = Shape(ball.verts * [0.8, 1.5, 1.0], ball.faces, "egg")
    drawn = bent_eggs(make_template(egg, "egg", NodeConfig("uniform", 36, 0.45)))
    for seed in range(6):
        verts = drawn(1, torch.Generator().manual_seed(seed))[0].double().numpy()
        save_shape(root / "eggs" / f"egg{seed}.ply", Shape(verts, ball.faces, "egg"))
    prepare(root / "eggs", root / "prepared", PrepareConfig(NodeConfig("uniform", 36, 0.5)))
    return root / "prepared"


def make_small(monkeypatch: pytest.MonkeyPatch, prepared: Path) -> None:
    """The preset "small" becomes tiny, and eggs take the place of bodies."""
    template = read_template(prepared / "template.safetensors")
    shapes = torch.from_numpy(read_registered(prepared, template))
    sources = registered_source(shapes[:5]), registered_source(shapes[5:])
    monkeypatch.setattr(ablation_training, "SMALL", TINY)
    monkeypatch.setattr(ablation_training, "HELD_OUT_SHAPES", 5)
    monkeypatch.setattr(ablation_training.Setting, "resting", lambda *_: template)
    monkeypatch.setattr(ablation_training.Setting, "sources", lambda *_: sources)
    monkeypatch.setattr(ablation_training, "pool_of", ablation_training.pool_of.__wrapped__)
