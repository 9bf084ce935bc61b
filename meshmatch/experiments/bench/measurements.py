"""Repeatability of body measurements over poses: `meshmatch measure body` on scans of the same people.

The girth of a thigh is nearly the same in every pose, but for muscles and skin, so that the spread over the poses of one
person bounds the errors of maps. The effect of the poses themselves is given for comparison: the same lines, transferred
from the first pose of each person to the others by the true correspondences, which are rounded to vertices. Shoulders and
bent hands really change.

Values are in centimetres, on bodies scaled to 1.9 square metres of skin. A spread is the standard deviation within a
person over poses, pooled over people and over left and right.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Any

import numpy as np
from typer import Option

import meshmatch
from meshmatch.api.measure import BODY, measuring_points
from meshmatch.arrays import Float, Floats
from meshmatch.experiments import runner
from meshmatch.experiments.bench.sets import BenchSet, load_set
from meshmatch.geometry.trees import cKDTree
from meshmatch.maps.evaluate import CM_PER_UNIT
from meshmatch.transfer.landmarks import push_landmarks

COLUMNS = {
    "measurement": "measurement", "people": "people", "scans": "scans", "missing": "missing", "mean cm": "mean:.1f",
    "spread cm": "spread:.2f", "%": "percent:.1f", "worst cm": "worst:.1f", "true correspondences cm": "true:.2f",
}  # fmt: skip


def people_of(name: str, shapes: Iterable[str]) -> dict[str, list[str]]:
    """Group shapes by person: SCAPE has one person, FAUST ten consecutive numbers for each."""
    found: dict[str, list[str]] = {}
    for shape in shapes:
        found.setdefault(name if name == "scape" else f"{name} {int(shape.removeprefix('tr_reg_')) // 10}", []).append(
            shape
        )
    return found


def measure_person(
    bench: BenchSet, shapes: list[str], matcher: meshmatch.Matcher, body: meshmatch.Fit
) -> list[list[Floats]]:
    """Measure each shape of a person; (2, N): by `measure`, and by true correspondences from the first shape."""
    points, found = measuring_points(BODY), []
    first = bench.shape(shapes[0])
    places = None
    for name in runner.track(shapes, f"people of {bench.name}"):
        shape = bench.shape(name)
        forward = matcher.map(body, matcher.fit(shape))
        here = push_landmarks(forward, points.shape, shape, points.points)
        places = here if places is None else places
        rows = cKDTree(first.verts[bench.landmarks(shapes[0])]).query(first.verts)[1]
        true = meshmatch.VertexMap.between(first, shape, bench.landmarks(name)[rows])
        scale = CM_PER_UNIT / np.sqrt(shape.area)
        there = push_landmarks(true, first, shape, places)
        found.append([scale * points.taken(each, least).values for each, least in ((here, 0.3), (there, 0.0))])
    return found


def _without_side(measurement: str) -> str:
    """Remove the side from the name of a measurement."""
    return measurement.removeprefix("left ").removeprefix("right ")


def _spread(people: list[Float[Floats, "S M"]]) -> float:
    """Pooled standard deviation within people; nan if no measurement was taken twice."""
    apart = [values - np.nanmean(values, axis=0) for values in people]
    free = sum(int((np.isfinite(each).sum(axis=0) - 1).sum()) for each in apart)
    return float(np.sqrt(sum(float(np.nansum(each**2)) for each in apart) / free)) if free else np.nan


def _taken_columns(values: Float[Floats, "S M"]) -> Float[Floats, "S N"]:
    """Select the measurements that were taken of a person at least once."""
    return np.asarray(values[:, np.isfinite(values).any(axis=0)])


def _row(name: str, people: list[Float[Floats, "S 2 M"]]) -> dict[str, Any]:
    """Compute a table row from S scans per person and the M sides of a measurement, by maps and by true correspondences."""
    missing = int(sum(np.isnan(values[:, 0]).sum() for values in people))
    ours, true = ([_taken_columns(values[:, k]) for values in people] for k in range(2))
    mean = float(np.nanmean(np.concatenate([each.ravel() for each in ours])))
    spread = _spread(ours)
    return {
        "measurement": name,
        "people": len(people),
        "scans": sum(map(len, people)),
        "missing": missing,
        "mean": mean,
        "spread": spread,
        "percent": 100 * spread / mean,
        "worst": float(
            max((np.nanmax(np.abs(each - np.nanmedian(each, axis=0))) for each in ours if each.size), default=np.nan)
        ),
        "true": _spread(true),
    }


@runner.command
def main(
    data: runner.Data = runner.DATA,
    sets: Annotated[str, Option(help="of faust, scape")] = "faust,scape",
    limit_shapes: Annotated[int | None, Option(min=2, help="scans of each person, evenly spread")] = None,
    threads: runner.Threads = 1,
) -> runner.Report:
    matcher, points = meshmatch.Matcher("human"), measuring_points(BODY)
    body = matcher.fit(points.shape)
    names = [each.name for each in points.measurements]
    rows: list[dict[str, Any]] = []
    for name in runner.split_names(sets, ("faust", "scape"), "set"):
        bench = load_set(name, data)
        people = [
            np.array(measure_person(bench, runner.evenly_spread(own, limit_shapes), matcher, body))
            for own in people_of(name, bench.shapes).values()
        ]
        for each in dict.fromkeys(map(_without_side, names)):
            own = [k for k, full in enumerate(names) if _without_side(full) == each]
            rows.append({"set": name} | _row(each, [values[:, :, own] for values in people]))
    tables = [
        runner.table(f"Measurements of the people of {name}", [row for row in rows if row["set"] == name], COLUMNS)
        for name in dict.fromkeys(row["set"] for row in rows)
    ]
    return runner.Report({"rows": rows}, tables)
