"""Select the parts of a file to fit when the whole file is of no known kind, or fits poorly.

A body may stand on a pedestal or a floor, carry a box, or share its file with a chair. The residuals of the models'
predictions show which parts are a shape of a known kind. The other parts are left out, as with ``load_shape(without=...)``,
and a note lists them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import NoReturn

import numpy as np

from meshmatch.api.inputs import repair_allowing_parts
from meshmatch.arrays import Float, Floats
from meshmatch.errors import InputError
from meshmatch.fitting.classify import classify
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.fitter import Fitter, may_be_part
from meshmatch.fitting.judge.category import (
    MAX_CERTAIN_RESIDUAL,
    MAX_UNRIVALLED_RESIDUAL,
    MIN_CATEGORY_TRUST,
    MIN_FOREIGN_RESIDUAL,
    CategoryResiduals,
)
from meshmatch.models.trained import TrainedModel
from meshmatch.progress import ProgressCallback
from meshmatch.shapes.parts import Parts, are_separate, candidate_sets, without_parts
from meshmatch.shapes.repair import NOT_TRUSTED, Repaired
from meshmatch.shapes.shape import Shape

Loader = Callable[[], TrainedModel]
# A larger set of parts, such as a body with its clothes, is preferred while its residual exceeds the best one by at most
# this (units of sqrt(area)).
_RESIDUAL_MARGIN = 0.003
_MIN_RIVAL_AREA = 0.5  # area of another shape that may be meant instead, as a share of the area of the best one
_MAX_FITS = 2  # sets of parts with an inconclusive residual that are fitted, in a long search
# Residual up to which a fit of them is likely to succeed; stylised characters on pedestals had 0.051, others, whose fits
# were poor, 0.058. Set by hand.
_MAX_PROMISING = 0.054
_MAX_LISTED = 6  # part numbers in a message


@dataclass(frozen=True, eq=False)
class KnownParts:
    """Parts of a file that are a shape of a known kind by themselves.

    Attributes
    ----------
    clean
        The repaired parts, with the correspondence to all vertices of the file.
    residuals
        (M,) `category_residual` by each model; infinite for models that were not evaluated.
    row
        Index of the model with the lowest residual.
    fit
        The fit by that model, with refined nodes, if one was needed to decide.
    """

    clean: Repaired
    residuals: Float[Floats, " M"]
    row: int
    fit: Fit | None = None

    def usable_fit(self, config: FitConfig) -> Fit | None:
        """Return the fit if the config asks for refined nodes, as it has."""
        return self.fit if config.refine == "nodes" else None


def find_known_parts(
    models: Sequence[Loader],
    whole: Shape,
    config: FitConfig,
    order: Iterable[Sequence[int]] | None = None,
    progress: ProgressCallback | None = None,
) -> KnownParts | None:
    """Find the parts of a file that are a shape of a kind that one of the models knows.

    Parameters
    ----------
    models
        Loaders of the M models.
    whole
        The shape as it was loaded.
    config
        How it is fitted. With ``try_harder``, more sets of parts with inconclusive residuals are fitted to decide.
    order
        Groups of rows of ``models``, evaluated one after the other until a model knows some parts; by default all at once.
    progress
        As in `match`.

    Returns
    -------
    KnownParts or None
        None if there are no such parts, if the user chose parts (the shape has weights), or if ``config.partial`` is "yes".

    Raises
    ------
    InputError
        Several shapes of one kind fit about equally well.
    """
    if whole.weights is not None or config.partial == "yes":
        return None
    parts = Parts.of(whole, bases=True)
    sets, clean = [], []
    for numbers in candidate_sets(parts):
        with suppress(InputError):  # too few faces to be fitted
            rest = repair_allowing_parts(without_parts(whole, parts, parts.others(numbers)))
            if not rest.far_parts:
                sets.append(numbers)
                clean.append(rest)
    if not sets:
        return None
    evaluator = CategoryResiduals(models, [each.shape for each in clean], [config] * len(clean))
    found = evaluator.found
    for rows in order or [range(len(models))]:
        evaluator.ask(rows, range(len(clean)))
        if found.min() <= MAX_CERTAIN_RESIDUAL:
            break
    value = found.min(axis=0)

    def confirming_fit(k: int) -> Fit | None:
        """Fit a set with an inconclusive residual; return the fit if it confirms the kind."""
        model = models[int(found[:, k].argmin())]()
        of_kind, fit = classify(model, clean[k].shape, value[k], config, progress)
        return fit if of_kind and fit is not None and fit.trust >= MIN_CATEGORY_TRUST and not fit.partial else None

    known = [k for k in range(len(sets)) if value[k] <= MAX_CERTAIN_RESIDUAL]
    if known:
        chosen, fit = _largest_good_set(parts, sets, value, known), None
    else:
        n_fits, max_value = (_MAX_FITS, MIN_FOREIGN_RESIDUAL) if config.try_harder else (1, _MAX_PROMISING)
        for chosen in [int(k) for k in value.argsort(kind="stable")[:n_fits] if value[k] <= max_value]:
            if (fit := confirming_fit(chosen)) is not None:
                break
        else:
            return None
    copied = clean[chosen].copied  # copies of one figure elsewhere in the scene are no rivals: either may be fitted
    copies = [k for k in range(len(sets)) if copied is not None and copied[np.isin(parts.number, list(sets[k]))].all()]
    others = _rivals(parts, sets, chosen, [k for k in known if k not in copies])
    if not others:  # another figure may be in a pose with an inconclusive residual
        promising = [
            k for k in range(len(sets)) if MAX_CERTAIN_RESIDUAL < value[k] <= _MAX_PROMISING and k not in copies
        ]
        others = [
            k for k in _rivals(parts, sets, chosen, promising, separate=True)[:1] if confirming_fit(k) is not None
        ]
    if others:
        _refuse_to_choose(whole, parts, [sets[k] for k in (chosen, *others)])
    left_out = parts.others(sets[chosen])
    notes = [note for note in clean[chosen].notes if not note.endswith(NOT_TRUSTED)]
    rest = replace(clean[chosen], notes=(left_out_note(parts, left_out), *notes), left_out=left_out)
    return KnownParts(rest, found[:, chosen], int(found[:, chosen].argmin()), fit)


def fit_known_parts(
    model: TrainedModel, clean: Repaired, config: FitConfig, progress: ProgressCallback | None
) -> tuple[Fit, Repaired] | None:
    """Fit parts of a shape whose fit as a whole is poor.

    Return the fit and the parts, or None if no parts are of the model's kind or their fit is poor too.
    """
    alone = find_known_parts([lambda: model], clean.original, config, progress=progress)
    if alone is None:
        return None
    fit = alone.usable_fit(config) or Fitter(model, config, progress).fit(alone.clean.shape)
    return None if fit.verdict == "poor" else (fit, alone.clean)


def may_contain_known_parts(clean: Repaired, config: FitConfig) -> bool:
    """Whether a longer search could fit a mesh as partial, or parts of it on their own."""
    if clean.shape.is_cloud:
        return False
    return len(Parts.of(clean.original, bases=True)) > 1 or may_be_part(clean.shape, config)


def left_out_note(parts: Parts, numbers: Sequence[int]) -> str:
    """Describe the parts that were left out, and how to choose others."""
    those = f"{len(numbers)} of {len(parts)} parts"
    if min(numbers) > len(parts) - parts.bases:
        those = "the flat base that it is fused with" if parts.bases == 1 else f"{parts.bases} flat bases"
    share = f"{100 * parts.share(numbers):.0f} % of the area"
    return f"left out {those}, {share}: {_listed(numbers)} (--only and --without choose parts)"


def _listed(numbers: Sequence[int]) -> str:
    more = f" and {len(numbers) - _MAX_LISTED} more" if len(numbers) > _MAX_LISTED else ""
    return f"{'part' if len(numbers) == 1 else 'parts'} {', '.join(map(str, numbers[:_MAX_LISTED]))}{more}"


def _largest_good_set(parts: Parts, sets: Sequence[frozenset[int]], value: Floats, known: Sequence[int]) -> int:
    """Index of the set with the lowest residual, or of the largest superset with about the same residual.

    A body with its clothes is preferred to the body alone.
    """
    best = min(known, key=lambda k: value[k])
    max_residual = max(MAX_UNRIVALLED_RESIDUAL, value[best] + _RESIDUAL_MARGIN)
    return max(
        (k for k in known if sets[k] >= sets[best] and value[k] <= max_residual), key=lambda k: parts.share(sets[k])
    )


def _rivals(
    parts: Parts, sets: Sequence[frozenset[int]], best: int, among: Sequence[int], separate: bool = False
) -> list[int]:
    """Indices of the sets that may be meant instead of the best one, the largest first.

    These are large enough and lie apart from it. Unless ``separate``, a set that surrounds the best one also counts, if no
    set contains both, as one would if it were its clothes.
    """
    min_share = _MIN_RIVAL_AREA * parts.share(sets[best])

    def is_another(one: frozenset[int]) -> bool:
        may_be_clothes = separate or one & sets[best] or any(sets[k] >= one | sets[best] for k in among)
        return are_separate(parts, one, sets[best]) or not may_be_clothes

    rivals = [k for k in among if k != best and parts.share(sets[k]) >= min_share and is_another(sets[k])]
    return sorted(rivals, key=lambda k: -parts.share(sets[k]))


def _refuse_to_choose(whole: Shape, parts: Parts, rivals: Sequence[frozenset[int]]) -> NoReturn:
    """Raise `InputError`: several shapes of one kind, such as two people in one file."""
    firsts = sorted({min(each) for each in rivals})
    shares = " and ".join(f"part {n} ({100 * parts.shares[n - 1]:.0f} % of the area)" for n in firsts[:3])
    problem = f"{whole.name or 'the shape'} contains several shapes of one kind: {shares} fit about equally well"
    raise InputError(problem, f"choose one with --only {firsts[0]} or --only {firsts[1]} (only= of load_shape)")
