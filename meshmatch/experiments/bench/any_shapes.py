"""Matching any two shapes of a class without a model, measured at hand-picked keypoints of the SHREC'07 classes.

All ordered pairs of six shapes of each class are matched. The error is the mean distance, along the target's edges, between
the mapped keypoints of the source and those of the target, in units of sqrt(area), times 100; the smallest over the
symmetries of the class. These are read from its ``symmetry.txt``. A class without that file, such as chairs, has the
rotations and reflections of its keypoints that at least half of its shapes have, and those of either shape of the pair: a
round table may be turned by one leg. In table 141 the keypoints of two legs are exchanged with those of its top, unlike in
all other tables. They are corrected, and a last row gives the mean for the keypoints as marked.

Bearings, cups and mechanical parts are rotationally symmetric, so that only their verdicts count: how many of the maps
with an error over 20 are reported as ambiguous or poor.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import date
from functools import cache, partial
from itertools import permutations
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
from PIL import Image
from scipy.optimize import linear_sum_assignment, minimize
from scipy.sparse.csgraph import dijkstra
from scipy.spatial.transform import Rotation
from typer import Option

from meshmatch.api.inputs import repair_allowing_parts
from meshmatch.api.matcher import Matcher
from meshmatch.api.results import maps_of_fits
from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.errors import InputError
from meshmatch.experiments import runner
from meshmatch.experiments.bench.baselines import METHODS, Baseline, Choices
from meshmatch.experiments.bench.methods import EarlierVersion, Method
from meshmatch.fitting.direct import DirectMatch, match_either_side
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.judge.calibration import DIRECT, DIRECT_BOTH_WAYS, DirectCalibration
from meshmatch.fitting.judge.direct import judge_direct
from meshmatch.fitting.one_way import DirectConfig
from meshmatch.fitting.same_pose import refine_match
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.models.registry import NO_MODEL
from meshmatch.render.compose import compose_match
from meshmatch.render.picture import Look
from meshmatch.shapes.files import load_shape
from meshmatch.templates.make import edge_graph

CLASSES = (
    *("ant", "armadillo", "bird", "bust", "fish", "fourleg", "glasses", "hand", "human", "octopus", "plier", "teddy"),
    *("chair", "plane", "table"),
)
ROTATING_CLASSES = ("bearing", "cup", "mech")
SHAPES = 6  # per class
MAX_ERROR, LARGE_ERROR = 10.0, 20.0
_PAIRS_PER_ROW, _PAIR_SIZE = 3, (480, 340)  # pairs per row of the picture, and the size of each in pixels
# (maximum, mean) distance between keypoints and their images under a symmetry, as a fraction of the keypoints' RMS radius:
# for symmetries that most shapes of a class share, and for those of a single shape.
_CLASS_TOLERANCES, _SHAPE_TOLERANCES = (0.4, 0.2), (0.25, 0.08)
# Keypoints that a shape has in another order than its class: for each keypoint of the class, its index in the file.
_REORDERED_KEYPOINTS = {("table", "141"): {6: 10, 7: 11, 10: 6, 11: 7}}
_COLUMNS = {"class": "class", "pairs": "pairs:d", "mean": "mean:.1f", "median": "median:.1f", "under 10": "under:.0%"}
_COLUMNS |= {
    "good": "good:d",
    "good over 10": "good_over:d",
    "over 20": "far_off:d",
    "over 20 and flagged": "told:d",
    "worst": "worst",
    "error": "worst_error:.1f",
    "CPU s": "cpu:.1f",
}
_COMPARISON_COLUMNS = {
    "method": "method",
    "pairs": "pairs:d",
    "failed": "failed:d",
    "mean": "mean:.1f",
    "median": "median:.1f",
}
_COMPARISON_COLUMNS |= {"under 10": "under:.0%", "CPU s": "cpu:.1f"}
_HELD_OUT_COLUMNS = {
    "maps": "maps",
    "pairs": "pairs:d",
    "under 10": "right:d",
    "good": "good:d",
    "good over 10": "good_over:d",
}
_HELD_OUT_COLUMNS |= {"under 10, good or fair": "right_not_poor:d"}


def folder_of(name: str, data: Path) -> Path:
    """Return the folder of a class of shapes."""
    return data / name if name in ("chair", "plane", "table") else data / "shrec07" / name


def shapes_of(folder: Path) -> list[str]:
    """Return the names of the first `SHAPES` shapes of a class."""
    return sorted((file.stem for file in folder.glob("*.ply")), key=int)[:SHAPES]


@cache
def keypoints_of(folder: Path, shape: str, as_marked: bool = False) -> Int[Ints, " N"]:
    """Return the keypoints' vertices in the order of the class, or with ``as_marked`` in that of the file."""
    found = np.load(folder / f"{shape}.keypoints.npy", allow_pickle=False).astype(np.int64)
    moved = {} if as_marked else _REORDERED_KEYPOINTS.get((folder.name, shape), {})
    return np.array([found[moved.get(k, k)] for k in range(len(found))])


