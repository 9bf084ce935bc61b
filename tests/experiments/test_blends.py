"""What lies between codes is measured on the same pairs for every model."""

import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from meshmatch.experiments import blends
from meshmatch.experiments.blends import decoded, main
from tests.training.small import bent_eggs, egg_template, small_network

SAMPLES = Path(__file__).parents[2] / "templates" / "samples"


def test_two_models_see_the_same_pairs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "scape").mkdir()
    for name, sample in (("mesh000", "dancer"), ("mesh001", "climber")):
        shutil.copy(SAMPLES / f"{sample}.ply", tmp_path / "scape" / f"{name}.ply")
    twin = tmp_path / "twin"
    shutil.copytree(SAMPLES.parent / "models" / "human", twin)
    words = ["--models", f"human,{twin}", "--data", str(tmp_path), "--limit-pairs", "1"]
    words += ["--ways", "codes,field", "--bodies", "7"]
    monkeypatch.setattr(blends, "decoded", lambda model, bodies, seed: {"ends_arap": bodies / 8 + seed})
    assert main(words) == 0
    text = capsys.readouterr().out
    whole = json.loads(text.splitlines()[-1])
    assert "0.8750" in text and whole["decoded"][0] == {"model": "human", "ends_arap": 0.875}
    codes, field, *second = whole["models"]
    assert [row | {"model": "human"} for row in second] == [codes, field]
    assert (codes["way"], codes["pairs"]) == ("codes", "1 of 2")
    assert 0 < codes["volume"] < 1 and 0 < codes["residual"] < 0.1
    assert codes["template_volume"] != codes["volume"]
    # The ends are the same fits; what turns every part keeps lengths better than what mixes codes.
    assert field["residual"] == codes["residual"] and field["arap"] < 0.5 * codes["arap"]
    assert list(codes["at"]) == ["0.25", "0.5", "0.75"]
    assert sum(row["arap"] for row in codes["at"].values()) / 3 == pytest.approx(codes["arap"])


def test_the_decoder_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Bent eggs for bodies: the measured numbers are those of the training's own loss."""
    template = egg_template()
    network = small_network(template)
    torch.nn.init.normal_(network.decoder.network[-1].weight, std=0.3)  # type: ignore[arg-type]
    card = SimpleNamespace(seed=4, field={"kernel": "smooth"})
    model = SimpleNamespace(template=template, network=network.eval(), card=card)
    asked: list[int] = []

    def eggs(template, people: int, seed: int):
        asked.append(seed)
        return bent_eggs(template)

    monkeypatch.setattr(blends, "as_model", lambda name: model)
    monkeypatch.setattr(blends, "human_source", eggs)
    found = decoded("egg", 6, 0)
    assert asked == [5] and found == decoded("egg", 6, 0)
    # One body blended with itself: what lies between is what is at the ends.
    codes = torch.randn(1, network.config.code).expand(6, -1)
    monkeypatch.setattr(network.encoder, "forward", lambda features: codes)
    same = decoded("egg", 6, 0)
    assert same["between_arap"] == pytest.approx(same["ends_arap"], rel=1e-4)
    assert same["between_volume"] == pytest.approx(same["ends_volume"], rel=1e-4) and same["ends_arap"] > 0.01
    assert same["code_error_cm"] > 1 and found != same
    assert main(["--bodies", "1"]) == 2


def test_a_way_that_is_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--data", str(tmp_path), "--ways", "codes,magic"]) == 1
    assert "unknown way to blend 'magic'" in capsys.readouterr().err


def test_a_set_that_is_not_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--data", str(tmp_path)]) == 1
    assert "no shapes" in capsys.readouterr().err
