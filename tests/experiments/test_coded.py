"""3D-CODED on bent eggs: no constraint, scans as they stand, a training that goes on, a model that the rival takes."""

import json
from pathlib import Path

import pytest

from meshmatch.api.inputs import as_model
from meshmatch.experiments import coded
from meshmatch.experiments.adapters import CodedMatcher
from meshmatch.experiments.coded import coded_recipe, main
from tests.training.small import bent_eggs, egg_template


def test_the_recipe_is_pointwise_and_free() -> None:
    chosen = coded_recipe(7, 2.5, 5, 96, 64, bf16=True, threads=1, seed=3)
    loss = chosen.train.loss
    assert (loss.volume, loss.arap, loss.blend, loss.robust) == (0, 0, 0, False)
    assert (chosen.network.field, chosen.network.encoder, chosen.network.width) == ("pointwise", "point", 64)
    assert (chosen.train.steps, chosen.train.minutes, chosen.train.seed, chosen.train.bf16) == (
        7,
        2.5,
        3,
        True,
    )
    assert chosen.train.shapes == 5
    assert chosen.scan.upright and chosen.scan.points == 96 and chosen.scan.partial == 0


def test_the_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[int] = []

    def eggs(template, identities: int, seed: int):
        asked.extend([identities, seed])
        return bent_eggs(template)

    monkeypatch.setattr(coded, "human_source", eggs)
    monkeypatch.setattr(coded, "read_template", lambda name: egg_template())
    folder = tmp_path / "egg"
    words = ["-o", str(folder), "--steps", "2", "--points", "96", "--width", "16", "--identities", "64"]
    words += ["--shapes", "4", "--threads", "1", "--seed", "3"]
    assert main([*words, "--minutes", "1e-9"]) == 0
    first = json.loads(capsys.readouterr().out)
    assert first["steps"] == 1 and asked == [64, 3]
    assert main([*words, "--minutes", "1", "--bf16"]) == 0
    whole = json.loads(capsys.readouterr().out)
    assert whole["steps"] == 2 and whole["train"]["seed"] == 3 and whole["train"]["bf16"] is True
    assert whole["network"]["width"] == 16 and whole["train"]["shapes"] == 4 and whole["scan"]["points"] == 96
    assert {"date", "commit", "machine", "minutes", "distance"} <= whole.keys()
    model = as_model(str(folder))
    assert not model.has_nodes and model.network.aligner is None
    egg = egg_template().shape
    fit = CodedMatcher(str(folder), steps=3).fit(egg)
    assert fit.points.shape == egg.verts.shape


def test_a_choice_that_cannot_be(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["-o", str(tmp_path / "x"), "--steps", "0"]) == 1
    assert "steps must be 1 or more" in " ".join(capsys.readouterr().err.split())
    with pytest.raises(SystemExit):
        main(["--points", "0"])
