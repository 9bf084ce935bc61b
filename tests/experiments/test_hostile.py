"""The campaign against the product: it finds what is wrong, gives the same again, and goes on where it was stopped."""

import json
import os
import signal
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from meshmatch.experiments import hostile, hostile_inputs, hostile_kills
from meshmatch.experiments.hostile_inputs import Sample, make_input, run_batch
from meshmatch.experiments.hostile_samples import make_samples

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")


@pytest.fixture(scope="module")
def samples(tmp_path_factory: pytest.TempPathFactory) -> list[Sample]:
    return make_samples(tmp_path_factory.mktemp("samples") / "all")


def test_samples_are_read_undamaged(samples: list[Sample]) -> None:
    shape = hostile_inputs.small_shape()
    refused = []
    for sample in samples:
        path = sample.folder / sample.files[0]
        first = next(iter(hostile_inputs.readers(sample.family, path, shape)))
        try:
            first()
        except Exception as error:
            refused.append(f"{path.name}: {error}")
    assert refused == []
    assert len({sample.family for sample in samples}) == 11


def test_a_number_gives_the_same_file_again(samples: list[Sample], tmp_path: Path) -> None:
    made = []
    for name in "ab":
        (tmp_path / name).mkdir()
        made.append([make_input(samples, 3, number, tmp_path / name)[1].read_bytes() for number in range(60)])
    assert made[0] == made[1]
    whole = {(sample.folder / sample.files[0]).read_bytes() for sample in samples}
    assert sum(data not in whole for data in made[0]) > 40


def crash(path: Path) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def chatter(path: Path) -> None:
    os.write(2, b"libtiff: odd\n")


def hoard(path: Path) -> None:
    np.ones(1 << 28)


@pytest.mark.parametrize(
    ("read", "kind"),
    [
        (lambda path: {}[path], "traceback"),
        (crash, "crash"),
        (lambda path: time.sleep(9), "time"),
        (hoard, "memory"),
        (chatter, "printed"),
        (lambda path: hostile_inputs._check("\x1b[31m"), "message"),
    ],
)
def test_what_is_wrong_is_found(
    samples: list[Sample], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, read: Any, kind: str
) -> None:
    """Of eleven inputs one is of the family that goes wrong; its file is kept with what happened."""
    monkeypatch.setattr(hostile_inputs, "SECONDS", 0.5)
    monkeypatch.setattr(
        hostile_inputs, "readers", lambda family, path, shape: [lambda: family == "maps" and read(path)]
    )
    (failure,) = run_batch(samples, 0, range(11), tmp_path)
    assert (failure.family, failure.kind, failure.number) == ("maps", kind, 1)
    kept = tmp_path / f"{kind}-maps-1"
    assert "what.txt" in os.listdir(kept) and any(name.startswith("m.") for name in os.listdir(kept))


def test_a_library_that_hears_no_alarm_is_ended(
    samples: list[Sample], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def deaf(path: Path) -> None:
        signal.signal(signal.SIGALRM, signal.SIG_IGN)
        time.sleep(60)

    for name in ("SECONDS", "_PATIENCE"):
        monkeypatch.setattr(hostile_inputs, name, 0.4)
    monkeypatch.setattr(hostile_inputs, "readers", lambda family, path, shape: [lambda: deaf(path)])
    assert [failure.kind for failure in run_batch(samples, 0, range(2), tmp_path)] == ["time", "time"]


def test_it_goes_on_where_it_was_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    seen: list[range] = []
    monkeypatch.setattr(hostile, "make_samples", lambda folder: [Sample("maps", folder, ("a",))])
    monkeypatch.setattr(hostile_inputs, "run_batch", lambda samples, seed, numbers, keep: seen.append(numbers) or [])
    clock = iter(np.arange(0.0, 100.0))
    monkeypatch.setattr("meshmatch.experiments.hostile.time", type("Clock", (), {"monotonic": lambda: next(clock)}))
    for _ in range(2):
        assert hostile.main(["--minutes", "0.03", "--killing", "0", "--output", str(tmp_path)]) == 0
    assert [numbers.start for numbers in seen] == [k * hostile_inputs.BATCH for k in range(len(seen))]
    record = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (record["failures"], record["inputs"]) == (0, seen[-1].stop)


def small_case(folder: Path, half: bool) -> hostile_kills.Case:
    (folder / "case").mkdir(parents=True)
    file = folder / "case" / "out"

    def reset() -> None:
        file.write_text("old")

    def outputs() -> dict[str, str]:
        return {"out": file.read_text()}

    words = ("half",) if half else ("whole",)
    return hostile_kills.Case(
        "a command", folder / "case", words, reset, outputs, (), [{"out": "old"}, {"out": "new"}], [0.2]
    )


@pytest.mark.parametrize("half", [False, True])
def test_half_of_a_file_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, half: bool) -> None:
    """A command that writes for a while, into the file itself or into another."""

    def write(place: Path, words: tuple[str, ...]) -> int:
        if words == ("models", "list"):
            return 0
        (place / "out").write_text("n" if words == ("half",) else "old")
        time.sleep(0.5)
        (place / "out").write_text("new")
        return 0

    monkeypatch.setattr(hostile_kills, "_run", write)
    monkeypatch.setattr(hostile_kills, "SIGNALS", (signal.SIGKILL,))
    case = small_case(tmp_path, half)
    found = {hostile_kills.kill(case, 0, number).outcome for number in range(6)}
    assert ("broken" in found) == half
    assert found <= {"fine", "broken"}
