"""Four-legged animals through a template of one of them: ``python -m meshmatch.experiments.animals``.

The benchmark's animals (cats, dogs, cows, hippos, horses) stand in different poses and are turned every way. One is
the template; a model is trained on all of them without correspondence, or, with ``--points N``, with N known points on
each. Then every ordered pair is matched, and every landmark counts. The error is the Euclidean distance on the target
between the matched and the true point, in units of sqrt(area), times 100. Beside it: rigid alignment and the nearest
vertex. Animals are trained and measured on the same shapes: a registration of a collection.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from meshmatch.config import set_threads
from meshmatch.errors import InputError, MeshmatchError
from meshmatch.experiments.category import Pair, fit_all, load_category, map_all, nearest_all, trained
from meshmatch.experiments.report import circumstances, explain, wide_console
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.shapes.sampling import farthest_points
from meshmatch.shapes.shape import Shape
from meshmatch.templates.nodes import NodeConfig

TRUTH = ".landmarks.npy"
RIGHT = 0.15
"""In units of sqrt(area): further off is another limb."""
_KINDS = {
    "dog": ("dog", "wolf", "fox", "inuit"),
    "cat": ("lion", "cougar", "tiger"),
    "cow": ("cow",),
    "hippo": ("hippo",),
}


def kind_of(name: str) -> str:
    """What kind of animal a file's name says it is; "other" where it says nothing."""
    words = name.lower()
    return next((kind for kind, signs in _KINDS.items() if any(sign in words for sign in signs)), "other")


def animal_errors(
    shapes: Mapping[str, Shape], truth: Mapping[str, np.ndarray], maps: Mapping[Pair, np.ndarray]
) -> dict[str, Any]:
    """Errors of index maps at all landmarks: over pairs, the share further off than `RIGHT`, and by kinds."""
    means, lost = {}, []
    kinds: dict[str, list[float]] = defaultdict(list)
    for (source, target), index in maps.items():
        shape = shapes[target]
        apart = shape.verts[index[truth[source]]] - shape.verts[truth[target]]
        error = np.linalg.norm(apart, axis=1) / np.sqrt(shape.area)
        means[source, target] = 100 * float(error.mean())
        lost.append(float((error > RIGHT).mean()))
        same = kind_of(source) == kind_of(target) != "other"
        kinds[f"{kind_of(source)} to {kind_of(target)}" if same else "across"].append(means[source, target])
    return {
        "pairs": len(means),
        "mean_x100": round(float(np.mean(list(means.values()))), 4),
        "median_pair_x100": round(float(np.median(list(means.values()))), 4),
        "lost": round(float(np.mean(lost)), 4),
        "kinds": {name: round(float(np.mean(values)), 4) for name, values in sorted(kinds.items())},
    }


def known_points(truth: Mapping[str, np.ndarray], shapes: Mapping[str, Shape], template: str, count: int):
    """The same ``count`` landmarks of every animal, far apart on the template: name -> vertices (count,)."""
    at = farthest_points(shapes[template].verts[truth[template]], count)
    return {name: ids[at] for name, ids in truth.items()}


def run(
    *,
    data: Path,
    template: str,
    points: int,
    minutes: float,
    steps: int,
    threads: int,
    seed: int,
    nodes: int,
    radius: float,
    work: Path,
) -> dict[str, Any]:
    """Train, match, measure, print a table and a JSON line; the line's record is returned too."""
    set_threads(threads)
    shapes, truth = load_category(data / "animal", TRUTH)
    if template not in shapes:
        raise InputError(f"there is no animal {template!r}", f"choose from {', '.join(shapes)}")
    landmarks = None
    if points:
        (work / "points").mkdir(parents=True, exist_ok=True)
        for name, ids in known_points(truth, shapes, template, points).items():
            np.save(work / "points" / f"{name}.npy", ids.astype(np.int64))
        landmarks = str(work / "points")
    results: dict[str, dict[str, Any]] = {}
    with Console(stderr=True).status("animals") as status:
        nearest = {
            pair: index for pair, (index, _) in nearest_all(shapes, "rigid", "area", status.update).items()
        }
        results["rigid alignment, nearest vertex"] = animal_errors(shapes, truth, nearest)
        model, how = trained(
            data / "animal",
            work,
            minutes=minutes,
            steps=steps,
            how="rigid",
            scale="area",
            threads=threads,
            seed=seed,
            tell=status.update,
            nodes=NodeConfig(strategy="geodesic", K=nodes, radius=radius, seed=seed),
            landmarks=landmarks,
            template=template,
        )
        for config, label in (
            (FitConfig(seed=seed, refine="none", partial="no"), "network alone"),
            (FitConfig(seed=seed, partial="no"), "nodes refined"),
        ):
            began = time.monotonic()
            fits = fit_all(model, shapes, config, status.update)
            found = map_all(model, shapes, fits, config, status.update)
            results[label] = animal_errors(shapes, truth, {pair: each.index for pair, each in found.items()})
            results[label]["seconds"] = round(time.monotonic() - began, 1)
            results[label]["verdicts"] = {name: fit.verdict for name, fit in fits.items()}
    table = Table(title="Animals: Euclidean error x 100 / sqrt(area), all pairs", title_justify="left")
    kinds = list(results["nodes refined"]["kinds"])
    for name in ("method", "mean", "median pair", "lost", *kinds):
        table.add_column(name, justify="left" if name == "method" else "right")
    for name, each in results.items():
        numbers = f"{each['mean_x100']:.1f}", f"{each['median_pair_x100']:.1f}", f"{100 * each['lost']:.0f} %"
        table.add_row(name, *numbers, *(f"{each['kinds'][kind]:.1f}" for kind in kinds))
    wide_console().print(table)
    whole = {
        "benchmark": "animals",
        **circumstances(threads=threads, jobs=1),
        "seed": seed,
        "points": points,
        "training": how,
        "results": results,
    }
    print(json.dumps(whole), flush=True)
    return whole


def main(words: list[str] | None = None) -> int:
    """Run the benchmark; 0 when it ran, 1 when the data stopped it."""
    parser = argparse.ArgumentParser("python -m meshmatch.experiments.animals", description=__doc__)
    parser.add_argument("--data", type=Path, default=Path("../shared/bench"), help="the benchmark's data")
    parser.add_argument("--template", default="dog_alph", help="which animal; %(default)s")
    parser.add_argument("--points", type=int, default=0, help="known points on each animal; %(default)s")
    parser.add_argument("--minutes", type=float, default=15.0, help="of training at most")
    parser.add_argument("--steps", type=int, default=2000, help="of training")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--nodes", type=int, default=320, help="of the template")
    parser.add_argument("--radius", type=float, default=0.13, help="of a node, units of sqrt(area)")
    parser.add_argument("--work", type=Path, help="keep the prepared folder and the model here")
    options = parser.parse_args(words)
    if options.steps < 1 or options.minutes <= 0 or options.threads < 1 or options.points < 0:
        parser.error("steps and threads of 1 or more, minutes above 0 and points of 0 or more are needed")
    try:
        with tempfile.TemporaryDirectory() as temporary:
            run(
                data=options.data,
                template=options.template,
                points=options.points,
                minutes=options.minutes,
                steps=options.steps,
                threads=options.threads,
                seed=options.seed,
                nodes=options.nodes,
                radius=options.radius,
                work=options.work or Path(temporary),
            )
    except MeshmatchError as error:
        explain(error)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
