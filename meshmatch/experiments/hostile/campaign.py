"""A hostile user: damaged files of every kind that is read, and commands killed at random moments.

Samples of all formats are made, damaged at random (bytes, numbers, words, JSON, archives, headers) and read as the product
reads them, each in 20 s of CPU and a gigabyte; commands are ended by SIGKILL, SIGTERM, SIGHUP and SIGINT, or find the disk
full after some bytes. A failure is anything but a result or one of our errors: a traceback, the end of the interpreter, too
much time or memory, something printed raw, a message that is long or commands a terminal; after a kill anything that is
neither the old nor the new. Each failure is kept in the output folder, with the file. The same seed gives the same inputs;
the same command goes on where it was stopped.
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

_FULL = 9  # of so many commands one is not killed, but finds the disk full; no divisor of the commands of a turn
_DISK = ", disk full"
_COLUMNS = {"family": "family", "tried": "tried:,d", **{kind: f"{kind}:d" for kind in inputs.KINDS}}
_KILL_COLUMNS = {
    "command": "command",
    "kills": "kills:,d",
    "ended before": "missed:d",
    "neither old nor new": "broken:d",
}


def _load(path: Path) -> dict[str, Any]:
    fresh = {"next": 0, "tried": {}, "failed": {}, "kills": {}, "rounds": 0}
    return {**fresh, **json.loads(path.read_text(encoding="utf-8"))} if path.is_file() else fresh


def _save(path: Path, state: dict[str, Any]) -> None:
    with replace_on_success(path) as temporary:
        temporary.write_text(json.dumps(state) + "\n", encoding="utf-8")


def read_damaged(state: dict[str, Any], seed: int, folder: Path, file: Path, seconds: float, least: int) -> None:
    """Batches of damaged files until the time is over, and there were so many of each family; the state is kept after
    each batch.
    """
    with tempfile.TemporaryDirectory() as place:
        samples = make_samples(Path(place))
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
    """Commands killed in turn, and now and then run on a full disk, until the time is over, and so many were killed."""
    with tempfile.TemporaryDirectory() as place:
        cases = kills.make_cases(Path(place), training)
        end = time.monotonic() + seconds
        while time.monotonic() < end or _killed(state) < least:
            number = state["rounds"]
            case, full = cases[number % len(cases)], number % _FULL == _FULL - 1
            found = (kills.fill if full else kills.kill)(case, seed, number)
            name = f"{case.name}{_DISK if full else ''}"
            counted = Counter(state["kills"])
            counted[f"{name} {found.outcome}"] += 1
            if found.outcome == "broken":
                kept = folder / f"kill-{name.replace(' ', '-')}-{number}"
                shutil.copytree(case.folder, kept, dirs_exist_ok=True)
                (kept / "what.txt").write_text(found.what, encoding="utf-8")
            state |= {"kills": dict(counted), "rounds": number + 1}
            _save(file, state)


def _killed(state: dict[str, Any]) -> int:
    return sum(count for name, count in state["kills"].items() if not name.endswith(" missed") and _DISK not in name)


@runner.command
def main(
    minutes: Annotated[float, Option(min=0.0, help="how long; the same command goes on later")] = 2.0,
    seed: runner.Seed = 0,
    output: Annotated[Path, Option(help="folder of the counts and of all that failed")] = Path("out/hostile"),
    killing: Annotated[float, Option(min=0.0, max=1.0, help="share of the time for kills")] = 0.25,
    training: Annotated[bool, Option("--train/--no-train", help="kill trainings too, which need torch")] = True,
    inputs_each: Annotated[int, Option("--inputs", min=0, help="go on until so many of each family were read")] = 0,
    least: Annotated[int, Option("--kills", min=0, help="go on until so many commands were killed")] = 0,
    fresh: Annotated[bool, Option("--fresh", help="begin anew")] = False,
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
    wrong = sum(state["failed"].values()) + sum(row["broken"] for row in killed)
    tables = [runner.table(f"Damaged files, seed {seed}", rows, _COLUMNS), runner.table("Kills", killed, _KILL_COLUMNS)]
    record = {"inputs": state["next"], "families": rows, "kills": killed, "failures": wrong}
    stopped = MeshmatchError(f"{wrong} failures", f"each is kept in {output}") if wrong else None
    return runner.Report(record, tables, stopped=stopped)