@cache
def distances(folder: Path, shape: str, as_marked: bool = False) -> Float[Floats, "N V"]:
    """Compute distances from each keypoint to all vertices, along edges, in units of sqrt(area)."""
    mesh, points = load_shape(folder / f"{shape}.ply"), keypoints_of(folder, shape, as_marked)
    found = dijkstra(edge_graph(mesh), directed=False, indices=points) / np.sqrt(mesh.area)
    return np.asarray(np.where(np.isfinite(found), found, found[np.isfinite(found)].max()))


def symmetries(folder: Path, *shapes: str, as_marked: bool = False) -> list[Int[Ints, " N"]]:
    """Return the permutations of the keypoints under the symmetries of a class or of one of ``shapes``, identity first."""
    plain = np.arange(len(keypoints_of(folder, shapes_of(folder)[0])))
    if not (folder / "symmetry.txt").exists():
        own = [each for shape in shapes for each in _shape_symmetries(folder, shape, _SHAPE_TOLERANCES, as_marked)]
        found = dict.fromkeys([tuple(plain.tolist()), *_common_symmetries(folder, as_marked), *own])
        return [np.array(each) for each in found]
    lines = (folder / "symmetry.txt").read_text().splitlines()
    orbits = [np.array(line.split(), np.int64) for line in lines if line.strip()]
    swapped = plain.copy()
    for a, b in (orbit for orbit in orbits if len(orbit) == 2):
        swapped[[a, b]] = b, a
    rings = [orbit for orbit in orbits if len(orbit) > 2]
    if not rings:
        return [plain, swapped]
    found_turns = []
    for start in range(len(rings[0])):
        for step in (1, -1):
            turned = plain.copy()
            for ring in rings:
                turned[ring] = ring[(start + step * np.arange(len(ring))) % len(ring)]
            found_turns.append(turned)
    return found_turns


Symmetry = tuple[int, ...]


@cache
def _shape_symmetries(folder: Path, shape: str, most: tuple[float, float], as_marked: bool) -> frozenset[Symmetry]:
    """Find the octahedral rotations and reflections, about the file's axes, that map keypoints onto keypoints."""
    octahedral = Rotation.create_group("O").as_matrix()
    points = load_shape(folder / f"{shape}.ply").verts[keypoints_of(folder, shape, as_marked)]
    points = points - points.mean(0)
    points /= np.sqrt(np.square(points).sum(1).mean())
    found = set()
    for motion in (sign * turn for turn in octahedral for sign in (1, -1)):
        apart = np.linalg.norm((points @ motion.T)[:, None] - points, axis=2)
        rows, columns = linear_sum_assignment(apart)
        missed = apart[rows, columns]
        if missed.max() < most[0] and missed.mean() < most[1]:
            found.add(tuple(columns.tolist()))
    return frozenset(found)


def _common_symmetries(folder: Path, as_marked: bool) -> list[Symmetry]:
    """Find the rotations and reflections that at least half of the shapes of a class have."""
    names = shapes_of(folder)
    votes = Counter(
        each for name in names for each in sorted(_shape_symmetries(folder, name, _CLASS_TOLERANCES, as_marked))
    )
    return [each for each, count in votes.items() if 2 * count >= len(names)]


def error_of(folder: Path, pair: tuple[str, str], index: Int[Ints, " V"], as_marked: bool = False) -> float:
    """Compute the mean distance of mapped keypoints from the true ones, times 100; the smallest over the symmetries."""
    known, arrived = distances(folder, pair[1], as_marked), index[keypoints_of(folder, pair[0], as_marked)]
    return min(float(100 * known[each, arrived].mean()) for each in symmetries(folder, *pair, as_marked=as_marked))


