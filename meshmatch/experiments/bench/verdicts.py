"""Reliability of verdicts and confidences, on sound and damaged shapes and on shapes of other kinds.

Each case (`meshmatch.experiments.bench.verdict_cases`) is matched to one of 24 targets: other people (or animals) in other
poses, every fourth of which is cut. The error of a vertex is the Euclidean distance on the target between its partner and
the true one, in centimetres for a person of 1.9 m2. A map's error is the mean over the vertices with a true partner, and
infinite for shapes of other kinds. A map is right below 5 cm and wrong above 8 cm. Confidence is compared, at every vertex,
with how often the error is within 5 cm; a vertex without a true partner counts as wrong. All maps have the same weight,
whatever their number of vertices. The longest fit is in CPU seconds.

``--fit`` prints the weights that best separate right from wrong maps of this run, in the form of
`meshmatch.fitting.judge.calibration`; those of other kinds are regularised towards those of people. Measure verdicts with
other seeds than those that the calibration names.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from scipy.optimize import minimize
from scipy.stats import beta
from typer import Option

from meshmatch.api.matcher import Matcher
from meshmatch.arrays import Bool, Bools, Float, Floats, Floats32
from meshmatch.errors import InputError, MeshmatchError
from meshmatch.experiments import runner
from meshmatch.experiments.bench.verdict_cases import FAMILIES, KEPT, OF_PEOPLE, Case, Cases, direction, faces_between
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.judge.calibration import CALIBRATION, Calibration
from meshmatch.generators.kinds import GENERATORS
from meshmatch.maps.evaluate import CM_PER_UNIT
from meshmatch.outputs import make_folder
from meshmatch.render.charts import draw_lines
from meshmatch.shapes.shape import Shape

RIGHT_CM, WRONG_CM = 5.0, 8.0
VERDICTS = ("good", "fair", "poor")
REFUSED = "refused"
_N_TARGETS, _N_FINE_BINS, _N_BINS = 24, 100, 10
_MIN_VERTICES = 200  # minimum number of vertices for which a bin of confidence has a row of values
_COLUMNS = {"maps": "maps:d", "good": "good:d", "fair": "fair:d", "poor": "poor:d", "refused": "refused:d"}
_COLUMNS |= {"under 5 cm": "right:d", "over 8 cm": "wrong:d", "mean cm": "mean_cm:.1f", "worst": "worst_cm:.1f"}
_COLUMNS |= {"longest": "seconds:.1f"}
_CONFIDENCE_COLUMNS = {
    "confidence": "of",
    "vertices": "vertices:d",
    "mean": "confidence:.3f",
    "within 5 cm": "near:.3f",
}
_TOTAL_COLUMNS = {"maps": "maps:d", "good": "good:d", "fair": "fair:d", "poor": "poor:d"}
_TOTAL_COLUMNS |= {
    "good, over 8 cm": "good_and_wrong:d",
    "of good ones, at most": "at_most:.1%",
    "under 5 cm": "right:d",
    "of these good or fair": "right_and_believed:d",
}
_RIDGE = 0.002
_MAX_CUTS = 20  # cuts of a target to try; nearly all can be fitted
GROUPS = {"tuned": [name for name in FAMILIES if name not in KEPT], "kept": list(KEPT), "all": list(FAMILIES)}


@dataclass(frozen=True, eq=False)
class Target:
    """A target: its fit, the true positions of all template vertices, and which of them the shape has."""

    shape: Shape
    fit: Fit
    places: Float[Floats, "T 3"]
    has: Bool[Bools, " T"]


def target_of(others: Cases, matcher: Matcher, number: int) -> Target:
    """Make a target from another person than the cases; every fourth is cut, again if the cut shape cannot be fitted.

    `InputError` of the last fit after `_MAX_CUTS` cuts, or of the only fit of a whole shape.
    """
    rng, cut = np.random.default_rng([others.seed, number]), number % 4 == 3
    places, faces = others.bodies[number], others.template.shape.faces
    whole, every = Shape(places, faces, f"target {number}"), np.arange(len(places))
    cuts = 0
    while True:
        cuts += cut
        shape, kept = (
            faces_between(whole, every, direction(rng), rng.uniform(0.15, 0.5), 1.0) if cut else (whole, every)
        )
        has = np.zeros(len(places), bool)
        has[kept] = True
        try:
            return Target(shape, matcher.fit(shape), places, has)
        except InputError:
            if not cut or cuts == _MAX_CUTS:
                raise


def measure_case(case: Case, target: Target, matcher: Matcher) -> dict[str, Any]:
    """Match a case to a target; return its verdict, error, features and confidence bins."""
    began = time.process_time()
    row: dict[str, Any] = {"family": case.family, "verdict": REFUSED, "error": float("inf")}
    try:
        fit = matcher.fit(case.shape)
    except MeshmatchError as error:
        return row | {"reasons": error.message}
    row["seconds"] = time.process_time() - began
    vertex_map = matcher.map(fit, target.fit)
    known = np.flatnonzero(case.truth >= 0)
    has = known[target.has[case.truth[known]]]
    off = target.shape.verts[vertex_map.index[has]] - target.places[case.truth[has]]
    cm = np.full(len(case.truth), np.inf)
    cm[has] = _cm_per_unit(target) * np.linalg.norm(off, axis=1)
    row |= {"verdict": vertex_map.verdict, "fit": fit.verdict, "trust": fit.trust, "reasons": "; ".join(fit.reasons)}
    row |= {"error": float(cm[has].mean()) if len(has) else float("inf"), "partial": fit.partial}
    assert fit.signs is not None
    return row | {"signs": list(fit.signs.values()), "bins": fine_bins(vertex_map.confidence, cm <= RIGHT_CM)}


def _cm_per_unit(target: Target) -> float:
    """Return centimetres per unit of the target's file, scaled to a person of 1.9 m2."""
    return CM_PER_UNIT / float(np.sqrt(Shape(target.places, np.asarray(target.fit.faces)).area))


