"""What verbs say about shapes, fits and maps: in words, and as records for --json."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from meshmatch.cli.console import Console, Json
from meshmatch.errors import PoorFit

if TYPE_CHECKING:
    from meshmatch.api.results import MatchResult
    from meshmatch.fitting.fit import Fit
    from meshmatch.maps.vertex_map import VertexMap

_HINT = "is it the model's category? try --up and --front, or leave out --strict to see the result"


def names_of(paths: Sequence[Path], names: Sequence[str] = ()) -> list[str]:
    """Names to show, those of the files if none are given; where two files have the same, with their folders."""
    names = names or [path.name for path in paths]
    real: dict[str, set[str]] = {}
    for path, name in zip(paths, names, strict=True):
        real.setdefault(name, set()).add(os.path.realpath(path))
    return [name if len(real[name]) == 1 else str(path) for path, name in zip(paths, names, strict=True)]


def refuse_poor(strict: bool, verdict: str, reasons: Sequence[str]) -> None:
    """With --strict, a poor fit is an error (`PoorFit`)."""
    if strict and verdict == "poor":
        raise PoorFit(f"poor fit, nothing was written: {why(reasons)}", _HINT)


def tell_verdict(console: Console, verdict: str, reasons: Sequence[str], what: str = "the fit") -> None:
    """A warning where it is poor, notes where it is fair."""
    if verdict == "poor":
        console.warn(f"{what} is poor: {why(reasons)}")
    elif verdict != "good":
        for reason in reasons:
            console.say(f"note: {reason}")


def why(reasons: Sequence[str]) -> str:
    """The reasons of a verdict in one line."""
    return "; ".join(reasons) or "no reason was given"


def fit_words(fit: Fit) -> str:
    """The verdict and the axes."""
    return f"{fit.verdict} fit, up {fit.up}, front {fit.front}"


def tell_match(console: Console, result: MatchResult, names: Sequence[str]) -> None:
    """What was repaired, and how both shapes were fitted."""
    for note in result.notes:
        console.say(note)
    for name, fit in zip(names, (result.source_fit, result.target_fit), strict=True):
        console.say(f"{name}: {fit_words(fit)}")


def fit_record(name: str, fit: Fit) -> Json:
    """A fit for --json."""
    record = {"shape": name, "verdict": fit.verdict, "reasons": fit.reasons, "residual": float(fit.residual)}
    return record | {"up": fit.up, "front": fit.front, "seconds": round(fit.seconds, 3), "seed": fit.seed}


def map_record(found: VertexMap, names: Sequence[str]) -> Json:
    """A map for --json."""
    sizes = {"source_vertices": found.source_vertices, "target_vertices": found.target_vertices}
    return {"source": names[0], "target": names[1]} | sizes | {"verdict": found.verdict, "reasons": found.reasons}


def match_record(result: MatchResult, names: Sequence[str]) -> Json:
    """A match for --json."""
    from meshmatch.maps.vertex_map import DIRECTION

    confidence = float(result.map.confidence.mean())
    fits = [fit_record(*each) for each in zip(names, (result.source_fit, result.target_fit), strict=True)]
    about = {"direction": DIRECTION, "confidence_mean": confidence, "notes": result.notes, "fits": fits}
    return map_record(result.map, names) | about | {"seconds": round(result.seconds, 3)}
