"""Other methods on the same pairs with the same metric.

Each method fits and maps the pairs of `experiments.bench`, and is measured as there: no pair is left out, one that fails
counts as the map of everything to vertex 0 and is listed as failed. A method whose package is not installed, or whose
model is not given, is skipped, and the output says so.

- rigid: scaled by area, all orientations tried, nearest vertex.
- zoomout: pyfmaps, HKS and WKS, ZoomOut from 30 to 120 eigenfunctions; meshes thinned to 10,000 triangles.
- nricp: trimesh's non-rigid ICP, source onto target from the rigid alignment; the source thinned to 5,000 triangles.
- meshmonk: viscoelastic registration, source onto target from the rigid alignment; both thinned to 20,000 triangles.
- coded: 3D-CODED (--coded), its code searched by the Chamfer distance.
- transmatch: a transformer (--transmatch), not refined.
- ours: this project, refined and not.

The first four have a second row each, with both shapes in the frames of our unrefined fits: what they do where the
orientation is no question.

The learned ones are trained by `experiments.learned_baselines`; zoomout, nricp and meshmonk need
pip install 'meshmatch[bench]'. Each result, a method on a set, is one JSON file in the output folder; a second run
measures only what is not there. --minutes starts nothing new after that time. The table says how many pairs were
measured, and how long learned methods were trained.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from typer import Option

from meshmatch.experiments import runner
from meshmatch.experiments.bench.accuracy import INCOMPLETE, run_set
from meshmatch.experiments.bench.baseline_methods import METHODS, Baseline, Choices
from meshmatch.experiments.bench.charts import Bar, draw_bars
from meshmatch.experiments.bench.sets import ALL_SETS, SET_NAMES, BenchSet, load_set
from meshmatch.maps.evaluate import LOST_CM, SKIN_M2
from meshmatch.maps.geodesics import GEODESIC
from meshmatch.outputs import make_folder

COLUMNS = {
    **{"set": "set", "method": "label", "pairs": "measured:>", "failed": "failures", "mean": "mean_cm:.2f"},
    **{"median": "median_cm:.2f", f"over {LOST_CM:g}": "share_over_15cm:.1%", "flips": "flips:.0%"},
    **{"fit s": "fit_seconds_mean:.2f", "pair s": "map_seconds_mean:.2f", "trained, min": "minutes:g"},
}


def measured(
    row: Baseline, bench: BenchSet, folder: Path, limit: int | None, late: bool, **how: Any
) -> dict[str, Any] | None:
    """One result: read from the folder, or measured and written there; None if it is not there and it is too late.

    ``how`` is that of `run_set`.

    Raises
    ------
    OptionError
        The folder holds this result of other choices.
    InputError
        The file in the folder is damaged.
    """
    assert row.method is not None
    pairs = runner.spread(bench.pairs, limit)
    path = folder / f"{bench.name}-{row.name}.json"
    settings = {key: str(value) for key, value in vars(row.method).items()}
    asked = {"method": row.name, "set": bench.name, "pairs": pairs, "settings": settings, "model": row.model}
    before = runner.recall(path, asked)
    if before is not None or late:
        return before
    began = time.perf_counter()
    scores = run_set(bench, row.method, pairs, **how).as_dict()
    scores.pop("fits")
    found = {
        **runner.circumstances(how.get("threads", 1), how.get("jobs", 1)),
        **{"of": len(bench.pairs), "minutes": row.minutes},
        **{"seconds": round(time.perf_counter() - began, 1), "scores": scores},
    }
    return runner.keep(path, asked, found)


def draw_results(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Mean errors as bars, with medians as ticks, a group for each set; where pairs failed a bar may run off the axis.

    Beside each method stands how long it was trained, on one core, or that it learned nothing of the category.
    """
    groups: dict[str, list[Bar]] = {}
    for row in rows:
        words = f"{row['mean_cm']:.1f} cm"
        words += f", {row['failures']} failed" if row["failures"] else ""
        trained = row.get("minutes")
        known = "knows no category" if trained is None else f"trained {trained:.0f} min"
        bar = Bar(f"{row['label']}; {known}", row["mean_cm"], words, row["name"].startswith("ours"), row["median_cm"])
        groups.setdefault(f"{row['set']}: {row['measured']} pairs", []).append(bar)
    whole = [row for row in rows if not row["failures"]]
    longest = max((max(row["mean_cm"], row["median_cm"]) for row in whole), default=0.0)
    axis = "mean geodesic error, cm; tick: median"
    draw_bars(groups, path, axis, 1.1 * longest or None)


@runner.command
def main(
    data: runner.Data = runner.DATA,
    sets: Annotated[str, Option(help=f"of {', '.join(ALL_SETS)}")] = ",".join(SET_NAMES),
    methods: Annotated[str, Option(help=f"of {', '.join(METHODS)}")] = ",".join(METHODS),
    limit_pairs: runner.LimitPairs = None,
    minutes: Annotated[float, Option(help="start nothing new after so long")] = 1e6,
    output: Annotated[Path, Option(help="folder of the results")] = Path("out/baselines"),
    picture: Annotated[Path | None, Option(help="the chart, by default baselines.png there")] = None,
    model: runner.Model = "human",
    coded: Annotated[str | None, Option(help="a model folder of experiments.learned_baselines")] = None,
    coded_steps: Annotated[int, Option(min=1, help="of its search over codes")] = 2000,
    transmatch: Annotated[Path | None, Option(help="a folder of experiments.learned_baselines")] = None,
    seed: runner.Seed = 0,
    jobs: runner.Jobs = 1,
    threads: runner.Threads = 1,
    cache: runner.Cache = None,
) -> runner.Report:
    until = time.monotonic() + 60 * minutes
    benches = [load_set(name, data) for name in runner.names_of(sets, ALL_SETS, "set")]
    choices = Choices(model, coded, coded_steps, transmatch, seed, threads)
    known = [row for name in runner.names_of(methods, METHODS, "method") for row in METHODS[name](choices)]
    make_folder(output)
    rows, skipped = [], {}
    for bench in benches:
        for row in known:
            found = None
            if row.method is not None:
                runner.tell(f"{row.label} on {bench.name}")
                how = {"cache": cache, "jobs": jobs, "threads": threads}
                found = measured(row, bench, output, limit_pairs, time.monotonic() > until, **how)
            if found is None:
                skipped[f"{bench.name}, {row.label}"] = row.missing or "the time was up: run again to go on"
                continue
            names = {"set": bench.name, "name": row.name, "label": row.label}
            scores = found["scores"]
            share = {"measured": f"{scores['pairs']} of {found['of']}", "failures": len(scores["failed"])}
            rows.append({**names, **share, **{key: found[key] for key in found if key != "scores"}, **scores})
    notes = [f"skipped: {where}: {why}" for where, why in skipped.items()]
    if rows:
        chart = picture or output / "baselines.png"
        draw_results(rows, chart)
        notes.append(f"wrote {chart}")
    if not all(row["complete"] for row in rows):
        notes.append(INCOMPLETE)
    drawn = runner.table(f"Geodesic error, cm at {SKIN_M2} m2 of skin ({GEODESIC})", rows, COLUMNS)
    return runner.Report({"geodesic": GEODESIC, "skipped": skipped, "rows": rows}, [drawn], notes)


if __name__ == "__main__":
    sys.exit(main())
