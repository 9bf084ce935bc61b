"""Animals, hands and heads that the models were not trained on, matched with a model or without.

Cats, dogs, cows, horses and hippos of the benchmark are each fitted once; then every ordered pair is matched as `match`
does it, and every landmark counts. The error is the geodesic distance on the target between the matched and the true point,
in units of sqrt(area), times 100; "off" is the share of points beyond 10. A second table has the errors by verdict, the
worse one of the two fits.

Hands and heads are generated (meshmatch/experiments/makers/cut_scans.py): identities and poses that training did not use,
remeshed, cut at random, in random orientations, every other one next to another object, and hands of both sides. A table
has the share of hands whose side was found, and the number of pairs with one wrong side that were called good. Their errors
are in percent of the length of the hand (wrist to fingertips) or the head (chin to crown).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from rich.table import Table
from typer import Option

from meshmatch.api.matcher import Matcher
from meshmatch.arrays import Ints
from meshmatch.experiments import runner
from meshmatch.experiments.bench.pairs import match_by_fits, match_directly
from meshmatch.experiments.bench.scores import TruthDistances
from meshmatch.experiments.bench.sets import Pair, Shapes, load_folder, ordered_pairs
from meshmatch.experiments.makers.cut_scans import make_scans, scan_errors
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.models.registry import NO_MODEL

LOST = 0.1
"""Error, in units of sqrt(area), beyond which a point is lost."""
SETS = ("animals", "hand", "head")
MODELS = {"animals": "quadruped"}
"""Models of the sets that are not named like their model."""
TRUTH = ".landmarks.npy"
_SPECIES = {
    "dog": ("dog", "wolf", "fox", "inuit"),
    "cat": ("lion", "cougar", "tiger"),
    "cow": ("cow",),
    "hippo": ("hippo",),
}
_COLUMNS = {"pairs": "pairs:d", "mean": "mean_x100:.2f", "median": "median_x100:.2f", "off": "off:.1%"}
_SIDES = {"shapes": "shapes:d", "left": "left:d", "right side found": "found:.1%"}
_SIDES |= {"wrong pairs called good": "wrong_called_good:d"}

Errors = dict[Pair, np.ndarray]
Group = Callable[[Pair], str]


@dataclass(frozen=True, eq=False)
class Subjects:
    """Shapes of a set and how to measure their maps.

    Parameters
    ----------
    title : the unit of errors, for the table's title
    shapes : shapes by name
    errors : function from maps of pairs to the errors at the points of each pair
    groups : by table title, a function that groups pairs, in addition to grouping by verdict
    left : for hands, whether each one is a left hand
    """

    title: str
    shapes: Shapes
    errors: Callable[[Mapping[Pair, VertexMap]], Errors]
    groups: Mapping[str, Group] = field(default_factory=dict)
    left: Mapping[str, bool] = field(default_factory=dict)


def species_of(name: str) -> str:
    """Return the species from an animal's file name; "other" if it names none."""
    words = name.lower()
    return next((kind for kind, signs in _SPECIES.items() if any(sign in words for sign in signs)), "other")


def rows_of(errors: Errors, group: Group) -> list[dict[str, Any]]:
    """Compute a row for every group of pairs: mean and median of their mean errors, and the mean share beyond `LOST`."""
    groups: dict[str, list[np.ndarray]] = defaultdict(list)
    for pair, values in errors.items():
        groups[group(pair)].append(values)
    return [
        {
            "of": name,
            "pairs": len(each),
            "mean_x100": round(100 * float(np.mean([values.mean() for values in each])), 4),
            "median_x100": round(100 * float(np.median([values.mean() for values in each])), 4),
            "off": round(float(np.mean([(values > LOST).mean() for values in each])), 4),
        }
        for name, each in sorted(groups.items())
    ]


def geodesic_errors(
    shapes: Shapes, truth: Mapping[str, Ints], cache: Path | None, maps: Mapping[Pair, VertexMap]
) -> Errors:
    """Compute geodesic distances on the target at every landmark of every pair, in units of sqrt(area)."""
    found: Errors = {}
    for target in runner.track(sorted({b for _, b in maps}), "measuring"):
        mine = [pair for pair in maps if pair[1] == target]
        distances = TruthDistances(shapes[target], truth[target], cache)
        values = distances.errors([maps[pair].index[truth[pair[0]]] for pair in mine])
        found |= dict(zip(mine, values, strict=True))
    return found