def fine_bins(confidence: Float[Floats32, " V"], near: Bool[Bools, " V"]) -> dict[str, list[float]]:
    """Histogram confidences: number of vertices, sum of confidences, and number of near vertices in each fine bin."""
    which = np.minimum((confidence * _N_FINE_BINS).astype(int), _N_FINE_BINS - 1)
    columns: dict[str, np.ndarray] = {"count": np.ones(len(near)), "sum": confidence, "near": near}
    return {name: np.bincount(which, values, _N_FINE_BINS).tolist() for name, values in columns.items()}


def calibration(found: Sequence[Mapping[str, Any]]) -> tuple[list[dict[str, Any]], float]:
    """Compare confidence with the share of vertices that are near, in ten bins.

    Return a row for each bin (number of vertices, mean confidence, share near) and the AUC of confidence. All maps have
    the same weight.
    """
    vertices = np.sum([each["bins"]["count"] for each in found], axis=0)
    total = {
        name: np.sum([np.divide(each["bins"][name], sum(each["bins"]["count"])) for each in found], axis=0)
        for name in ("count", "sum", "near")
    }
    rows = []
    for number in range(_N_BINS):
        part = slice(number * _N_FINE_BINS // _N_BINS, (number + 1) * _N_FINE_BINS // _N_BINS)
        count, expected, near = (float(total[name][part].sum()) for name in ("count", "sum", "near"))
        many = int(vertices[part].sum())
        row: dict[str, Any] = {"of": f"{number / _N_BINS:.1f} to {(number + 1) / _N_BINS:.1f}", "vertices": many}
        rows.append(row | ({"confidence": expected / count, "near": near / count} if many >= _MIN_VERTICES else {}))
    near, far = total["near"], total["count"] - total["near"]
    below = np.cumsum(far) - 0.5 * far
    return rows, float((near * below).sum() / max(near.sum() * far.sum(), 1e-12))


def rows_of(found: Sequence[Mapping[str, Any]], group: str, names: Sequence[str]) -> list[dict[str, Any]]:
    """Summarise maps by the value of a column: numbers of each verdict, of right and of wrong maps, and errors."""
    rows = []
    for name in names:
        some = [each for each in found if each[group] == name]
        row: dict[str, Any] = {"of": name, "maps": len(some)}
        row |= {verdict: sum(each["verdict"] == verdict for each in some) for verdict in (*VERDICTS, REFUSED)}
        mapped = [each for each in some if each["verdict"] != REFUSED]
        finite = [each["error"] for each in mapped if np.isfinite(each["error"])]
        row |= {"right": sum(each["error"] < RIGHT_CM for each in mapped)}
        row |= {"wrong": sum(each["error"] > WRONG_CM for each in mapped)}
        row |= {"mean_cm": float(np.mean(finite)), "worst_cm": max(finite)} if finite else {}
        row |= {"seconds": max(each["seconds"] for each in mapped)} if mapped else {}
        rows.append(row)
    return rows


def bars_of(found: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Compute the criteria for verdicts; refused shapes do not count as maps.

    ``at_most`` is the upper end of the 95 % interval of the share of wrong maps among good ones.
    """
    good = [each for each in found if each["verdict"] == "good"]
    right = [each for each in found if each["verdict"] != REFUSED and each["error"] < RIGHT_CM]
    wrong = sum(each["error"] > WRONG_CM for each in good)
    believed = sum(each["verdict"] != "poor" for each in right)
    most = float(beta.ppf(0.975, wrong + 1, max(len(good) - wrong, 1e-9)))  # Clopper and Pearson 1934
    return {
        "good": len(good),
        "good_and_wrong": wrong,
        "at_most": most,
        "right": len(right),
        "right_and_believed": believed,
    }


def fit_weights(
    found: Sequence[Mapping[str, Any]], near: Calibration | None = None
) -> tuple[Float[Floats, " N"], float]:
    """Fit weights of the features and an offset by logistic regression of being wrong.

    A small ridge penalty pulls towards 0, or towards the calibration ``near``. Weights are not negative: no feature improves
    a verdict. Maps that are poor only because of the target's fit are left out.
    """
    known = [
        each for each in found if each["verdict"] != REFUSED and (each["verdict"] != "poor" or each["fit"] == "poor")
    ]
    X, error = np.array([each["signs"] for each in known]), np.array([each["error"] for each in known])
    weights, offset = (np.zeros(X.shape[1]), 0.0) if near is None else (np.array(near.weights), near.offset)
    sign = np.where(error > WRONG_CM, 1.0, -1.0)
    weight = np.where((error > RIGHT_CM) & (error < 1.5 * WRONG_CM), 0.5, 1.0)  # half weight around the limits
    deviation = np.where(X.std(0) > 0, X.std(0), 1.0)
    Z = X / deviation

    def loss(p: Floats) -> float:
        costs = np.logaddexp(0.0, -sign * (X @ weights + offset + Z @ p[1:] + p[0]))
        return float((weight * costs).sum() / weight.sum() + _RIDGE * np.square(p[1:]).sum())

    bounds = [(None, None), *[(-each, None) for each in weights * deviation]]
    p = minimize(loss, np.zeros(X.shape[1] + 1), method="L-BFGS-B", bounds=bounds).x
    return weights + p[1:] / deviation, offset + float(p[0])


def measure_seed(
    kind: str, names: Sequence[str], count: int, seed: int, threads: int, folder: Path
) -> Iterator[dict[str, Any]]:
    """Measure ``count`` cases of each family for one seed; results are cached in the folder."""
    cases, matcher = Cases(kind, seed), Matcher(kind, FitConfig(seed=seed), threads)
    onto = cache(partial(target_of, Cases(kind, 900 + seed), matcher))

    def family(name: str) -> dict[str, Any]:
        first = list(FAMILIES).index(name) * count
        numbers = runner.track(range(count), f"{name}, seed {seed}", count)
        return {"found": [measure_case(cases.draw(name, k), onto((first + k) % _N_TARGETS), matcher) for k in numbers]}

    for name in names:
        which = {"kind": kind, "family": name, "count": count, "seed": seed, "targets": _N_TARGETS}
        path = folder / f"{kind}-{name.replace(' ', '-')}-{seed}.json"
        kept = runner.cached(path, which, partial(family, name))["found"]
        # JSON has null for infinity
        found = [each | {"error": np.inf if each["error"] is None else each["error"]} for each in kept]
        (row,) = rows_of(found, "family", [name])
        runner.log(f"{name}, seed {seed}: " + ", ".join(f"{row[word]} {word}" for word in (*VERDICTS, REFUSED)))
        yield from found


def families_of(kind: str, chosen: str) -> list[str]:
    """Return families by their names, or those of a group that exist for the kind."""
    if chosen not in GROUPS:
        return runner.split_names(chosen, FAMILIES, "family")
    return [name for name in GROUPS[chosen] if kind == "human" or name not in OF_PEOPLE]


@runner.command
def main(
    kind: Annotated[str, Option(help=f"human, {', '.join(GENERATORS)}")] = "human",
    families: Annotated[str, Option(help=f"names, or one of {', '.join(GROUPS)}")] = "all",
    count: Annotated[int, Option(min=1, help="cases of each family")] = 10,
    output: Annotated[Path, Option(help="folder of results and of the chart")] = Path("verdicts"),
    fit: Annotated[bool, Option("--fit", help="also fit the weights of the features")] = False,
    threads: runner.Threads = 1,
    seed: runner.Seed = 1,
    seeds: Annotated[int, Option(min=1, help="number of seeds from --seed on, counted together")] = 1,
) -> runner.Report:
    names = families_of(kind, families)
    found: list[dict[str, Any]] = []
    for number in range(seed, seed + seeds):
        found += measure_seed(kind, names, count, number, threads, output)
    mapped = [each for each in found if each["verdict"] != REFUSED]
    steps, auc = calibration(mapped)
    bars, by_family, by_verdict = bars_of(found), rows_of(found, "family", names), rows_of(found, "verdict", VERDICTS)
    furthest = max(abs(row["near"] - row["confidence"]) for row in steps if "near" in row)
    shown = [row for row in steps if "near" in row]
    lines = {
        "measured": ([row["confidence"] for row in shown], [row["near"] for row in shown]),
        "ideal": ([0, 1], [0, 1]),
    }
    make_folder(output)
    draw_lines(lines, output / f"{kind}.png", "confidence", f"within {RIGHT_CM:g} cm", {})
    tables = [
        runner.table(
            f"{kind}: verdicts by family, {seeds} seeds from {seed} on", by_family, {"family": "of", **_COLUMNS}
        ),
        runner.table(
            "In all",
            [bars | {word: sum(row[word] for row in by_family) for word in ("maps", *VERDICTS)}],
            _TOTAL_COLUMNS,
        ),
        runner.table("By verdict", by_verdict, {"verdict": "of", **_COLUMNS}),
        runner.table("Confidence of vertices", steps, _CONFIDENCE_COLUMNS),
    ]
    notes = [f"confidence: AUC {auc:.3f}, furthest from the truth {furthest:.3f}"]
    record: dict[str, Any] = {"families": by_family, "verdicts": by_verdict, "confidence": steps, "auc": auc, **bars}
    if fit:
        near = None if kind == "human" else CALIBRATION
        weights, offset = fit_weights([each for each in found if each["family"] not in KEPT], near)
        record["weights"] = [round(float(value), 3) for value in weights] + [round(offset, 3)]
        fitted = Calibration(
            weights=tuple(record["weights"][:-1]),
            offset=record["weights"][-1],
            data=f"{count} cases of each family of {kind}: {families}",
            seeds=tuple(range(seed, seed + seeds)),
            date=f"{date.today()}",
        )
        notes.append(str(fitted))
    return runner.Report(record, tables, notes)
