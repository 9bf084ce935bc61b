"""The aligner alone: it learns orientations of eggs, the same for the same seed; the whole training begins with it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from meshmatch.models.deformer import Deformer
from meshmatch.models.registry import load_model
from meshmatch.progress import Progress
from meshmatch.training import aligner as stage
from meshmatch.training.aligner import train_aligner
from meshmatch.training.datasets import BatchDataset
from meshmatch.training.loop import TrainConfig
from meshmatch.training.recipes import Recipe
from meshmatch.training.train import CardFacts, build_dataset, build_deformer, train_model
from tests.training.small import NETWORK, SCAN, bent_eggs, egg_template


@pytest.fixture(autouse=True)
def few_scans(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stage, "_SHAPES", 32)


def horned(count: int, generator: torch.Generator) -> torch.Tensor:
    """Eggs with a horn and a flank: no turn takes them to themselves."""
    x, y, z = torch.from_numpy(np.array(egg_template().shape.verts)).float().unbind(1)
    verts = torch.stack([x + 6 * y.clamp_min(0) ** 2, y, z + 2 * x.clamp_min(0)], 1)
    return verts * (1 + 0.1 * torch.randn(count, 1, 3, generator=generator))


def untrained() -> tuple[Deformer, BatchDataset]:
    template, network = egg_template(), replace(NETWORK, align_width=64, align_basis=48)
    model = build_deformer(template, horned, network, SCAN, "smooth", 0)
    return model, build_dataset(template, horned, model, SCAN, 4, 2, 0)


def test_it_learns_orientations_and_nothing_else() -> None:
    model, data = untrained()
    before = {name: value.clone() for name, value in model.state_dict().items()}
    early = train_aligner(model, data, 5)
    model.load_state_dict(before)
    late = train_aligner(model, data, 200)
    assert late < 0.85 * early
    changed = {name.split(".")[0] for name, value in model.state_dict().items() if not torch.equal(value, before[name])}
    assert changed == {"aligner"}


def test_it_is_a_function_of_the_seed() -> None:
    (one, data), (two, again) = untrained(), untrained()
    assert train_aligner(one, data, 3) == train_aligner(two, again, 3)
    for name, value in one.state_dict().items():
        assert torch.equal(value, two.state_dict()[name]), name


def test_a_training_begins_with_it_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []

    def train_aligner(model: Deformer, data: BatchDataset, steps: int, progress: Progress | None, draw: str) -> None:
        asked.append(steps)

    monkeypatch.setattr("meshmatch.training.train.train_aligner", train_aligner)
    template = egg_template()
    config = TrainConfig(steps=2, shapes=4, scans_per_shape=1, workers=0, warm_up=1, align_steps=7)
    recipe = Recipe(NETWORK, config, SCAN, "smooth")
    for _ in range(2):  # the second time it goes on from the checkpoint
        train_model(template, bent_eggs(template), tmp_path / "eggs", recipe, CardFacts("eggs"))
    assert asked == [7]
    assert load_model(tmp_path / "eggs").card.recipe["train"]["align_steps"] == 7