def errors_of(folder: Path, pair: tuple[str, str], index: Int[Ints, " V"]) -> dict[str, float]:
    """Return the error, and the error for the keypoints as they are marked in the files."""
    return {"error": error_of(folder, pair, index), "as_marked": error_of(folder, pair, index, as_marked=True)}


def measure(folder: Path, pair: tuple[str, str], model: str, seed: int) -> dict[str, Any]:
    """Measure error, verdict and cost of one pair.

    Without a model, ``one_way`` has the result of matching in one direction where both were tried.
    """
    source, target = (load_shape(folder / f"{name}.ply") for name in pair)
    began = time.process_time()
    if model != NO_MODEL:
        mapped = Matcher(model, FitConfig(seed=seed), threads=1).match(source, target).map
        return _row(folder, pair, mapped) | {"cpu": time.process_time() - began}
    clean = repair_allowing_parts(source), repair_allowing_parts(target)

    def row(found: DirectMatch) -> dict[str, Any]:
        fits = replace(found.source, repaired=clean[0]), replace(found.target, repaired=clean[1])
        return _row(folder, pair, maps_of_fits(fits, fits, 1)[0]) | {
            "energy": found.energy,
            "leads": found.leads,
            "turns": found.turns,
            "side_in_doubt": any(reason.code == "side" for reason in found.reasons),
        }

    shapes = clean[0].shape, clean[1].shape
    roughly = match_either_side(*shapes, DirectConfig(seed=seed))
    found = refine_match(*shapes, roughly, FitConfig(seed=seed))
    best = row(found) | {"cpu": time.process_time() - began, "finer": found.reasons != roughly.reasons}
    return best | {"one_way": None if found.before is None else row(found.before)}


def judge_again(row: dict[str, Any]) -> dict[str, Any]:
    """Replace a pair's verdict by that of the current calibration, which may be newer than the pairs in a work folder.

    Pairs that a refined fit judged keep their verdict.
    """
    if "energy" not in row or row.get("finer"):
        return row
    calibration = DIRECT_BOTH_WAYS if row["one_way"] else DIRECT
    verdict, _, reasons = judge_direct(row["energy"], row["leads"], calibration, row["turns"])
    if verdict == "good" and row["side_in_doubt"]:
        verdict = "fair"
    return {**row, "verdict": verdict, "ambiguous": any(reason.code == "ambiguous" for reason in reasons)}


def _row(folder: Path, pair: tuple[str, str], mapped: VertexMap) -> dict[str, Any]:
    """Return the record of a mapped pair."""
    return {
        "pair": " to ".join(pair),
        **errors_of(folder, pair, mapped.index),
        "verdict": mapped.verdict,
        "confidence": float(mapped.confidence.mean()),
        "ambiguous": any("ambiguous" in reason for reason in mapped.reasons),
    }


def measure_by(method: Method, folder: Path, pair: tuple[str, str]) -> dict[str, Any]:
    """Measure error and cost of another method on one pair; a failure counts as the map of everything to vertex 0."""
    source, target = (load_shape(folder / f"{name}.ply") for name in pair)
    began, failed = runner.cpu_seconds(), False
    try:
        index = method.map(source, method.fit(source), target, method.fit(target)).index
    except InputError:
        index, failed = np.zeros(source.V, np.int64), True
    spent = runner.cpu_seconds() - began
    return {"pair": " to ".join(pair), **errors_of(folder, pair, index), "failed": failed, "cpu": spent}


