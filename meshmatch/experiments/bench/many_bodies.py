"""What fits cost where there are thousands, and what `FitConfig.quick` gives up.

Generated people whom no training drew, in its poses, with all vertices of the body model, decimated to about 7,000 and
turned anywhere, are fitted by `Matcher.fit_all`, fifty at a time, with all of the search and with less of it. The error is
the mean distance between the fitted template's vertices and where they belong, in centimetres of a person of 1.9 m2. CPU
seconds are those of all threads; drawing bodies is not counted.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Annotated, Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from typer import Option

from meshmatch.api.matcher import Matcher
from meshmatch.arrays import Float, Floats
from meshmatch.experiments import runner
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.generators.bodies import sample_bodies
from meshmatch.generators.rig import cached_rig
from meshmatch.geometry.trees import cKDTree
from meshmatch.maps.evaluate import CM_PER_UNIT
from meshmatch.shapes.decimate import decimate
from meshmatch.shapes.shape import Shape
from meshmatch.templates.template import Template, read_template

VERTICES = 7_000
OFF_CM = 8.0
_AT_ONCE = 50
_PEOPLE = 64
_COLUMNS = {"search": "search", "bodies": "bodies:d", "CPU s a body": "cpu:.3f", "s a body": "wall:.3f"}
_COLUMNS |= {"mean cm": "mean:.2f", "median": "median:.2f", "over 8 cm": "off:.1%", "good": "good:d", "fair": "fair:d"}
_COLUMNS |= {"poor": "poor:d"}

Body = tuple[Shape, Float[Floats, "V 3"]]
"""A shape, and where the template's vertices belong on it."""


def bodies(template: Template, count: int, seed: int) -> Iterator[list[Body]]:
    """Fifty at a time; each a function of the seed and its number."""
    dense = template.dense
    own = cKDTree(dense.verts).query(template.shape.verts)[1]
    rig = cached_rig(_PEOPLE, 1_000 + seed).restricted(np.arange(dense.V), np.array(dense.faces))
    generator = torch.Generator().manual_seed(seed)
    for first in range(0, count, _AT_ONCE):
        drawn = sample_bodies(rig, min(_AT_ONCE, count - first), generator).double().numpy()
        turns = Rotation.random(len(drawn), rng=np.random.default_rng([seed, first])).as_matrix()
        places = np.einsum("bvi,bji->bvj", drawn, turns)
        yield [(decimate(Shape(each, dense.faces), 2 * VERTICES), each[own]) for each in places]


def error_of(fit: Fit, places: Float[Floats, "V 3"], template: Template) -> float:
    """In centimetres."""
    unit = CM_PER_UNIT / np.sqrt(Shape(places, template.shape.faces).area)
    return float(unit * np.linalg.norm(fit.points_in_file - places, axis=1).mean())


def row_of(search: str, fits: Sequence[tuple[float, str]], cpu: float, wall: float) -> dict[str, Any]:
    """A row of the table, of errors and verdicts."""
    errors, count = [error for error, _ in fits], len(fits)
    counts = Counter(verdict for _, verdict in fits)
    row = {"search": search, "bodies": count, "cpu": cpu / count, "wall": wall / count}
    row |= {"mean": float(np.mean(errors)), "median": float(np.median(errors))}
    return row | {
        "off": float(np.mean(np.array(errors) > OFF_CM)),
        **{each: counts[each] for each in ("good", "fair", "poor")},
    }


@runner.command
def main(
    count: Annotated[int, Option("--bodies", min=1, help="how many")] = 1000,
    threads: runner.Threads = 1,
    seed: runner.Seed = 0,
) -> runner.Report:
    template = read_template("human-T")
    searches = {"all": FitConfig(seed=seed), "quick": FitConfig.quick(seed=seed)}
    matchers = {name: Matcher("human", config, threads) for name, config in searches.items()}
    found: dict[str, list[tuple[float, str]]] = {name: [] for name in matchers}
    cpu, wall = dict.fromkeys(matchers, 0.0), dict.fromkeys(matchers, 0.0)
    for number, some in enumerate(runner.track(bodies(template, count, seed), "bodies", -(-count // _AT_ONCE))):
        for name, matcher in matchers.items():
            if number == 0:
                matcher.fit(some[0][0])  # the model is loaded
            began, worked = time.perf_counter(), time.process_time()
            fits = matcher.fit_all([shape for shape, _ in some])
            cpu[name] += time.process_time() - worked
            wall[name] += time.perf_counter() - began
            found[name] += [
                (error_of(fit, places, template), fit.verdict) for fit, (_, places) in zip(fits, some, strict=True)
            ]
    rows = [row_of(name, each, cpu[name], wall[name]) for name, each in found.items()]
    return runner.Report({"rows": rows}, [runner.table(f"{count} people of {VERTICES} vertices", rows, _COLUMNS)])
