"""Animals, hands and heads through models that have never seen one of them.

Cats, dogs, cows, horses and hippos of the benchmark, each fitted once and turned every way; then every ordered pair is
matched as `match` does it (--agree all lets the fits of all shapes agree once, instead of those of every pair), and every
landmark counts. The error is the distance along the target between the matched and the true point, in units of sqrt(area),
times 100; "off" is the share of points beyond 10. Beside it how far the verdicts tell the truth: the worse one of the two
fits, and the error of the pair.

Hands and heads are generated (meshmatch/experiments/makers/cut_scans.py): of people and in poses that no training
drew, with other triangles, cut at random, turned anywhere, every other one with a thing beside it, and hands of both
sides; a table says how many sides were found, and how many pairs of one wrong side were called good. Their errors are
in percent of the length of the hand (wrist to fingertips) or the head (chin to crown).
"""

from __future__ import annotations

import sys
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from rich.table import Table
from typer import Option

from meshmatch.api.inputs import validated
from meshmatch.api.matching import Matcher
from meshmatch.arrays import Ints
from meshmatch.experiments import runner
from meshmatch.experiments.bench.category import Shapes, ordered_pairs
from meshmatch.experiments.bench.scores import TruthDistances
from meshmatch.experiments.bench.sets import Pair, load_folder
from meshmatch.experiments.makers.cut_scans import make_scans, scan_errors
from meshmatch.fitting.agree import agreed_fits
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.maps.build import build_map
from meshmatch.maps.places import Places
from meshmatch.maps.vertex_map import VertexMap

OFF = 0.1
"""In units of sqrt(area): a point further off is lost."""
VERDICTS = ("good", "fair", "poor")
SETS = ("animals", "hand", "head")
MODELS = {"animals": "quadruped"}
"""Of the sets that are not named as theirs."""
TRUTH = ".landmarks.npy"
_SPECIES = {
    "dog": ("dog", "wolf", "fox", "inuit"),
    "cat": ("lion", "cougar", "tiger"),
    "cow": ("cow",),
    "hippo": ("hippo",),
}
BARS = {"hand": 4.0, "head": 2.0}
"""Percent of the length."""
_COLUMNS = {"pairs": "pairs:d", "mean": "mean_x100:.2f", "median": "median_x100:.2f", "off": "off:.1%"}

Agree = Literal["pairs", "all", "no"]


def species_of(name: str) -> str:
    """The species that an animal's file is named after; "other" where its name says nothing."""
    words = name.lower()
    return next((kind for kind, signs in _SPECIES.items() if any(sign in words for sign in signs)), "other")


def maps_of(matcher: Matcher, fits: Mapping[str, Fit], pairs: Sequence[Pair], agree: Agree) -> dict[Pair, VertexMap]:
    """Maps of pairs through their fits, which agree first: those of each pair, or all of them at once."""
    threads = matcher.threads
    clean = {name: validated(fit.repaired.original) for name, fit in fits.items() if fit.repaired is not None}

    def agreed(names: Sequence[str]) -> dict[str, Fit]:
        own = [fits[name] for name in names]
        if agree == "no":
            return dict(zip(names, own, strict=True))
        shapes = [clean[name].shape for name in names]
        return dict(zip(names, agreed_fits(matcher.model, shapes, own, matcher.config, threads=threads), strict=True))

    def placed(names: Sequence[str]) -> dict[str, Places]:
        return {name: Places.of(clean[name], fit, fits[name]) for name, fit in agreed(names).items()}

    together = placed(list(fits)) if agree == "all" else {}
    found = {}
    for a, b in runner.track(sorted({(min(pair), max(pair)) for pair in pairs}), "mapping"):
        both = together or placed([a, b])
        for pair in {(a, b), (b, a)} & set(pairs):
            found[pair] = build_map(both[pair[0]], both[pair[1]])
    return found


def rows_of(errors: Mapping[Pair, np.ndarray], group: Any) -> list[dict[str, Any]]:
    """A row for every group of pairs, with the mean over pairs of their means, medians and shares beyond `OFF`."""
    groups: dict[str, list[np.ndarray]] = defaultdict(list)
    for pair, values in errors.items():
        groups[group(pair)].append(values)
    return [
        {
            "of": name,
            "pairs": len(each),
            "mean_x100": round(100 * float(np.mean([values.mean() for values in each])), 4),
            "median_x100": round(100 * float(np.median([values.mean() for values in each])), 4),
            "off": round(float(np.mean([(values > OFF).mean() for values in each])), 4),
        }
        for name, each in sorted(groups.items())
    ]


def geodesic_errors(
    shapes: Shapes, truth: Mapping[str, Ints], maps: Mapping[Pair, VertexMap], cache: Path | None
) -> dict[Pair, np.ndarray]:
    """Distances along the target at every landmark of every pair, in units of sqrt(area)."""
    found: dict[Pair, np.ndarray] = {}
    for target in runner.track(sorted({b for _, b in maps}), "measuring"):
        mine = [pair for pair in maps if pair[1] == target]
        distances = TruthDistances(shapes[target], truth[target], cache)
        values = distances.errors([maps[pair].index[truth[pair[0]]] for pair in mine])
        found |= dict(zip(mine, values, strict=True))
    return found


