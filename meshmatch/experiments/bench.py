"""The development benchmark, whole: ``python -m meshmatch.experiments.bench --data ../shared/bench``.

Fits every shape once, builds the map of every pair from two fits, measures every pair and prints a table and,
last, one JSON line. ``--limit-pairs`` measures a stated part and says so. A pair that cannot be matched is
not left out: it counts as the map that sends every vertex to vertex 0.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from meshmatch.errors import MeshmatchError
from meshmatch.experiments.distances import default_folder
from meshmatch.experiments.protocols import CLOUD_SET, SET_NAMES, BenchSet, Pair, load_set
from meshmatch.experiments.report import circumstances, print_table, status_of
from meshmatch.experiments.scores import SetScores, evaluate_set
from meshmatch.fitting.choices import Refine
from meshmatch.maps.files import load_map, save_map
from meshmatch.maps.geodesics import GEODESIC
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.outputs import make_folder
from meshmatch.render.charts import draw_curves
from meshmatch.shapes.shape import Shape
from meshmatch.threads import set_threads


class Matcher(Protocol):
    """What is measured: something that fits one shape, and makes a map of two fits. It must survive a
    pickle.
    """

    def fit(self, shape: Shape) -> Any:
        """Whatever is worth knowing about one shape."""

    def map(self, source: Shape, source_fit: Any, target: Shape, target_fit: Any) -> VertexMap:
        """The map between two shapes that were fitted."""


@dataclass(frozen=True)
class PipelineMatcher:
    """This project's own pipeline with its options."""

    model: str = "human"
    refine: Refine = "nodes"
    seed: int = 0

    def fit(self, shape: Shape) -> Any:
        """Move the model's template onto the shape."""
        from meshmatch.pipeline import fit_shape

        return fit_shape(shape, model=self.model, refine=self.refine, seed=self.seed)

    def map(self, source: Shape, source_fit: Any, target: Shape, target_fit: Any) -> VertexMap:
        """Build the map from two fits."""
        from meshmatch.pipeline import map_between

        agreeing = self.model if self.refine == "nodes" else None
        return map_between(source, source_fit, target, target_fit, model=agreeing)


@dataclass(frozen=True)
class _Work:
    """What a worker needs: it is sent once, not with every task."""

    bench: BenchSet
    matcher: Matcher
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
        fit = _work.matcher.fit(shape)
    except MeshmatchError as error:
        fit = error
    return name, fit, time.perf_counter() - started


def _map_one(pair: Pair) -> tuple[Pair, NDArray[np.int64] | MeshmatchError, float]:
    assert _work is not None
    fits = [_work.fits[name] for name in pair]
    for fit in fits:
        if isinstance(fit, MeshmatchError):
            return pair, fit, 0.0
    source, target = (_seen(_work.bench, name) for name in pair)
    started = time.perf_counter()
    try:
        index = _work.matcher.map(source, fits[0], target, fits[1]).index
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


def chosen_pairs(bench: BenchSet, limit: int | None) -> list[Pair]:
    """All pairs, or `limit` of them spread evenly over the list, always the same ones."""
    if limit is None or limit >= len(bench.pairs):
        return list(bench.pairs)
    return [bench.pairs[k] for k in np.linspace(0, len(bench.pairs) - 1, max(1, limit)).round().astype(int)]


def run_set(
    bench: BenchSet,
    matcher: Matcher,
    *,
    pairs: Sequence[Pair],
    cache: Path,
    jobs: int = 1,
    threads: int = 1,
    save: Path | None = None,
    console: Console | None = None,
) -> SetRun:
    """Fit every shape of `pairs` once, map every pair, measure all of them."""
    console = console or Console(stderr=True, quiet=True)
    names = sorted({name for pair in pairs for name in pair}, key=bench.shapes.index)
    fits: dict[str, Any] = {}
    fit_seconds: dict[str, float] = {}
    with console.status(f"{bench.name}: fitting") as status:
        for name, fit, seconds in _each(_fit_one, names, _Work(bench, matcher, threads, {}), jobs):
            fits[name], fit_seconds[name] = fit, seconds
            status.update(f"{bench.name}: fitted {len(fits)} of {len(names)} shapes")
        maps: dict[Pair, NDArray[np.int64]] = {}
        map_seconds: dict[Pair, float] = {}
        failed: dict[Pair, str] = {}
        for pair, index, seconds in _each(_map_one, pairs, _Work(bench, matcher, threads, fits), jobs):
            if isinstance(index, MeshmatchError):
                failed[pair] = index.message
                maps[pair] = np.zeros(bench.shape(pair[0]).V, dtype=np.int64)
            else:
                maps[pair], map_seconds[pair] = index, seconds
            status.update(f"{bench.name}: mapped {len(maps)} of {len(pairs)} pairs")
        if save is not None:
            save_maps(save, bench, maps)
        status.update(f"{bench.name}: measuring {len(pairs)} pairs (the first time this takes minutes)")
        scores = evaluate_set(bench, maps, cache=cache, pairs=pairs)
    return SetRun(scores, fit_seconds, map_seconds, failed, fits)