def animals(data: Path, limit: int | None, cache: Path | None) -> Subjects:
    """Load the animals of the evaluation data."""
    shapes, truth = load_folder(data / "animal", TRUTH)
    shapes = {name: shapes[name] for name in runner.evenly_spread(list(shapes), limit)}
    groups: dict[str, Group] = {"species": lambda pair: " to ".join(map(species_of, pair))}
    return Subjects("error x 100 / sqrt(area)", shapes, partial(geodesic_errors, shapes, truth, cache), groups)


def cut_scans(kind: str, count: int, seed: int, cache: Path | None) -> Subjects:
    """Generate hands or heads."""
    scans = {scan.shape.name: scan for scan in make_scans(kind, count, seed)}
    side = {name: "left" if scan.mirrored else "right" for name, scan in scans.items()}
    return Subjects(
        "error in percent of its length",
        {name: scan.shape for name, scan in scans.items()},
        lambda maps: scan_errors(scans, maps, cache),
        {"sides": lambda pair: " to ".join(side[name] for name in pair)} if "left" in side.values() else {},
        {name: scan.mirrored for name, scan in scans.items()},
    )


def measure_set(
    name: str, subjects: Subjects, matcher: Matcher, limit: int | None = None, direct: bool = False
) -> tuple[dict[str, Any], list[Table]]:
    """Measure all pairs of a set, or ``limit`` of them; ``direct`` matches without a model.

    Return the record and the tables: all pairs together, by verdict, and by each other grouping.
    """
    pairs, fits = ordered_pairs(subjects.shapes, limit), dict[str, Fit]()
    if direct:
        found = match_directly(matcher, subjects.shapes, pairs, name)
    else:
        fits, found = match_by_fits(matcher, subjects.shapes, pairs, name)
    errors = subjects.errors({pair: each.map for pair, each in found.items()})
    whole = rows_of(errors, lambda _: "all")[0]
    groups = {"verdict": lambda pair: found[pair].verdict, **subjects.groups}
    rows = {heading: rows_of(errors, group) for heading, group in groups.items()}
    record: dict[str, Any] = {"all": whole, **rows, "verdicts": {each: fit.verdict for each, fit in fits.items()}}
    title = f"{name} {'without a model' if direct else f'with {matcher.model.card.name}'}: {subjects.title}"
    tables = [runner.table(title, [whole], {"of": "of", **_COLUMNS})]
    tables += [runner.table(f"By {heading}", some, {heading: "of", **_COLUMNS}) for heading, some in rows.items()]
    if not direct and matcher.model.card.mirror == "auto":
        wrong = {each for each, fit in fits.items() if fit.frame.mirrored != subjects.left[each]}
        good = sum(each.verdict == "good" and len(wrong & set(pair)) == 1 for pair, each in found.items())
        sides: dict[str, Any] = {"shapes": len(fits), "left": sum(subjects.left.values())}
        sides |= {"found": 1 - len(wrong) / len(fits), "wrong_called_good": good, "wrong": sorted(wrong)}
        tables.append(runner.table("Sides", [sides], _SIDES))
        record["side"] = sides
    return record, tables


@runner.command
def main(
    data: runner.Data = runner.DATA,
    sets: Annotated[str, Option(help=f"of {', '.join(SETS)}")] = ",".join(SETS),
    model: Annotated[str | None, Option(help="default: that of the kind; or none")] = None,
    limit_pairs: runner.LimitPairs = None,
    limit_shapes: Annotated[int | None, Option(min=2, help="number of animals, evenly spread")] = None,
    scans: Annotated[int, Option(min=2, help="number of hands, and of heads")] = 10,
    cache: runner.Cache = None,
    threads: runner.Threads = 1,
    seed: runner.Seed = 0,
) -> runner.Report:
    record: dict[str, Any] = {}
    tables: list[Table] = []
    for name in runner.split_names(sets, SETS, "set"):
        matcher = Matcher(model or MODELS.get(name, name), FitConfig(seed=seed), threads)
        subjects = animals(data, limit_shapes, cache) if name == "animals" else cut_scans(name, scans, seed, cache)
        record[name], some = measure_set(name, subjects, matcher, limit_pairs, model == NO_MODEL)
        tables += some
    return runner.Report(record, tables)
