"""Two shapes of any kind, matched without a model: hand-picked points of the SHREC'07 classes, and no pair left out.

Every ordered pair of six shapes of each class. The error is the mean distance along the target's edges between where the
keypoints of the source arrive and the target's own, in units of sqrt(area), times 100: the best of the symmetries that the
class has. Those are in its ``symmetry.txt``; where there is none, as of chairs, they are the turns and reflections of
its keypoints that most of its shapes have, and those that either shape of the pair has: a round table may be turned by
a leg. Of table 141 the points of two legs are exchanged against those of its top, unlike those of all other tables: they
are put back, and a last row says what the mean is as they are marked.

Bearings, cups and mechanical parts can turn in themselves, so that only their verdicts count: how many of those maps are
told, as ambiguous or poor, whose error is over 20.
"""

from __future__ import annotations

import os
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
TURNING = ("bearing", "cup", "mech")
SHAPES = 6  # of each class
OFF, FAR_OFF = 10.0, 20.0
_ACROSS, _SIZE = 3, (480, 340)  # pairs in a row of a picture, and pixels of each
# Of the keypoints' spread: how far a symmetry may miss them, at most and on average; one of most shapes, and one of a shape.
_ALIKE, _EXACTLY = (0.4, 0.2), (0.25, 0.08)
# Points that a shape has in another order than its class; of each point which one it is.
_PUT_BACK = {("table", "141"): {6: 10, 7: 11, 10: 6, 11: 7}}
_COLUMNS = {"class": "class", "pairs": "pairs:d", "mean": "mean:.1f", "median": "median:.1f", "under 10": "under:.0%"}
_COLUMNS |= {
    "good": "good:d",
    "good over 10": "good_over:d",
    "over 20": "far_off:d",
    "told": "told:d",
    "worst": "worst",
    "error": "worst_error:.1f",
    "CPU s": "cpu:.1f",
}
_BESIDE = {"method": "method", "pairs": "pairs:d", "failed": "failed:d", "mean": "mean:.1f", "median": "median:.1f"}
_BESIDE |= {"under 10": "under:.0%", "CPU s": "cpu:.1f"}
_HELD_OUT = {"maps": "maps", "pairs": "pairs:d", "under 10": "right:d", "good": "good:d", "good over 10": "good_over:d"}
_HELD_OUT |= {"under 10, good or fair": "right_not_poor:d"}


def folder_of(name: str, data: Path) -> Path:
    """Where the shapes of a class are."""
    return data / name if name in ("chair", "plane", "table") else data / "shrec07" / name


def shapes_of(folder: Path) -> list[str]:
    """Names of the first shapes of a class."""
    return sorted((file.stem for file in folder.glob("*.ply")), key=int)[:SHAPES]


@cache
def keypoints_of(folder: Path, shape: str, as_marked: bool = False) -> Int[Ints, " N"]:
    """The vertices of the keypoints, in the order of the class, or as the file has them."""
    found = np.load(folder / f"{shape}.keypoints.npy", allow_pickle=False).astype(np.int64)
    moved = {} if as_marked else _PUT_BACK.get((folder.name, shape), {})
    return np.array([found[moved.get(k, k)] for k in range(len(found))])


@cache
def distances(folder: Path, shape: str, as_marked: bool = False) -> Float[Floats, "N V"]:
    """From each keypoint to all vertices, along edges, in units of sqrt(area)."""
    mesh, points = load_shape(folder / f"{shape}.ply"), keypoints_of(folder, shape, as_marked)
    found = dijkstra(edge_graph(mesh), directed=False, indices=points) / np.sqrt(mesh.area)
    return np.asarray(np.where(np.isfinite(found), found, found[np.isfinite(found)].max()))


def symmetries(folder: Path, *shapes: str, as_marked: bool = False) -> list[Int[Ints, " N"]]:
    """Permutations of the keypoints that a class allows, or one of these shapes, the identity first."""
    plain = np.arange(len(keypoints_of(folder, shapes_of(folder)[0])))
    if not (folder / "symmetry.txt").exists():
        own = [each for shape in shapes for each in _of_positions(folder, shape, _EXACTLY, as_marked)]
        found = dict.fromkeys([tuple(plain.tolist()), *_of_most(folder, as_marked), *own])
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
def _of_positions(folder: Path, shape: str, most: tuple[float, float], as_marked: bool) -> frozenset[Symmetry]:
    """Turns and reflections in the axes of a shape's file that bring keypoints onto keypoints."""
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


def _of_most(folder: Path, as_marked: bool) -> list[Symmetry]:
    """The turns and reflections that half of the shapes have."""
    names = shapes_of(folder)
    votes = Counter(each for name in names for each in sorted(_of_positions(folder, name, _ALIKE, as_marked)))
    return [each for each, count in votes.items() if 2 * count >= len(names)]


