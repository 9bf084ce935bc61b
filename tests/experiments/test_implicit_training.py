"""Trainings learn, end where an unbroken one does, and refuse checkpoints of others; models come back as they were."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("skimage", reason="scikit-image is of the extra `bench`")

from meshmatch.errors import MeshmatchError, ModelError, OptionError
from meshmatch.experiments import implicit_surfaces, implicit_training
from meshmatch.experiments.implicit_model import IMPLICIT, ImplicitModel, load_implicit
from meshmatch.experiments.implicit_samples import ImplicitSamples, read_implicit_samples
from meshmatch.experiments.implicit_training import train_implicit
from meshmatch.geometry.triangles import is_watertight
from meshmatch.maps.files import load_map
from meshmatch.models.registry import WEIGHTS
from meshmatch.shapes.files import load_shape
from meshmatch.training.loop import StepReport
from meshmatch.training.train import CHECKPOINT
from tests.experiments.small_implicit import TRAIN, boxes, config

BOTH = pytest.mark.parametrize("deformation", ["reduced", "pointwise"])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("boxes")
    boxes(made)
    return made


@pytest.fixture(scope="module")
def samples(folder: Path) -> ImplicitSamples:
    return read_implicit_samples(folder)


@pytest.fixture(scope="module")
def learned(samples: ImplicitSamples, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model that has a surface."""
    output = tmp_path_factory.mktemp("learned")
    training = replace(TRAIN, steps=60, rate=3e-3, average=0.9)
    return train_implicit(output, samples, config=config("reduced"), training=training)


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
    assert bool(energies) == (deformation == "reduced")


def test_a_checkpoint_of_other_shapes_or_another_network_is_refused(
    samples: ImplicitSamples, tmp_path: Path, folder: Path
) -> None:
    train_implicit(tmp_path, samples, config=config("pointwise"), training=TRAIN)
    others = replace(samples, rows=0.9 * samples.rows)
    for given, deformation in ((others, "pointwise"), (samples, "reduced")):
        with pytest.raises(ModelError, match="checkpoint"):
            train_implicit(tmp_path, given, config=config(deformation), training=TRAIN)


def test_surfaces_are_closed_and_in_the_files_frame(learned: Path, folder: Path) -> None:
    model = load_implicit(learned)
    truth = load_shape(folder / "box1.ply")
    found = model.surface("box1", resolution=32)
    assert is_watertight(found.faces)
    corners = found.verts[found.faces]
    assert (corners[:, 0] * np.cross(corners[:, 1], corners[:, 2])).sum() > 0  # outwards
    assert np.abs(found.bounds - truth.bounds).max() < 0.35 * truth.diagonal
    between = model.surface("box0", "box1", 0.5, 32)
    assert is_watertight(between.faces)
    with pytest.raises(OptionError, match="no shape"):
        model.surface("nobody")
    with pytest.raises(OptionError, match="even"):
        model.surface("box0", resolution=33)


def test_maps_go_through_the_template(learned: Path, folder: Path) -> None:
    model = load_implicit(learned)
    a, b = (load_shape(folder / f"box{k}.ply") for k in (0, 1))
    found = model.match("box0", "box1", a, b)
    assert (found.source_vertices, found.target_vertices) == (a.V, b.V)
    same = model.match("box0", "box0", a, a)
    assert np.array_equal(same.index, np.arange(a.V))
    assert same.confidence.min() == 1
    drawn = model.match("box0", "box1")
    assert drawn.source_vertices == model.surface("box0").V


def test_models_come_back_as_they_were(learned: Path) -> None:
    a, b = load_implicit(learned), load_implicit(learned)
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    assert np.array_equal(a.distance(points, a.network.codes[0])[0], b.distance(points, b.network.codes[0])[0])


def damaged(learned: Path, folder: Path, change: dict[str, object]) -> Path:
    folder.mkdir()
    card = json.loads((learned / IMPLICIT).read_text())
    card["config"] |= change.pop("config", {})
    (folder / IMPLICIT).write_text(json.dumps(card | change))
    (folder / WEIGHTS).write_bytes((learned / WEIGHTS).read_bytes())
    return folder


@pytest.mark.parametrize(
    "change",
    [
        {"schema": 2},
        {"names": ["box0"]},
        {"names": ["a", "a", "a", "a"]},
        {"frames": [[0, 0, 0, 0]] * 4},
        {"frames": [["x"]] * 4},
        {"frames": 7},
        {"config": {"width": 10**9}},
        {"config": {"width": -1}},
        {"config": {"code": "8"}},
        {"config": {"code": 9}},
        {"config": {"unheard": 1}},
        {"config": {"deformation": "pointwise"}},
        {"config": {"frequency": "fast"}},
        {"config": {"kernel": "unknown"}},
        {"config": {"deformation": "unknown"}},
    ],
    ids=str,
)
def test_hostile_cards_are_told_in_a_line(learned: Path, tmp_path: Path, change: dict[str, object]) -> None:
    with pytest.raises(ModelError) as caught:
        load_implicit(damaged(learned, tmp_path / "bad", dict(change)))
    assert caught.value.hint


def test_hostile_files_are_told_in_a_line(learned: Path, tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="no implicit model"):
        load_implicit(tmp_path)
    bad = damaged(learned, tmp_path / "bad", {})
    for content in (b"", b"{", b"[" * 100_000, b"\x00" * 100, b"[]", b"1" * 2_000_000):
        (bad / IMPLICIT).write_bytes(content)
        with pytest.raises(ModelError):
            load_implicit(bad)
    weights = (learned / WEIGHTS).read_bytes()
    for content in (b"", weights[:-10], weights[:100]):
        (bad / WEIGHTS).write_bytes(content)
        (bad / IMPLICIT).write_bytes((learned / IMPLICIT).read_bytes())
        with pytest.raises(MeshmatchError):
            load_implicit(bad)


def test_the_commands_train_and_interpolate(
    folder: Path, learned: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "model"
    assert implicit_training.main([str(folder), "-o", str(output), "--steps", "2"]) == 0
    assert json.loads(capsys.readouterr().out)["steps"] == 2
    assert isinstance(load_implicit(output), ImplicitModel)
    assert (output / CHECKPOINT).is_file()
    way, file = tmp_path / "way", tmp_path / "map.npz"
    own = ["--source", str(folder / "box0.ply"), "--target", str(folder / "box1.ply"), "--resolution", "32"]
    words = [str(learned), "box0", "box1", "-n", "3", *own, "--map", str(file), "-o", str(way)]
    assert implicit_surfaces.main(words) == 0
    assert sorted(each.name for each in way.iterdir()) == [f"frame-00{k}.ply" for k in range(3)]
    assert load_map(file).source_vertices == load_shape(folder / "box0.ply").V
    words[1], words[-1] = "nobody", str(tmp_path / "other")
    assert implicit_surfaces.main(words) == 1
    assert not (tmp_path / "other").exists()
    assert "knows no shape" in capsys.readouterr().err
