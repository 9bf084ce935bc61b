"""The aligner alone: it learns orientations of eggs, the same for the same seed; the whole training begins with it."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from meshmatch.errors import ModelError
from meshmatch.models.deformer import Deformer
from meshmatch.models.registry import load_model
from meshmatch.progress import Progress
from meshmatch.training import aligner as stage
from meshmatch.training.aligner import Aligned, train_aligner
from meshmatch.training.datasets import BatchDataset
from meshmatch.training.folder_lock import ALIGNER
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
    early = train_aligner(model, data, 5).error
    model.load_state_dict(before)
    late = train_aligner(model, data, 200).error
    assert late < 0.85 * early
    changed = {name.split(".")[0] for name, value in model.state_dict().items() if not torch.equal(value, before[name])}
    assert changed == {"aligner"}


def test_it_is_a_function_of_the_seed() -> None:
    (one, data), (two, again) = untrained(), untrained()
    assert train_aligner(one, data, 3).error == train_aligner(two, again, 3).error
    for name, value in one.state_dict().items():
        assert torch.equal(value, two.state_dict()[name]), name


def test_it_stops_after_its_minutes_and_goes_on_exactly(tmp_path: Path) -> None:
    (whole, data), (stopped, again) = untrained(), untrained()
    checkpoint = tmp_path / "aligner.safetensors"
    found = train_aligner(whole, data, 3)
    assert found.done and found.total_seconds == found.seconds > 0
    seconds = 0.0
    for run in range(3):
        part = train_aligner(stopped, again, 3, None, "auto", 1e-9, checkpoint)
        assert part.done == (run == 2) and part.total_seconds > seconds
        seconds = part.total_seconds - 0.1  # it is written to a tenth
        stopped, again = (stopped, again) if part.done else untrained()  # as another process would begin
    for name, value in whole.state_dict().items():
        assert torch.equal(value, stopped.state_dict()[name]), name
    other = replace(data, seed=data.seed + 1)
    for wrong, steps in ((other, 3), (data, 4)):
        with pytest.raises(ModelError, match="not a checkpoint of this training"):
            train_aligner(whole, wrong, steps, None, "auto", 1e-9, checkpoint)
    checkpoint.write_bytes(b"something else")
    with pytest.raises(ModelError, match="not a checkpoint of this training"):
        train_aligner(whole, data, 3, None, "auto", 1e-9, checkpoint)


def test_its_minutes_are_those_of_the_training(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    template = egg_template()
    config = TrainConfig(steps=3, shapes=4, scans_per_shape=1, workers=0, warm_up=1, align_steps=2)
    recipe = Recipe(NETWORK, config, SCAN, "smooth")
    short = recipe.changed(minutes=1e-9)
    done = []
    for _ in range(4):
        train_model(template, bent_eggs(template), tmp_path / "eggs", short, CardFacts("eggs"))
        done.append((load_model(tmp_path / "eggs").card.steps, (tmp_path / "eggs" / ALIGNER).is_file()))
    assert done == [(0, True), (1, False), (2, False), (3, False)]
    train_model(template, bent_eggs(template), tmp_path / "whole", recipe, CardFacts("eggs"))
    cards = [load_model(tmp_path / name).card for name in ("eggs", "whole")]
    assert cards[0].weights_sha256 == cards[1].weights_sha256


def test_a_training_begins_with_it_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []

    def train_aligner(
        model: Deformer, data: BatchDataset, steps: int, progress: Progress | None, draw: str, *stop: Any
    ) -> Aligned:
        asked.append(steps)
        return Aligned()

    monkeypatch.setattr("meshmatch.training.train.train_aligner", train_aligner)
    template = egg_template()
    config = TrainConfig(steps=2, shapes=4, scans_per_shape=1, workers=0, warm_up=1, align_steps=7)
    recipe = Recipe(NETWORK, config, SCAN, "smooth")
    for _ in range(2):  # the second time it goes on from the checkpoint
        train_model(template, bent_eggs(template), tmp_path / "eggs", recipe, CardFacts("eggs"))
    assert asked == [7]
    assert load_model(tmp_path / "eggs").card.recipe["train"]["align_steps"] == 7
