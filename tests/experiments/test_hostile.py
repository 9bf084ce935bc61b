"""The campaign against the product: it finds what is wrong, gives the same again, and goes on where it was stopped."""

import json
import os
import shutil
import signal
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from meshmatch.errors import ModelError
from meshmatch.experiments.hostile import campaign as hostile
from meshmatch.experiments.hostile import inputs as hostile_inputs
from meshmatch.experiments.hostile import kills as hostile_kills
from meshmatch.experiments.hostile import readers as hostile_readers
from meshmatch.experiments.hostile.damage import apply_damage
from meshmatch.experiments.hostile.inputs import Sample, make_input, run_batch
from meshmatch.experiments.hostile.learned import update_hashes
from meshmatch.experiments.hostile.samples import make_samples
from meshmatch.models.registry import verify_model
from meshmatch.templates.template import load_template
from tests.fitting.small_viscous import use_small_fits

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")


@pytest.fixture(scope="module")
def samples(tmp_path_factory: pytest.TempPathFactory) -> list[Sample]:
    with pytest.MonkeyPatch.context() as patch:
        use_small_fits(patch)
        return make_samples(tmp_path_factory.mktemp("samples") / "all")


@pytest.mark.filterwarnings("ignore::meshmatch.errors.MeshmatchWarning")
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
    assert len({sample.family for sample in samples}) == 21


def test_a_number_gives_the_same_file_again(samples: list[Sample], tmp_path: Path) -> None:
    made = []
    for name in "ab":
        (tmp_path / name).mkdir()
        made.append([make_input(samples, 3, number, tmp_path / name)[1].read_bytes() for number in range(60)])
    assert made[0] == made[1]
    whole = {(sample.folder / sample.files[0]).read_bytes() for sample in samples}
    assert sum(data not in whole for data in made[0]) > 40


def test_what_is_nested_deeply_is_damaged_otherwise() -> None:
    deep = b'{"a":' * 600 + b"1" + b"}" * 600
    assert len({apply_damage(deep, deep, np.random.default_rng(seed)) for seed in range(1000)}) > 800


def crash(path: Path) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def chatter(path: Path) -> None:
    os.write(2, b"libtiff: odd\n")


def busy(path: Path) -> None:
    while True:
        pass


def hoard(path: Path) -> None:
    np.ones(1 << 28)


@pytest.mark.parametrize(
    ("read", "kind"),
    [
        (lambda path: {}[path], "traceback"),
        (crash, "crash"),
        (busy, "time"),
        (hoard, "memory"),
        (chatter, "printed"),
        (lambda path: hostile_readers.check("\x1b[31m"), "message"),
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
        signal.signal(signal.SIGPROF, signal.SIG_IGN)
        time.sleep(60)

    for name in ("SECONDS", "_PATIENCE"):
        monkeypatch.setattr(hostile_inputs, name, 0.4)
    monkeypatch.setattr(hostile_inputs, "readers", lambda family, path, shape: [lambda: deaf(path)])
    assert [failure.kind for failure in run_batch(samples, 0, range(2), tmp_path)] == ["time", "time"]


def test_it_goes_on_where_it_was_stopped_until_there_were_enough(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """However little time there is."""
    seen: list[range] = []
    samples = [Sample(family, tmp_path, ("a",)) for family in ("maps", "lists")]
    monkeypatch.setattr(hostile, "make_samples", lambda folder: samples)
    monkeypatch.setattr(hostile_inputs, "run_batch", lambda samples, seed, numbers, keep: seen.append(numbers) or [])
    outcomes = iter(["fine", "missed", "fine", "fine"])
    monkeypatch.setattr(hostile_kills, "make_cases", lambda folder, training: [small_case(folder, False)])
    monkeypatch.setattr(hostile_kills, "kill", lambda *rest: hostile_kills.Outcome(next(outcomes)))
    words = ["--minutes", "0", "--kills", "3", "--output", str(tmp_path / "out"), "--inputs"]
    assert hostile.main([*words, "400"]) == 0 and hostile.main([*words, "1000"]) == 0
    assert [numbers.start for numbers in seen] == [k * hostile_inputs.BATCH for k in range(10)]
    state = json.loads((tmp_path / "out" / "hostile-0.json").read_text())
    assert state["tried"] == {"maps": 1000, "lists": 1000}
    assert state["kills"] == {"a command fine": 3, "a command missed": 1} and next(outcomes, None) is None
    record = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (record["failures"], record["inputs"]) == (0, 2000)


def test_what_somebody_signs_is_read(samples: list[Sample], tmp_path: Path) -> None:
    """Weights and a template that were changed pass for whole ones once their hashes are written anew."""
    model = next(sample for sample in samples if sample.family == "models")
    for name in ("weights", "template"):
        folder = tmp_path / name
        shutil.copytree(model.folder, folder)
        data = bytearray((folder / f"{name}.safetensors").read_bytes())
        size = 8 + int.from_bytes(data[:8], "little")
        tensors = {key: at for key, at in json.loads(data[8:size]).items() if key != "__metadata__"}
        first = tensors["nodes" if name == "template" else min(tensors)]
        data[size + first["data_offsets"][0]] ^= 1
        (folder / f"{name}.safetensors").write_bytes(data)
        with pytest.raises(ModelError, match=r"not those of its card|does not match its hash"):
            verify_model(folder)
        update_hashes(folder)
        if name == "weights":
            assert verify_model(folder).name == "model"
        else:
            assert load_template(folder / "template.safetensors").K == 36


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


@pytest.mark.parametrize(
    ("said", "status", "outcome"), [("error: cannot write out", 1, "fine"), ("Errno 27", 1, "broken")]
)
def test_a_full_disk_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, said: str, status: int, outcome: str
) -> None:
    """A command that writes a megabyte beside its output, where files may not be so large."""

    def write(place: Path, words: tuple[str, ...]) -> int:
        try:
            (place / "new").write_bytes(bytes(10**6))
        except OSError:
            (place / "new").unlink()
            os.write(2, said.encode())
            return status
        return 0

    monkeypatch.setattr(hostile_kills, "_run", write)
    assert hostile_kills.fill(small_case(tmp_path, False), 0, 0).outcome == outcome
