"""Errors become words and a status in one place."""

import os
import signal
import subprocess
import sys
import warnings
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import meshmatch
from meshmatch import __version__
from meshmatch.cli import main
from meshmatch.errors import InputError, MeshmatchWarning
from meshmatch.shapes.files import load_shape
from tests.cli.conftest import Run, refused

ROOT = Path(__file__).resolve().parents[2]

VERBS = ("match", "register", "evaluate", "info", "models", "prepare", "train")


def test_help_names_every_verb(run: Run) -> None:
    answer = run("--help")
    assert answer.status == 0
    assert answer.err == ""
    assert [verb for verb in VERBS if f"\n  {verb} " not in answer.out] == []
    assert "..." not in answer.out.partition("Commands:")[2]  # none is cut, in 80 columns


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
        ["train", "-o", "model", "--threads", "1000000000"],
    ],
)
def test_a_wrong_command_line_is_2(run: Run, words: list[str]) -> None:
    answer = run(*words)
    assert answer.status == 2
    assert answer.out == ""
    assert "Error: " in answer.err


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["match", "", "b.ply", "-o", "x.npz"], "the argument after match is empty"),
        (["match", "a.ply", "b.ply", "-o", ""], "the argument after -o is empty"),
        (["fit", "", "-o", "fits"], "the argument after fit is empty"),
        (["info", "--picture=", "a.ply"], "--picture is empty"),
    ],
)
def test_an_empty_argument_is_not_the_current_folder(
    run: Run, words: list[str], told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    refused(run(*words), told, tmp_path, set())
    for call in (meshmatch.load_shape, meshmatch.Collection):
        with pytest.raises(InputError, match="a path is empty"):
            call("")
    assert "no file nothing.ply" in run("match", "nothing.ply", "b.ply", "-o", "x.npz", "--only=x=").err  # a name


def test_a_word_that_is_none_of_the_choices(run: Run) -> None:
    assert (
        "Error: Invalid value for '--up': 'q' is not one of" in run("view", "a", "b", "-o", "c.html", "--up", "q").err
    )


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

    monkeypatch.setattr("meshmatch.shapes.files.list_meshes", load)


def test_a_folder_that_may_not_be_entered_is_an_error_in_a_line(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    fail(PermissionError(13, "Permission denied", "locked/a.ply"), monkeypatch)
    answer = run("info", "a.ply")
    assert answer.status == 1
    assert answer.err.splitlines() == [
        "error: cannot reach locked/a.ply: Permission denied",
        "hint: may you read and write there?",
    ]


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


# A verb that writes, ends a process that it forked, and waits; while it cleans up, a second signal comes.
WRITING = """
import os, signal, sys, time
from pathlib import Path
from meshmatch.cli import main
from meshmatch.outputs import replace_on_success
from meshmatch.shapes import files

def load(path):
    ready, say = os.pipe()
    child = os.fork()
    if not child:
        try:
            os.write(say, b"!")  # before this Python may forget a signal that came while it forked
            time.sleep(60)
        finally:
            os._exit(7)
    os.read(ready, 1)
    os.kill(child, signal.SIGTERM)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
    try:
        with replace_on_success("out.ply") as temporary:
            temporary.write_text("ply")
            print("writing", flush=True)
            time.sleep(60)
    finally:
        os.kill(os.getpid(), signal.SIGTERM)
        Path("cleaned").touch()

files.list_meshes = load
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # under nohup it is ignored, and stays so
sys.exit(main(["info", "a.ply"]))
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_kill_leaves_no_file_behind_and_has_its_status(tmp_path: Path, number: signal.Signals) -> None:
    outside = os.environ | {"PYTHONPATH": str(ROOT)}
    with subprocess.Popen(
        [sys.executable, "-c", WRITING],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path, env=outside,
    ) as process:  # fmt: skip
        assert process.stdout is not None
        assert process.stdout.readline() == f"{-signal.SIGTERM}\n"  # the forked one ended as any other
        assert process.stdout.readline() == "writing\n"
        (half,) = tmp_path.iterdir()
        assert half.name.startswith(".out.")
        process.send_signal(number)
        words = process.communicate()[1]
    assert (process.returncode, words) == (128 + number, "killed: no file is half-written\n")
    assert [path.name for path in tmp_path.iterdir()] == ["cleaned"]


def test_a_second_kill_later_counts(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the first was lost, in a callback that swallows whatever is raised, another one is heard."""
    clock = iter((0.0, 5.0, 5.0))
    monkeypatch.setattr("meshmatch.cli.boundary.time", type("Clock", (), {"monotonic": lambda: next(clock)}))
    told = []

    def load(path: Path) -> None:
        try:
            signal.raise_signal(signal.SIGTERM)
        except KeyboardInterrupt:
            told.append("lost")
        signal.raise_signal(signal.SIGTERM)
        told.append("not heard")

    monkeypatch.setattr("meshmatch.shapes.files.list_meshes", load)
    assert run("info", "a.ply").status == 143
    assert told == ["lost"]


def test_a_kill_that_comes_too_late_changes_nothing(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """All is written, and the program about to leave: its status stands."""

    def leaving(number: int, handler: object) -> None:
        if handler is signal.SIG_DFL and not told:
            told.append(number)
            signal.raise_signal(signal.SIGTERM)
        return real(number, handler)

    told: list[int] = []
    real = signal.signal
    monkeypatch.setattr("meshmatch.cli.boundary.signal.signal", leaving)
    assert run("--version").status == 0
    assert told == [signal.SIGTERM]


@pytest.mark.parametrize(("number", "word"), [(signal.SIGTERM, "killed"), (signal.SIGINT, "interrupted")])
def test_what_a_kill_breaks_is_no_bug(run: Run, monkeypatch: pytest.MonkeyPatch, number: int, word: str) -> None:
    def load(path: Path) -> None:
        try:
            signal.raise_signal(number)
        except KeyboardInterrupt:
            raise RuntimeError("a worker is gone") from None

    monkeypatch.setattr("meshmatch.shapes.files.list_meshes", load)
    usual = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
    before = signal.signal(number, usual)  # a shell lets what runs in its background ignore Ctrl-C
    try:
        answer = run("info", "a.ply")
    finally:
        signal.signal(number, before)
    assert (answer.status, answer.err) == (128 + number, f"{word}: no file is half-written\n")


def test_the_signal_is_only_borrowed(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """Afterwards it does what it did; and a handler of a program around this one is left alone."""
    inside: list[object] = []

    def load(path: Path) -> None:
        inside.append(signal.getsignal(signal.SIGTERM))
        raise InputError("bad file")

    def own(number: int, frame: object) -> None: ...

    monkeypatch.setattr("meshmatch.shapes.files.list_meshes", load)
    before = signal.getsignal(signal.SIGTERM)
    try:
        for handler in (signal.SIG_DFL, own, signal.SIG_IGN):
            signal.signal(signal.SIGTERM, handler)
            assert run("info", "a.ply").status == 1
            assert signal.getsignal(signal.SIGTERM) is handler
    finally:
        signal.signal(signal.SIGTERM, before)
    assert inside[0] is not signal.SIG_DFL
    assert inside[1:] == [own, signal.SIG_IGN]


@pytest.mark.parametrize("error", [MemoryError(), RuntimeError("[enforce] DefaultCPUAllocator: can't allocate memory")])
def test_too_little_memory_is_told_in_words(run: Run, monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    fail(error, monkeypatch)
    answer = run("info", "a.ply")
    assert (answer.status, answer.out) == (1, "")
    assert answer.err.splitlines()[0] == "error: there is not enough memory for this"


def test_a_reader_that_had_enough_is_no_error(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "meshmatch", "models", "show", "human"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=ROOT) as process:
        assert process.stdout is not None and process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == b""


def test_a_bug_keeps_its_traceback(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    fail(ZeroDivisionError("a bug"), monkeypatch)
    with pytest.raises(ZeroDivisionError):
        main(["info", "a.ply"])


@pytest.mark.parametrize(("value", "shown"), [("1", True), ("yes", True), ("", False), ("0", False)])
def test_debug_shows_the_traceback_of_an_error(monkeypatch: pytest.MonkeyPatch, value: str, shown: bool) -> None:
    fail(InputError("bad file"), monkeypatch)
    monkeypatch.setenv("MESHMATCH_DEBUG", value)
    with pytest.raises(InputError) if shown else nullcontext():
        assert main(["info", "a.ply"]) == 1


def test_python_m_meshmatch_passes_the_status_on(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "meshmatch", "info", str(tmp_path / "nothing.ply")]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 1
    assert done.stdout == ""
    assert "Traceback" not in done.stderr


def cut_short(folder: Path) -> Path:
    """An stl of three triangles that promises five."""
    rows = b"".join(bytes(12) + np.eye(3, dtype="<f4").tobytes() + bytes(2) for _ in range(3))
    path = folder / "a.stl"
    path.write_bytes(b"x".ljust(80) + (5).to_bytes(4, "little") + rows)
    return path


def test_a_warning_is_one_line_on_stderr(run: Run, tmp_path: Path) -> None:
    answer = run("info", cut_short(tmp_path), "--json")
    assert answer.status == 0
    assert answer.err == "warning: a.stl promises 5 triangles, but holds 3: these are read\n"
    assert answer.out.count("\n") == 1


@pytest.mark.parametrize("asked", ["error", "ignore"])
def test_a_warning_is_shown_whatever_python_was_asked(run: Run, tmp_path: Path, asked: Any) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter(asked)
        answer = run("info", cut_short(tmp_path))
    assert answer.status == 0
    assert answer.err.count("warning: a.stl promises") == 1


def test_a_program_gets_a_usual_warning(tmp_path: Path) -> None:
    with pytest.warns(MeshmatchWarning, match="promises 5 triangles"):
        assert load_shape(cut_short(tmp_path)).F == 3
