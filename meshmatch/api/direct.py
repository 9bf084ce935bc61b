"""Direct matching of two shapes without a model, with the result type of `match`."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from meshmatch.api.inputs import LandmarkPairs, landmark_vertices, refuse_far_parts
from meshmatch.api.results import MatchResult, maps_of_fits
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.maps.build import judge_by_pairs
from meshmatch.progress import ProgressCallback
from meshmatch.shapes.parts import Parts
from meshmatch.shapes.repair import Repaired
from meshmatch.threads import thread_limit, worker_slot

if TYPE_CHECKING:
    from meshmatch.fitting.direct import DirectMatch
    from meshmatch.fitting.one_way import DirectConfig, KnownPairs

_NOTE_UNKNOWN = "no installed model knows these shapes: they were matched directly"
_NOTE_BETTER = "the model {} fits these shapes less well than they fit each other: they were matched directly"
_NOTE_UNUSED = "up, front and partial have no meaning without a model, and were not used"


def match_without_model(
    clean: Sequence[Repaired],
    configs: Sequence[FitConfig],
    landmarks: LandmarkPairs | None,
    threads: int,
    progress: ProgressCallback | None,
    unknown: bool = False,
    guess: MatchResult | None = None,
) -> MatchResult:
    """Match two repaired shapes directly: one of them serves as the template of both.

    With ``unknown``, the notes say that no model knows the shapes. ``guess`` is the result of a model whose verdict is not
    good: it is used as an initial correspondence, and returned if the direct match is not clearly better.

    `InputError` if a shape cannot be matched: it has large parts far apart, or is a cloud that is no surface.
    """
    from meshmatch.fitting.direct import MIN_ENERGY_LEAD
    from meshmatch.fitting.one_way import DirectConfig
    from meshmatch.fitting.same_pose import refine_match

    began, (source, target) = time.monotonic(), clean
    pairs = None if landmarks is None else landmark_vertices(clean, landmarks)
    known = None if pairs is None else (source.original.verts[pairs[0]], target.original.verts[pairs[1]])
    by_model = None if guess is None else (guess.source_fit.points_in_file, guess.target_fit.points_in_file)
    direct = DirectConfig(seed=configs[0].seed)
    found = _match_pair(source, target, configs[0], direct, threads, progress, known, by_model)
    if known is None and guess is None:
        with thread_limit(1), worker_slot(threading.Semaphore(threads)):
            found = refine_match(source.shape, target.shape, found, configs[0], progress)
    fits = replace(found.source, repaired=source), replace(found.target, repaired=target)
    verdict = found.verdict
    if guess is not None and verdict != "good" and (verdict == "poor" or found.guess_lead < MIN_ENERGY_LEAD):
        return guess
    with thread_limit(1):
        mapped, opposite = maps_of_fits((fits[0], fits[1]), (fits[0], fits[1]), threads)
        if pairs is not None:
            mapped = judge_by_pairs(mapped, target.original, pairs, fits[1].frame.scale)
    notes = direct_notes(clean, configs, unknown)
    if fits[0].frame.mirrored != fits[1].frame.mirrored:
        notes = (*notes, f"{target.shape.name}: taken for a mirror image of {source.shape.name}")
    for fit, one, other in zip(fits, clean, clean[::-1], strict=True):
        if fit.partial:
            notes = (*notes, f"{one.shape.name}: taken for a part of {other.shape.name}")
    if mapped.verdict == "poor":
        notes = (*notes, *_notes_on_parts(clean))
    if guess is not None:
        notes = (_NOTE_BETTER.format(guess.source_fit.model), *notes)
    seconds = time.monotonic() - began
    return MatchResult(mapped, fits[0], fits[1], seconds, notes, (fits[0], fits[1]), threads, opposite)


def fit_to_first(
    clean: Sequence[Repaired], configs: Sequence[FitConfig], threads: int, progress: ProgressCallback | None
) -> tuple[list[Fit], DirectMatch]:
    """Fit the first of two or more repaired shapes, as the template, to all others.

    Return the fits of all shapes, the first included, and the match of the first to the second. Errors as in
    `match_without_model`.
    """
    from meshmatch.fitting.one_way import DirectConfig

    first, *others = clean
    direct = DirectConfig(seed=configs[0].seed, from_source=True)
    found = [_match_pair(first, each, configs[0], direct, threads, progress) for each in others]
    fits = [replace(found[0].source, repaired=first)]
    fits += [replace(each.target, repaired=own) for each, own in zip(found, others, strict=True)]
    return fits, found[0]


def _match_pair(
    source: Repaired,
    target: Repaired,
    config: FitConfig,
    direct: DirectConfig,
    threads: int,
    progress: ProgressCallback | None,
    known: KnownPairs | None = None,
    guess: KnownPairs | None = None,
) -> DirectMatch:
    from meshmatch.fitting.direct import match_directly, match_either_side

    for each in (source, target):
        refuse_far_parts(each)
    match = match_directly if config.mirror == "no" else match_either_side
    with thread_limit(1), worker_slot(threading.Semaphore(threads)):
        return match(source.shape, target.shape, direct, known, progress, guess)


def direct_notes(clean: Sequence[Repaired], configs: Sequence[FitConfig], unknown: bool) -> tuple[str, ...]:
    """Notes on shapes that were matched directly; with ``unknown``, because no model knows them."""
    notes = [_NOTE_UNKNOWN] if unknown else []
    if any(each.up or each.front or each.partial == "yes" for each in configs):
        notes.append(_NOTE_UNUSED)
    notes += [f"{each.shape.name}: {note}" for each in clean for note in each.notes]
    return tuple(dict.fromkeys(notes))


def _notes_on_parts(clean: Sequence[Repaired]) -> list[str]:
    """Notes on shapes with several parts, none of which the user left out: no model can tell which do not belong to it."""
    counts = [0 if each.original.weights is not None else len(Parts.of(each.original, bases=True)) for each in clean]
    how = "if it is not all one object, choose with --only (`meshmatch info` lists parts)"
    return [f"{each.shape.name}: has {n} parts: {how}" for each, n in zip(clean, counts, strict=True) if n > 1]


def are_whole_meshes(clean: Sequence[Repaired], fits: Sequence[Fit]) -> bool:
    """Whether all shapes are complete meshes with no parts left out, so that they can also be matched directly."""
    are_complete = all(not (each.shape.is_cloud or each.far_parts or each.left_out) for each in clean)
    return are_complete and not any(fit.partial for fit in fits)
