"""Parts matched to wholes: ``python -m meshmatch.experiments.partial``.

Each source is one of two parts of a shape of the benchmark, the target another whole shape:

- *view*: the faces that a camera far away sees, by ray casting; a random direction for each source;
- *cut*: what lies on one side of a plane across a random direction, between half and 90 % of the faces.

Errors are geodesic, in centimetres at 1.9 m2 of skin, at the source's landmarks that are left. How well the map knows
where it is wrong: the area under the curve (AUC) of confidence telling errors below 15 cm from those above; 0.5 is
guessing. ``--partial auto`` is what `meshmatch match` does, ``no`` what it did without fits of parts.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from meshmatch.experiments.bench import chosen_pairs
from meshmatch.experiments.category import area_under_curve
from meshmatch.experiments.distances import TruthDistances, default_folder
from meshmatch.experiments.protocols import SET_NAMES, BenchSet, load_set
from meshmatch.experiments.report import circumstances, status_of, wide_console
from meshmatch.fitting.fit import Fit
from meshmatch.maps.evaluate import CM_PER_UNIT, LOST_CM
from meshmatch.pipeline import map_between, register
from meshmatch.render.scene import Scene
from meshmatch.render.surface import FacePaint, Surface
from meshmatch.shapes.shape import Shape
from meshmatch.threads import set_threads

Kind = Literal["view", "cut"]
KINDS: tuple[Kind, ...] = ("view", "cut")
_FEWEST, _MOST = 0.5, 0.9  # share of the faces that a cut leaves


def part_of(shape: Shape, kind: Kind, seed: int) -> tuple[Shape, NDArray[np.int64]]:
    """A part of a mesh, and which of its vertices (V_part,) are left, in their order."""
    rng = np.random.default_rng(seed)
    direction = rng.standard_normal(3)
    direction /= np.linalg.norm(direction)
    centers = shape.verts[shape.faces].mean(axis=1)
    if kind == "cut":
        height = centers @ direction
        keep = height >= np.quantile(height, 1 - rng.uniform(_FEWEST, _MOST))
    else:
        keep = seen_faces(shape, centers, direction)
    used = np.unique(shape.faces[keep])
    return Shape(shape.verts[used], np.searchsorted(used, shape.faces[keep]), shape.name), used


def seen_faces(shape: Shape, centers: np.ndarray, direction: np.ndarray) -> NDArray[np.bool_]:
    """(F,) whether a camera far away in a direction (3,) sees the middle of each face."""
    facing = shape.face_normals @ direction > 0
    scene = Scene(
        [Surface(shape.verts, shape.faces, np.zeros_like(shape.verts), FacePaint(np.ones((shape.F, 3))))]
    )
    lifted = (centers + 1e-4 * shape.diagonal * shape.face_normals).astype(np.float32)
    towards = np.broadcast_to(direction.astype(np.float32), lifted.shape)
    return np.asarray(facing & ~scene.blocked(lifted, towards, 2 * shape.diagonal))


def run_set(
    bench: BenchSet, kind: Kind, *, limit: int, partial: str, model: str, seed: int, cache: Path
) -> dict[str, Any]:
    """Errors of ``limit`` pairs, evenly spread; every pair counts."""
    fits: dict[str, Fit] = {}
    parts: dict[str, tuple[Shape, NDArray[np.int64], Fit]] = {}
    errors, confidence = [], []
    began = time.perf_counter()
    pairs = chosen_pairs(bench, limit)
    for source, target in pairs:
        if target not in fits:
            fits[target] = register(bench.shape(target), model=model, seed=seed)
        if source not in parts:
            part, used = part_of(bench.shape(source), kind, seed + bench.shapes.index(source))
            fit = register(part, model=model, seed=seed, partial=partial)  # type: ignore[arg-type]
            parts[source] = part, used, fit
        part, used, fit = parts[source]
        whole = bench.shape(target)
        found = map_between(part, fit, whole, fits[target], model=model)
        landmarks = bench.landmarks(source)
        left = np.flatnonzero(np.isin(landmarks, used))
        at = np.searchsorted(used, landmarks[left])
        answers = bench.landmarks(target).copy()
        answers[left] = found.index[at]
        values = TruthDistances(whole, bench.landmarks(target), cache).errors([answers])[0][left]
        errors.append(values * CM_PER_UNIT)
        confidence.append(found.confidence[at])
    means = [float(values.mean()) for values in errors]
    joined = np.concatenate(errors)
    return {
        "pairs": len(pairs),
        "of": len(bench.pairs),
        "mean_cm": float(np.mean(means)),
        "median_cm": float(np.median(joined)),
        "median_pair_cm": float(np.median(means)),
        "share_over_15cm": float((joined > LOST_CM).mean()),
        "auc": area_under_curve(np.concatenate(confidence), joined <= LOST_CM),
        "taken_for_parts": sum(fit.partial for _, _, fit in parts.values()) / len(parts),
        "seconds": round(time.perf_counter() - began, 1),
    }


def run(
    sets: Sequence[str], *, limit: int, partial: str, model: str, seed: int, data: Path, cache: Path
) -> dict[str, Any]:
    """Measure, print a table and a JSON line; the line's record is returned too."""
    set_threads(1)
    table = Table(title="Parts matched to wholes, cm at 1.9 m2", title_justify="left")
    columns = ("pairs", "mean", "median", "median pair", f"over {LOST_CM:g} cm", "AUC", "taken for parts")
    for name in ("set", "part", *columns):
        table.add_column(name, justify="left" if name in ("set", "part") else "right")
    records: dict[str, Any] = {}
    with Console(stderr=True).status("matching parts") as status:
        for name in sets:
            bench = load_set(name, data)
            records[name] = {}
            for kind in KINDS:
                status.update(f"{name}: {kind}")
                record = run_set(
                    bench, kind, limit=limit, partial=partial, model=model, seed=seed, cache=cache
                )
                records[name][kind] = record
                numbers = (f"{record[key]:.2f}" for key in ("mean_cm", "median_cm", "median_pair_cm"))
                table.add_row(
                    name,
                    kind,
                    f"{record['pairs']} of {record['of']}",
                    *numbers,
                    f"{100 * record['share_over_15cm']:.1f} %",
                    f"{record['auc']:.2f}",
                    f"{100 * record['taken_for_parts']:.0f} %",
                )
    wide_console().print(table)
    whole = {
        "benchmark": "partial",
        **circumstances(threads=1, jobs=1),
        "model": model,
        "partial": partial,
        "seed": seed,
        "sets": records,
    }
    print(json.dumps(whole), flush=True)
    return whole


def main(words: Sequence[str] | None = None) -> int:
    """Run the benchmark; 0 when it ran, 1 when the data or the choice stopped it."""
    parser = argparse.ArgumentParser("python -m meshmatch.experiments.partial", description=__doc__)
    parser.add_argument(
        "--sets", default="scape,shrec19", help=f"some of {', '.join(SET_NAMES)}; %(default)s"
    )
    parser.add_argument(
        "--limit-pairs", type=int, default=40, metavar="N", help="pairs of each set; %(default)s"
    )
    parser.add_argument(
        "--partial", default="auto", choices=("auto", "yes", "no"), help="how sources are fitted"
    )
    parser.add_argument("--model", default="human")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--data", type=Path, default=Path("../shared/bench"), help="the benchmark's data")
    parser.add_argument("--cache", type=Path, help="folder of kept geodesic distances")
    options = parser.parse_args(words)
    return status_of(
        lambda: run(
            options.sets.split(","),
            limit=options.limit_pairs,
            partial=options.partial,
            model=options.model,
            seed=options.seed,
            data=options.data,
            cache=options.cache or default_folder(),
        )
    )


if __name__ == "__main__":
    sys.exit(main())
