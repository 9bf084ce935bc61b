"""Reliability of verdicts on collections without a model, in which some specimens are damaged or of another kind.

In each collection four in ten specimens are spoiled: warped, cut by a plane, or replaced by a shape of another collection.
All are rotated at random, and in sets with sides every third one is a mirror image (see
`meshmatch.experiments.bench.specimens`). A fit is right if the mean errors of its maps to and from the sound specimens have
a median of less than a tenth of sqrt(area), and lost otherwise; replaced specimens are always lost.

A row "of others" counts verdicts by weights fitted to the other collections of generated shapes. ``--fit`` prints weights
fitted to all generated ones, in the form of `meshmatch.fitting.reference_statistics`. The rows "as they are" count the
verdicts that users see.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import permutations
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from scipy.optimize import minimize
from typer import Option

from meshmatch.arrays import Bool, Bools, Float, Floats
from meshmatch.collections.collection import Collection
from meshmatch.collections.compare import Compared
from meshmatch.collections.setting import SINGLE_FITS, SUFFIX, Record
from meshmatch.experiments import runner
from meshmatch.experiments.bench.specimens import SETS, SIDED, Specimens, by_collection, make_scan, registered_shapes
from meshmatch.experiments.makers.molars_and_leaves import MAKERS, deform_randomly
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.reference_statistics import Weights
from meshmatch.maps.fit_files import read_fit, read_fit_header
from meshmatch.models.registry import NO_MODEL
from meshmatch.outputs import make_folder
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.shape import Shape

TREATMENTS = ("sound", "sound", "warped", "sound", "cut", "sound", "sound", "replaced", "sound", "warped")
REPLACEMENTS = {"femurs": "molars", "knees": "leaves", "molars": "knees", "leaves": "molars"}
"""Collections, each with the one that its replaced specimens are from."""
RIGHT = 0.1  # error below which a fit is right, as a fraction of sqrt(area)
_COLUMNS = {"collection": "name", "weights": "weights", "fits": "fits:d", "right": "right:d", "good": "good:d"}
_COLUMNS |= {"good, lost": "good_lost:d", "right, good or fair": "believed:d", "lost, not poor": "lost_not_poor:d"}


@dataclass(frozen=True, eq=False)
class Spoiled:
    """A collection, and for each specimen what was done to it, one of `TREATMENTS`."""

    some: Specimens
    how: Mapping[str, str]


def make_spoiled(name: str, data: Path, count: int, seed: int) -> Spoiled:
    """Make a collection of ``count`` specimens, or fewer if it has fewer."""
    rng = np.random.default_rng([seed, 30, SETS.index(name)])
    shapes, others = (
        registered_shapes(name, data, count, seed + 1),
        list(registered_shapes(REPLACEMENTS[name], data, count, seed + 1).values()),
    )
    made, how = {}, {}
    for number, (key, whole) in enumerate(shapes.items()):
        what = TREATMENTS[number % len(TREATMENTS)]
        unit = float(np.sqrt(whole.area))
        if what == "warped":
            verts = deform_randomly(whole.verts, rng.uniform(0.05, 0.25) * unit, 0.3 * unit, rng)
            whole = Shape(verts, whole.faces, whole.name)
        if what == "replaced":
            other = others[number % len(others)]
            whole = Shape(other.verts * unit / np.sqrt(other.area), other.faces, whole.name)
        one = make_scan(whole, rng, name in SIDED and number % 3 == 2, what == "cut")
        made[key], how[key] = one, what
    return Spoiled(Specimens(made, "mm"), how)


def measure(name: str, data: Path, count: int, seed: int, work: Path) -> dict[str, Any]:
    """Fit a collection; return name, treatment, error and verdict of each fit."""
    found = make_spoiled(name, data, count, seed)
    scans, fits = work / "scans" / name, work / "fits" / name
    make_folder(scans)
    for key, each in found.some.each.items():
        save_shape(scans / f"{key}.ply", each.shape)
    done = by_collection(found.some, scans, fits, NO_MODEL)
    sound = {key for key, what in found.how.items() if what == "sound"}
    apart: dict[str, list[float]] = {key: [] for key in found.how}
    for pair in permutations([key for key, what in found.how.items() if what != "replaced"], 2):
        off = found.some.errors(pair, done.points(pair)) / np.sqrt(found.some.each[pair[1]].shape.area)
        for key, other in (pair, pair[::-1]):
            if other in sound:
                apart[key].append(float(np.nanmean(off)))
    errors = {key: float(np.median(some)) if some else np.inf for key, some in apart.items()}
    rows = [{"name": each.name, "what": found.how[each.name], "error": errors[each.name], "verdict": each.verdict}
            for each in done.records]  # fmt: skip
    return {"fits": rows}


@dataclass(frozen=True, eq=False)
class SingleFits:
    """The fits of a collection before they were compared with each other."""

    fits: Mapping[str, Fit]
    records: Mapping[str, Record]
    usual: Compared

    @classmethod
    def read(cls, folder: Path) -> SingleFits:
        """Read the single fits of a folder of fits."""
        collection = Collection(folder)
        paths = {name: folder / SINGLE_FITS / f"{name}{SUFFIX}" for name in collection.names}
        records = {name: Record.of(read_fit_header(path)[1]["record"]) for name, path in paths.items()}
        usual = Compared.of(list(records.values()))
        assert usual is not None
        fits = {name: read_fit(path, collection.template).fit for name, path in paths.items()}
        return cls(fits, records, usual)

    def verdicts(self, weights: Weights) -> dict[str, str]:
        """Judge the fits by other weights."""
        usual = replace(self.usual, usual=replace(self.usual.usual, weights=weights))
        return {name: usual.judged(fit, self.records[name]).verdict for name, fit in self.fits.items()}

    def signs(self, rows: Sequence[Mapping[str, Any]]) -> tuple[Floats, Bools]:
        """Return features (N, 2), and which fits are right (N,), of fits that nothing but these features can make poor."""
        some = [row for row in rows if self.records[row["name"]].side >= 0 and self.fits[row["name"]].verdict != "poor"]
        records = [self.records[row["name"]] for row in some]
        values = [self.usual.usual.signs(each.stretch, each.residual) for each in records]
        return np.array(values).reshape(-1, 2), np.array([is_right(row) for row in some], bool)


def fit_weights(values: Float[Floats, "N 2"], right: Bool[Bools, " N"], ridge: float = 0.002) -> Weights:
    """Fit weights by ridge-regularised logistic regression; larger features never improve a verdict."""
    deviation = values.std(0) + 1e-9

    def loss(p: Floats) -> float:
        costs = np.logaddexp(0.0, np.where(right, -1.0, 1.0) * (p[0] - values / deviation @ p[1:]))
        return float(costs.mean() + ridge * np.square(p[1:]).sum())

    found = minimize(loss, np.zeros(3), method="L-BFGS-B", bounds=[(None, None), (0, None), (0, None)]).x
    return Weights(float(found[0]), *(float(each) for each in found[1:] / deviation))


def is_right(row: Mapping[str, Any]) -> bool:
    """Return whether a fit is right; the error of a replaced specimen is None."""
    return row["error"] is not None and row["error"] < RIGHT


def row_of(name: str, weights: str, rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Count the verdicts of right and of lost fits."""
    right = [is_right(each) for each in rows]
    verdicts = [each["verdict"] for each in rows]
    both = list(zip(right, verdicts, strict=True))
    return {
        **{"name": name, "weights": weights, "fits": len(rows), "right": sum(right), "good": verdicts.count("good")},
        "good_lost": sum(not known and verdict == "good" for known, verdict in both),
        "believed": sum(known and verdict in ("good", "fair") for known, verdict in both),
        "lost_not_poor": sum(not known and verdict in ("good", "fair") for known, verdict in both),
    }


