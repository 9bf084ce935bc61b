"""Parts matched to wholes.

Each source is one of two parts of a shape of the benchmark, the target another whole shape:

- view: the faces that a camera far away sees, by ray casting; a random direction for each source;
- cut: what lies on one side of a plane across a random direction, between half and 90 % of the faces.

Errors are geodesic, in centimeters at 1.9 m2 of skin, at the source's landmarks that are left; their mean is over pairs.
How well the map knows where it is wrong: the area under the curve (AUC) of confidence telling errors below 15 cm from
those above; 0.5 is guessing. --partial auto is what `meshmatch match` does, no is without fits of parts.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache as remembered
from functools import partial as bound
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import numpy as np
from typer import Option

from meshmatch.api.inputs import as_model
from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints
from meshmatch.experiments import runner
from meshmatch.experiments.bench.methods import OurMethod
from meshmatch.experiments.bench.scores import TruthDistances, area_under_curve, joined_errors, summary
from meshmatch.experiments.bench.sets import SET_NAMES, BenchSet, load_set
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import Partial
from meshmatch.geometry.triangles import normalized
from meshmatch.maps.evaluate import LOST_CM, Errors
from meshmatch.render.scene import Scene
from meshmatch.render.surface import Surface, face_paint
from meshmatch.shapes.shape import Shape

Kind = Literal["view", "cut"]
KINDS: tuple[Kind, ...] = get_args(Kind)
_LEFT = (0.5, 0.9)  # share of the faces that a cut leaves, at least and at most
COLUMNS = {
    **{"set": "set", "part": "part", "pairs": "pairs", "mean": "mean_cm:.2f", "median": "median_cm:.2f"},
    **{"median pair": "median_pair_cm:.2f", f"over {LOST_CM:g} cm": "share_over_15cm:.1%"},
    **{"AUC": "auc:.2f", "taken for parts": "taken_for_parts:.0%"},
}


def part_of(shape: Shape, kind: Kind, seed: int) -> tuple[Shape, Int[Ints, " V_part"]]:
    """A part of a mesh, and which of its vertices are left, in their order."""
    rng = np.random.default_rng(seed)
    direction = rng.standard_normal(3)
    direction /= np.linalg.norm(direction)
    centers = shape.verts[shape.faces].mean(axis=1)
    if kind == "cut":
        height = centers @ direction
        keep = height >= np.quantile(height, 1 - rng.uniform(*_LEFT))
    else:
        keep = seen_faces(shape, centers, direction)
    used = np.unique(shape.faces[keep])
    return Shape(shape.verts[used], np.searchsorted(used, shape.faces[keep]), shape.name), used


def seen_faces(shape: Shape, centers: Float[Floats, "F 3"], direction: Float[Floats, " 3"]) -> Bool[Bools, " F"]:
    """Whether a camera far away in a direction sees the middle of each face."""
    facing = normalized(shape.face_vectors) @ direction > 0
    white = face_paint(np.ones((shape.F, 3)))
    scene = Scene([Surface(shape.verts, shape.faces, np.zeros_like(shape.verts), white)])
    lifted = (centers + 1e-4 * shape.diagonal * normalized(shape.face_vectors)).astype(np.float32)
    towards = np.broadcast_to(direction.astype(np.float32), lifted.shape)
    return np.asarray(facing & ~scene.blocked(lifted, towards, 2 * shape.diagonal))


def measure(
    bench: BenchSet,
    kind: Kind,
    whole: OurMethod,
    part: OurMethod,
    limit: int | None,
    cache: Path | None,
    work: Path | None,
    asked: Mapping[str, Any],
) -> dict[str, Any]:
    """Errors of ``limit`` pairs, evenly spread; every pair counts. ``part`` fits the sources, ``whole`` the targets.

    Distances are kept in ``cache``, and finished pairs in ``work``, with what was ``asked`` for.
    """

    @remembered
    def fit_of(target: str) -> Fit:
        return whole.fit(bench.shape(target))

    @remembered
    def piece_of(source: str) -> tuple[Shape, Ints, Fit]:
        piece, used = part_of(bench.shape(source), kind, whole.seed + bench.shapes.index(source))
        return piece, used, part.fit(piece)

    def matched(source: str, target: str) -> dict[str, Any]:
        piece, used, fit = piece_of(source)
        found = whole.map(piece, fit, bench.shape(target), fit_of(target))
        landmarks = bench.landmarks(source)
        left = np.flatnonzero(np.isin(landmarks, used))
        at = np.searchsorted(used, landmarks[left])
        answers = bench.landmarks(target).copy()
        answers[left] = found.index[at]
        truth = TruthDistances(bench.shape(target), bench.landmarks(target), cache)
        errors = truth.errors([answers])[0][left]
        return {"errors": errors, "confidence": found.assumed_confidence[at], "partial": fit.partial}

    pairs = runner.evenly_spread(bench.pairs, limit)
    results = [
        runner.cached_in(work, f"{bench.name}-{kind}-{source}-{target}", asked, bound(matched, source, target))
        for source, target in runner.track(pairs, f"{bench.name}: {kind}")
    ]
    errors = [Errors(np.array(each["errors"])) for each in results]
    taken = {source: each["partial"] for (source, _), each in zip(pairs, results, strict=True)}
    joined = joined_errors(errors)
    return {
        "set": bench.name,
        "part": kind,
        "pairs": f"{len(pairs)} of {len(bench.pairs)}",
        **summary(errors),
        "mean_cm": float(np.mean([each.mean_cm for each in errors])),
        "auc": area_under_curve(np.concatenate([each["confidence"] for each in results]), joined.cm <= LOST_CM),
        "taken_for_parts": sum(taken.values()) / len(taken),
    }


@runner.command
def main(
    sets: Annotated[str, Option(help=f"of {', '.join(SET_NAMES)}")] = "scape,shrec19",
    limit_pairs: Annotated[int, Option(min=1, help="pairs of each set, evenly spread")] = 40,
    partial: Annotated[Partial, Option(help="how sources are fitted")] = "auto",
    model: runner.Model = "human",
    seed: runner.Seed = 0,
    data: runner.Data = runner.DATA,
    cache: runner.Cache = None,
    work: runner.Work = None,
) -> runner.Report:
    benches = [load_set(name, data) for name in runner.split_names(sets, SET_NAMES, "set")]
    methods = OurMethod(model, seed=seed), OurMethod(model, seed=seed, partial=partial)
    asked = {"weights": as_model(model).card.weights_sha256, "seed": seed, "partial": partial}
    rows = [measure(bench, kind, *methods, limit_pairs, cache, work, asked) for bench in benches for kind in KINDS]
    return runner.Report({"rows": rows}, [runner.table("Parts matched to wholes, cm at 1.9 m2", rows, COLUMNS)])