def draw_worst(rows: Sequence[dict[str, Any]], path: Path, data: Path, matcher: Matcher) -> None:
    """Match the worst pair of each class again, and draw all in one picture; corresponding points share a color."""
    drawn = []
    with TemporaryDirectory() as folder:
        for row in runner.track(rows, "pictures"):
            source, target = (
                load_shape(folder_of(row["class"], data) / f"{name}.ply") for name in row["worst"].split(" to ")
            )
            result = matcher.match(source, target)
            names = f"{row['class']} {row['worst']}", f"{row['worst_error']:.1f}, {result.map.verdict}"
            shown = compose_match(source, target, result.map, result.rotations).named(names)
            shown.render(Path(folder) / "pair.png", Look(size=_PAIR_SIZE))
            with Image.open(Path(folder) / "pair.png") as image:
                drawn.append(image.convert("RGB"))
    sheet = Image.new(
        "RGB", (_PAIRS_PER_ROW * _PAIR_SIZE[0], -(-len(drawn) // _PAIRS_PER_ROW) * _PAIR_SIZE[1]), "white"
    )
    for number, each in enumerate(drawn):
        sheet.paste(each, (number % _PAIRS_PER_ROW * _PAIR_SIZE[0], number // _PAIRS_PER_ROW * _PAIR_SIZE[1]))
    sheet.save(path)


_Found = Mapping[str, Sequence[dict[str, Any]]]  # measured pairs by class


def _all_rows(found: _Found) -> list[dict[str, Any]]:
    """Concatenate the rows of all classes."""
    return [row for some in found.values() for row in some]


def fit_calibration(found: Sequence[dict[str, Any]], most: float = 0.008, ridge: float = 0.01) -> DirectCalibration:
    """Fit the calibration by logistic regression on right and wrong maps made without a model.

    ``most`` caps the leads, and ``ridge`` weighs the L2 penalty on the weights.
    """
    right = np.array([each["error"] < MAX_ERROR for each in found])
    values = np.array([[-each["energy"], min([most, *each["leads"]])] for each in found])
    deviation = values.std(0) + 1e-9

    def loss(p: Floats) -> float:
        costs = np.logaddexp(0.0, np.where(right, -1.0, 1.0) * (values / deviation @ p[1:] + p[0]))
        return float(costs.mean() + ridge * np.square(p[1:]).sum())

    offset, *weights = minimize(loss, np.zeros(3), method="L-BFGS-B").x
    energy, lead = (float(weight) for weight in weights / deviation)
    data = f"{len(found)} pairs of experiments.bench.any_shapes, of which {int(right.sum())} are right"
    today = date.today().isoformat()
    return DirectCalibration(offset=float(offset), energy=energy, lead=lead, most=most, data=data, date=today)


def cross_validate(found: _Found) -> dict[str, Any]:
    """Count verdicts by leave-one-class-out cross-validation: each class is judged by weights fitted to the others."""
    counts = {"pairs": 0, "right": 0, "good": 0, "good_over": 0, "right_not_poor": 0}
    for name, own in found.items():
        others = [row for other, some in found.items() if other != name for row in some]
        calibration = fit_calibration(others)
        for row in own:
            verdict = judge_direct(row["energy"], row["leads"], calibration, row["turns"])[0]
            right = row["error"] < MAX_ERROR
            counts["pairs"] += 1
            counts["right"] += right
            counts["good"] += verdict == "good"
            counts["good_over"] += verdict == "good" and not right
            counts["right_not_poor"] += verdict != "poor" and right
    return counts


def _summary(errors: Float[Floats, " N"]) -> dict[str, Any]:
    """Summarise errors: number of pairs, mean, median and share under `MAX_ERROR`."""
    mean, median, under = float(errors.mean()), float(np.median(errors)), float((errors < MAX_ERROR).mean())
    return {"pairs": len(errors), "mean": mean, "median": median, "under": under}


def row_of(name: str, found: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the table row of a class."""
    errors = np.array([each["error"] for each in found])
    good = np.array([each["verdict"] == "good" for each in found])
    far_off = errors > LARGE_ERROR
    flagged = far_off & np.array([each["ambiguous"] or each["verdict"] == "poor" for each in found])
    worst = int(errors.argmax())
    return {
        "class": name,
        **_summary(errors),
        "good": int(good.sum()),
        "good_over": int((good & (errors > MAX_ERROR)).sum()),
        "far_off": int(far_off.sum()),
        "told": int(flagged.sum()),
        "worst": found[worst]["pair"],
        "worst_error": float(errors[worst]),
        "cpu": float(np.mean([each["cpu"] for each in found])),
    }


def _with_calibrations(report: runner.Report, found: _Found) -> runner.Report:
    """Add to a report the fitted weights of one-way and two-way matches, and their leave-one-class-out counts."""
    doubtful = {name: [row for row in some if row["one_way"]] for name, some in found.items()}
    one_way = {name: [row["one_way"] or row for row in some] for name, some in found.items()}
    fits = {"one way": one_way, "both ways, where one way leaves doubt": doubtful}
    rows = [{"maps": which, **cross_validate(each)} for which, each in fits.items()]
    table = runner.table("Verdicts by weights that other classes gave", rows, _HELD_OUT_COLUMNS)
    return replace(
        report,
        record={**report.record, "held out": rows},
        tables=[*report.tables, table],
        notes=[*report.notes, *(f"{which}: {fit_calibration(_all_rows(each))}" for which, each in fits.items())],
    )


def _compare_methods(
    found: _Found, methods: str, earlier: Path | None, limit: int, data: Path, work: Path | None, seed: int
) -> tuple[list[dict[str, Any]], list[str]]:
    """Compare with other methods on ``limit`` pairs of each class.

    Return a row for each method, this one first, and notes on the methods that could not run.
    """
    some = {name: runner.evenly_spread(rows, limit) for name, rows in found.items()}
    rows, missing = [{"method": "ours", "failed": 0, **_comparison_row(_all_rows(some))}], []
    others = {name: METHODS[name](Choices(seed=seed))[0] for name in runner.split_names(methods, METHODS, "method")}
    if earlier is not None:
        label = f"fit --model none of {runner.commit(earlier)}"
        others["earlier"] = Baseline("earlier", label, EarlierVersion(earlier))
    for name, baseline in others.items():
        if baseline.method is None:
            missing.append(f"skipped: {baseline.label}: {baseline.missing}")
            continue
        measured = []
        for kind, own in some.items():
            folder = folder_of(kind, data)
            for pair in runner.track([row["pair"] for row in own], f"{name}, {kind}"):
                first, _, second = pair.partition(" to ")
                call = partial(measure_by, baseline.method, folder, (first, second))
                asked = {"method": name, "seed": seed}
                measured.append(runner.cached_in(work, f"{kind}-{first}-{second}-{name}", asked, call))
        failed = sum(row["failed"] for row in measured)
        rows.append({"method": baseline.label, "failed": failed, **_comparison_row(measured)})
    return rows, missing


def _comparison_row(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    cpu = float(np.mean([row["cpu"] for row in rows]))
    return {**_summary(np.array([row["error"] for row in rows])), "cpu": cpu}


@runner.command
def main(
    classes: Annotated[str, Option(help="comma-separated names, or all")] = "all",
    limit_pairs: runner.LimitPairs = None,
    model: runner.Model = "none",
    seed: runner.Seed = 0,
    data: runner.Data = runner.DATA,
    work: runner.Work = None,
    fit: Annotated[bool, Option("--fit", help="also fit the weights of verdicts")] = False,
    beside: Annotated[str, Option(help="methods of `bench.baselines` to measure too, comma-separated")] = "",
    earlier: Annotated[
        Path | None, Option(help="a checkout of an earlier version, to measure its `fit --model none`")
    ] = None,
    limit_beside: Annotated[int, Option(min=1, help="pairs of each class to measure these methods on")] = 12,
    draw: Annotated[Path | None, Option(help="draw the worst pair of each class into this PNG")] = None,
) -> runner.Report:
    names = CLASSES if classes == "all" else runner.split_names(classes, (*CLASSES, *ROTATING_CLASSES), "class")
    found: dict[str, list[dict[str, Any]]] = {}
    asked = {"model": model, "seed": seed}
    for name in names:
        folder = folder_of(name, data)
        pairs = runner.evenly_spread(list(permutations(shapes_of(folder), 2)), limit_pairs)
        found[name] = []
        for pair in runner.track(pairs, name):
            row = runner.cached_in(work, f"{name}-{'-'.join(pair)}", asked, partial(measure, folder, pair, model, seed))
            found[name].append(judge_again(row))
    everything = _all_rows(found)
    rows = [*(row_of(name, some) for name, some in found.items()), row_of("all", everything)]
    if any(each["error"] != each["as_marked"] for each in everything):
        marked = [{**each, "error": each["as_marked"]} for each in everything]
        rows.append(row_of("all, as marked", marked))
    tables = [runner.table("Keypoints, x100 of sqrt(area)", rows, _COLUMNS)]
    record: dict[str, Any] = {"rows": rows, "pairs": everything}
    notes = list[str]()
    if beside or earlier is not None:
        record["beside"], notes = _compare_methods(found, beside, earlier, limit_beside, data, work, seed)
        tables.append(
            runner.table(f"Other methods, {limit_beside} pairs of each class", record["beside"], _COMPARISON_COLUMNS)
        )
    if draw is not None:
        draw_worst(rows[: len(names)], draw, data, Matcher(model, FitConfig(seed=seed)))
    report = runner.Report(record, tables, notes)
    return _with_calibrations(report, found) if fit else report