@runner.command
def main(
    data: runner.Data = runner.DATA,
    collections: Annotated[str, Option(help=f"of {', '.join(REPLACEMENTS)}")] = ",".join(REPLACEMENTS),
    count: Annotated[int, Option(min=6, help="specimens of each collection, if it has as many")] = 15,
    fit: Annotated[bool, Option("--fit", help="also fit the weights")] = False,
    work: runner.Work = None,
    threads: runner.Threads = 1,
    seed: runner.Seed = 0,
) -> runner.Report:
    names = runner.split_names(collections, REPLACEMENTS, "collection")
    with tempfile.TemporaryDirectory() as temporary:
        place, asked = work or Path(temporary), {"count": count, "seed": seed}
        found, alone = {}, {}
        for name in names:
            runner.log(name)
            call = partial(measure, name, data, count, seed, place)
            found[name] = runner.cached(place / "rows" / f"{name}.json", asked, call)["fits"]
            alone[name] = SingleFits.read(place / "fits" / name)
    signs = {name: alone[name].signs(found[name]) for name in names if name in MAKERS}

    def weights_without(name: str) -> Weights:
        values, right = zip(*(each for other, each in signs.items() if other != name), strict=True)
        return fit_weights(np.concatenate(values), np.concatenate(right))

    rows, held = [], []
    for name in names:
        if signs.keys() - {name}:
            verdicts = alone[name].verdicts(weights_without(name))
            own = [row | {"verdict": verdicts[row["name"]]} for row in found[name]]
            rows.append(row_of(name, "of others", own))
            held += own
        rows.append(row_of(name, "as they are", found[name]))
    rows.append(row_of("all", "of others", held))
    rows.append(row_of("all", "as they are", [row for name in names for row in found[name]]))
    notes = [str(weights_without(""))] if fit and signs else []
    record = {"rows": rows, "fits": found}
    return runner.Report(record, [runner.table("Verdicts of collections", rows, _COLUMNS)], notes)
