"""Errors of maps on the sets of the benchmark.

Errors are geodesic distances on the target between the predicted and the true vertex. The distances from the landmarks of
a target to its vertices are the same for all maps, so they are computed once and cached on disk.
"""

from __future__ import annotations

import hashlib
import os
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import platformdirs
from numpy.lib.format import open_memmap
from numpy.typing import ArrayLike, NDArray

from meshmatch.arrays import Int, Ints
from meshmatch.errors import InputError, OutputError
from meshmatch.experiments.bench.sets import BenchSet, Pair
from meshmatch.maps.evaluate import CM_PER_UNIT, LOST_CM, Errors
from meshmatch.maps.geodesics import GEODESIC, GeodesicDistances
from meshmatch.outputs import replace_on_success
from meshmatch.shapes.shape import Shape

READ_BYTES = 64_000_000
CACHE_VARIABLE = "MESHMATCH_GEODESICS"
# Part of every file's name: increase it when the graph in maps.geodesics changes, which invalidates cached distances.
_GRAPH_VERSION = "1"


def default_folder() -> Path:
    """Return the folder of cached distances: ``$MESHMATCH_GEODESICS``, or ``geodesics`` in the user's cache folder."""
    chosen = os.environ.get(CACHE_VARIABLE)
    return Path(chosen) if chosen else platformdirs.user_cache_path("meshmatch") / "geodesics"


