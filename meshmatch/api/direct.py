"""Matching of two shapes without a model, as `match` gives it back."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import replace

from meshmatch.api.inputs import LandmarkPairs, landmark_vertices, refuse_far_parts
from meshmatch.api.results import MatchResult, map_of_fits
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.maps.build import judged_by_pairs
from meshmatch.progress import ProgressCallback
from meshmatch.shapes.repair import Repaired
from meshmatch.threads import thread_limit, worker_slot

_UNKNOWN = "no installed model knows these shapes: they were matched directly"
_UNUSED = "up, front and partial have no meaning without a model, and were not used"


def match_without_model(
    clean: Sequence[Repaired],
    configs: Sequence[FitConfig],
    landmarks: LandmarkPairs | None,
    threads: int,
    progress: ProgressCallback | None,
    unknown: bool = False,
) -> MatchResult:
    """The map of two repaired shapes, of which the first is the template of both; ``unknown`` says that no model knew them.

    `InputError` where a shape cannot be matched: large parts far apart, or a cloud that is no surface.
    """
    from meshmatch.fitting import direct

    for each in clean:
        refuse_far_parts(each)
    source, target = clean
    pairs = None if landmarks is None else landmark_vertices(clean, landmarks)
    known = None if pairs is None else (source.original.verts[pairs[0]], target.original.verts[pairs[1]])
    config = direct.DirectConfig(seed=configs[0].seed)
    with thread_limit(1), worker_slot(threading.Semaphore(threads)):
        found = direct.match_directly(source.shape, target.shape, config, known, progress)
        fits = replace(found.source, repaired=source), replace(found.target, repaired=target)
        mapped = map_of_fits(fits, fits, threads)
        if pairs is not None:
            mapped = judged_by_pairs(mapped, target.original, pairs, fits[1].frame.scale)
    notes = [_UNKNOWN] if unknown else []
    if any(each.up or each.front or each.partial == "yes" for each in configs):
        notes.append(_UNUSED)
    notes += [f"{each.shape.name}: {note}" for each in clean for note in each.notes]
    return MatchResult(mapped, *fits, fits[1].seconds, tuple(dict.fromkeys(notes)), fits, threads)
