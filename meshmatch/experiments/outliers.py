"""Clouds with points that are no surface: ``python -m meshmatch.experiments.outliers --data ../shared/bench``.

``faust_outliers.npy`` is (30, 1000, 3): bodies in metres, 1,000 points each, row i the same point of each; many rows are
not on the surface. Every ordered pair is matched, every row counts, strays too. There is no mesh, so the error is
the straight distance between the predicted and the true point of the target, in centimetres.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import fields
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from meshmatch.errors import InputError
from meshmatch.experiments.report import circumstances, status_of, wide_console
from meshmatch.fitting.fit import Fit
from meshmatch.geometry.frames import Frame
from meshmatch.maps.evaluate import LOST_CM
from meshmatch.outputs import make_folder, replace_on_success
from meshmatch.pipeline import map_between, register
from meshmatch.shapes.shape import Shape
from meshmatch.threads import set_threads

FILE = "faust_outliers.npy"


def load_clouds(data: Path) -> list[Shape]:
    """The clouds of the file, in metres.

    Raises
    ------
    InputError
        The file is missing or holds something else.
    """
    path = Path(data) / FILE
    try:
        points = np.load(path, allow_pickle=False)
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read {path}", "--data names the folder that holds it") from error
    if points.ndim != 3 or points.shape[2] != 3:
        raise InputError(f"{path} holds {points.shape}, not (N, P, 3)")
    return [Shape(cloud, np.empty((0, 3), np.int64), f"cloud {k}") for k, cloud in enumerate(points)]


def fit_of(cloud: Shape, model: str, seed: int, keep: Path | None) -> Fit:
    """The fit of a cloud; the one kept in a folder under the cloud's hash, if there is one."""
    path = None if keep is None else keep / f"{cloud.hash}-{model}-{seed}.npz"
    if path is not None and path.is_file():
        with np.load(path, allow_pickle=False) as held:
            found = {name: held[name][()] if held[name].ndim == 0 else held[name] for name in held.files}
        frame = Frame(float(found.pop("scale")), found.pop("rotation"), found.pop("center"))
        words = {name: str(found[name]) for name in ("template_hash", "verdict", "up", "front")}
        return Fit(**{**found, **words, "frame": frame, "reasons": tuple(map(str, found["reasons"]))})
    fit = register(cloud, model=model, seed=seed)
    if path is not None:
        make_folder(path.parent)
        plain: dict[str, Any] = {
            each.name: getattr(fit, each.name) for each in fields(fit) if each.name != "frame"
        }
        plain |= {"reasons": np.array(fit.reasons, str)}
        turn: dict[str, Any] = {
            "scale": fit.frame.scale,
            "rotation": fit.frame.rotation,
            "center": fit.frame.center,
        }
        with replace_on_success(path) as unfinished:
            np.savez(unfinished, **plain, **turn)
    return fit


def measure(
    clouds: Sequence[Shape], *, model: str, seed: int, limit: int | None = None, keep: Path | None = None
) -> dict[str, Any]:
    """Match every ordered pair of corresponding clouds, or ``limit`` of them evenly spread, and measure every row."""
    began = time.perf_counter()
    voice = Console(stderr=True)
    fits = [fit_of(cloud, model, seed, keep) for cloud in track(clouds, "fitting", console=voice)]
    every = list(permutations(range(len(clouds)), 2))
    count = len(every) if limit is None else min(limit, len(every))
    pairs = [every[k] for k in np.linspace(0, len(every) - 1, max(1, count)).round().astype(int)]
    errors, trusted = [], []
    for a, b in track(pairs, "matching", console=voice):
        found = map_between(clouds[a], fits[a], clouds[b], fits[b], model=model)
        there = clouds[b].verts
        errors.append(100 * np.linalg.norm(there[found.index] - there, axis=1))
        trusted.append(found.confidence > 0.5)
    means = np.array([values.mean() for values in errors])
    joined, sure = np.concatenate(errors), np.concatenate(trusted)
    return {
        "pairs": len(pairs),
        "of": len(every),
        "mean_cm": float(joined.mean()),
        "median_cm": float(np.median(joined)),
        "share_over_15cm": float((joined > LOST_CM).mean()),
        "flips": float((means > LOST_CM).mean()),
        "confident_share": float(sure.mean()),
        "confident_mean_cm": float(joined[sure].mean()) if sure.any() else float("nan"),
        "verdicts": dict(Counter(fit.verdict for fit in fits)),
        "seconds": round(time.perf_counter() - began, 1),
    }


def run(
    clouds: Sequence[Shape], *, model: str, seed: int, limit: int | None = None, keep: Path | None = None
) -> dict[str, Any]:
    """Measure, print a table and a JSON line; the line's record is returned too."""
    set_threads(1)
    record = measure(clouds, model=model, seed=seed, limit=limit, keep=keep)
    table = Table(title="Clouds with outliers, straight distance in cm, strays counted", title_justify="left")
    row = {
        "pairs": f"{record['pairs']} of {record['of']}",
        "mean": f"{record['mean_cm']:.2f}",
        "median": f"{record['median_cm']:.2f}",
        f"over {LOST_CM:g} cm": f"{100 * record['share_over_15cm']:.1f} %",
        "flips": f"{100 * record['flips']:.1f} %",
        "confidence > 0.5": f"{100 * record['confident_share']:.0f} %",
        "mean of these": f"{record['confident_mean_cm']:.2f}",
        "verdicts": ", ".join(f"{count} {verdict}" for verdict, count in record["verdicts"].items()),
    }
    for name in row:
        table.add_column(name, justify="right")
    table.add_row(*row.values())
    wide_console().print(table)
    whole = {
        "benchmark": "outliers",
        **circumstances(threads=1, jobs=1),
        "model": model,
        "seed": seed,
        **record,
    }
    print(json.dumps(whole), flush=True)
    return whole


def main(words: Sequence[str] | None = None) -> int:
    """Run the benchmark; 0 when it ran, 1 when the data or the choice stopped it."""
    parser = argparse.ArgumentParser("python -m meshmatch.experiments.outliers", description=__doc__)
    parser.add_argument("--data", type=Path, default=Path("../shared/bench"), help="the benchmark's data")
    parser.add_argument("--limit", type=int, metavar="N", help="the first N clouds only")
    parser.add_argument("--limit-pairs", type=int, metavar="N", help="N pairs only, evenly spread")
    parser.add_argument(
        "--keep", type=Path, metavar="FOLDER", help="keep fits there, and use those that are kept"
    )
    parser.add_argument("--model", default="human")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(words)
    return status_of(
        lambda: run(
            load_clouds(options.data)[: options.limit],
            model=options.model,
            seed=options.seed,
            limit=options.limit_pairs,
            keep=options.keep,
        )
    )


if __name__ == "__main__":
    sys.exit(main())
