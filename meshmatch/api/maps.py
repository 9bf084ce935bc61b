"""The maps that transfers, pictures and pages follow: those at hand, or from matching now."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from meshmatch.api.results import MapPair, MatchResult, pair_of_map
from meshmatch.errors import InputError
from meshmatch.maps.files import load_map
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.files import ShapeLike, as_shape
from meshmatch.shapes.shape import Shape

if TYPE_CHECKING:
    from meshmatch.api.matching import Matcher

MapMaker: TypeAlias = Callable[[Shape, Shape], "MatchResult | MapPair"]
MapLike: TypeAlias = "MatchResult | MapPair | VertexMap | str | Path | Matcher | MapMaker | None"
"""What a transfer follows: a match or a map from source to target, its file, or who makes it when all else is
checked: a `Matcher`, or a function of both shapes."""


def find_maps(source: ShapeLike, target: ShapeLike, match: MapLike = None) -> MapPair:
    """The maps between two shapes, which transfers follow; several transfers can share one pair.

    Parameters
    ----------
    source, target
        As in `meshmatch.match`.
    match : MatchResult, VertexMap, path, Matcher or None
        A match or a map from source to target that is there already; or what the shapes are matched with.

    Raises
    ------
    MeshmatchError
        The map belongs to other shapes or has the opposite direction; or as `meshmatch.match`.
    """
    source, target = as_shape(source, "source"), as_shape(target, "target")
    if isinstance(match, str | Path):
        return pair_of_map(load_map(match), source, target, label=Path(match).name)
    if isinstance(match, VertexMap):
        return pair_of_map(match, source, target)
    found = match if isinstance(match, MatchResult | MapPair) else _maker(match)(source, target)
    if isinstance(found, MapPair):
        found.forward.for_shapes(source, target)
        return found
    return MapPair(source, target, found.map.for_shapes(source, target), found, found.threads)


def _maker(match: Matcher | MapMaker | None) -> MapMaker:
    if callable(match):
        return match
    from meshmatch.api.matching import Matcher

    matcher = Matcher() if match is None else match
    if not isinstance(matcher, Matcher):
        raise InputError(
            f"{type(match).__name__} is not a map",
            "pass a MatchResult, a VertexMap, the path of a map, a Matcher, or nothing to match the shapes",
        )
    return lambda source, target: matcher.match(source, target)
