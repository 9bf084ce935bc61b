"""What lies between codes is measured on the same pairs for every model."""

import json
import shutil
from pathlib import Path

import pytest

from meshmatch.experiments.blends import main

SAMPLES = Path(__file__).parents[2] / "templates" / "samples"


def test_two_models_see_the_same_pairs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "scape").mkdir()
    for name, sample in (("mesh000", "dancer"), ("mesh001", "climber")):
        shutil.copy(SAMPLES / f"{sample}.ply", tmp_path / "scape" / f"{name}.ply")
    twin = tmp_path / "twin"
    shutil.copytree(SAMPLES.parent / "models" / "human", twin)
    words = ["--models", f"human,{twin}", "--data", str(tmp_path), "--limit-pairs", "1"]
    assert main(words) == 0
    record = json.loads(capsys.readouterr().out.splitlines()[-1])["models"]
    first, second = record["human"], record[str(twin)]
    assert first == second
    assert (first["pairs"], first["of"]) == (1, 2)
    assert 0 < first["volume"] < 1 and 0 < first["residual"] < 0.1
    assert first["template_volume"] != first["volume"]


def test_a_set_that_is_not_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--data", str(tmp_path)]) == 1
    assert "no shapes" in capsys.readouterr().err
