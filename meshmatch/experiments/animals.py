"""Four-legged animals through a template of one of them: ``python -m meshmatch.experiments.animals``.

The benchmark's animals (cats, dogs, cows, hippos, horses) stand in different poses and are turned every way. One is
the template; a model is trained on all of them without correspondence, or, with ``--points N``, with N known points on
each. Then every ordered pair is matched (or some, evenly spread: ``--limit-shapes``, ``--limit-pairs``), and every
landmark counts. The error is the Euclidean distance on the target between the matched and the true point, in units of
sqrt(area), times 100. Beside it: rigid alignment and the nearest vertex. Animals are trained and measured on the same
shapes: a registration of a collection.
"""

from __future__ import annotations

import sys
import time
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from meshmatch.errors import InputError
from meshmatch.experiments.category import (
    Pair,
    Training,
    fit_all,
    load_category,
    map_all,
    nearest_all,
    options_of_training,
    spread_pairs,
    trained,
    training_of,
)
from meshmatch.experiments.report import columns, publish, status_of
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.outputs import make_folder
from meshmatch.shapes.sampling import farthest_points
from meshmatch.shapes.shape import Shape
from meshmatch.threads import set_threads

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
    training: Training, *, data: Path, template: str, points: int, limit: int | None, some: int | None
) -> dict[str, Any]:
    """Train, match, measure, print a table and a JSON line; the line's record is returned too."""
    set_threads(training.threads)
    shapes, truth = load_category(data / "animal", TRUTH)
    if template not in shapes:
        raise InputError(f"there is no animal {template!r}", f"choose from {', '.join(shapes)}")
    names = list(shapes)
    picked = names if some is None else [names[k] for k in np.linspace(0, len(names) - 1, some).astype(int)]
    measured = {name: shapes[name] for name in picked}
    pairs = spread_pairs(measured, limit)
    landmarks = None
    if points:
        place = training.work / "points"
        make_folder(place)
        for name, ids in known_points(truth, shapes, template, points).items():
            np.save(place / f"{name}.npy", ids.astype(np.int64))
        landmarks = str(place)
    results: dict[str, dict[str, Any]] = {}
    with Console(stderr=True).status("animals") as status:
        tell = status.update
        nearest = nearest_all(measured, "rigid", "area", tell, pairs)
        found = {pair: index for pair, (index, _) in nearest.items()}
        results["rigid alignment, nearest vertex"] = animal_errors(shapes, truth, found)
        model, how = trained(
            data / "animal",
            training,
            how="rigid",
            scale="area",
            tell=tell,
            strategy="geodesic",
            landmarks=landmarks,
            template=template,
        )
        for label, config in (
            ("network alone", FitConfig(seed=training.seed, refine="none", partial="no")),
            ("nodes refined", FitConfig(seed=training.seed, partial="no")),
        ):
            began = time.monotonic()
            fits = fit_all(model, measured, config, tell)
            maps = map_all(model, measured, fits, config, tell, pairs)
            found = {pair: each.index for pair, each in maps.items()}
            results[label] = animal_errors(shapes, truth, found)
            results[label]["seconds"] = round(time.monotonic() - began, 1)
            results[label]["verdicts"] = {name: fit.verdict for name, fit in fits.items()}
    kinds = list(results["nodes refined"]["kinds"])
    title = "Animals: Euclidean error x 100 / sqrt(area)"
    table = columns(title, ["method"], ["pairs", "mean", "median pair", "lost", *kinds])
    for label, each in results.items():
        numbers = f"{each['mean_x100']:.1f}", f"{each['median_pair_x100']:.1f}", f"{100 * each['lost']:.0f} %"
        kinded = (f"{each['kinds'][kind]:.1f}" for kind in kinds)
        table.add_row(label, str(each["pairs"]), *numbers, *kinded)
    record = {"seed": training.seed, "points": points, "training": how, "results": results}
    return publish("animals", table, record, threads=training.threads)


def main(words: list[str] | None = None) -> int:
    """Run the benchmark; 0 when it ran, 1 when the data stopped it."""
    parser = options_of_training("animals", __doc__, minutes=15, steps=2000, nodes=320, radius=0.13)
    parser.add_argument("--template", default="dog_alph", help="which animal; %(default)s")
    parser.add_argument("--points", type=int, default=0, help="known points on each animal; %(default)s")
    parser.add_argument("--limit-pairs", type=int, metavar="N", help="N of the pairs, evenly spread")
    parser.add_argument("--limit-shapes", type=int, metavar="N", help="N of the animals are measured")
    options = parser.parse_args(words)
    if options.points < 0 or (options.limit_pairs or 1) < 1 or (options.limit_shapes or 2) < 2:
        parser.error("points of 0 or more, a pair or more and two shapes or more are needed")
    with training_of(parser, options) as training:
        return status_of(
            lambda: run(
                training,
                data=options.data,
                template=options.template,
                points=options.points,
                limit=options.limit_pairs,
                some=options.limit_shapes,
            )
        )


if __name__ == "__main__":
    sys.exit(main())