def measured_animals(
    data: Path, matcher: Matcher, agree: Agree, limits: tuple[int | None, int | None], cache: Path | None
) -> tuple[dict[str, Any], list[Table]]:
    """Record and tables of the animals; ``limits``: of shapes and of pairs."""
    shapes, truth = load_folder(data / "animal", TRUTH)
    shapes = {name: shapes[name] for name in runner.spread(list(shapes), limits[0])}
    began = time.perf_counter()
    fits = dict(zip(shapes, matcher.fit_all(list(shapes.values())), strict=True))
    fitted = time.perf_counter() - began
    maps = maps_of(matcher, fits, ordered_pairs(shapes, limits[1]), agree)
    mapped = time.perf_counter() - began - fitted
    errors = geodesic_errors(shapes, truth, maps, cache)
    verdicts = {name: fit.verdict for name, fit in fits.items()}
    worse = {pair: max((verdicts[name] for name in pair), key=VERDICTS.index) for pair in maps}
    whole = rows_of(errors, lambda _: "all")[0]
    kinds = rows_of(errors, lambda pair: f"{species_of(pair[0])} to {species_of(pair[1])}")
    judged = rows_of(errors, worse.__getitem__)
    title = "error x 100 / sqrt(area)"
    tables = [
        runner.table(f"Animals with {matcher.model.card.name}: {title}", [*kinds, whole], {"of": "of", **_COLUMNS}),
        runner.table(f"By the worse verdict: {title}", judged, {"verdict": "of", **_COLUMNS}),
    ]
    record: dict[str, Any] = {"all": whole, "kinds": kinds, "judged": judged, "verdicts": verdicts}
    record |= {"fit_seconds": round(fitted / len(fits), 2), "map_seconds": round(mapped / len(maps), 2)}
    return record, tables


def measured_scans(
    kind: str, count: int, matcher: Matcher, agree: Agree, cache: Path | None
) -> tuple[dict[str, Any], list[Table]]:
    """Record and table of generated hands or heads: all pairs, then by the worse verdict."""
    scans = {scan.shape.name: scan for scan in make_scans(kind, count, matcher.config.seed)}
    shapes = {name: scan.shape for name, scan in scans.items()}
    fits = dict(zip(shapes, matcher.fit_all(list(shapes.values())), strict=True))
    maps = maps_of(matcher, fits, ordered_pairs(shapes, None), agree)
    errors = scan_errors(scans, maps, cache)
    worse = {pair: max((fits[name].verdict for name in pair), key=VERDICTS.index) for pair in maps}
    rows = [*rows_of(errors, lambda _: "all"), *rows_of(errors, worse.__getitem__)]
    title = f"{kind} with {matcher.model.card.name}: error in percent of its length, bar {BARS[kind]:g}"
    whole = rows[0] | {"bar": BARS[kind], "met": rows[0]["mean_x100"] <= BARS[kind]}
    record = {"all": whole, "judged": rows[1:], "verdicts": {name: fit.verdict for name, fit in fits.items()}}
    tables = [runner.table(title, rows, {"of": "of", **_COLUMNS})]
    if matcher.model.card.mirror == "auto":
        wrong = {name for name, fit in fits.items() if fit.frame.mirrored != scans[name].mirrored}
        good = sum(worse[pair] == "good" and len(wrong & set(pair)) == 1 for pair in maps)
        left = sum(scan.mirrored for scan in scans.values())
        sides: dict[str, Any] = {"shapes": len(scans), "left": left, "found": 1 - len(wrong) / len(scans)}
        sides["wrong_called_good"] = good
        columns = {"shapes": "shapes:d", "left": "left:d", "right side found": "found:.1%"}
        tables.append(runner.table("Sides", [sides], columns | {"wrong pairs called good": "wrong_called_good:d"}))

        def side(name: str) -> str:
            return "left" if scans[name].mirrored else "right"

        each = rows_of(errors, lambda pair: f"{side(pair[0])} to {side(pair[1])}")
        tables.append(runner.table("By the sides of a pair", each, {"sides": "of", **_COLUMNS}))
        record["sides"] = sides | {"by_side": each, "wrong": sorted(wrong)}
    return record, tables


@runner.command
def main(
    data: runner.Data = runner.DATA,
    sets: Annotated[str, Option(help=f"of {', '.join(SETS)}")] = ",".join(SETS),
    model: Annotated[str | None, Option(help="default: the kind's own")] = None,
    agree: Annotated[Agree, Option(help="which fits agree before they are composed")] = "pairs",
    limit_pairs: runner.LimitPairs = None,
    limit_shapes: Annotated[int | None, Option(min=2, help="animals, evenly spread")] = None,
    scans: Annotated[int, Option(min=2, help="hands, and heads")] = 10,
    cache: runner.Cache = None,
    threads: runner.Threads = 1,
    seed: runner.Seed = 0,
) -> runner.Report:
    record: dict[str, Any] = {}
    tables: list[Table] = []
    for name in runner.names_of(sets, SETS, "set"):
        matcher = Matcher(model or MODELS.get(name, name), FitConfig(seed=seed), threads)
        if name == "animals":
            found, several = measured_animals(data, matcher, agree, (limit_shapes, limit_pairs), cache)
            record |= found
            tables += several
        else:
            record[name], several = measured_scans(name, scans, matcher, agree, cache)
            tables += several
    return runner.Report(record, tables)


if __name__ == "__main__":
    sys.exit(main())
