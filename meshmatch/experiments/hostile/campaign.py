"""Fuzzing: damaged files of every format that is read, and commands killed at random moments.

Samples of all formats are made, damaged at random (bytes, numbers, words, JSON, archives, headers) and read as the commands
read them, each with limits of 20 s of CPU time and a gigabyte of memory. Commands are killed by SIGKILL, SIGTERM, SIGHUP
and SIGINT, or run out of disk space.

A failure is anything but a result or one of meshmatch's own errors: a traceback, a crash, too much time or memory, stray
output, a message that is too long or contains terminal escapes; after a kill, output files that are neither the old nor the
new ones. Each failure is kept in the output folder, with the file. The same seed gives the same inputs; the same command
continues after an interruption.
"""

from __future__ import annotations

import json
import shutil
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Annotated, Any

from typer import Option

from meshmatch.errors import MeshmatchError
from meshmatch.experiments import runner
from meshmatch.experiments.hostile import inputs, kills
from meshmatch.experiments.hostile.samples import make_samples
from meshmatch.outputs import make_folder, replace_on_success

# Every 9th command runs on a full disk instead of being killed; 9 does not divide the number of cases.
_FULL_DISK_EVERY = 9
_FULL_DISK = ", disk full"
_COLUMNS = {"family": "family", "tried": "tried:,d", **{kind: f"{kind}:d" for kind in inputs.KINDS}}
_KILL_COLUMNS = {
    "command": "command",
    "kills": "kills:,d",
    "ended before": "missed:d",
    "neither old nor new": "broken:d",
}


def _load(path: Path) -> dict[str, Any]:
    initial = {"next": 0, "tried": {}, "failed": {}, "kills": {}, "rounds": 0}
    return {**initial, **json.loads(path.read_text(encoding="utf-8"))} if path.is_file() else initial


def _save(path: Path, state: dict[str, Any]) -> None:
    with replace_on_success(path) as temporary:
        temporary.write_text(json.dumps(state) + "\n", encoding="utf-8")


def read_damaged(state: dict[str, Any], seed: int, folder: Path, file: Path, seconds: float, least: int) -> None:
    """Read batches of damaged files until ``seconds`` have passed and ``least`` files of each family were read; the state
    is saved after each batch.
    """
    with tempfile.TemporaryDirectory() as temporary:
        samples = make_samples(Path(temporary))
        families = list(dict.fromkeys(sample.family for sample in samples))
        end = time.monotonic() + seconds
        while time.monotonic() < end or state["next"] < least * len(families):
            numbers = range(state["next"], state["next"] + inputs.BATCH)
            failures = inputs.run_batch(samples, seed, numbers, folder)
            tried = Counter(state["tried"])
            tried.update(families[number % len(families)] for number in numbers)
            failed = Counter(state["failed"])
            failed.update(f"{failure.family} {failure.kind}" for failure in failures)
            state |= {"next": numbers.stop, "tried": dict(tried), "failed": dict(failed)}
            _save(file, state)


def kill_commands(
    state: dict[str, Any], seed: int, folder: Path, file: Path, seconds: float, least: int, training: bool
) -> None:
    """Kill commands in a fixed order, and sometimes run them on a full disk, until ``seconds`` have passed and ``least``
    were killed.
    """
    with tempfile.TemporaryDirectory() as temporary:
        cases = kills.make_cases(Path(temporary), training)
        end = time.monotonic() + seconds
        while time.monotonic() < end or _killed(state) < least:
            number = state["rounds"]
            case, full = cases[number % len(cases)], number % _FULL_DISK_EVERY == _FULL_DISK_EVERY - 1
            outcome = (kills.fill if full else kills.kill)(case, seed, number)
            name = f"{case.name}{_FULL_DISK if full else ''}"
            counts = Counter(state["kills"])
            counts[f"{name} {outcome.outcome}"] += 1
            if outcome.outcome == "broken":
                copy = folder / f"kill-{name.replace(' ', '-')}-{number}"
                shutil.copytree(case.folder, copy, dirs_exist_ok=True)
                (copy / "what.txt").write_text(outcome.what, encoding="utf-8")
            state |= {"kills": dict(counts), "rounds": number + 1}
            _save(file, state)


def _killed(state: dict[str, Any]) -> int:
    return sum(
        count for name, count in state["kills"].items() if not name.endswith(" missed") and _FULL_DISK not in name
    )


@runner.command
def main(
    minutes: Annotated[float, Option(min=0.0, help="duration; the same command continues later")] = 2.0,
    seed: runner.Seed = 0,
    output: Annotated[Path, Option(help="folder of the counts and of all failures")] = Path("out/hostile"),
    killing: Annotated[float, Option(min=0.0, max=1.0, help="share of the time for kills")] = 0.25,
    training: Annotated[bool, Option("--train/--no-train", help="kill trainings too, which need torch")] = True,
    inputs_each: Annotated[int, Option("--inputs", min=0, help="least number of files of each family to read")] = 0,
    least: Annotated[int, Option("--kills", min=0, help="least number of commands to kill")] = 0,
    fresh: Annotated[bool, Option("--fresh", help="start from the beginning")] = False,
) -> runner.Report:
    make_folder(output)
    file = output / f"hostile-{seed}.json"
    if fresh:
        file.unlink(missing_ok=True)
    state = _load(file)
    if killing:
        kill_commands(state, seed, output, file, 60 * minutes * killing, least, training)
    read_damaged(state, seed, output, file, 60 * minutes * (1 - killing), inputs_each)
    rows = [
        {"family": family, "tried": count} | {kind: state["failed"].get(f"{family} {kind}", 0) for kind in inputs.KINDS}
        for family, count in state["tried"].items()
    ]
    names = list(dict.fromkeys(key.rsplit(" ", 1)[0] for key in state["kills"]))
    killed = [
        {"command": name, "kills": sum(state["kills"].get(f"{name} {how}", 0) for how in ("fine", "broken"))}
        | {how: state["kills"].get(f"{name} {how}", 0) for how in ("missed", "broken")}
        for name in names
    ]
    n_failures = sum(state["failed"].values()) + sum(row["broken"] for row in killed)
    tables = [runner.table(f"Damaged files, seed {seed}", rows, _COLUMNS), runner.table("Kills", killed, _KILL_COLUMNS)]
    record = {"inputs": state["next"], "families": rows, "kills": killed, "failures": n_failures}
    stopped = MeshmatchError(f"{n_failures} failures", f"each is kept in {output}") if n_failures else None
    return runner.Report(record, tables, stopped=stopped)