def error_of(folder: Path, pair: tuple[str, str], index: Int[Ints, " V"], as_marked: bool = False) -> float:
    """Mean distance of where a map takes keypoints from where they belong, times 100; the best of the symmetries."""
    known, arrived = distances(folder, pair[1], as_marked), index[keypoints_of(folder, pair[0], as_marked)]
    return min(float(100 * known[each, arrived].mean()) for each in symmetries(folder, *pair, as_marked=as_marked))


def errors_of(folder: Path, pair: tuple[str, str], index: Int[Ints, " V"]) -> dict[str, float]:
    """The error, and that of the points as they are marked."""
    return {"error": error_of(folder, pair, index), "as_marked": error_of(folder, pair, index, as_marked=True)}


def measure(folder: Path, pair: tuple[str, str], model: str, seed: int) -> dict[str, Any]:
    """Error, verdict and cost of one pair; without a model and where both ways were tried, also what one gives alone."""
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


def judged(row: dict[str, Any]) -> dict[str, Any]:
    """A pair with the verdict that the weights of now give it, unless a finer fit has its own: a work folder may be of a
    run from which they were found."""
    if "energy" not in row or row.get("finer"):
        return row
    calibration = DIRECT_BOTH_WAYS if row["one_way"] else DIRECT
    verdict, _, reasons = judge_direct(row["energy"], row["leads"], calibration, row["turns"])
    if verdict == "good" and row["side_in_doubt"]:
        verdict = "fair"
    return {**row, "verdict": verdict, "ambiguous": any(reason.code == "ambiguous" for reason in reasons)}


def _row(folder: Path, pair: tuple[str, str], mapped: VertexMap) -> dict[str, Any]:
    return {
        "pair": " to ".join(pair),
        **errors_of(folder, pair, mapped.index),
        "verdict": mapped.verdict,
        "confidence": float(mapped.confidence.mean()),
        "ambiguous": any("ambiguous" in reason for reason in mapped.reasons),
    }


def measure_by(method: Method, folder: Path, pair: tuple[str, str]) -> dict[str, Any]:
    """Error and cost of another method on one pair; where it fails, of the map of everything to the first vertex."""
    source, target = (load_shape(folder / f"{name}.ply") for name in pair)
    began, failed = os.times(), False
    try:
        index = method.map(source, method.fit(source), target, method.fit(target)).index
    except InputError:
        index, failed = np.zeros(source.V, np.int64), True
    spent = sum(os.times()[:4]) - sum(began[:4])  # of this process, and of those that it began
    return {"pair": " to ".join(pair), **errors_of(folder, pair, index), "failed": failed, "cpu": spent}


