"""Errors become words and a status in one place."""

import subprocess
import sys
from pathlib import Path

import pytest

from meshmatch import __version__
from meshmatch.cli import main
from meshmatch.errors import InputError
from tests.cli.conftest import Run

VERBS = ("match", "register", "evaluate", "info", "models", "prepare", "train")


def test_help_names_every_verb(run: Run) -> None:
    answer = run("--help")
    assert answer.status == 0
    assert answer.err == ""
    assert [verb for verb in VERBS if f"\n  {verb} " not in answer.out] == []


def test_version(run: Run) -> None:
    assert run("--version").out == f"meshmatch {__version__}\n"


@pytest.mark.parametrize(
    "words",
    [
        ["nonsense"],
        ["match", "a.ply"],
        ["match", "a.ply", "b.ply"],
        ["info", "--nonsense", "a.ply"],
        ["models", "x"],
    ],
)
def test_a_wrong_command_line_is_2(run: Run, words: list[str]) -> None:
    answer = run(*words)
    assert answer.status == 2
    assert answer.out == ""
    assert "Error: " in answer.err


def test_an_error_is_one_line_a_hint_and_1(run: Run, tmp_path: Path) -> None:
    answer = run("info", tmp_path / "nothing.ply")
    lines = answer.err.splitlines()
    assert answer.status == 1
    assert answer.out == ""
    assert [line.split(":")[0] for line in lines] == ["error", "hint"]
    assert "nothing.ply" in lines[0]


def test_words_in_brackets_are_shown_as_they_are(run: Run) -> None:
    assert "there is no file [red]x[/].ply" in run("info", "[red]x[/].ply").err


def test_a_long_message_stays_one_line(run: Run, tmp_path: Path) -> None:
    name = "x" * 180 + ".ply"
    assert f"there is no file {tmp_path / name}" in run("info", tmp_path / name).err.splitlines()[0]


def fail(error: BaseException, monkeypatch: pytest.MonkeyPatch) -> None:
    def load(path: Path) -> None:
        raise error

    monkeypatch.setattr("meshmatch.shapes.files.load_shape", load)


def test_ctrl_c_is_one_line_and_130(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    fail(KeyboardInterrupt(), monkeypatch)
    answer = run("info", "a.ply")
    assert answer.status == 130
    assert answer.err.splitlines() == ["interrupted: no file is half-written"]


def test_ctrl_c_before_the_verb_is_the_same(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def loading(arguments: object) -> int:
        raise KeyboardInterrupt  # while Python still imports

    monkeypatch.setattr("meshmatch.cli.boundary._run", loading)
    answer = run("info", "a.ply")
    assert (answer.status, answer.err) == (130, "interrupted: no file is half-written\n")


def test_a_bug_keeps_its_traceback(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    fail(ZeroDivisionError("a bug"), monkeypatch)
    with pytest.raises(ZeroDivisionError):
        main(["info", "a.ply"])


@pytest.mark.parametrize("value", ["1", "yes"])
def test_debug_shows_the_traceback_of_an_error(run: Run, monkeypatch: pytest.MonkeyPatch, value: str) -> None:
    fail(InputError("bad file"), monkeypatch)
    monkeypatch.setenv("MESHMATCH_DEBUG", value)
    with pytest.raises(InputError):
        main(["info", "a.ply"])


@pytest.mark.parametrize("value", ["", "0"])
def test_debug_can_be_off(run: Run, monkeypatch: pytest.MonkeyPatch, value: str) -> None:
    fail(InputError("bad file"), monkeypatch)
    monkeypatch.setenv("MESHMATCH_DEBUG", value)
    assert main(["info", "a.ply"]) == 1


def test_python_m_meshmatch_passes_the_status_on(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "meshmatch", "info", str(tmp_path / "nothing.ply")]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=Path(__file__).parents[2])
    assert done.returncode == 1
    assert done.stdout == ""
    assert "Traceback" not in done.stderr
