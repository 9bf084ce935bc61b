"""Other methods on the same pairs, measured by the same metric.

Each method fits and maps the pairs of `experiments.bench` and is measured as there: a pair that fails counts as the map of
everything to vertex 0 and is listed as failed. A method whose package is not installed, or whose model is not given, is
skipped, and the output says so.

- rigid: scaled by area, all orientations tried, nearest vertex.
- zoomout: pyfmaps, HKS and WKS, ZoomOut from 30 to 120 eigenfunctions; meshes thinned to 10,000 triangles.
- nricp: trimesh's non-rigid ICP, source onto target from the rigid alignment; the source thinned to 5,000 triangles.
- meshmonk: viscoelastic registration, source onto target from the rigid alignment; both thinned to 20,000 triangles.
- coded: 3D-CODED (--coded), its code optimised by the Chamfer distance; ``meshmatch train --preset paper --field pointwise
  --volume 0 --arap 0 --blend 0`` trains one.
- ours: this project, with refinement and without.

zoomout, nricp and meshmonk need pip install 'meshmatch[bench]'. The result of a method on a set is one JSON file in the
output folder; a second run measures only missing results. The table gives the number of measured pairs and the training
time of learned methods.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

from typer import Option

from meshmatch.experiments import runner
from meshmatch.experiments.bench.accuracy import INCOMPLETE, run_set
from meshmatch.experiments.bench.methods import Method, OurMethod, Registration, ZoomOut, coded
from meshmatch.experiments.bench.sets import ALL_SETS, SET_NAMES, BenchSet, load_set
from meshmatch.maps.evaluate import LOST_CM, SKIN_M2
from meshmatch.maps.geodesics import GEODESIC
from meshmatch.models.registry import find_model
from meshmatch.outputs import make_folder

COLUMNS = {
    **{"set": "set", "method": "label", "pairs": "measured:>", "failed": "failures", "mean": "mean_cm:.2f"},
    **{"median": "median_cm:.2f", f"over {LOST_CM:g}": "share_over_15cm:.1%", "flips": "flips:.0%"},
    **{"fit s": "fit_seconds_mean:.2f", "pair s": "map_seconds_mean:.2f", "trained, min": "minutes:g"},
}


@dataclass(frozen=True)
class Baseline:
    """One row of the comparison."""

    name: str  # used in file names
    label: str  # shown in tables
    method: Method | None  # None if it cannot run
    missing: str = ""  # why it cannot run
    minutes: float | None = None  # training time; None for a method without training
    model: str = ""  # hash of the model's weights


@dataclass(frozen=True)
class Choices:
    """Command-line choices that methods depend on."""

    model: str = "human"
    coded: str | None = None
    coded_steps: int = 2000
    seed: int = 0
    threads: int = 1


def _untrained(choices: Choices, name: str, label: str, method: Registration | ZoomOut, package: str) -> list[Baseline]:
    """Return the row of a method without training; it cannot run if its ``package`` is missing."""
    if package and find_spec(package) is None:
        return [Baseline(name, label, None, f"{package} is not installed: pip install 'meshmatch[bench]'")]
    return [Baseline(name, label, replace(method, seed=choices.seed))]


def _coded(choices: Choices) -> list[Baseline]:
    """Return the row of 3D-CODED; it cannot run without a model."""
    if choices.coded is None:
        return [Baseline("coded", "3D-CODED", None, "give --coded MODEL, trained as the help says")]
    card = find_model(choices.coded)[1]
    method = coded(choices.coded, choices.coded_steps, choices.seed)
    return [Baseline("coded", "3D-CODED", method, "", card.training_minutes, card.weights_sha256)]


def _ours(choices: Choices) -> list[Baseline]:
    """Return the rows of this project, without and with refinement."""
    card = find_model(choices.model)[1]
    nodes = OurMethod(choices.model, "nodes", choices.seed, threads=choices.threads)
    none = replace(nodes, refine="none")
    rows = ("ours-none", "ours, unrefined", none), ("ours", "ours, refined", nodes)
    return [Baseline(*row, "", card.training_minutes, card.weights_sha256) for row in rows]


_UNTRAINED: dict[str, tuple[str, Registration | ZoomOut, str]] = {
    "rigid": ("rigid, nearest", Registration("rigid"), ""),
    "zoomout": ("ZoomOut (pyfmaps)", ZoomOut(), "pyFM"),
    "nricp": ("nricp (trimesh)", Registration("nricp", 5000), "trimesh"),
    "meshmonk": ("meshmonk", Registration("meshmonk", 20_000), "meshmonk"),
}
METHODS: dict[str, Callable[[Choices], list[Baseline]]] = {
    **{
        name: partial(_untrained, name=name, label=label, method=method, package=package)
        for name, (label, method, package) in _UNTRAINED.items()
    },
    "coded": _coded,
    "ours": _ours,
}
"""By method name, a function that returns its rows; `ModelError` or `TemplateError` if its model cannot be read."""


def measure_baseline(row: Baseline, bench: BenchSet, folder: Path, limit: int | None, **how: Any) -> dict[str, Any]:
    """Return one result, read from the folder or measured and written there. ``how`` is passed on to `run_set`.

    Raises
    ------
    OptionError
        The folder contains this result for other choices.
    InputError
        The file in the folder is damaged.
    """
    pairs = runner.evenly_spread(bench.pairs, limit)
    path = folder / f"{bench.name}-{row.name}.json"
    settings = {key: str(value) for key, value in vars(row.method).items()}
    asked = {"method": row.name, "set": bench.name, "pairs": pairs, "settings": settings, "model": row.model}

    def measure() -> dict[str, Any]:
        assert row.method is not None
        began = time.perf_counter()
        scores = run_set(bench, row.method, pairs, **how).as_dict()
        scores.pop("fits")
        return {
            **runner.run_metadata(how.get("threads", 1), how.get("jobs", 1)),
            **{"of": len(bench.pairs), "minutes": row.minutes},
            **{"seconds": round(time.perf_counter() - began, 1), "scores": scores},
        }

    return runner.cached(path, asked, measure)


@runner.command
def main(
    data: runner.Data = runner.DATA,
    sets: Annotated[str, Option(help=f"of {', '.join(ALL_SETS)}")] = ",".join(SET_NAMES),
    methods: Annotated[str, Option(help=f"of {', '.join(METHODS)}")] = ",".join(METHODS),
    limit_pairs: runner.LimitPairs = None,
    output: Annotated[Path, Option(help="folder of the results")] = Path("out/baselines"),
    model: runner.Model = "human",
    coded_model: Annotated[str | None, Option("--coded", help="a trained model of 3D-CODED")] = None,
    coded_steps: Annotated[int, Option(min=1, help="steps of its optimization of codes")] = 2000,
    seed: runner.Seed = 0,
    jobs: runner.Jobs = 1,
    threads: runner.Threads = 1,
    cache: runner.Cache = None,
) -> runner.Report:
    benches = [load_set(name, data) for name in runner.split_names(sets, ALL_SETS, "set")]
    choices = Choices(model, coded_model, coded_steps, seed, threads)
    known = [row for name in runner.split_names(methods, METHODS, "method") for row in METHODS[name](choices)]
    make_folder(output)
    rows, skipped = [], {}
    for bench in benches:
        for row in known:
            if row.method is None:
                skipped[row.label] = row.missing
                continue
            runner.log(f"{row.label} on {bench.name}")
            found = measure_baseline(row, bench, output, limit_pairs, cache=cache, jobs=jobs, threads=threads)
            names = {"set": bench.name, "name": row.name, "label": row.label}
            scores = found["scores"]
            share = {"measured": f"{scores['pairs']} of {found['of']}", "failures": len(scores["failed"])}
            rows.append({**names, **share, **{key: found[key] for key in found if key != "scores"}, **scores})
    notes = [f"skipped: {label}: {why}" for label, why in skipped.items()]
    if not all(row["complete"] for row in rows):
        notes.append(INCOMPLETE)
    drawn = runner.table(f"Geodesic error, cm at {SKIN_M2} m2 of skin ({GEODESIC})", rows, COLUMNS)
    return runner.Report({"geodesic": GEODESIC, "skipped": skipped, "rows": rows}, [drawn], notes)