def _map_path(folder: Path, bench: BenchSet, pair: Pair) -> Path:
    return folder / bench.name / f"{pair[0]}-{pair[1]}.npy"


def save_maps(folder: Path, bench: BenchSet, maps: dict[Pair, NDArray[np.int64]]) -> None:
    """Keep maps as ``folder/set/source-target.npy``, where `load_maps` finds them."""
    make_folder(folder / bench.name)
    for pair, index in maps.items():
        save_map(_map_path(folder, bench, pair), VertexMap(*pair, index))


def load_maps(folder: Path, bench: BenchSet, pairs: Iterable[Pair]) -> dict[Pair, NDArray[np.int64]]:
    """Maps that were made elsewhere, checked against their shapes."""
    shapes = {name: bench.shape(name) for name in sorted({name for pair in pairs for name in pair})}
    return {
        pair: load_map(_map_path(folder, bench, pair), shapes[pair[0]], shapes[pair[1]]).index
        for pair in pairs
    }


def _arguments(words: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser("python -m meshmatch.experiments.bench", description=__doc__)
    parser.add_argument("--data", type=Path, default=Path("../shared/bench"), help="the benchmark's data")
    parser.add_argument("--sets", default=",".join(SET_NAMES), help=f"some of %(default)s, {CLOUD_SET}")
    parser.add_argument("--model", default="human")
    parser.add_argument("--refine", default="nodes", choices=("none", "latent", "nodes"))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--limit-pairs", type=int, metavar="N", help="N pairs of each set, evenly spread")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--threads", type=int, default=1, help="threads in each process")
    parser.add_argument("--cache", type=Path, help="folder of kept geodesic distances (10 GB for all sets)")
    parser.add_argument("--maps", type=Path, metavar="DIR", help="measure DIR/set/source-target.npy instead")
    parser.add_argument("--save-maps", type=Path, metavar="DIR", help="keep the maps there")
    parser.add_argument("--curve", type=Path, metavar="FILE", help="draw the cumulative curves")
    return parser.parse_args(words)


def main(words: Sequence[str] | None = None) -> int:
    """Run the benchmark; 0 when it ran, 1 when the data or the choice stopped it."""
    options = _arguments(words)
    console = Console(stderr=True)
    return status_of(lambda: run(options, console))


def run(options: argparse.Namespace, console: Console) -> dict[str, Any]:
    """Everything that `main` does, errors as exceptions; the record that the JSON line holds is returned
    too.
    """
    set_threads(options.threads)
    started = time.perf_counter()
    cache = options.cache or default_folder()
    benches = [load_set(name, options.data) for name in options.sets.split(",")]
    matcher = PipelineMatcher(options.model, options.refine, options.seed)
    runs: list[SetRun] = []
    for bench in benches:
        pairs = chosen_pairs(bench, options.limit_pairs)
        if options.maps is not None:
            maps = load_maps(options.maps, bench, pairs)
            runs.append(SetRun(evaluate_set(bench, maps, cache=cache, pairs=pairs), {}, {}, {}, {}))
        else:
            runs.append(
                run_set(
                    bench,
                    matcher,
                    pairs=pairs,
                    cache=cache,
                    jobs=options.jobs,
                    threads=options.threads,
                    save=options.save_maps,
                    console=console,
                )
            )
    if options.curve is not None:
        draw_curves({each.scores.bench.name: each.scores.joined for each in runs}, options.curve)
    print_table([each.scores for each in runs])
    record = {
        "benchmark": "development half",
        **circumstances(options.threads, options.jobs),
        "geodesic": GEODESIC,
        "maps": str(options.maps) if options.maps else vars(matcher),
        "seconds": round(time.perf_counter() - started, 1),
        "sets": {each.scores.bench.name: each.as_dict() for each in runs},
    }
    print(json.dumps(record), flush=True)
    return record


if __name__ == "__main__":
    sys.exit(main())
