"""Collections as experiments: fits of whole sets, and of bodies whose fitting is killed."""

import json
from pathlib import Path

import pytest

from meshmatch.experiments.bench import collections as groupwise


def last_row(capsys: pytest.CaptureFixture[str]) -> dict[str, object]:
    return dict(json.loads(capsys.readouterr().out.splitlines()[-1])["rows"][0])


def test_hearts_without_a_model(bench: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--data", str(bench), "--sets", "heart", "--limit-shapes", "2", "--work", str(tmp_path / "work")]
    assert groupwise.main(words) == 0
    row = last_row(capsys)
    assert (row["shapes"], row["maps"], row["same"]) == (2, 2, True)
    assert isinstance(row["error"], float) and 0.1 < row["error"] < 0.7
    assert isinstance(row["largest_gb"], float) and row["largest_gb"] > 0.05


def test_generated_bodies(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("anny")
    words = ["--sets", "bodies", "--limit-shapes", "2", "--work", str(tmp_path / "work")]
    assert groupwise.main(words) == 0
    row = last_row(capsys)
    assert (row["shapes"], row["maps"], row["same"]) == (2, 1, True)
    assert isinstance(row["error"], float) and 0.1 < row["error"] < 5.0
