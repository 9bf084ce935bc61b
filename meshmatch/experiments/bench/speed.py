"""Time and memory of whole processes.

Each case is a command as a user types it, in a process of its own, from the interpreter's start to its end: nothing is
warm but the disk's cache. Shown is the median of several runs after one that does not count: seconds on the clock,
seconds of CPU (both cores together), and the largest memory that a run ever held. Bars are for two cores, and all
processes are kept on two where the system allows that. The shapes are the two samples, split and decimated to the sizes
that the cases ask for.

``--against`` puts an earlier run beside this one: the file that it wrote with --save, such as docs/results/speed.json.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from typer import Option

import meshmatch
from meshmatch.arrays import Ints
from meshmatch.errors import InputError, MeshmatchError
from meshmatch.experiments import runner
from meshmatch.geometry.trees import cKDTree
from meshmatch.geometry.triangles import edge_keys
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.decimate import decimate
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.shape import Shape
from meshmatch.templates.location import bundled_folder


@dataclass(frozen=True)
class Case:
    """A command and what it may cost.

    Parameters
    ----------
    words : tuple of str
        What follows ``python -m meshmatch``; a word ``NAME@V`` stands for the file of the sample NAME brought to at
        least V vertices, ``NAME@V+CHANGE`` for one that was also changed (`CHANGES`), ``NAME.glb`` for that sample, ``A>B``
        for a map between two such words, ``A~B`` for a truth that differs from it (`truth_beside`), ``@FILE`` for a file
        to write. What a case reads is made before it is measured.
    seconds, gigabytes : float
        The bars; nothing is asked of memory where it is 0.
    """

    words: tuple[str, ...]
    seconds: float
    gigabytes: float = 0.0


def _baking(size: int) -> tuple[str, ...]:
    target = "climber@10000"
    known = ("--map", f"dancer-textured.glb>{target}")
    return ("transfer-texture", "dancer-textured.glb", target, "-o", "@dressed.glb", *known, "--size", str(size))


_EVALUATED = "dancer@60000", "climber@60000"
CASES = {
    "help": Case(("--help",), 0.1),
    "pair": Case(("match", "climber@10000", "dancer@10000", "-o", "@map.npy"), 3.0, 0.5),
    "million": Case(("match", "dancer@1000000", "climber@10000", "-o", "@map.npy"), 8.0, 1.0),
    "onto a million": Case(("match", "climber@10000", "dancer@1000000", "-o", "@map.npy"), 8.0, 1.0),
    "scans": Case(("match", "climber@50000", "dancer@50000", "-o", "@map.npy"), 10.0, 1.0),
    "noisy": Case(("match", "climber@10000+noise", "dancer@10000+noise", "-o", "@map.npy"), 5.0),
    "partial": Case(("match", "dancer@10000+upper", "climber@10000", "--partial", "-o", "@map.npy"), 7.0),
    "direct": Case(("match", "climber@10000", "dancer@10000", "--model", "none", "-o", "@map.npy"), 8.0, 1.0),
    "large direct": Case(("match", "climber@100000", "dancer@100000", "--model", "none", "-o", "@map.npy"), 20.0),
    "loose direct": Case(("match", "dancer@100000+loose", "climber@10000", "--model", "none", "-o", "@map.npy"), 60.0),
    "evaluate": Case(("evaluate", ">".join(_EVALUATED), *_EVALUATED, "--truth", "~".join(_EVALUATED)), 10.0),
    "texture 2048": Case(_baking(2048), 4.0),
    "texture 8192": Case(_baking(8192), 25.0, 1.5),
}


@dataclass(frozen=True)
class Cost:
    """What one process took: seconds on the clock, seconds of CPU, gigabytes at its largest."""

    wall: float
    cpu: float
    gigabytes: float


def cost_of(command: Sequence[str]) -> Cost:
    """Run a command to its end and read what the kernel counted.

    Memory is never less than what this process itself holds, for a child begins as its copy. Compiled modules are kept
    for the next run, as they are by an installation, and memory is given back as nobody's settings say, whatever the
    environment has.

    Raises
    ------
    MeshmatchError
        It did not end with status 0; the message is its last line of stderr.
    """
    own = ("PYTHONDONTWRITEBYTECODE", "MALLOC_")
    environment = {name: value for name, value in os.environ.items() if not name.startswith(own)}
    with tempfile.TemporaryFile() as told:
        started = time.perf_counter()
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=told, env=environment)
        _, status, usage = os.wait4(process.pid, 0)
        wall = time.perf_counter() - started
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            told.seek(0)
            lines = told.read().decode(errors="replace").strip().splitlines() or ["it said nothing"]
            raise MeshmatchError(f"{' '.join(command)} ended with {process.returncode}: {lines[-1]}")
    unit = 1.0 if sys.platform == "darwin" else 1024.0  # of ru_maxrss, in bytes
    return Cost(wall, usage.ru_utime + usage.ru_stime, usage.ru_maxrss * unit / 1e9)


def split(shape: Shape) -> Shape:
    """Every triangle in four, in an order that decimation leaves closed (trimesh's is not)."""
    corners = shape.faces
    keys, place = np.unique(edge_keys(corners, shape.V), return_inverse=True)
    middles = 0.5 * (shape.verts[keys // shape.V] + shape.verts[keys % shape.V])
    ab, bc, ca = shape.V + place.reshape(3, -1)
    a, b, c = corners.T
    parts = [(a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca)]
    faces = np.concatenate([np.stack(part, axis=1) for part in parts])
    return Shape(np.concatenate([shape.verts, middles]), faces, shape.name)


def sized(shape: Shape, V: int) -> Shape:
    """A closed shape split until it has at least V vertices; a small one is then decimated to about V."""
    while shape.V < V:
        shape = split(shape)
    return decimate(shape, 2 * V) if 1.1 * V < shape.V < 200_000 else shape


def noisy(shape: Shape) -> Shape:
    """The vertices alone, with Gaussian noise of 1 % of the diagonal."""
    noise = np.random.default_rng(0).standard_normal(shape.verts.shape)
    return Shape(shape.verts + 0.01 * shape.diagonal * noise, np.empty((0, 3), np.int64), shape.name)


def upper_half(shape: Shape) -> Shape:
    """What lies above the middle of a shape whose y axis points up."""
    heights = shape.verts[:, 1]
    faces = shape.faces[(heights[shape.faces] > 0.5 * (heights.min() + heights.max())).all(1)]
    used = np.unique(faces)
    return Shape(shape.verts[used], np.searchsorted(used, faces), shape.name)


def loose(shape: Shape) -> Shape:
    """Every triangle alone, a little smaller than it was, so that none touches another."""
    corners = shape.verts[shape.faces]
    corners = corners + 0.01 * (corners.mean(1, keepdims=True) - corners)
    return Shape(corners.reshape(-1, 3), np.arange(3 * shape.F).reshape(-1, 3), shape.name)


CHANGES: dict[str, Callable[[Shape], Shape]] = {
    "": lambda shape: shape,
    "noise": noisy,
    "upper": upper_half,
    "loose": loose,
}


def truth_beside(found: VertexMap, target: Shape) -> Ints:
    """The vertices (V_src,) of the target beside the images of a map: 1 % of sqrt(area) from them along each axis."""
    noise = 0.01 * np.sqrt(target.area) * np.random.default_rng(0).standard_normal((len(found.index), 3))
    return np.asarray(cKDTree(target.verts).query(target.verts[found.index] + noise)[1], np.int64)


def _write(word: str, path: Path, made: list[Path]) -> None:
    if ">" in word:
        meshmatch.save_map(path, meshmatch.match(*made).map)
    elif "~" in word:
        source, target = load_shape(made[1]), load_shape(made[2])
        np.save(path, truth_beside(meshmatch.load_map(made[0], source, target), target))
    else:
        size, _, change = word.partition("+")
        sample, V = size.split("@")
        shape = sized(load_shape(bundled_folder() / "samples" / f"{sample}.ply"), int(V))
        save_shape(path, CHANGES[change](shape))


def file_of(word: str, folder: Path) -> Path:
    """The file of a word of a case, made once, by a process of its own: a child's memory is counted from its parent's."""
    if word.endswith(".glb"):
        return bundled_folder() / "samples" / word
    both = word.replace("~", ">").split(">")
    suffix = ".npz" if ">" in word else ".npy" if "~" in word else ".ply"
    path = folder / "".join(letter if letter.isalnum() else "-" for letter in word)
    path = path.with_suffix(suffix)
    if not path.exists():
        made = [] if len(both) == 1 else [file_of(each, folder) for each in both]
        made = [file_of(">".join(both), folder), *made] if "~" in word else made
        maker = multiprocessing.get_context("spawn").Process(target=_write, args=(word, path, made))
        maker.start()
        maker.join()
        if maker.exitcode:
            raise MeshmatchError(f"could not make {word}")
    return path


def measure(case: Case, runs: int, folder: Path) -> list[Cost]:
    """Costs of `runs` runs after one that is not counted."""
    command = [sys.executable, "-m", "meshmatch"]
    for word in case.words:
        if word.startswith("@"):
            command.append(str(folder / word[1:]))
        else:
            command.append(str(file_of(word, folder)) if "@" in word or word.endswith(".glb") else word)
    return [cost_of(command) for _ in range(runs + 1)][1:]


def keep_to_cores(count: int) -> int:
    """Keep this process and its children on `count` cores; returns on how many they are."""
    if not hasattr(os, "sched_setaffinity"):
        return os.cpu_count() or 1
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:count])
    return len(os.sched_getaffinity(0))


def record_of(name: str, case: Case, costs: list[Cost]) -> dict[str, Any]:
    """A case's row: medians, bars, whether they are met, every run."""
    middle = Cost(*(statistics.median(values) for values in zip(*(asdict(c).values() for c in costs), strict=True)))
    return {
        "case": name,
        **{key: round(value, 3) for key, value in asdict(middle).items()},
        "bar_seconds": case.seconds,
        "bar_gigabytes": case.gigabytes or None,
        "met": middle.wall <= case.seconds and (not case.gigabytes or middle.gigabytes <= case.gigabytes),
        "runs": [[round(value, 3) for value in asdict(cost).values()] for cost in costs],
    }


COLUMNS = {
    **{"case": "case", "seconds": "wall:.2f", "bar, s": "bar_seconds:g", "CPU s": "cpu:.2f"},
    **{"GB": "gigabytes:.2f", "bar, GB": "bar_gigabytes:g", "met": "met"},
}


AGAINST = {"s before": "wall_before:.2f", "CPU s before": "cpu_before:.2f", "GB before": "gigabytes_before:.2f"}
RATIOS = {"s, ratio": "wall_ratio:.2f", "CPU, ratio": "cpu_ratio:.2f", "GB, ratio": "gigabytes_ratio:.2f"}


def earlier(path: Path) -> dict[str, dict[str, Any]]:
    """The rows of an earlier run by the name of their case; `InputError` if the file does not hold one."""
    try:
        rows = json.loads(path.read_text(encoding="utf-8"))["values"]["cases"]
        return {row["case"]: {name: float(row[name]) for name in ("wall", "cpu", "gigabytes")} for row in rows}
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise InputError(f"{path} holds no run of this experiment", "give a file that --save wrote") from error


def compared(row: dict[str, Any], before: dict[str, float]) -> dict[str, Any]:
    """A row with the numbers of an earlier one, and how many times as much it takes."""
    return (
        row
        | {f"{name}_before": value for name, value in before.items()}
        | {f"{name}_ratio": round(row[name] / value, 3) for name, value in before.items() if value > 0}
    )


@runner.command
def main(
    cases: Annotated[str, Option(help=f"of {', '.join(CASES)}")] = ",".join(CASES),
    runs: Annotated[int, Option(min=1, help="counted runs of each case")] = 5,
    cores: Annotated[int, Option(min=1, help="cores that all processes share")] = 2,
    against: Annotated[Path | None, Option(help="a file of results of an earlier run")] = None,
) -> runner.Report:
    before = {} if against is None else earlier(against)
    kept = keep_to_cores(cores)
    with tempfile.TemporaryDirectory() as folder:
        rows = [
            compared(record_of(name, CASES[name], measure(CASES[name], runs, Path(folder))), before.get(name, {}))
            for name in runner.track(runner.split_names(cases, CASES, "case"), "running")
        ]
    title = f"Whole processes on {kept} cores, median of {runs} runs"
    columns = COLUMNS if against is None else {**COLUMNS, **AGAINST, **RATIOS}
    return runner.Report({"kept_to_cores": kept, "cases": rows}, [runner.table(title, rows, columns)])
