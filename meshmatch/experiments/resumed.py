"""Trainings that are killed at random moments and gone on with: are their weights those of one that nobody disturbed?

Small networks learn from three eggs, with nodes and implicitly in turn, and write a checkpoint after every step. Each is
ended by SIGKILL at a random moment, up to three times and mostly after a step, then goes on to its end. Its weights must be
equal bit for bit.
"""

from __future__ import annotations

import os
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from typer import Option

from meshmatch.errors import MeshmatchError
from meshmatch.experiments import runner
from meshmatch.experiments.hostile_kills import digest
from meshmatch.experiments.hostile_learned import (
    IMPLICIT_TRAINING,
    RECIPE,
    learn_eggs,
    learn_implicitly,
    prepare_eggs,
    write_eggs,
)
from meshmatch.models.registry import WEIGHTS
from meshmatch.training.alone import CHECKPOINT

_STEPS = 12
_EARLY = 0.2  # of the kills come at any moment, maybe before the first step
_COLUMNS = {
    "training": "training",
    "trainings": "trainings:d",
    "kills": "kills:d",
    "before a step": "early:d",
    "equal": "equal:d",
}


@dataclass(frozen=True)
class Learner:
    """A training, and what is counted: trainings, kills, kills that came before there was a checkpoint, and how many ended
    with the weights of one that nobody disturbed. ``seconds`` is what each run took that came to its end, and ``later`` what
    it took after its first checkpoint.
    """

    name: str
    learn: Callable[[Path], None]
    row: dict[str, int] = field(default_factory=lambda: dict.fromkeys(("trainings", "kills", "early", "equal"), 0))
    seconds: list[float] = field(default_factory=list)
    later: list[float] = field(default_factory=list)


def _run(learner: Learner, output: Path, patience: float = float("inf"), stepped: bool = False) -> bool:
    """Train in a process of its own, which is killed after some seconds, counted from its first step if `stepped`; whether
    it was.
    """
    began, old = time.monotonic(), _changed(output)
    first = None
    child = os.fork()
    if not child:
        status = 1
        try:
            learner.learn(output)
            status = 0
        finally:
            os._exit(status)
    while not (ended := os.waitpid(child, os.WNOHANG))[0]:
        now = time.monotonic()
        first = first or (now if _changed(output) != old else None)
        if now - ((first or now) if stepped else began) > patience:
            os.kill(child, signal.SIGKILL)
            return os.WIFSIGNALED(os.waitpid(child, 0)[1])
        time.sleep(0.001)
    if ended[1]:
        raise MeshmatchError(f"{learner.name}: a training ended with {os.waitstatus_to_exitcode(ended[1])} in {output}")
    learner.seconds.append(time.monotonic() - began)
    learner.later.append(time.monotonic() - (first or began))
    return False


def _changed(output: Path) -> int:
    """When the checkpoint was written, if there is one."""
    file = output / CHECKPOINT
    return file.stat().st_mtime_ns if file.is_file() else 0


def disturb(learner: Learner, output: Path, rng: np.random.Generator) -> None:
    """Train, kill it one to three times, and let it end."""
    wanted, kills = int(rng.integers(1, 4)), 0
    while kills < wanted:
        stepped = rng.random() > _EARLY
        usual = np.median(learner.later if stepped else learner.seconds)
        if _run(learner, output, rng.uniform(0, usual), stepped):
            kills += 1
            learner.row["early"] += not (output / CHECKPOINT).is_file()
        elif kills:
            break
        else:  # it ended before it could be killed
            shutil.rmtree(output)
    _run(learner, output)
    learner.row["trainings"] += 1
    learner.row["kills"] += kills


@runner.command
def main(
    trainings: Annotated[int, Option(min=2, help="how many are killed")] = 100,
    seed: runner.Seed = 0,
    steps: Annotated[int, Option(min=2, help="of each training")] = _STEPS,
) -> runner.Report:
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        eggs, ready = place / "eggs", place / "ready"
        write_eggs(eggs)
        prepare_eggs(eggs, ready)
        plain, implicit = (
            replace(each, steps=steps, checkpoint_minutes=0.0) for each in (RECIPE.train, IMPLICIT_TRAINING)
        )
        learners = [
            Learner("nodes", lambda output: learn_eggs(ready, output, plain)),
            Learner("implicit", lambda output: learn_implicitly(eggs, output, implicit)),
        ]
        whole = []
        for learner in learners:
            learner.learn(place / learner.name / "first")  # what is imported late is imported for all
            _run(learner, place / learner.name / "m")
            whole.append(digest(place / learner.name / "m" / WEIGHTS))
        for number in range(trainings):
            learner, output = learners[number % 2], place / str(number) / "m"
            disturb(learner, output, np.random.default_rng([seed, number]))
            learner.row["equal"] += digest(output / WEIGHTS) == whole[number % 2]
            shutil.rmtree(output.parent)
    rows = [{"training": learner.name} | learner.row for learner in learners]
    equal = sum(learner.row["equal"] for learner in learners)
    title = f"{equal} of {trainings} trainings that were killed are equal bit for bit"
    stopped = None if equal == trainings else MeshmatchError(title, "the others differ")
    return runner.Report({"trainings": rows, "equal": equal}, [runner.table(title, rows, _COLUMNS)], stopped=stopped)


if __name__ == "__main__":
    sys.exit(main())
