"""The development benchmark: every shape is fitted once, and every pair is mapped and measured.

A pair that cannot be matched counts as the map of every vertex to vertex 0. --limit-pairs measures a subset of the pairs,
and the tables say so.

--output FOLDER keeps fits and maps: the same command resumes where it was stopped.
"""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from rich.table import Table
from typer import Option

from meshmatch.api.inputs import as_model
from meshmatch.arrays import Ints
from meshmatch.errors import MeshmatchError
from meshmatch.experiments import runner
from meshmatch.experiments.bench.methods import DirectMethod, Method, OurMethod
from meshmatch.experiments.bench.scores import SetScores, evaluate_set
from meshmatch.experiments.bench.sets import ALL_SETS, SET_NAMES, BenchSet, Pair, load_set
from meshmatch.fitting.fit_config import Refine
from meshmatch.maps.evaluate import LOST_CM, SKIN_M2
from meshmatch.maps.files import load_map, save_map
from meshmatch.maps.geodesics import GEODESIC
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.models.registry import NO_MODEL
from meshmatch.outputs import make_folder
from meshmatch.render.charts import draw_curves
from meshmatch.shapes.shape import Shape
from meshmatch.threads import set_threads


@lru_cache(maxsize=64)
def _seen(bench: BenchSet, name: str) -> Shape:
    """Load a shape as methods get it."""
    return bench.seen(name)


def _fit_one(bench: BenchSet, method: Method, name: str) -> tuple[str, Any, float]:
    """Fit one shape; return its name, the fit or the error, and seconds."""
    shape = _seen(bench, name)
    started = time.perf_counter()
    try:
        fit = method.fit(shape)
    except MeshmatchError as error:
        fit = error
    # a stored fit has the time that it took to make, not to read
    return name, fit, max(time.perf_counter() - started, getattr(fit, "seconds", 0.0))


def _map_one(
    bench: BenchSet, method: Method, kept: Path | None, task: tuple[Pair, tuple[Any, Any]]
) -> tuple[Pair, Ints | MeshmatchError, float]:
    """Map a pair from its two fits; the map is read from the folder ``kept``, or computed and written there."""
    pair, fits = task
    for fit in fits:
        if isinstance(fit, MeshmatchError):
            return pair, fit, 0.0
    source, target = (_seen(bench, name) for name in pair)
    file = None if kept is None else kept / bench.name / f"{pair[0]}-{pair[1]}.npy"
    if file is not None and file.is_file():
        return pair, load_map(file, source, target).index, 0.0
    started = time.perf_counter()
    try:
        index = method.map(source, fits[0], target, fits[1]).index
    except MeshmatchError as error:
        return pair, error, time.perf_counter() - started
    seconds = time.perf_counter() - started
    if file is not None:
        make_folder(file.parent)
        save_map(file, VertexMap(*pair, index))
    return pair, index, seconds


def _run_tasks(task: Any, items: Sequence[Any], threads: int, jobs: int) -> Iterator[Any]:
    """Map ``task`` over items, in ``jobs`` processes of ``threads`` threads each; yield results in order."""
    if jobs <= 1:
        set_threads(threads)
        yield from map(task, items)
        return
    context = multiprocessing.get_context("spawn")  # a fork would inherit torch's and scipy's thread pools
    with ProcessPoolExecutor(jobs, context, initializer=set_threads, initargs=(threads,)) as pool:
        yield from pool.map(task, items, chunksize=1)


