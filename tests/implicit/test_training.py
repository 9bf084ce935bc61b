"""Trainings learn, end where an unbroken one does, and refuse checkpoints of others."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from meshmatch.errors import ModelError, OptionError
from meshmatch.implicit.model import load_implicit
from meshmatch.implicit.samples import ImplicitSamples, read_implicit_samples
from meshmatch.implicit.training import train_implicit
from meshmatch.models.implicit_card import IMPLICIT
from meshmatch.models.registry import WEIGHTS
from meshmatch.shapes.sampling import sample_surface
from meshmatch.training.loop import StepReport
from tests.implicit.boxes import TRAIN, box, config

BOTH = pytest.mark.parametrize("deformation", ["mls", "pointwise"])


@pytest.fixture(scope="module")
def samples(folder: Path) -> ImplicitSamples:
    return read_implicit_samples(folder)


@BOTH
def test_a_stopped_training_ends_where_an_unbroken_one_does(
    samples: ImplicitSamples, tmp_path: Path, deformation: str
) -> None:
    """Bit for bit; and the same seed gives the same weights."""
    settings = {"config": config(deformation), "training": replace(TRAIN, checkpoint_minutes=0)}
    whole = train_implicit(tmp_path / "whole", samples, **settings)

    def stop(now: StepReport) -> None:
        if now.step == 3:
            raise KeyboardInterrupt

    broken = tmp_path / "broken"
    with pytest.raises(KeyboardInterrupt), pytest.MonkeyPatch.context() as patch:
        patch.setattr("meshmatch.training.loop.Trainer.run", every_step(stop))
        train_implicit(broken, samples, **settings)
    assert not (broken / IMPLICIT).exists()
    torch.rand(17)  # another process has another global stream
    train_implicit(broken, samples, **settings)
    assert (broken / WEIGHTS).read_bytes() == (whole / WEIGHTS).read_bytes()


def every_step(stop):
    """`Trainer.run`, which reports each step and writes a checkpoint after each."""
    from meshmatch.training.loop import Trainer

    run = Trainer.run

    def changed(self, data, checkpoint=None, report=None, validate=None, every=50):
        def both(now):
            self.save(checkpoint)
            stop(now)

        run(self, data, checkpoint, both, validate, 1)

    return changed


@BOTH
def test_a_training_lowers_its_loss(samples: ImplicitSamples, tmp_path: Path, deformation: str) -> None:
    reports: list[StepReport] = []
    training = replace(TRAIN, steps=100, rate=2e-3)
    train_implicit(tmp_path, samples, config=config(deformation), training=training, report=reports.append)
    assert reports[-1].terms["sdf"] < 0.7 * reports[0].terms["sdf"]
    energies = {"volume", "arap", "blend"} & reports[-1].terms.keys()
    assert bool(energies) == (deformation == "mls")


def test_a_checkpoint_of_other_shapes_or_another_network_is_refused(
    samples: ImplicitSamples, tmp_path: Path, folder: Path
) -> None:
    train_implicit(tmp_path, samples, config=config("pointwise"), training=TRAIN)
    others = replace(samples, rows=0.9 * samples.rows)
    for given, deformation in ((others, "pointwise"), (samples, "mls")):
        with pytest.raises(ModelError, match="checkpoint"):
            train_implicit(tmp_path, given, config=config(deformation), training=TRAIN)


def test_a_training_needs_full_precision(samples: ImplicitSamples, tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="bfloat16"):
        train_implicit(tmp_path, samples, config=config("mls"), training=replace(TRAIN, bf16=True))


def test_the_sign_of_clouds_comes_from_their_normals(tmp_path: Path) -> None:
    """No distance but 0 is known; still the inside becomes negative, and the corners of the cube positive."""
    rng = np.random.default_rng(0)
    for number in range(3):
        half = rng.uniform([0.5, 0.4, 0.4], [1.0, 0.6, 0.8])
        drawn = sample_surface(box(half), 4000, rng)
        np.savez(tmp_path / f"cloud{number}.npz", points=drawn.points, normals=drawn.normals)
    training = replace(TRAIN, steps=150, rate=2e-3, average=0.9)
    model = load_implicit(train_implicit(tmp_path / "model", tmp_path, config=config("mls"), training=training))
    for name in model.card.shapes:
        values = model.distance(np.array([[0.0, 0, 0], [0.95, 0.95, 0.95]]), model.known(name).code)[0]
        assert values[0] < -0.05
        assert values[1] > 0.05