class TruthDistances:
    """Distances on one target between its landmarks and all its vertices, in units of sqrt(area).

    Parameters
    ----------
    target
        The shape on which errors are measured.
    landmarks
        Vertex ids ``(N,)`` of its landmarks.
    folder
        Folder of the cached matrix (`default_folder` for None): ``(unique landmarks, V)`` float16, named by the hashes
        of shape and landmarks. float16 rounds a distance by at most one part in 2000.
    """

    def __init__(self, target: Shape, landmarks: Int[Ints, " N"], folder: Path | None) -> None:
        self.target = target
        self.rows, self.row_of_landmark = np.unique(landmarks, return_inverse=True)
        parts = [target.hash, hashlib.sha256(self.rows.tobytes()).hexdigest(), GEODESIC, _GRAPH_VERSION]
        name = hashlib.sha256("|".join(parts).encode()).hexdigest()[:16]
        self.path = Path(folder or default_folder()) / f"{target.hash}-{name}.npy"

    def prepare(self) -> None:
        """Compute and store the matrix unless it exists (1 to 15 ms a row on one core).

        Raises
        ------
        OutputError
            The folder cannot be made or written.
        """
        if self.path.exists():
            return
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(
                f"cannot keep distances in {self.path.parent}: {error.strerror}", "choose a folder with --cache"
            ) from error
        geodesics = GeodesicDistances(self.target)
        with replace_on_success(self.path) as temporary:
            matrix = open_memmap(temporary, "w+", dtype=np.float16, shape=(len(self.rows), self.target.V))
            for first, rows in geodesics.chunks(self.rows):
                matrix[first : first + len(rows)] = rows
            matrix.flush()
            del matrix

    def of(self, landmarks: Int[NDArray[np.integer], N]) -> NDArray[np.float16]:
        """Return distances (N, V) from landmarks, given by their indices, to all vertices."""
        self.prepare()
        matrix = np.load(self.path, mmap_mode="r", allow_pickle=False)
        return np.array(matrix[self.row_of_landmark[landmarks]])

    def errors(self, predictions: Sequence[NDArray[np.integer]]) -> list[NDArray[np.float32]]:
        """Return errors ``(N,)`` of each prediction ``(N,)``: the distance from landmark k to vertex ``prediction[k]``.

        The matrix is read once for all predictions, so pass all those of a target together.
        """
        self.prepare()
        matrix = np.load(self.path, mmap_mode="r", allow_pickle=False)
        order = np.argsort(self.row_of_landmark, kind="stable")
        bounds = np.searchsorted(self.row_of_landmark[order], np.arange(len(self.rows) + 1))
        results = [np.empty(len(self.row_of_landmark), dtype=np.float32) for _ in predictions]
        step = max(1, READ_BYTES // (2 * self.target.V))
        for first in range(0, len(self.rows), step):
            block = np.array(matrix[first : first + step])
            mine = order[bounds[first] : bounds[first + len(block)]]
            rows = self.row_of_landmark[mine] - first
            for prediction, result in zip(predictions, results, strict=True):
                result[mine] = block[rows, prediction[mine]]
        return results


def joined_errors(several: Iterable[Errors]) -> Errors:
    """Concatenate the errors of several maps."""
    return Errors(np.concatenate([errors.values for errors in several]))


def summary(errors: Sequence[Errors]) -> dict[str, float]:
    """Summarise the errors of pairs in centimetres: mean and median over points, median over pairs, lost points, flips."""
    joined, means = joined_errors(errors), [each.mean_cm for each in errors]
    return {
        "mean_cm": joined.mean_cm,
        "median_cm": joined.median_cm,
        "median_pair_cm": float(np.median(means)),
        "share_over_15cm": joined.share_over(LOST_CM),
        "flips": float(np.mean([mean > LOST_CM for mean in means])),
    }


@dataclass(frozen=True, eq=False)
class SetScores:
    """Errors of all pairs of a set, or of a subset.

    Parameters
    ----------
    errors : dict of pair to Errors
        Errors at all landmarks, for each evaluated pair.
    group : str
        Name of the group of pairs, such as "same subject"; empty for pairs of all groups.
    """

    bench: BenchSet
    errors: Mapping[Pair, Errors]
    group: str = ""

    @property
    def expected(self) -> int:
        """Number of pairs in the protocol."""
        return sum(1 for pair in self.bench.pairs if self.group in ("", self.bench.group(pair)))

    @property
    def means_cm(self) -> dict[Pair, float]:
        """Mean error of each pair in centimetres, in descending order."""
        means = {pair: errors.mean_cm for pair, errors in self.errors.items()}
        return dict(sorted(means.items(), key=lambda item: -item[1]))

    @property
    def joined(self) -> Errors:
        """Errors of all points of all pairs."""
        return joined_errors(self.errors.values())

    def groups(self) -> list[SetScores]:
        """Split the scores by group of pairs; empty if the set has no groups."""
        parts: dict[str, dict[Pair, Errors]] = defaultdict(dict)
        for pair, errors in self.errors.items():
            parts[self.bench.group(pair)][pair] = errors
        return [SetScores(self.bench, part, name) for name, part in sorted(parts.items()) if name]

    def as_dict(self, worst: int = 10) -> dict[str, Any]:
        """Return a JSON record. All pairs have the same number of points, so the mean over points is that over pairs."""
        digits = {"share_over_15cm": 5, "flips": 5}
        rounded = {
            name: round(value, digits.get(name, 4)) for name, value in summary(list(self.errors.values())).items()
        }
        return {
            "pairs": len(self.errors),
            "complete": len(self.errors) == self.expected,
            "points_per_pair": len(next(iter(self.errors.values())).values),
            **rounded,
            "mean_x100": round(100 * self.joined.mean, 4),
            "worst": [[*pair, round(mean, 2)] for pair, mean in list(self.means_cm.items())[:worst]],
        }


def evaluate_set(
    bench: BenchSet, maps: Mapping[Pair, ArrayLike], *, pairs: Sequence[Pair] | None = None, cache: Path | None = None
) -> SetScores:
    """Compute errors of maps on a set, at the source's landmarks: geodesic on meshes, Euclidean in metres on clouds.

    Parameters
    ----------
    maps
        For each pair ``(source, target)`` the index ``(V_src,)``: target vertex of each source vertex.
    pairs
        The pairs to evaluate; all pairs of the set if None.
    cache
        Folder of cached distances; the first run fills it.

    Raises
    ------
    InputError
        There are no pairs, a pair is not in the set, or a map is missing, has the wrong length or an index outside the
        target.
    """
    wanted = list(bench.pairs if pairs is None else pairs)
    if not wanted:
        raise InputError(f"{bench.name}: there is nothing to evaluate")
    if strangers := sorted(set(wanted) - set(bench.pairs)):
        raise InputError(f"{bench.name} has no pair {' -> '.join(strangers[0])}")
    if missing := [pair for pair in wanted if pair not in maps]:
        raise InputError(f"{bench.name}: {len(missing)} maps are missing, the first {' -> '.join(missing[0])}")
    sources: dict[str, list[str]] = defaultdict(list)
    for source, target in wanted:
        sources[target].append(source)
    found: dict[Pair, Errors] = {}
    sizes = {name: bench.shape(name).V for name in sorted({source for source, _ in wanted})}
    for target, names in sources.items():
        shape = bench.shape(target)
        predictions = []
        for source in names:
            index = np.asarray(maps[source, target])
            if index.shape != (sizes[source],) or index.dtype.kind not in "iu":
                wrong = f"a map of {sizes[source]} indices is needed, not {index.dtype} {index.shape}"
                raise InputError(f"{bench.name} {source} -> {target}: {wrong}")
            if index.min() < 0 or index.max() >= shape.V:
                raise InputError(f"{bench.name} {source} -> {target}: an index is outside the target")
            predictions.append(index[bench.landmarks(source)])
        marks = bench.landmarks(target)
        if shape.is_cloud:
            off = [shape.verts[index] - shape.verts[marks] for index in predictions]
            errors = [(np.linalg.norm(each, axis=1) * 100 / CM_PER_UNIT).astype(np.float32) for each in off]
        else:
            errors = TruthDistances(shape, marks, cache).errors(predictions)
        for source, values in zip(names, errors, strict=True):
            found[source, target] = Errors(values)
    return SetScores(bench, {pair: found[pair] for pair in wanted})


def area_under_curve(score: ArrayLike, right: ArrayLike) -> float:
    """Area under the ROC curve: the probability that a right answer has a higher score than a wrong one.

    Ties count half; nan if there are no right or no wrong answers.
    """
    from scipy.stats import rankdata

    values, truth = np.asarray(score, float), np.asarray(right, bool)
    good, bad = int(truth.sum()), int((~truth).sum())
    if not good or not bad:
        return float("nan")
    return float((rankdata(values)[truth].sum() - good * (good + 1) / 2) / (good * bad))