@dataclass(frozen=True)
class SetRun:
    """Results of one set: errors, times, failures and fits."""

    scores: SetScores
    fit_seconds: dict[str, float]
    map_seconds: dict[Pair, float]
    failed: dict[Pair, str]
    fits: dict[str, Any]

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON record of the scores, overall and by group of pairs, the verdict on each fit, and the times."""
        record = self.scores.as_dict()
        record["groups"] = {part.group: part.as_dict() for part in self.scores.groups()}
        record["failed"] = [[*pair, reason] for pair, reason in self.failed.items()]
        if self.fit_seconds:
            record["fit_seconds_mean"] = round(float(np.mean(list(self.fit_seconds.values()))), 3)
            record["fit_seconds_max"] = round(max(self.fit_seconds.values()), 3)
        if self.map_seconds:
            record["map_seconds_mean"] = round(float(np.mean(list(self.map_seconds.values()))), 3)
        record["fits"] = {name: _judgement(fit) for name, fit in self.fits.items()}
        return record


def _judgement(fit: Any) -> Any:
    """Return verdict and residual of a fit, or "failed" and the error message."""
    if isinstance(fit, MeshmatchError):
        return ["failed", fit.message]
    residual = getattr(fit, "residual", None)
    return [getattr(fit, "verdict", None), None if residual is None else round(float(residual), 5)]


def run_set(
    bench: BenchSet,
    method: Method,
    pairs: Sequence[Pair],
    *,
    cache: Path | None = None,
    jobs: int = 1,
    threads: int = 1,
    kept: Path | None = None,
) -> SetRun:
    """Fit every shape of ``pairs`` once, map every pair, and measure all maps.

    ``kept`` is a folder of maps: existing ones are read, new ones are written.
    """
    names = sorted({name for pair in pairs for name in pair}, key=bench.shapes.index)
    fits: dict[str, Any] = {}
    fit_seconds: dict[str, float] = {}
    work = _run_tasks(partial(_fit_one, bench, method), names, threads, jobs)
    for name, fit, seconds in runner.track(work, f"{bench.name}: fitting", len(names)):
        fits[name], fit_seconds[name] = fit, seconds
    maps: dict[Pair, Ints] = {}
    map_seconds: dict[Pair, float] = {}
    failed: dict[Pair, str] = {}
    tasks = [(pair, (fits[pair[0]], fits[pair[1]])) for pair in pairs]
    work = _run_tasks(partial(_map_one, bench, method, kept), tasks, threads, jobs)
    for pair, index, seconds in runner.track(work, f"{bench.name}: mapping", len(pairs)):
        if isinstance(index, MeshmatchError):
            failed[pair] = index.message
            maps[pair] = np.zeros(bench.shape(pair[0]).V, dtype=np.int64)
        else:
            maps[pair] = index
            if seconds:
                map_seconds[pair] = seconds
    return SetRun(evaluate_set(bench, maps, pairs=pairs, cache=cache), fit_seconds, map_seconds, failed, fits)


def scores_table(sets: Sequence[SetScores]) -> Table:
    """Build a table with a row for each set and for each group of pairs in it."""
    rows = []
    for whole in sets:
        for scores in (whole, *whole.groups()):
            row = scores.as_dict()
            part = "" if row["complete"] else f" of {scores.expected}"
            name = f"  {scores.group}" if scores.group else scores.bench.name
            rows.append(row | {"set": name, "pairs": f"{row['pairs']}{part}", "worst": row["worst"][0][2]})
    columns = {"set": "set", "pairs": "pairs:>", "mean": "mean_cm:.2f", "median": "median_cm:.2f"}
    columns |= {"median pair": "median_pair_cm:.2f", f"over {LOST_CM:g} cm": "share_over_15cm:.2%"}
    columns |= {"flips": "flips:.1%", "worst pair": "worst:.2f"}
    return runner.table(f"Geodesic error, cm at {SKIN_M2} m2 of skin ({GEODESIC})", rows, columns)


INCOMPLETE = "Not all pairs were measured: these means are not the benchmark's."


@runner.command
def main(
    data: runner.Data = runner.DATA,
    sets: Annotated[str, Option(help=f"of {', '.join(ALL_SETS)}")] = ",".join(SET_NAMES),
    model: runner.Model = "human",
    refine: Refine = "nodes",
    quick: Annotated[bool, Option("--quick", help="fit with `FitConfig.quick`")] = False,
    seed: runner.Seed = 0,
    limit_pairs: runner.LimitPairs = None,
    jobs: runner.Jobs = 1,
    threads: runner.Threads = 1,
    cache: runner.Cache = None,
    output: Annotated[Path | None, Option(help="keep fits and maps in this folder, and reuse those there")] = None,
    curve: Annotated[Path | None, Option(help="draw the cumulative error curves into this file")] = None,
) -> runner.Report:
    benches = [load_set(name, data) for name in runner.split_names(sets, ALL_SETS, "set")]
    weights = model if model == NO_MODEL else as_model(model).card.weights_sha256  # fails early for an unknown model
    if output is not None:
        asked = {"weights": weights, "refine": refine, "seed": seed, "threads": threads}
        asked |= {"quick": True} if quick else {}
        runner.cached(output / "asked.json", asked, lambda: runner.run_metadata(threads, jobs))
    fits, made = (None, None) if output is None else (output / "fits", output / "maps")
    method: Method = OurMethod(model, refine, seed, threads=threads, kept=fits, quick=quick)
    if model == NO_MODEL:
        method = DirectMethod(seed, threads)
    runs: list[SetRun] = []
    for bench in benches:
        pairs = runner.evenly_spread(bench.pairs, limit_pairs)
        runs.append(run_set(bench, method, pairs, cache=cache, jobs=jobs, threads=threads, kept=made))
    scores = [each.scores for each in runs]
    if curve is not None:
        draw_curves({each.bench.name: each.joined for each in scores}, curve)
    notes = []
    for each in scores:
        worst = ", ".join(f"{a} -> {b} {mean:.1f}" for (a, b), mean in list(each.means_cm.items())[:5])
        notes.append(f"{each.bench.name}, worst pairs (mean, cm): {worst}")
    if any(len(each.errors) < each.expected for each in scores):
        notes.append(INCOMPLETE)
    record = {"geodesic": GEODESIC, "sets": {each.scores.bench.name: each.as_dict() for each in runs}}
    return runner.Report(record, [scores_table(scores)], notes)
