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
    words += ["--ways", "codes,field"]
    assert main(words) == 0
    record = json.loads(capsys.readouterr().out.splitlines()[-1])["models"]
    first, second = record["human"], record[str(twin)]
    assert first == second
    codes, field = first["codes"], first["field"]
    assert (codes["pairs"], codes["of"]) == (1, 2)
    assert 0 < codes["volume"] < 1 and 0 < codes["residual"] < 0.1
    assert codes["template_volume"] != codes["volume"]
    # The ends are the same fits; what turns every part keeps lengths better than what mixes codes.
    assert field["residual"] == codes["residual"] and field["arap"] < 0.5 * codes["arap"]
    assert list(codes["at"]) == ["0.25", "0.5", "0.75"]
    assert sum(row["arap"] for row in codes["at"].values()) / 3 == pytest.approx(codes["arap"])


def test_a_way_that_is_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--data", str(tmp_path), "--ways", "codes,magic"]) == 1
    assert "no way 'magic'" in capsys.readouterr().err


def test_a_set_that_is_not_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--data", str(tmp_path)]) == 1
    assert "no shapes" in capsys.readouterr().err
