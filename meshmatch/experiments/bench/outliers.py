"""Point clouds with outliers.

``faust_outliers.npy`` is (30, 1000, 3): bodies in meters, 1,000 points each, row i the same point of each; many rows are
not on the surface. Every ordered pair is matched and every row counts, outliers too. There is no mesh, so the error is
the straight distance between the predicted and the true point of the target, in centimeters.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import cache, partial
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np

from meshmatch.api.inputs import as_model
from meshmatch.errors import InputError
from meshmatch.experiments import runner
from meshmatch.experiments.bench.methods import Method, OurMethod
from meshmatch.experiments.bench.scores import summary
from meshmatch.maps.evaluate import CM_PER_UNIT, LOST_CM, Errors
from meshmatch.shapes.shape import Shape

FILE = "faust_outliers.npy"
COLUMNS = {
    **{"pairs": "pairs", "mean": "mean_cm:.2f", "median": "median_cm:.2f"},
    **{f"over {LOST_CM:g} cm": "share_over_15cm:.1%", "flips": "flips:.1%"},
    **{"confidence > 0.5": "confident_share:.0%", "mean of these": "confident_mean_cm:.2f"},
    "verdicts": "words",
}


def load_clouds(data: Path) -> list[Shape]:
    """The clouds of the file, in meters.

    Raises
    ------
    InputError
        The file is missing or holds something else.
    """
    path = Path(data) / FILE
    try:
        points = np.load(path, allow_pickle=False)
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read {path}", "--data names the folder that holds it") from error
    if points.ndim != 3 or points.shape[2] != 3:
        raise InputError(f"{path} holds {points.shape}, not (N, P, 3)")
    return [Shape(cloud, np.empty((0, 3), np.int64), f"cloud {k}") for k, cloud in enumerate(points)]


def measure(
    clouds: Sequence[Shape], method: Method, limit: int | None, work: Path | None, asked: Mapping[str, Any]
) -> dict[str, Any]:
    """Match every ordered pair of corresponding clouds, or ``limit`` of them evenly spread, and measure every row.

    What is finished is kept in ``work``, with what was ``asked`` for.
    """
    fit_of = cache(lambda number: method.fit(clouds[number]))
    every = list(permutations(range(len(clouds)), 2))
    pairs = runner.spread(every, limit)

    def matched(a: int, b: int) -> dict[str, Any]:
        found = method.map(clouds[a], fit_of(a), clouds[b], fit_of(b))
        there = clouds[b].verts
        cm = 100 * np.linalg.norm(there[found.index] - there, axis=1)
        return {"cm": cm, "trusted": (found.confidence > 0.5).tolist()}

    told = [
        runner.at_work(work, f"cloud-{k}", asked, lambda: {"verdict": fit_of(k).verdict})["verdict"]  # noqa: B023
        for k in runner.track(range(len(clouds)), "fitting")
    ]
    results = [
        runner.at_work(work, f"{a}-{b}", asked, partial(matched, a, b)) for a, b in runner.track(pairs, "matching")
    ]
    errors = [np.array(each["cm"], np.float32) for each in results]
    joined, confident = np.concatenate(errors), np.concatenate([each["trusted"] for each in results])
    return {
        "pairs": f"{len(pairs)} of {len(every)}",
        **summary([Errors(each / CM_PER_UNIT) for each in errors]),
        "confident_share": float(confident.mean()),
        "confident_mean_cm": float(joined[confident].mean()) if confident.any() else None,
        "verdicts": dict(Counter(told)),
    }


@runner.command
def main(
    data: runner.Data = runner.DATA,
    limit_pairs: runner.LimitPairs = None,
    model: runner.Model = "human",
    seed: runner.Seed = 0,
    work: runner.Work = None,
) -> runner.Report:
    asked = {"weights": as_model(model).card.weights_sha256, "seed": seed}
    record = measure(load_clouds(data), OurMethod(model, seed=seed), limit_pairs, work, asked)
    words = ", ".join(f"{count} {verdict}" for verdict, count in record["verdicts"].items())
    title = "Clouds with outliers, straight distance in cm, outliers counted"
    return runner.Report(record, [runner.table(title, [record | {"words": words}], COLUMNS)])


if __name__ == "__main__":
    sys.exit(main())
