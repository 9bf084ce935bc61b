"""Why the paper's network stalls: what each change leaves of it, and what is measured, on bent eggs."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from meshmatch.errors import ModelError
from meshmatch.experiments.paper import narrow, stalling
from meshmatch.experiments.paper.stalling import CHANGES, Change, encoder_of, measure, network_of, scans_of
from meshmatch.models.network import PAPER
from meshmatch.models.registry import load_model
from meshmatch.shapes.shape import Shape
from meshmatch.templates.make import NodeConfig, make_template
from meshmatch.templates.template import Template
from tests.conftest import icosphere
from tests.training.small import bent_eggs


@pytest.fixture
def eggs(monkeypatch: pytest.MonkeyPatch) -> Template:
    ball = icosphere(3)
    shape = Shape(ball.verts * [0.8, 1.5, 1.0], ball.faces, "egg")
    template = make_template(shape, "egg", NodeConfig("uniform", 36, 0.5))
    monkeypatch.setattr(stalling, "human_source", lambda *_: bent_eggs(template))
    monkeypatch.setattr(stalling, "_POINTS", 64)
    monkeypatch.setattr(stalling, "_HELD_OUT", 8)
    return template


def test_a_change_is_one_thing() -> None:
    torch.manual_seed(0)
    plain = encoder_of(Change(), 64)(torch.zeros(1, 3), 8)
    torch.manual_seed(0)
    changed = encoder_of(Change(dropout=0.0, norms=False, waves=3.0), 64)(torch.zeros(1, 3), 8)
    assert torch.allclose(changed.frequencies, 3 * plain.frequencies)
    kinds = [[type(layer) for layer in each.points] for each in (plain, changed)]
    assert kinds[1] == [kind for kind in kinds[0] if not issubclass(kind, nn.BatchNorm1d)] != kinds[0]
    assert [layer.p for layer in (*plain.head, *changed.head) if isinstance(layer, nn.Dropout)] == [0.3, 0.0]
    assert network_of(Change(), 4).decoder == PAPER.decoder and network_of(Change(), 4).width == PAPER.width // 4
    assert network_of(Change(encoder="basis", decoder="flat"), 4).encoder == "basis"
    assert CHANGES["nothing"] == Change() and len(set(CHANGES.values())) == len(CHANGES)


def test_the_mean_body_spreads_by_nothing_and_training_lowers_the_error(eggs: Template) -> None:
    scans = scans_of(eggs, 40)
    assert (scans.learned, scans.points.shape) == (40, (48, 64, 3))
    easy = Change(encoder="basis", decoder="flat", yaw=False)
    short, long = (measure(easy, eggs, scans, 8, steps, 0) for steps in (20, 200))
    assert long["at_work"] < short["at_work"] and long["held_out"] < short["held_out"]
    assert 0 <= short["spread"] and np.isfinite(long["spread"])
    turned = measure(replace(easy, yaw=True), eggs, scans, 8, 20, 0)
    assert turned["mean_body"] != short["mean_body"] == long["mean_body"]


def test_a_narrow_network_is_kept_as_a_model_with_its_curve(
    eggs: Template, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(narrow, "CHANGE", Change(yaw=False, dropout=0.0))
    found = narrow.trained(tmp_path / "model", eggs, 8, 120, 40, 0)
    assert list(found["curve"]) == list(range(6, 121, 6)) and found["curve"][120] < found["curve"][6]
    assert found["held_out"] == pytest.approx(found["curve"][120], rel=0.3)  # of averaged weights, where there are any
    model = load_model(tmp_path / "model", encoder=encoder_of(narrow.CHANGE, 1024 // 8))
    assert model.card.steps == 120 and model.card.network["width"] == PAPER.width // 8
    with pytest.raises(ModelError, match="custom encoder"):
        load_model(tmp_path / "model")
