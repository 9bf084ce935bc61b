"""The runner: options, tables, finished work that is kept, the JSON line and the exit status."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from meshmatch.errors import InputError, OptionError
from meshmatch.experiments import runner
from meshmatch.experiments.runner import (
    Report,
    Seed,
    cached,
    command,
    commit,
    evenly_spread,
    read_cached,
    split_names,
    table,
    table_cells,
    to_json,
    write_cached,
)

ROWS = [{"set": "scape", "mean": 1.234, "share": 0.25}, {"set": "faust", "mean": float("nan")}]


@command
def main(count: int, seed: Seed = 0) -> Report:
    if count == 13:
        raise InputError("thirteen [shapes]", "take another number")
    record = {"rows": ROWS, "path": Path("x"), "array": np.arange(count)}
    return Report(record, [table("A table", ROWS, {"set": "set", "mean": "mean:.2f", "part": "share:.0%"})], ["done"])


def test_lists_of_a_docstring_stay_lists_in_the_help(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(
        sys.modules[__name__], "__doc__", "Sets.\n\n- SMAL_r: animals\n  of SMAL.\n- TOPKIDS: children.\n"
    )
    assert main(["--help"]) == 0
    assert "  - SMAL_r: animals of SMAL.\n\n  - TOPKIDS: children.\n" in capsys.readouterr().out


def test_a_command_prints_tables_notes_and_one_line_last(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["2", "--seed", "3"]) == 0
    lines = capsys.readouterr().out.splitlines()
    record = json.loads(lines[-1])
    assert lines[-2] == "done"
    assert any("scape" in line and "1.23" in line and "25 %" in line for line in lines)
    assert (record["experiment"], record["options"]) == ("tests.experiments.test_runner", {"count": 2, "seed": 3})
    assert {"date", "commit", "machine", "python", "threads", "jobs", "seconds"} < record.keys()
    assert record["rows"][1]["mean"] is None  # JSON has no nan
    assert (record["path"], record["array"]) == ("x", [0, 1])


def test_what_stops_a_command_is_one_line_and_a_status(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["13"]) == 1
    assert capsys.readouterr().err.splitlines() == ["error: thirteen [shapes]", "hint: take another number"]
    assert main(["2", "--seed", "-1"]) == 2
    assert main(["many"]) == 2
    assert main(["--help"]) == 0
    assert "The runner: options" in capsys.readouterr().out


def test_a_bug_keeps_its_traceback() -> None:
    with pytest.raises(ZeroDivisionError):
        command(lambda: 1 // 0)([])  # type: ignore[arg-type,return-value]


def test_names_are_checked_and_items_are_spread() -> None:
    assert split_names("b,a,b", "abc", "letter") == ["b", "a"]
    assert split_names("", "abc", "letter") == []
    with pytest.raises(OptionError, match="unknown letter 'd'"):
        split_names("a,d", "abc", "letter")
    items = list(range(10))
    assert evenly_spread(items, None) == evenly_spread(items, 99) == items
    assert evenly_spread(items, 2) == [0, 9]
    assert len(set(evenly_spread(items, 4))) == 4
    assert evenly_spread(items, 0) == [0]


def test_a_table_as_words() -> None:
    columns, rows = table_cells(table("T", ROWS, {"set": "set", "mean": "mean:.1f"}))
    assert (columns, rows) == (["set", "mean"], [["scape", "1.2"], ["faust", ""]])


def test_a_saved_run_has_its_command_and_its_tables(tmp_path: Path) -> None:
    path = tmp_path / "run.json"
    assert main(["2", "--save", str(path), "--seed", "3"]) == 0
    found = json.loads(path.read_text())
    assert found["commands"] == ["python -m meshmatch.experiments.tests.experiments.test_runner 2 --seed 3"]
    assert found["tables"][0]["rows"][0] == ["scape", "1.23", "25 %"]
    assert found["values"]["array"] == [0, 1]
    assert main(["2", f"--save={tmp_path / 'b.json'}", "--seed", "3"]) == 0
    assert json.loads((tmp_path / "b.json").read_text())["commands"] == found["commands"]


def test_plain_values() -> None:
    found = to_json({"a": (1, Path("b")), 2: np.float32(0.5), "c": np.int64(3), "d": True, "e": np.inf})
    assert found == {"a": [1, "b"], "2": 0.5, "c": 3, "d": True, "e": None}


def test_a_result_is_measured_once(tmp_path: Path) -> None:
    calls: list[int] = []

    def measure() -> dict[str, float]:
        calls.append(1)
        return {"cm": 2.5}

    path = tmp_path / "new" / "run.json"
    asked = {"pairs": (("a", "b"),), "seed": 0}
    assert read_cached(path, asked) is None
    assert cached(path, asked, measure) == cached(path, asked, measure) == read_cached(path, asked)
    assert len(calls) == 1


def test_a_result_of_other_choices_is_refused(tmp_path: Path) -> None:
    write_cached(tmp_path / "run.json", {"seed": 0, "steps": 5}, {"cm": 1})
    with pytest.raises(OptionError, match=r"other options \(seed, steps\)"):
        read_cached(tmp_path / "run.json", {"seed": 1, "steps": 6})
    with pytest.raises(OptionError, match=r"\(minutes\)"):
        read_cached(tmp_path / "run.json", {"seed": 0, "steps": 5, "minutes": 2})


@pytest.mark.parametrize("words", ["{", "[]", "{}", "3", "[" * 5000, '"asked"'])
def test_a_damaged_result_is_told(words: str, tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text(words)
    with pytest.raises(InputError, match=r"run\.json is not a result"):
        read_cached(tmp_path / "run.json", {})


def test_commit_without_git(tmp_path: Path) -> None:
    assert commit(tmp_path) == "unknown"
    assert runner.run_metadata(2)["threads"] == 2
