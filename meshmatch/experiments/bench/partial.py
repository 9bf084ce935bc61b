"""Partial shapes matched to whole ones.

Each source is one of two kinds of parts of a shape of the benchmark; the target is another, whole shape:

- view: the faces visible to a distant camera in a random direction, by ray casting;
- cut: the faces on one side of a plane perpendicular to a random direction, between 50 and 90 % of the faces.

Errors are geodesic, in centimetres at 1.9 m2 of skin, at the remaining landmarks of the source; their mean is over pairs.
The AUC is the area under the ROC curve of confidence as a predictor of errors below 15 cm; 0.5 is chance. --partial auto is
what `meshmatch match` does; with no, sources are fitted as whole shapes.
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
_KEPT_SHARE = (0.5, 0.9)  # minimum and maximum share of the faces that a cut leaves
COLUMNS = {
    **{"set": "set", "part": "part", "pairs": "pairs", "mean": "mean_cm:.2f", "median": "median_cm:.2f"},
    **{"median pair": "median_pair_cm:.2f", f"over {LOST_CM:g} cm": "share_over_15cm:.1%"},
    **{"AUC": "auc:.2f", "taken for parts": "taken_for_parts:.0%"},
}


def part_of(shape: Shape, kind: Kind, seed: int) -> tuple[Shape, Int[Ints, " V_part"]]:
    """Return a part of a mesh, and the sorted indices of the vertices that are left."""
    rng = np.random.default_rng(seed)
    direction = rng.standard_normal(3)
    direction /= np.linalg.norm(direction)
    centers = shape.verts[shape.faces].mean(axis=1)
    if kind == "cut":
        height = centers @ direction
        keep = height >= np.quantile(height, 1 - rng.uniform(*_KEPT_SHARE))
    else:
        keep = seen_faces(shape, centers, direction)
    used = np.unique(shape.faces[keep])
    return Shape(shape.verts[used], np.searchsorted(used, shape.faces[keep]), shape.name), used


def seen_faces(shape: Shape, centers: Float[Floats, "F 3"], direction: Float[Floats, " 3"]) -> Bool[Bools, " F"]:
    """Return whether the center of each face is visible from a distant camera in a direction."""
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
    """Measure ``limit`` evenly spread pairs. ``part`` fits the sources, ``whole`` the targets.

    Geodesic distances are cached in ``cache``, and finished pairs in ``work`` with the settings ``asked``.
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
