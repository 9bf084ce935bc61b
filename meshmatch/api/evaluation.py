"""How good a map is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from meshmatch.api.results import MatchResult
from meshmatch.arrays import Ints
from meshmatch.errors import InputError
from meshmatch.maps.evaluate import Evaluation, evaluate_map
from meshmatch.maps.files import load_map
from meshmatch.maps.vertex_map import VertexMap, check_map
from meshmatch.shapes.files import ShapeLike, as_shape
from meshmatch.threads import thread_limit


def evaluate(
    found: MatchResult | VertexMap | str | Path,
    source: ShapeLike,
    target: ShapeLike,
    truth: ArrayLike | tuple[ArrayLike, ArrayLike] | None = None,
    *,
    seed: int = 0,
) -> Evaluation:
    """Measure a map: its coverage, its distortion, and its errors where the truth is known.

    Errors are geodesic distances on the target, over the square root of its area; or in centimetres with the target
    scaled to 1.9 square metres, the skin of a person. ``found`` is a map, or its file; the shapes are as in `match`.
    ``truth`` is the true target vertex of every source vertex (V_source,); or N vertices of the source and those of the
    target, ((N,), (N,)). ``seed`` is of the random pairs of points between which distortion is measured.

    `MeshmatchError`: the map or the truth belongs to other shapes, or is something else.
    """
    source, target = as_shape(source, "source"), as_shape(target, "target")
    if isinstance(found, str | Path):
        found = load_map(found, source, target)
    vertex_map = found.map if isinstance(found, MatchResult) else found
    check_map(vertex_map)
    known: list[Ints] = []
    if truth is not None:
        pair = truth if isinstance(truth, tuple) and len(truth) == 2 else (np.arange(source.V), truth)
        for numbers in map(np.asarray, pair):
            if numbers.dtype.kind not in "iu":
                hint = "integers, counted from 0"
                raise InputError(f"the truth must be numbers of vertices, not {numbers.dtype}", hint)
            known.append(numbers.astype(np.int64))
        if known[0].ndim != 1 or known[0].shape != known[1].shape:
            raise InputError(
                f"the truth has {known[0].shape} vertices of the source and {known[1].shape} of the target",
                "give one target vertex for every source vertex, or a pair of lists of the same length",
            )
    with thread_limit(1):
        return evaluate_map(vertex_map, source, target, *known, rng=np.random.default_rng(seed))
