"""The development benchmark, whole: every shape fitted once, every pair mapped and measured.

A pair that cannot be matched is not left out: it counts as the map that sends every vertex to vertex 0. --limit-pairs
measures a stated part and says so.

--oriented-by MODEL asks what --model is worth where the orientation is no question: every shape is first turned into the
frame of that model's unrefined fit, and up and front are told. Maps are between the same vertices, and measured as ever.
"""

from __future__ import annotations

import multiprocessing
import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Protocol

import numpy as np
from rich.table import Table
from typer import Option

from meshmatch.api.matching import Matcher
from meshmatch.arrays import Int, Ints
from meshmatch.errors import MeshmatchError, OptionError
from meshmatch.experiments import runner
from meshmatch.experiments.orientation import upright
from meshmatch.experiments.scores import SetScores, evaluate_set
from meshmatch.experiments.sets import ALL_SETS, SET_NAMES, BenchSet, Pair, load_set
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import ON_NODES, FitConfig, Partial, Refine
from meshmatch.maps.evaluate import LOST_CM, SKIN_M2
from meshmatch.maps.files import load_map, save_map
from meshmatch.maps.geodesics import GEODESIC
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.models.registry import find_model
from meshmatch.outputs import make_folder
from meshmatch.render.charts import draw_curves
from meshmatch.shapes.shape import Shape
from meshmatch.threads import set_threads

Maps = Mapping[Pair, Int[Ints, " V_src"]]


class Method(Protocol):
    """What is measured: something that fits one shape, and makes a map of two fits. It must survive a pickle."""

    def fit(self, shape: Shape) -> Any:
        """Whatever is worth knowing about one shape."""

    def map(self, source: Shape, source_fit: Any, target: Shape, target_fit: Any) -> VertexMap:
        """The map between two shapes that were fitted."""


@dataclass(frozen=True)
class OurMethod:
    """This project with its options.

    ``oriented_by``: a model whose unrefined fit finds the orientation; then a fit searches only what is left of it.
    """

    model: str = "human"
    refine: Refine = "nodes"
    seed: int = 0
    partial: Partial = "auto"
    threads: int = 1
    oriented_by: str = ""  # a model; empty: the fitted model searches by itself

    def _matcher(self) -> Matcher:
        config = FitConfig(refine=self.refine, seed=self.seed, partial=self.partial)
        return Matcher(self.model, config, self.threads)

    def fit(self, shape: Shape) -> Fit:
        """Fit the model's template to the shape."""
        matcher = self._matcher()
        if not self.oriented_by:
            return matcher.fit(shape)
        told = replace(matcher.config, up="y", front="z")
        return matcher.fit(upright(self.oriented_by, shape, self.seed), told)

    def map(self, source: Shape, source_fit: Fit, target: Shape, target_fit: Fit) -> VertexMap:
        """Build the map from two fits."""
        return self._matcher().map(source_fit, target_fit, agree=self.refine in ON_NODES)


@dataclass(frozen=True)
class _Work:
    """What a worker needs: it is sent once, not with every task."""

    bench: BenchSet
    method: Method
    threads: int
    fits: dict[str, Any]


_work: _Work | None = None


def _begin(work: _Work) -> None:
    global _work
    set_threads(work.threads)
    _work = work


@lru_cache(maxsize=64)
def _seen(bench: BenchSet, name: str) -> Shape:
    return bench.seen(name)


def _fit_one(name: str) -> tuple[str, Any, float]:
    assert _work is not None
    shape = _seen(_work.bench, name)
    started = time.perf_counter()
    try:
        fit = _work.method.fit(shape)
    except MeshmatchError as error:
        fit = error
    return name, fit, time.perf_counter() - started


def _map_one(pair: Pair) -> tuple[Pair, Ints | MeshmatchError, float]:
    assert _work is not None
    fits = [_work.fits[name] for name in pair]
    for fit in fits:
        if isinstance(fit, MeshmatchError):
            return pair, fit, 0.0
    source, target = (_seen(_work.bench, name) for name in pair)
    started = time.perf_counter()
    try:
        index = _work.method.map(source, fits[0], target, fits[1]).index
    except MeshmatchError as error:
        return pair, error, time.perf_counter() - started
    return pair, index, time.perf_counter() - started


def _each(task: Any, items: Sequence[Any], work: _Work, jobs: int) -> Iterator[Any]:
    if jobs <= 1:
        _begin(work)
        yield from map(task, items)
        return
    context = multiprocessing.get_context("spawn")  # a fork would inherit torch's and scipy's thread pools
    with ProcessPoolExecutor(jobs, context, initializer=_begin, initargs=(work,)) as pool:
        yield from pool.map(task, items, chunksize=1)


