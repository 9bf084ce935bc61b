"""What a process that stays alive takes, and workers that share a model."""

import json
import sys
from pathlib import Path

import pytest

from meshmatch.errors import OptionError
from meshmatch.experiments import living, speed
from meshmatch.experiments.speed import Case, main
from tests.experiments.test_speed import cores  # noqa: F401 (a run keeps its process on few cores)


def last_line(capsys: pytest.CaptureFixture[str]) -> dict:
    return json.loads(capsys.readouterr().out.strip().splitlines()[-1])


@pytest.mark.slow
def test_the_stages_of_a_process_that_lives(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(speed, "CASES", {"pair": Case(("match", "climber@900", "dancer@900", "-o", "@map"), 1.0)})
    monkeypatch.setattr(living, "BARS", living.BARS | {"map": 1e-9, "agreement": 1e9})
    assert main(["--living", "--runs", "1"]) == 0
    rows = {row["stage"]: row for row in last_line(capsys)["living"]}
    assert list(rows) == list(living.BARS)
    assert all(row["cpu"] > 0.001 and row["runs"] == [row["cpu"]] for row in rows.values())
    assert rows["map"]["cpu"] < rows["agreement"]["cpu"] < rows["fit, climber"]["cpu"] + rows["fit, dancer"]["cpu"]
    assert (rows["map"]["met"], rows["agreement"]["met"]) == (False, True)


def test_the_first_match_does_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    seconds = iter([9.0, 3.0, 1.0, 2.0])
    monkeypatch.setattr(living, "_stages", lambda matcher, paths: dict.fromkeys(living.BARS, next(seconds)))
    assert {row["cpu"] for row in living.living([], 3).record["living"]} == {2.0}


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_workers_hold_the_weights_once(capsys: pytest.CaptureFixture[str]) -> None:
    """Of the 49 MB of weights a worker has none to itself, and two have them once."""
    assert main(["--shared", "--runs", "1"]) == 0
    private, shared = last_line(capsys)["workers"]
    assert (private["weights"], shared["weights"]) == ("private", "shared")
    assert 45 < private["private"] - shared["private"] < 90
    assert 45 < private["both"] - shared["both"] < 120
    assert shared["pss"] < private["pss"]
    assert 0 < shared["cpu"] < private["cpu"]


def test_where_the_system_does_not_tell(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Path, "exists", lambda path: False)
    with pytest.raises(OptionError, match="does not say"):
        living.shared(1)