def draw_worst(rows: Sequence[dict[str, Any]], path: Path, data: Path, matcher: Matcher) -> None:
    """The worst pair of each class, matched again, in one picture: the same colors where the map says the same place."""
    drawn = []
    with TemporaryDirectory() as folder:
        for row in runner.track(rows, "pictures"):
            source, target = (
                load_shape(folder_of(row["class"], data) / f"{name}.ply") for name in row["worst"].split(" to ")
            )
            result = matcher.match(source, target)
            names = f"{row['class']} {row['worst']}", f"{row['worst_error']:.1f}, {result.map.verdict}"
            shown = compose_match(source, target, result.map, result.rotations).named(names)
            shown.render(Path(folder) / "pair.png", Look(size=_SIZE))
            with Image.open(Path(folder) / "pair.png") as image:
                drawn.append(image.convert("RGB"))
    sheet = Image.new("RGB", (_ACROSS * _SIZE[0], -(-len(drawn) // _ACROSS) * _SIZE[1]), "white")
    for number, each in enumerate(drawn):
        sheet.paste(each, (number % _ACROSS * _SIZE[0], number // _ACROSS * _SIZE[1]))
    sheet.save(path)


_Found = Mapping[str, Sequence[dict[str, Any]]]  # pairs of each class


def _all(found: _Found) -> list[dict[str, Any]]:
    return [row for some in found.values() for row in some]


def fitted_calibration(found: Sequence[dict[str, Any]], most: float = 0.008, ridge: float = 0.01) -> DirectCalibration:
    """By logistic regression, with a little ridge, of maps without a model that are right and wrong."""
    right = np.array([each["error"] < OFF for each in found])
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


def held_out(found: _Found) -> dict[str, Any]:
    """How verdicts of each class come out by the weights that the other classes give."""
    counts = {"pairs": 0, "right": 0, "good": 0, "good_over": 0, "right_not_poor": 0}
    for name, own in found.items():
        others = [row for other, some in found.items() if other != name for row in some]
        calibration = fitted_calibration(others)
        for row in own:
            verdict = judge_direct(row["energy"], row["leads"], calibration, row["turns"])[0]
            right = row["error"] < OFF
            counts["pairs"] += 1
            counts["right"] += right
            counts["good"] += verdict == "good"
            counts["good_over"] += verdict == "good" and not right
            counts["right_not_poor"] += verdict != "poor" and right
    return counts


def _summary(errors: Float[Floats, " N"]) -> dict[str, Any]:
    mean, median, under = float(errors.mean()), float(np.median(errors)), float((errors < OFF).mean())
    return {"pairs": len(errors), "mean": mean, "median": median, "under": under}


def row_of(name: str, found: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The row of a class."""
    errors = np.array([each["error"] for each in found])
    good = np.array([each["verdict"] == "good" for each in found])
    far_off = errors > FAR_OFF
    told = far_off & np.array([each["ambiguous"] or each["verdict"] == "poor" for each in found])
    worst = int(errors.argmax())
    return {
        "class": name,
        **_summary(errors),
        "good": int(good.sum()),
        "good_over": int((good & (errors > OFF)).sum()),
        "far_off": int(far_off.sum()),
        "told": int(told.sum()),
        "worst": found[worst]["pair"],
        "worst_error": float(errors[worst]),
        "cpu": float(np.mean([each["cpu"] for each in found])),
    }


def _with_calibrations(report: runner.Report, found: _Found) -> runner.Report:
    """The weights of both verdicts, and how they do on classes that did not give them."""
    doubtful = {name: [row for row in some if row["one_way"]] for name, some in found.items()}
    one_way = {name: [row["one_way"] or row for row in some] for name, some in found.items()}
    fits = {"one way": one_way, "both ways, where one way leaves doubt": doubtful}
    rows = [{"maps": which, **held_out(each)} for which, each in fits.items()]
    table = runner.table("Verdicts by weights that other classes gave", rows, _HELD_OUT)
    return replace(
        report,
        record={**report.record, "held out": rows},
        tables=[*report.tables, table],
        notes=[*report.notes, *(f"{which}: {fitted_calibration(_all(each))}" for which, each in fits.items())],
    )


def _beside(
    found: _Found, methods: str, earlier: Path | None, limit: int, data: Path, work: Path | None, seed: int
) -> tuple[list[dict[str, Any]], list[str]]:
    """A row for each of some other methods on some pairs of each class, and for this one; and which could not run."""
    some = {name: runner.evenly_spread(rows, limit) for name, rows in found.items()}
    rows, missing = [{"method": "ours", "failed": 0, **_beside_row(_all(some))}], []
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
        rows.append({"method": baseline.label, "failed": failed, **_beside_row(measured)})
    return rows, missing


def _beside_row(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    cpu = float(np.mean([row["cpu"] for row in rows]))
    return {**_summary(np.array([row["error"] for row in rows])), "cpu": cpu}


@runner.command
def main(
    classes: Annotated[str, Option(help="names, with commas between them; or all")] = "all",
    limit_pairs: runner.LimitPairs = None,
    model: runner.Model = "none",
    seed: runner.Seed = 0,
    data: runner.Data = runner.DATA,
    work: runner.Work = None,
    fit: Annotated[bool, Option("--fit", help="also find the weights of verdicts")] = False,
    beside: Annotated[str, Option(help="methods of `bench.baselines` to measure too, with commas between them")] = "",
    earlier: Annotated[
        Path | None, Option(help="a checkout of an earlier version, to measure its `fit --model none`")
    ] = None,
    limit_beside: Annotated[int, Option(min=1, help="pairs of each class that they are measured on")] = 12,
    draw: Annotated[Path | None, Option(help="draw the worst pair of each class into this PNG")] = None,
) -> runner.Report:
    names = CLASSES if classes == "all" else runner.split_names(classes, (*CLASSES, *TURNING), "class")
    found: dict[str, list[dict[str, Any]]] = {}
    asked = {"model": model, "seed": seed}
    for name in names:
        folder = folder_of(name, data)
        pairs = runner.evenly_spread(list(permutations(shapes_of(folder), 2)), limit_pairs)
        found[name] = []
        for pair in runner.track(pairs, name):
            row = runner.cached_in(work, f"{name}-{'-'.join(pair)}", asked, partial(measure, folder, pair, model, seed))
            found[name].append(judged(row))
    everything = _all(found)
    rows = [*(row_of(name, some) for name, some in found.items()), row_of("all", everything)]
    if any(each["error"] != each["as_marked"] for each in everything):
        marked = [{**each, "error": each["as_marked"]} for each in everything]
        rows.append(row_of("all, as marked", marked))
    tables = [runner.table("Keypoints, x100 of sqrt(area)", rows, _COLUMNS)]
    record: dict[str, Any] = {"rows": rows, "pairs": everything}
    notes = list[str]()
    if beside or earlier is not None:
        record["beside"], notes = _beside(found, beside, earlier, limit_beside, data, work, seed)
        tables.append(
            runner.table(f"Beside other methods, {limit_beside} pairs of each class", record["beside"], _BESIDE)
        )
    if draw is not None:
        draw_worst(rows[: len(names)], draw, data, Matcher(model, FitConfig(seed=seed)))
    report = runner.Report(record, tables, notes)
    return _with_calibrations(report, found) if fit else report
