"""Match pairs as `match` does, by fits or without a model, for the benchmarks of kinds, characters and splits."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

from meshmatch.api.matcher import Matcher
from meshmatch.experiments.bench.sets import Pair, Shapes
from meshmatch.experiments.runner import track
from meshmatch.fitting.fit import Fit
from meshmatch.maps.vertex_map import VertexMap

VERDICTS = ("good", "fair", "poor")


@dataclass(frozen=True, eq=False)
class MatchedPair:
    """The map of a pair, the worse verdict of its fits, and the CPU seconds of fits and map."""

    map: VertexMap
    verdict: str
    seconds: float


def match_by_fits(
    matcher: Matcher, shapes: Shapes, pairs: Sequence[Pair], what: str
) -> tuple[dict[str, Fit], dict[Pair, MatchedPair]]:
    """Fit all shapes and map all pairs; return fits by name and maps by pair."""
    fits, spent = {}, {}
    for name, shape in track(shapes.items(), f"{what}: fitting", len(shapes)):
        began = time.process_time()
        fits[name] = matcher.fit(shape)
        spent[name] = time.process_time() - began
    found = {}
    for a, b in track(pairs, f"{what}: mapping", len(pairs)):
        began = time.process_time()
        vertex_map = matcher.map(fits[a], fits[b])
        seconds = spent[a] + spent[b] + time.process_time() - began
        found[a, b] = MatchedPair(vertex_map, max(fits[a].verdict, fits[b].verdict, key=VERDICTS.index), seconds)
    return fits, found


def match_directly(matcher: Matcher, shapes: Shapes, pairs: Sequence[Pair], what: str) -> dict[Pair, MatchedPair]:
    """Match all pairs without a model; return maps by pair."""
    found = {}
    for a, b in track(pairs, what, len(pairs)):
        began = time.process_time()
        vertex_map = matcher.match(shapes[a], shapes[b]).map
        found[a, b] = MatchedPair(vertex_map, str(vertex_map.verdict), time.process_time() - began)
    return found
