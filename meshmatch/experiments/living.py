"""A process that stays alive: what a `Matcher` takes for one more fit and map, and how workers share a model.

A fit, the agreement of two and a map between them are clocked in one process, with one thread, after a whole match that
does not count. Shapes are read anew before each run, so that nothing is known about them. Workers are processes that
load a model and ask its network; the kernel then says what memory is theirs, each page divided by how many share it.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, TypeVar

from meshmatch.api.matching import Matcher
from meshmatch.errors import OptionError
from meshmatch.experiments.runner import Report, table
from meshmatch.fitting.agree import agreed_fits
from meshmatch.shapes.files import load_shape
from meshmatch.threads import thread_limit

T = TypeVar("T")

# Of 10,000 vertices, in seconds of CPU.
BARS = {"fit, climber": 0.9, "fit, dancer": 0.9, "agreement": 0.4, "map": 0.1, "map, the same fits again": 0.1}
_COLUMNS = {"stage": "stage", "CPU s": "cpu:.3f", "bar": "bar:g", "met": "met"}
WORKERS = 2
_WORKER = """
import json, sys, time
import numpy as np
from meshmatch.models import trained
from meshmatch.models.registry import load_model
wall, cpu = time.perf_counter(), time.process_time()
network = load_model(sys.argv[1]).inference
took = time.perf_counter() - wall, time.process_time() - cpu
network.predict([np.random.default_rng(0).standard_normal((2048, 3))])
network.read_frames(np.zeros((1, *network.align_basis.shape), np.float32))
print(json.dumps(took), flush=True)
sys.stdin.readline()
"""
_WORKER_COLUMNS = {
    **{"weights": "weights", "load, s": "wall:.3f", "load, CPU s": "cpu:.3f", "PSS of one, MB": "pss:.1f"},
    **{"its private MB": "private:.1f", f"PSS of {WORKERS}, MB": "both:.1f"},
}


def living(paths: Sequence[Path], runs: int) -> Report:
    """Stages of a match of two files by a `Matcher` that has matched before."""
    matcher = Matcher("human", threads=1)
    measured = [_stages(matcher, paths) for _ in range(runs + 1)][1:]
    rows = []
    for stage, bar in BARS.items():
        values = [each[stage] for each in measured]
        middle = statistics.median(values)
        rows.append({"stage": stage, "cpu": middle, "bar": bar, "met": middle <= bar, "runs": values})
    title = f"A process that has matched before, 10,000 vertices, one thread, median of {runs}"
    return Report({"living": rows}, [table(title, rows, _COLUMNS)])


def _stages(matcher: Matcher, paths: Sequence[Path]) -> dict[str, float]:
    seconds: dict[str, float] = {}

    def timed(stage: str, call: Callable[[], T]) -> T:
        began = time.process_time()
        found = call()
        seconds[stage] = time.process_time() - began
        return found

    shapes = [load_shape(path) for path in paths]
    source = timed("fit, climber", lambda: matcher.fit(shapes[0]))
    target = timed("fit, dancer", lambda: matcher.fit(shapes[1]))
    timed("map", lambda: matcher.map(source, target, agree=False))
    timed("map, the same fits again", lambda: matcher.map(source, target, agree=False))
    clean = [fit.repaired.shape for fit in (source, target) if fit.repaired is not None]
    with thread_limit(1):
        timed("agreement", lambda: agreed_fits(matcher.model, clean, [source, target], matcher.config))
    return seconds


def shared(runs: int, model: str = "human") -> Report:
    """What workers of one model cost, with its weights in a file that they share and to each its own.

    `OptionError` where the system does not say what memory is shared.
    """
    if not Path("/proc/self/smaps_rollup").exists():
        raise OptionError("this system does not say what memory processes share", "use Linux")
    with tempfile.TemporaryDirectory() as folder:
        # there is no folder in a device: each worker has its weights to itself
        rows = [_workers(*case, runs, model) for case in (("private", os.devnull), ("shared", folder))]
    title = f"{WORKERS} workers that loaded a model and asked its network, median of {runs}"
    return Report({"workers": rows}, [table(title, rows, _WORKER_COLUMNS)])


def _workers(weights: str, cache: str, runs: int, model: str) -> dict[str, Any]:
    command = [sys.executable, "-c", _WORKER, model]
    # Memory is given back to the system, or kept, as nobody's settings say.
    environment = {name: value for name, value in os.environ.items() if not name.startswith("MALLOC_")}
    environment["XDG_CACHE_HOME"] = cache
    found: list[dict[str, float]] = []
    for _ in range(runs + 1):
        with ExitStack() as stack:
            workers, took = [], []
            for _ in range(WORKERS):
                process = subprocess.Popen(
                    command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment, text=True
                )
                workers.append(stack.enter_context(process))
                assert process.stdout is not None
                took.append(json.loads(process.stdout.readline()))
            memory = [_memory(process.pid) for process in workers]
            for process in workers:
                process.communicate("\n")
        wall, cpu = took[-1]
        one = {"pss": memory[-1]["Pss"], "private": memory[-1]["Private_Dirty"] + memory[-1]["Private_Clean"]}
        found.append({"wall": wall, "cpu": cpu, **one, "both": sum(each["Pss"] for each in memory)})
    row = {key: statistics.median(each[key] for each in found[1:]) for key in found[0]}
    return {"weights": weights, **row, "runs": found[1:]}


def _memory(pid: int) -> dict[str, float]:
    """Megabytes of a process, by the kernel's names."""
    lines = Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="utf-8").splitlines()[1:]
    return {name: int(amount.split()[0]) / 1000 * 1.024 for name, amount in (line.split(":") for line in lines)}
