"""Time and memory of whole processes.

Each case is a command line in a new process, measured from the interpreter's start to its end: only the disk's cache is
warm. The table has medians of several runs after a warm-up: wall time, CPU time of all cores, and peak memory. Bars are for
two cores; all processes are bound to two where the system allows it. The shapes are the two samples, subdivided and
decimated to the sizes of the cases.

``--against`` compares with an earlier run: a file that it wrote with --save, such as docs/results/speed.json.
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
    """A command and its limits of time and memory.

    Parameters
    ----------
    words : tuple of str
        Arguments of ``python -m meshmatch``. A word ``NAME@V`` stands for the sample NAME with at least V vertices,
        ``NAME@V+CHANGE`` for such a sample after a change of `CHANGES`, ``NAME.glb`` for that sample, ``A>B`` for a map
        between two such words, ``A~B`` for ground truth near it (`truth_beside`), ``@FILE`` for an output file. Inputs are
        made before the case is measured.
    seconds, gigabytes : float
        The limits; 0 gigabytes is no limit.
    """

    words: tuple[str, ...]
    seconds: float
    gigabytes: float = 0.0


def _baking(size: int) -> tuple[str, ...]:
    target = "climber@10000"
    known = ("--map", f"dancer-textured.glb>{target}")
    return ("transfer-texture", "dancer-textured.glb", target, "-o", "@dressed.glb", *known, "--size", str(size))


_EVALUATED_PAIR = "dancer@60000", "climber@60000"
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
    "evaluate": Case(
        ("evaluate", ">".join(_EVALUATED_PAIR), *_EVALUATED_PAIR, "--truth", "~".join(_EVALUATED_PAIR)), 10.0
    ),
    "texture 2048": Case(_baking(2048), 4.0),
    "texture 8192": Case(_baking(8192), 25.0, 1.5),
}


@dataclass(frozen=True)
class Cost:
    """Cost of one process: wall seconds, CPU seconds, and peak memory in gigabytes."""

    wall: float
    cpu: float
    gigabytes: float


def cost_of(command: Sequence[str]) -> Cost:
    """Run a command to its end and return the kernel's resource usage.

    Memory is at least that of this process, as the child is forked from it. Bytecode is cached, as in an installation, and
    the allocator has its default settings: environment variables that change either are not passed on.

    Raises
    ------
    MeshmatchError
        The status is not 0; the message has the last line of stderr.
    """
    own = ("PYTHONDONTWRITEBYTECODE", "MALLOC_")
    environment = {name: value for name, value in os.environ.items() if not name.startswith(own)}
    with tempfile.TemporaryFile() as stderr:
        started = time.perf_counter()
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=stderr, env=environment)
        _, status, usage = os.wait4(process.pid, 0)
        wall = time.perf_counter() - started
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            stderr.seek(0)
            lines = stderr.read().decode(errors="replace").strip().splitlines() or ["no message"]
            raise MeshmatchError(f"{' '.join(command)} ended with {process.returncode}: {lines[-1]}")
    unit = 1.0 if sys.platform == "darwin" else 1024.0  # bytes per unit of ru_maxrss
    return Cost(wall, usage.ru_utime + usage.ru_stime, usage.ru_maxrss * unit / 1e9)


def split(shape: Shape) -> Shape:
    """Split every triangle into four, in an order that decimation keeps closed (trimesh's is not)."""
    corners = shape.faces
    keys, place = np.unique(edge_keys(corners, shape.V), return_inverse=True)
    middles = 0.5 * (shape.verts[keys // shape.V] + shape.verts[keys % shape.V])
    ab, bc, ca = shape.V + place.reshape(3, -1)
    a, b, c = corners.T
    parts = [(a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca)]
    faces = np.concatenate([np.stack(part, axis=1) for part in parts])
    return Shape(np.concatenate([shape.verts, middles]), faces, shape.name)


def resize(shape: Shape, V: int) -> Shape:
    """Split a closed shape until it has at least V vertices; below 200,000 vertices it is then decimated to about V."""
    while shape.V < V:
        shape = split(shape)
    return decimate(shape, 2 * V) if 1.1 * V < shape.V < 200_000 else shape


def noisy(shape: Shape) -> Shape:
    """Return the vertices as a cloud, with Gaussian noise of 1 % of the diagonal."""
    noise = np.random.default_rng(0).standard_normal(shape.verts.shape)
    return Shape(shape.verts + 0.01 * shape.diagonal * noise, np.empty((0, 3), np.int64), shape.name)


def upper_half(shape: Shape) -> Shape:
    """Return the faces above half the height; y is up."""
    heights = shape.verts[:, 1]
    faces = shape.faces[(heights[shape.faces] > 0.5 * (heights.min() + heights.max())).all(1)]
    used = np.unique(faces)
    return Shape(shape.verts[used], np.searchsorted(used, faces), shape.name)


def loose(shape: Shape) -> Shape:
    """Separate all triangles and shrink them a little, so that none touches another."""
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
    """Return target vertices (V_src,) nearest to the images of a map plus Gaussian noise of 1 % of sqrt(area) per axis."""
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
        shape = resize(load_shape(bundled_folder() / "samples" / f"{sample}.ply"), int(V))
        save_shape(path, CHANGES[change](shape))


def file_of(word: str, folder: Path) -> Path:
    """Return the file of a word of a case, made once.

    A new process makes it, as this process's memory would count in that of measured children.
    """
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
    """Measure the costs of `runs` runs after a warm-up run."""
    command = [sys.executable, "-m", "meshmatch"]
    for word in case.words:
        if word.startswith("@"):
            command.append(str(folder / word[1:]))
        else:
            command.append(str(file_of(word, folder)) if "@" in word or word.endswith(".glb") else word)
    return [cost_of(command) for _ in range(runs + 1)][1:]


def keep_to_cores(count: int) -> int:
    """Bind this process and its children to `count` cores; return the number of cores that they can use."""
    if not hasattr(os, "sched_setaffinity"):
        return os.cpu_count() or 1
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:count])
    return len(os.sched_getaffinity(0))


def record_of(name: str, case: Case, costs: list[Cost]) -> dict[str, Any]:
    """Return a case's row: medians, limits, whether they are met, and every run."""
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


BEFORE_COLUMNS = {"s before": "wall_before:.2f", "CPU s before": "cpu_before:.2f", "GB before": "gigabytes_before:.2f"}
RATIO_COLUMNS = {"s, ratio": "wall_ratio:.2f", "CPU, ratio": "cpu_ratio:.2f", "GB, ratio": "gigabytes_ratio:.2f"}


def read_earlier(path: Path) -> dict[str, dict[str, Any]]:
    """Read the rows of an earlier run by case name; `InputError` if the file does not contain one."""
    try:
        rows = json.loads(path.read_text(encoding="utf-8"))["values"]["cases"]
        return {row["case"]: {name: float(row[name]) for name in ("wall", "cpu", "gigabytes")} for row in rows}
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise InputError(f"{path} holds no run of this experiment", "give a file that --save wrote") from error


def add_comparison(row: dict[str, Any], before: dict[str, float]) -> dict[str, Any]:
    """Add the numbers of an earlier row to a row, and the ratios to them."""
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
    against: Annotated[Path | None, Option(help="saved results of an earlier run to compare with")] = None,
) -> runner.Report:
    before = {} if against is None else read_earlier(against)
    kept = keep_to_cores(cores)
    with tempfile.TemporaryDirectory() as folder:
        rows = [
            add_comparison(record_of(name, CASES[name], measure(CASES[name], runs, Path(folder))), before.get(name, {}))
            for name in runner.track(runner.split_names(cases, CASES, "case"), "running")
        ]
    title = f"Whole processes on {kept} cores, median of {runs} runs"
    columns = COLUMNS if against is None else {**COLUMNS, **BEFORE_COLUMNS, **RATIO_COLUMNS}
    return runner.Report({"kept_to_cores": kept, "cases": rows}, [runner.table(title, rows, columns)])