@dataclass(frozen=True)
class SetRun:
    """One set, matched and measured."""

    scores: SetScores
    fit_seconds: dict[str, float]
    map_seconds: dict[Pair, float]
    failed: dict[Pair, str]
    fits: dict[str, Any]

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers, those of each kind of pair, each fit's own judgement, and the times."""
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
    save: Path | None = None,
) -> SetRun:
    """Fit every shape of ``pairs`` once, map every pair, measure all of them."""
    names = sorted({name for pair in pairs for name in pair}, key=bench.shapes.index)
    fits: dict[str, Any] = {}
    fit_seconds: dict[str, float] = {}
    work = _each(_fit_one, names, _Work(bench, method, threads, {}), jobs)
    for name, fit, seconds in runner.track(work, f"{bench.name}: fitting", len(names)):
        fits[name], fit_seconds[name] = fit, seconds
    maps: dict[Pair, Ints] = {}
    map_seconds: dict[Pair, float] = {}
    failed: dict[Pair, str] = {}
    work = _each(_map_one, pairs, _Work(bench, method, threads, fits), jobs)
    for pair, index, seconds in runner.track(work, f"{bench.name}: mapping", len(pairs)):
        if isinstance(index, MeshmatchError):
            failed[pair] = index.message
            maps[pair] = np.zeros(bench.shape(pair[0]).V, dtype=np.int64)
        else:
            maps[pair], map_seconds[pair] = index, seconds
    if save is not None:
        save_maps(save, bench, maps)
    return SetRun(evaluate_set(bench, maps, pairs=pairs, cache=cache), fit_seconds, map_seconds, failed, fits)


def _map_path(folder: Path, bench: BenchSet, pair: Pair) -> Path:
    return folder / bench.name / f"{pair[0]}-{pair[1]}.npy"


def save_maps(folder: Path, bench: BenchSet, maps: Maps) -> None:
    """Keep maps as ``folder/set/source-target.npy``, where `load_maps` finds them."""
    make_folder(folder / bench.name)
    for pair, index in maps.items():
        save_map(_map_path(folder, bench, pair), VertexMap(*pair, index))


def load_maps(folder: Path, bench: BenchSet, pairs: Iterable[Pair]) -> dict[Pair, Ints]:
    """Maps that were made elsewhere, checked against their shapes."""
    shapes = {name: bench.shape(name) for name in sorted({name for pair in pairs for name in pair})}
    return {pair: load_map(_map_path(folder, bench, pair), shapes[pair[0]], shapes[pair[1]]).index for pair in pairs}


def scores_table(sets: Sequence[SetScores], oriented_by: str = "") -> Table:
    """A row for each set, and one for each kind of pair in it; the title names the model that found the orientation."""
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
    title = f"Geodesic error, cm at {SKIN_M2} m2 of skin ({GEODESIC})"
    return runner.table(f"{title}, oriented by {oriented_by}" if oriented_by else title, rows, columns)


INCOMPLETE = "Not all pairs were measured: these means are not the benchmark's."


@runner.command
def main(
    data: runner.Data = runner.DATA,
    sets: Annotated[str, Option(help=f"of {', '.join(ALL_SETS)}")] = ",".join(SET_NAMES),
    model: runner.Model = "human",
    oriented_by: Annotated[str, Option(help="model whose fits turn every shape upright first; none by default")] = "",
    refine: Refine = "nodes",
    seed: runner.Seed = 0,
    limit_pairs: runner.LimitPairs = None,
    jobs: runner.Jobs = 1,
    threads: runner.Threads = 1,
    cache: runner.Cache = None,
    maps: Annotated[Path | None, Option(help="measure DIR/set/source-target.npy instead")] = None,
    save_maps: Annotated[Path | None, Option(help="keep the maps in this folder")] = None,
    curve: Annotated[Path | None, Option(help="draw the cumulative curves into this file")] = None,
) -> runner.Report:
    benches = [load_set(name, data) for name in runner.names_of(sets, ALL_SETS, "set")]
    if oriented_by and maps is not None:
        raise OptionError("maps that are given cannot be oriented anew", "leave out --oriented-by or --maps")
    if oriented_by:
        find_model(oriented_by)  # else a wrong name would cost every pair
    method = OurMethod(model, refine, seed, threads=threads, oriented_by=oriented_by)
    runs: list[SetRun] = []
    for bench in benches:
        pairs = runner.spread(bench.pairs, limit_pairs)
        if maps is not None:
            given = evaluate_set(bench, load_maps(maps, bench, pairs), pairs=pairs, cache=cache)
            runs.append(SetRun(given, {}, {}, {}, {}))
        else:
            runs.append(run_set(bench, method, pairs, cache=cache, jobs=jobs, threads=threads, save=save_maps))
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
    return runner.Report(record, [scores_table(scores, oriented_by)], notes)


if __name__ == "__main__":
    sys.exit(main())
