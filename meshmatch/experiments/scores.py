"""From maps to the numbers of a set: every pair counts, whoever made the maps."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from meshmatch.errors import InputError
from meshmatch.experiments.distances import TruthDistances, default_folder
from meshmatch.experiments.protocols import BenchSet, Pair, load_set
from meshmatch.maps.evaluate import LOST_CM, Errors


@dataclass(frozen=True, eq=False)
class SetScores:
    """Errors of all pairs of a set, or of a stated part of it.

    Parameters
    ----------
    bench : BenchSet
        The set.
    errors : dict of pair to Errors
        Errors at all landmarks, for each evaluated pair.
    group : str
        Which pairs these are, if not all kinds of the set ("same subject").
    """

    bench: BenchSet
    errors: Mapping[Pair, Errors]
    group: str = ""

    @property
    def expected(self) -> int:
        """Number of pairs that the protocol asks for."""
        return sum(1 for pair in self.bench.pairs if self.group in ("", self.bench.group(pair)))

    @property
    def means_cm(self) -> dict[Pair, float]:
        """Mean error of each pair, centimetres, the largest first."""
        means = {pair: errors.mean_cm for pair, errors in self.errors.items()}
        return dict(sorted(means.items(), key=lambda item: -item[1]))

    @property
    def flips(self) -> float:
        """Share (0..1) of the pairs whose mean error exceeds 15 cm."""
        return float(np.mean([mean > LOST_CM for mean in self.means_cm.values()]))

    @property
    def joined(self) -> Errors:
        """All points of all pairs."""
        return Errors.joined(list(self.errors.values()))

    def groups(self) -> list[SetScores]:
        """The same for each kind of pair, where a set has several."""
        parts: dict[str, dict[Pair, Errors]] = defaultdict(dict)
        for pair, errors in self.errors.items():
            parts[self.bench.group(pair)][pair] = errors
        return [SetScores(self.bench, part, name) for name, part in sorted(parts.items()) if name]

    def as_dict(self, worst: int = 10) -> dict[str, Any]:
        """Plain numbers. The mean over points is the mean over pairs, for every pair has as many points."""
        means = self.means_cm
        joined = self.joined
        return {
            "pairs": len(self.errors),
            "complete": len(self.errors) == self.expected,
            "points_per_pair": len(next(iter(self.errors.values())).values),
            "mean_cm": round(joined.mean_cm, 4),
            "median_cm": round(joined.median_cm, 4),
            "mean_x100": round(100 * joined.mean, 4),
            "median_pair_cm": round(float(np.median(list(means.values()))), 4),
            "share_over_15cm": round(joined.share_over(LOST_CM), 5),
            "flips": round(self.flips, 5),
            "worst": [[*pair, round(mean, 2)] for pair, mean in list(means.items())[:worst]],
        }


def evaluate_set(
    bench: BenchSet | str,
    maps: Mapping[Pair, ArrayLike],
    *,
    data: Path | None = None,
    cache: Path | None = None,
    pairs: Sequence[Pair] | None = None,
    tick: Callable[[int], object] = lambda done: None,
) -> SetScores:
    """Errors of maps on a set of the benchmark, at the source's landmarks, as geodesic distance on the
    target.

    Parameters
    ----------
    bench
        The set, or its name (then `data` is needed).
    maps
        For each pair ``(source, target)`` the index ``(V_src,)``: target vertex of each source vertex.
    cache
        Folder of the kept distances; `default_folder` if none is given. The first run fills it.
    pairs
        Evaluate these only. All pairs of the set, if none are given: a mean that leaves one out is not a
        mean.
    tick
        Called with the number of pairs that are done.

    Raises
    ------
    InputError
        A map is missing, or is not one of its pair: wrong length, or an index outside the target.
    """
    if isinstance(bench, str):
        if data is None:
            raise InputError(f"where is the set {bench}?", "give the folder of the benchmark's data")
        bench = load_set(bench, data)
    wanted = list(bench.pairs if pairs is None else pairs)
    if not wanted:
        raise InputError(f"{bench.name}: there is nothing to evaluate")
    if strangers := sorted(set(wanted) - set(bench.pairs)):
        raise InputError(f"{bench.name} has no pair {strangers[0][0]} -> {strangers[0][1]}")
    if missing := [pair for pair in wanted if pair not in maps]:
        raise InputError(
            f"{bench.name}: {len(missing)} maps are missing, the first {' -> '.join(missing[0])}"
        )

    sources: dict[str, list[str]] = defaultdict(list)
    for source, target in wanted:
        sources[target].append(source)
    found: dict[Pair, Errors] = {}
    sizes = {name: bench.shape(name).V for name in sorted({source for source, _ in wanted})}
    for target, names in sources.items():
        shape = bench.shape(target)
        predictions: list[NDArray[Any]] = []
        for source in names:
            index = np.asarray(maps[source, target])
            if index.shape != (sizes[source],) or index.dtype.kind not in "iu":
                raise InputError(
                    f"{bench.name} {source} -> {target}: a map of {sizes[source]} indices is needed, "
                    f"not {index.dtype} {index.shape}"
                )
            if index.min() < 0 or index.max() >= shape.V:
                raise InputError(f"{bench.name} {source} -> {target}: an index is outside the target")
            predictions.append(index[bench.landmarks(source)])
        truth = TruthDistances(shape, bench.landmarks(target), cache or default_folder())
        for source, values in zip(names, truth.errors(predictions), strict=True):
            found[source, target] = Errors(values)
        tick(len(found))
    return SetScores(bench, {pair: found[pair] for pair in wanted})
