"""What of a file is fitted where the whole is of no known kind, or fits poorly: its parts are tried apart.

A body may stand on a pedestal or a floor, carry a box, or share its file with a chair. Readings by models tell which parts
are a shape that they know; the others are left out, as `load_shape` leaves out those that a user names, and are said.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import NoReturn

import numpy as np

from meshmatch.api.inputs import usable
from meshmatch.arrays import Float, Floats
from meshmatch.errors import InputError
from meshmatch.fitting.classify import classify
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.fitter import Fitter, may_show_part
from meshmatch.fitting.judge.category import BELONGS, FAMILIAR, STRANGE, SURE, Readings
from meshmatch.models.trained import TrainedModel
from meshmatch.progress import ProgressCallback
from meshmatch.shapes.parts import Parts, apart, tries, without_parts
from meshmatch.shapes.repair import NOT_TRUSTED, Repaired
from meshmatch.shapes.shape import Shape

Loader = Callable[[], TrainedModel]
_AS_WELL = 0.003  # what also reads so much worse (units of sqrt(area)) keeps what touches it, such as clothes
_AS_LARGE = 0.5  # share of the area of what reads best from which on another shape of the kind may be meant instead
_MOST_FITS = 2  # of parts that read strangely, in a long search
# Residual up to which a fit of them is likely to be found; stylised characters on pedestals had 0.051, others, whose fits
# were poor, 0.058. Set by hand.
_PROMISING = 0.054
_TOLD = 6  # numbers of parts in a line


@dataclass(frozen=True, eq=False)
class Alone:
    """Some parts of a shape that are a shape by themselves.

    ``clean`` is what is left, with the way back to all vertices of the file; ``readings`` are by the models that were asked,
    infinite for others, ``row`` is the model that reads it best, and ``fit`` the one by it, with refined nodes, that had to
    tell, if any.
    """

    clean: Repaired
    readings: Float[Floats, " M"]
    row: int
    fit: Fit | None = None

    def usable_fit(self, config: FitConfig) -> Fit | None:
        """The fit, if it is one that the config asks for."""
        return self.fit if config.refine == "nodes" else None


def find_alone(
    models: Sequence[Loader],
    whole: Shape,
    config: FitConfig,
    order: Iterable[Sequence[int]] | None = None,
    progress: ProgressCallback | None = None,
) -> Alone | None:
    """The parts of a shape that are a shape which one of the models knows; None where there are none, or where its user
    chose parts or says that it is a part itself. ``order`` says which models (rows) are asked together, until one knows
    some parts; by default all. Of parts that read strangely, the most promising are fitted to find out; others only
    where the config says to try harder.

    `InputError` where different parts are such shapes, and nothing tells which one is meant.
    """
    if whole.weights is not None or config.partial == "yes":
        return None
    parts = Parts.of(whole, bases=True)
    sets, clean = [], []
    for numbers in tries(parts):
        with suppress(InputError):  # too few faces to be fitted
            rest = usable(without_parts(whole, parts, parts.others(numbers)))
            if not rest.far_parts:
                sets.append(numbers)
                clean.append(rest)
    if not sets:
        return None
    readings = Readings(models, [each.shape for each in clean], [config] * len(clean))
    found = readings.found
    for rows in order or [range(len(models))]:
        readings.ask(rows, range(len(clean)))
        if found.min() <= FAMILIAR:
            break
    value = found.min(axis=0)

    def trusted(k: int) -> Fit | None:
        """The fit of a set that reads strangely, if it shows that this is such a shape."""
        model = models[int(found[:, k].argmin())]()
        of_kind, fit = classify(model, clean[k].shape, value[k], config, progress)
        return fit if of_kind and fit is not None and fit.trust >= BELONGS and not fit.partial else None

    known = [k for k in range(len(sets)) if value[k] <= FAMILIAR]
    if known:
        chosen, fit = _fullest(parts, sets, value, known), None
    else:
        most, least_known = (_MOST_FITS, STRANGE) if config.try_harder else (1, _PROMISING)
        for chosen in [int(k) for k in value.argsort(kind="stable")[:most] if value[k] <= least_known]:
            if (fit := trusted(chosen)) is not None:
                break
        else:
            return None
    copied = clean[chosen].copied  # the same figure again, at another place of the scene: either is meant
    copies = [k for k in range(len(sets)) if copied is not None and copied[np.isin(parts.number, list(sets[k]))].all()]
    others = _rivals(parts, sets, chosen, [k for k in known if k not in copies])
    if not others:  # another one may be in a pose that reads strangely
        promising = [k for k in range(len(sets)) if FAMILIAR < value[k] <= _PROMISING and k not in copies]
        others = [k for k in _rivals(parts, sets, chosen, promising, beside=True)[:1] if trusted(k) is not None]
    if others:
        _refuse_to_choose(whole, parts, [sets[k] for k in (chosen, *others)])
    left_out = parts.others(sets[chosen])
    notes = [note for note in clean[chosen].notes if not note.endswith(NOT_TRUSTED)]
    rest = replace(clean[chosen], notes=(left_out_words(parts, left_out), *notes), left_out=left_out)
    return Alone(rest, found[:, chosen], int(found[:, chosen].argmin()), fit)


def fit_of_parts(
    model: TrainedModel, clean: Repaired, config: FitConfig, progress: ProgressCallback | None
) -> tuple[Fit, Repaired] | None:
    """A fit of some parts of a shape whose fit as a whole is poor, and these parts; None where that is poor too."""
    alone = find_alone([lambda: model], clean.original, config, progress=progress)
    if alone is None:
        return None
    fit = alone.usable_fit(config) or Fitter(model, config, progress).fit(alone.clean.shape)
    return None if fit.verdict == "poor" else (fit, alone.clean)


def may_be_parts(clean: Repaired, config: FitConfig) -> bool:
    """Whether a long search would try a mesh, or what it is made of, as parts of something."""
    if clean.shape.is_cloud:
        return False
    return len(Parts.of(clean.original, bases=True)) > 1 or may_show_part(clean.shape, config)


def left_out_words(parts: Parts, numbers: Sequence[int]) -> str:
    """What is said of parts that were left out."""
    those = f"{len(numbers)} of {len(parts)} parts"
    if min(numbers) > len(parts) - parts.bases:
        those = "the flat base that it is fused with" if parts.bases == 1 else f"{parts.bases} flat bases"
    share = f"{100 * parts.share(numbers):.0f} % of the area"
    return f"left out {those}, {share}: {_listed(numbers)} (--only and --without choose parts)"


def _listed(numbers: Sequence[int]) -> str:
    more = f" and {len(numbers) - _TOLD} more" if len(numbers) > _TOLD else ""
    return f"{'part' if len(numbers) == 1 else 'parts'} {', '.join(map(str, numbers[:_TOLD]))}{more}"


def _fullest(parts: Parts, sets: Sequence[frozenset[int]], value: Floats, known: Sequence[int]) -> int:
    """The set that reads best, or one around it that reads as well: a body in its clothes rather than without."""
    best = min(known, key=lambda k: value[k])
    as_well = max(SURE, value[best] + _AS_WELL)
    return max((k for k in known if sets[k] >= sets[best] and value[k] <= as_well), key=lambda k: parts.share(sets[k]))


def _rivals(
    parts: Parts, sets: Sequence[frozenset[int]], best: int, among: Sequence[int], beside: bool = False
) -> list[int]:
    """Which sets may be meant instead of the best one, the largest first: those that are large enough and ``beside`` it; by
    default also those around it that are in no such set together with it, as clothes would be.
    """
    least = _AS_LARGE * parts.share(sets[best])

    def another(one: frozenset[int]) -> bool:
        as_clothes = beside or one & sets[best] or any(sets[k] >= one | sets[best] for k in among)
        return apart(parts, one, sets[best]) or not as_clothes

    rivals = [k for k in among if k != best and parts.share(sets[k]) >= least and another(sets[k])]
    return sorted(rivals, key=lambda k: -parts.share(sets[k]))


def _refuse_to_choose(whole: Shape, parts: Parts, rivals: Sequence[frozenset[int]]) -> NoReturn:
    """Two people in one file (`InputError`)."""
    firsts = sorted({min(each) for each in rivals})
    shares = " and ".join(f"part {n} ({100 * parts.shares[n - 1]:.0f} % of the area)" for n in firsts[:3])
    problem = f"{whole.name or 'the shape'} holds several shapes of one kind: {shares} fit about equally well"
    raise InputError(problem, f"choose one with --only {firsts[0]} or --only {firsts[1]} (only= of load_shape)")
