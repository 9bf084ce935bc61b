"""Cost of fitting thousands of bodies, and the loss of accuracy by `FitConfig.quick`.

Generated people that training did not use, in poses of the training distribution, with all vertices of the body model, are
decimated to about 7,000 vertices and rotated at random. They are fitted by `Matcher.fit_all`, fifty at a time, with the
full search and the quick one. The error is the mean distance between the fitted template's vertices and their true
positions, in centimetres for a person of 1.9 m2. CPU seconds are those of all threads; generating bodies is not counted.
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
_BATCH = 50
_N_IDENTITIES = 64
_COLUMNS = {"search": "search", "bodies": "bodies:d", "CPU s a body": "cpu:.3f", "s a body": "wall:.3f"}
_COLUMNS |= {"mean cm": "mean:.2f", "median": "median:.2f", "over 8 cm": "off:.1%", "good": "good:d", "fair": "fair:d"}
_COLUMNS |= {"poor": "poor:d"}

Body = tuple[Shape, Float[Floats, "V 3"]]
"""A shape, and the true positions of the template's vertices on it."""


def bodies(template: Template, count: int, seed: int) -> Iterator[list[Body]]:
    """Generate bodies in batches of fifty."""
    dense = template.dense
    own = cKDTree(dense.verts).query(template.shape.verts)[1]
    rig = cached_rig(_N_IDENTITIES, 1_000 + seed).restricted(np.arange(dense.V), np.array(dense.faces))
    generator = torch.Generator().manual_seed(seed)
    for first in range(0, count, _BATCH):
        drawn = sample_bodies(rig, min(_BATCH, count - first), generator).double().numpy()
        turns = Rotation.random(len(drawn), rng=np.random.default_rng([seed, first])).as_matrix()
        places = np.einsum("bvi,bji->bvj", drawn, turns)
        yield [(decimate(Shape(each, dense.faces), 2 * VERTICES), each[own]) for each in places]


def error_of(fit: Fit, places: Float[Floats, "V 3"], template: Template) -> float:
    """Compute the mean error of a fit in centimetres."""
    unit = CM_PER_UNIT / np.sqrt(Shape(places, template.shape.faces).area)
    return float(unit * np.linalg.norm(fit.points_in_file - places, axis=1).mean())


def row_of(search: str, fits: Sequence[tuple[float, str]], cpu: float, wall: float) -> dict[str, Any]:
    """Compute a table row from the (error, verdict) of each fit."""
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
    count: Annotated[int, Option("--bodies", min=1, help="number of bodies")] = 1000,
    threads: runner.Threads = 1,
    seed: runner.Seed = 0,
) -> runner.Report:
    template = read_template("human-T")
    searches = {"all": FitConfig(seed=seed), "quick": FitConfig.quick(seed=seed)}
    matchers = {name: Matcher("human", config, threads) for name, config in searches.items()}
    found: dict[str, list[tuple[float, str]]] = {name: [] for name in matchers}
    cpu, wall = dict.fromkeys(matchers, 0.0), dict.fromkeys(matchers, 0.0)
    for number, some in enumerate(runner.track(bodies(template, count, seed), "bodies", -(-count // _BATCH))):
        for name, matcher in matchers.items():
            if number == 0:
                matcher.fit(some[0][0])  # warm-up: loads the model
            began, worked = time.perf_counter(), time.process_time()
            fits = matcher.fit_all([shape for shape, _ in some])
            cpu[name] += time.process_time() - worked
            wall[name] += time.perf_counter() - began
            found[name] += [
                (error_of(fit, places, template), fit.verdict) for fit, (_, places) in zip(fits, some, strict=True)
            ]
    rows = [row_of(name, each, cpu[name], wall[name]) for name, each in found.items()]
    return runner.Report({"rows": rows}, [runner.table(f"{count} people of {VERTICES} vertices", rows, _COLUMNS)])
