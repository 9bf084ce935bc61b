"""Times and errors of whole sets as collections: each shape is fitted once, fits are made to agree, maps are looked up.

The fits are made from scratch by one process and by two, and must be bit-identical; the ratio of the times is the speed-up
by a second process. Errors count all pairs, as in `meshmatch.experiments.bench`, which measures the same maps made pair by
pair. The ten four-chamber hearts are fitted without a model (`--model none`). They were decimated independently; vertices
of the same original mesh that both shapes of a pair kept, about a fifth of each, are exact ground truth. Their errors are
Euclidean, in units of sqrt(area), times 100: the walls are thin, and geodesic distances between their two sides are long.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from itertools import permutations
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from typer import Option

from meshmatch.api.matcher import Matcher
from meshmatch.arrays import Int, Ints
from meshmatch.collections.collection import Collection
from meshmatch.errors import InputError
from meshmatch.experiments import runner
from meshmatch.experiments.bench.pairs import match_directly
from meshmatch.experiments.bench.scores import evaluate_set
from meshmatch.experiments.bench.sets import Pair, Shapes, load_folder, load_set, ordered_pairs
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.models.registry import NO_MODEL

HEART = "heart"
SETS = ("scape", "faust", HEART)
TRUTH = ".truth.npy"
Truth = Mapping[str, Int[Ints, "V 2"]]
"""For each shape, the vertex of the original mesh and the chamber of each of its vertices."""
COLUMNS = {"set": "set", "shapes": "shapes:d", "maps": "maps:d", "fits, 1 process": "one_s:.1f"}
COLUMNS |= {
    "2 processes": "two_s:.1f",
    "times": "gain:.2f",
    "same bits": "same",
    "largest process, GB": "largest_gb:.2f",
}
COLUMNS |= {"maps written, s": "maps_s:.1f", "a map, ms": "map_ms:.1f", "error": "error:.3f", "unit": "unit"}
HEARTS = {"maps": "how", "pairs": "pairs:d", "mean": "mean_x100:.2f", "worst pair": "worst_pair_x100:.2f"}
HEARTS |= {"right chamber": "right_chamber:.1%", "along the normals": "across_x100:.2f"}


def heart_errors(shapes: Shapes, truth: Truth, maps: Mapping[Pair, VertexMap]) -> dict[str, Any]:
    """Compute errors at the vertices whose partner is known, and the share mapped to the right chamber.

    ``across_x100`` is the component of the errors along the target's normals; the rest is sliding along the surface.
    """
    means, chambers, across = {}, [], []
    for (source, target), found in maps.items():
        _, ours, theirs = np.intersect1d(truth[source][:, 0], truth[target][:, 0], return_indices=True)
        got, shape = found.index[ours], shapes[target]
        off = 100 * (shape.verts[got] - shape.verts[theirs]) / np.sqrt(shape.area)
        means[source, target] = float(np.linalg.norm(off, axis=1).mean())
        across.append(float(np.abs((off * shape.vertex_normals[theirs]).sum(1)).mean()))
        chambers.append(float((truth[target][got, 1] == truth[source][ours, 1]).mean()))
    worst = max(means, key=lambda pair: means[pair])
    return {
        **{"pairs": len(means), "mean_x100": round(float(np.mean(list(means.values()))), 4)},
        **{"worst_pair_x100": round(means[worst], 4), "worst_pair": list(worst)},
        "across_x100": round(float(np.mean(across)), 4),
        "right_chamber": round(float(np.mean(chambers)), 4),
    }


def read_fits(folder: Path) -> dict[str, bytes]:
    """Read the finished fits of a folder as bytes, by relative path."""
    fits = folder / "fits"
    return {path.relative_to(fits).as_posix(): path.read_bytes() for path in sorted(fits.rglob("*.safetensors"))}


def time_fits(shapes: list[Path], folder: Path, model: str, jobs: int) -> float:
    """Run `meshmatch fit` from scratch in a new process and return its seconds; `InputError` if it fails."""
    words = [*map(str, shapes), "-o", str(folder), "--model", model, "--jobs", str(jobs), "--quiet", "--json"]
    environment = {name: value for name, value in os.environ.items() if not name.startswith("MALLOC_")}
    began = time.perf_counter()
    done = subprocess.run([sys.executable, "-m", "meshmatch", "fit", *words], capture_output=True, env=environment)
    seconds = time.perf_counter() - began
    if done.returncode or json.loads(done.stdout)["verdicts"]["failed"]:
        raise InputError(f"meshmatch fit failed: {done.stderr.decode(errors='replace')[-200:]}")
    return seconds


def measure(name: str, data: Path, work: Path, limit: int | None, model: str | None = None) -> dict[str, Any]:
    """Fit, agree and map one set, and return its table row."""
    model, details = model or (NO_MODEL if name == HEART else "human"), {}
    if name == HEART:
        shapes, truth = load_folder(data / HEART, TRUTH)
        paths = [data / HEART / f"{each}.ply" for each in runner.evenly_spread(list(shapes), limit)]
    else:
        bench = load_set(name, data)
        paths = [bench.path(each) for each in runner.evenly_spread(list(bench.shapes), limit)]
    one, two = work / f"{name}-1", work / f"{name}-2"
    seconds = {folder: time_fits(paths, folder, model, number) for folder, number in ((one, 1), (two, 2))}
    largest = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1e6  # maximum over all child processes so far
    collection = Collection(two, 2)
    pairs = list(permutations(collection.names, 2))
    began = time.perf_counter()
    collection.save_maps(work / f"{name}-maps", pairs)
    written = time.perf_counter() - began
    found: dict[tuple[str, str], Any] = {}
    began = time.perf_counter()
    for pair in pairs:
        found[pair] = collection.map(*pair)
    each = (time.perf_counter() - began) / len(pairs)
    if name == HEART:
        details = {"how": "of the collection", **heart_errors(shapes, truth, found)}
        error, unit = details["mean_x100"], "x100 of sqrt(area)"
    else:
        scores = evaluate_set(bench, {pair: one.index for pair, one in found.items()}, pairs=pairs, cache=work / "kept")
        error, unit = float(np.mean(list(scores.means_cm.values()))), "cm"
    return {
        **{"set": name, "shapes": len(paths), "maps": len(pairs), "one_s": seconds[one], "two_s": seconds[two]},
        **{"gain": seconds[one] / seconds[two], "same": read_fits(one) == read_fits(two), "largest_gb": largest},
        **{"maps_s": written, "map_ms": 1000 * each, "error": error, "unit": unit, "details": details},
    }


def heart_pairs(data: Path, limit: int) -> dict[str, Any]:
    """Compute the errors of hearts that are matched pair by pair, without a model."""
    shapes, truth = load_folder(data / HEART, TRUTH)
    found = match_directly(Matcher(NO_MODEL, threads=1), shapes, ordered_pairs(shapes, limit), HEART)
    return {"how": "of pairs", **heart_errors(shapes, truth, {pair: each.map for pair, each in found.items()})}


@runner.command
def main(
    data: runner.Data = runner.DATA,
    sets: Annotated[str, Option(help=f"of {', '.join(SETS)}")] = ",".join(SETS),
    model: Annotated[str | None, Option(help="default: human, and none for hearts")] = None,
    limit_shapes: Annotated[int | None, Option(min=2, help="of each set, evenly spread; by default all")] = None,
    pairs: Annotated[int, Option(min=0, help="pairs of hearts to match one by one as well")] = 0,
    work: Annotated[Path | None, Option(help="keep fits and maps in this new folder")] = None,
) -> runner.Report:
    """Fit, agree and map whole sets."""
    asked = runner.split_names(sets, SETS, "set")
    with tempfile.TemporaryDirectory() as folder:
        rows = [measure(name, data, work or Path(folder), limit_shapes, model) for name in asked]
    title = f"Collections, {os.cpu_count()} cores, one thread a process"
    hearts = [row["details"] for row in rows if row["details"]]
    if pairs:
        hearts.append(heart_pairs(data, pairs))
    some = ((title, rows, COLUMNS), ("Hearts", hearts, HEARTS))
    tables = [runner.table(heading, each, columns) for heading, each, columns in some if each]
    return runner.Report({"rows": rows, "hearts": hearts}, tables)
