"""Where a match spends its time: the functions that are its stages keep a clock while it runs.

A stage's seconds are its own: what a function hands to one of another stage counts there, so stages and ``other`` sum to
the total. The steps by which two fits agree are Gauss-Newton's, and count as its stages.
"""

from __future__ import annotations

import sys
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import reduce, wraps
from importlib import import_module
from pathlib import Path
from typing import Any

from meshmatch.api.matching import match
from meshmatch.maps import files as map_files
from meshmatch.models import registry
from meshmatch.shapes import files as shape_files

# Stage, module, function or method.
STAGES = (
    ("load", "meshmatch.shapes.files", "load_shape"),
    ("load", "meshmatch.shapes.repair", "repair"),
    ("load", "meshmatch.models.registry", "load_model"),
    ("template", "meshmatch.fitting.system", "node_system"),
    ("template", "meshmatch.fitting.network_fit", "mirror_of"),
    ("samples", "meshmatch.fitting.task", "take_samples"),
    ("orientation", "meshmatch.fitting.initial_frames", "frames_to_try"),
    ("network, neighbours", "meshmatch.models.inference", "NodeNetwork.predict"),
    ("network, layers", "meshmatch.models.inference", "NodeNetwork._residual_mlp"),
    ("readings", "meshmatch.fitting.network_fit", "two_way_residual"),
    ("readings", "meshmatch.fitting.network_fit", "one_way_residual"),
    ("readings", "meshmatch.fitting.refinement", "CandidateScorer.score"),
    ("pairs", "meshmatch.fitting.nodes", "pair_terms"),
    ("Gauss-Newton, prior", "meshmatch.fitting.nodes", "nearest_rotations"),
    ("Gauss-Newton, prior", "meshmatch.fitting.system", "NodeSystem.deformation_gradient"),
    ("Gauss-Newton, solve", "meshmatch.fitting.system", "NodeSystem.solve"),
    ("agreement", "meshmatch.fitting.agree", "agreed_fits"),
    ("verdict", "meshmatch.fitting.verdict", "judge_registration"),
    ("map", "meshmatch.maps.build", "build_map"),
    ("write", "meshmatch.maps.files", "save_map"),
)
# What a command has imported when it has matched.
IMPORTS = (
    "import meshmatch.cli.app, meshmatch.cli.match, meshmatch.api.matching, meshmatch.maps.files\n"
    "import platformdirs, pydantic.types, rich.console, threadpoolctl\n"
)


class Clock:
    """Seconds of CPU and calls by stage, of everything that the process runs while it is wound up."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self.calls: Counter[str] = Counter()
        self._running = ["other"]
        self._since = time.process_time()

    @property
    def total(self) -> float:
        """CPU seconds of all stages."""
        return sum(self.seconds.values())

    def turn(self) -> None:
        """Book what has passed for the innermost stage."""
        now = time.process_time()
        self.seconds[self._running[-1]] += now - self._since
        self._since = now

    def timed(self, stage: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """The same function, keeping this clock."""

        @wraps(function)
        def called(*args: Any, **kwargs: Any) -> Any:
            self.turn()
            self._running.append(stage)
            self.calls[stage] += 1
            try:
                return function(*args, **kwargs)
            finally:
                self.turn()
                self._running.pop()

        return called


def place_of(module: str, name: str) -> tuple[Any, str]:
    """The module or class that holds a function of `STAGES`, and its name there."""
    *owners, last = name.split(".")
    return reduce(getattr, owners, import_module(module)), last


def _replace(place: Any, name: str, old: Any, new: Any) -> None:
    """Put one function in another's place, under every name by which a module of the package knows it."""
    setattr(place, name, new)
    for module in [module for known, module in sys.modules.items() if known.split(".")[0] == "meshmatch"]:
        for key in [key for key, value in vars(module).items() if value is old]:
            setattr(module, key, new)


@contextmanager
def watched() -> Iterator[Clock]:
    """A clock that the functions of `STAGES` keep until the block ends; they may run in one thread at a time."""
    for _, module, _ in STAGES:
        import_module(module)
    clock, swaps = Clock(), []
    try:
        for stage, module, name in STAGES:
            place, last = place_of(module, name)
            old = vars(place)[last]
            swaps.append((place, last, old, clock.timed(stage, old)))
            _replace(*swaps[-1])
        clock._since = time.process_time()
        yield clock
        clock.turn()
    finally:
        for place, last, old, new in reversed(swaps):
            _replace(place, last, new, old)


def clocked_match(source: Path, target: Path, output: Path) -> Clock:
    """Match two files with one thread, and a model that is loaded anew, as the command does."""
    with watched() as clock:
        shapes = shape_files.load_shape(source), shape_files.load_shape(target)
        found = match(*shapes, model=registry.load_model("human"), threads=1)
        map_files.save_map(output, found.map)
    return clock


def profile(source: Path, target: Path, output: Path, runs: int) -> list[Clock]:
    """Clocks of several matches, the quickest first; one before them, which imports, is not counted."""
    clocks = [clocked_match(source, target, output) for _ in range(runs + 1)][1:]
    return sorted(clocks, key=lambda clock: clock.total)


def rows_of(clock: Clock, imported: float) -> list[dict[str, Any]]:
    """The stages of one match in their order: CPU seconds, share of the total, calls."""
    stages = dict.fromkeys(["import", *(stage for stage, _, _ in STAGES), "other"])
    seconds, total = {"import": imported, **clock.seconds}, imported + clock.total
    return [
        {
            "stage": stage,
            "cpu": seconds.get(stage, 0.0),
            "share": seconds.get(stage, 0.0) / total,
            "calls": clock.calls.get(stage),
        }
        for stage in stages
    ]
