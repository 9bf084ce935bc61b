"""Which of the installed models fits what users hand in: the shapes decide."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from meshmatch.api.apart import find_known_parts
from meshmatch.api.inputs import UnknownKindsError, as_model, refuse_far_parts
from meshmatch.arrays import Float, Floats
from meshmatch.errors import InputError, ModelError, OptionError
from meshmatch.fitting.classify import classify
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.fitter import boundary_length, may_show_part
from meshmatch.fitting.judge.category import FAMILIAR, KNOWN, SURE, Readings
from meshmatch.maps.evaluate import CM, X100, ErrorUnit
from meshmatch.models.card import ModelCard
from meshmatch.models.registry import list_models
from meshmatch.models.trained import TrainedModel
from meshmatch.progress import Progress, ProgressCallback
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.repair import Repaired, repair
from meshmatch.shapes.shape import Shape
from meshmatch.threads import parallel_map

UnitName = Literal["auto", "cm", "file", "x100"]

_PEOPLE = "human"
_NEXT, _TOGETHER = ("quadruped",), 2  # asked after people, before the others; how many models at a time
# Trust from which on a shape that its model hardly knows may be of the other shapes' kind; set by hand: a character with a
# large head and short limbs has 0.48; planes, hearts, bones and dinosaurs have 0.13 at most.
_PERHAPS = 0.25
_MOST_READ = 40  # files of a folder whose kind is found out
_NAME_IT = "name the model (--model NAME, in Python model=NAME) if that is wrong"
_LEAVE_OUT = "exclude what does not belong to it with --without (`meshmatch info` lists parts), or try --try-harder"


@dataclass(frozen=True)
class Installed:
    """A model that shapes may be of, loaded when it is first asked."""

    card: ModelCard
    load: Callable[[], TrainedModel]
    built_in: bool = False

    @classmethod
    def loaded(cls, model: TrainedModel) -> Installed:
        return cls(model.card, lambda: model)


def installed_models() -> list[Installed]:
    """The models of the registry whose cards can be read; `ModelError` if there are none."""
    found = [
        Installed(entry.card, partial(as_model, entry.folder), entry.built_in)
        for entry in list_models()
        if isinstance(entry.card, ModelCard)
    ]
    if not found:
        raise _no_model()
    return found


def _no_model() -> ModelError:
    return ModelError("no model is installed", "see `meshmatch models list`")


def category_residuals(
    models: Sequence[Installed], shapes: Sequence[Shape], configs: Sequence[FitConfig], sure: float = SURE
) -> Float[Floats, "M S"]:
    """`category_residual` of repaired shapes by models; infinite where a model cannot see a shape, or was not asked.

    One shape decides first, if possible a whole one, or that with the shortest boundary. The model of people, and the
    user's own, are asked about it, and the others where none of these is ``sure``: two at a time, animals first, until one
    is. Models of its kind are then asked about the other shapes, and the rest where they do not know them: but not about a
    part of something whose kind is known.
    """
    readings = Readings([model.load for model in models], shapes, configs)
    found = readings.found
    parts = [_is_part(shape, config) for shape, config in zip(shapes, configs, strict=True)]
    lacking = [
        np.inf if shape.is_cloud else part * boundary_length(shape) / np.sqrt(shape.area)
        for shape, part in zip(shapes, parts, strict=True)
    ]
    first, *others = np.argsort(lacking, kind="stable").tolist()
    for rows in _order(models):
        readings.ask(rows, [first])
        if found[:, first].min() <= sure:
            break
    known = found[:, first].min() <= KNOWN
    kind = models[int(found[:, first].argmin())].card.category
    same = [row for row, model in enumerate(models) if model.card.category == kind and known]
    readings.ask(same, others)
    unknown = [number for number in others if found[:, number].min() > KNOWN and not (known and parts[number])]
    readings.ask([row for row in range(len(models)) if row not in same], unknown)
    return found


def _order(models: Sequence[Installed]) -> list[list[int]]:
    """Which models (rows) are asked together, one group after the other."""
    likely = [row for row, model in enumerate(models) if model.card.category == _PEOPLE or not model.built_in]
    rest = sorted(set(range(len(models))) - set(likely), key=lambda row: models[row].card.category not in _NEXT)
    return [likely, *(rest[first : first + _TOGETHER] for first in range(0, len(rest), _TOGETHER))]


def _is_part(shape: Shape, config: FitConfig) -> bool:
    """Whether its user says that a shape is a part, and it may be one."""
    return config.partial == "yes" and may_show_part(shape, replace(config, partial="auto"))


@dataclass(frozen=True, eq=False)
class Classification:
    """What is known of one shape: its kind, None where that cannot be told; the card of the model that reads it best; and
    the fit by it, with refined nodes, that had to tell, if any.
    """

    kind: str | None
    card: ModelCard
    fit: Fit | None = None


@dataclass(frozen=True, eq=False)
class Choice:
    """The model that knows all of some shapes. For each shape what is fitted of it: all, or some parts; a few words; a fit
    by the model that telling its kind took, if any; and whether its parts were tried apart.
    """

    model: TrainedModel
    clean: list[Repaired]
    words: list[str]
    fits: list[Fit | None]
    tried: list[bool]


def choose_model(
    clean: Sequence[Repaired],
    configs: Sequence[FitConfig],
    settled: TrainedModel | None = None,
    progress: ProgressCallback | None = None,
) -> Choice:
    """The installed model that knows the kind of all the shapes; or ``settled``, if it does.

    A cloud, or a shape that may be a part of something, is of the other shapes' kind where its own cannot be told; so is a
    mesh that hardly looks like that kind, but more so than like any other, as are several such meshes together. Of a
    mesh of no kind, or of parts far apart, those parts are chosen that are of a kind (`meshmatch.api.apart`).
    `InputError` if two shapes are of different kinds, or one of none; `ModelError` if no model is installed.
    """
    models = installed_models()
    if settled is not None and settled.card not in [model.card for model in models]:
        models.append(Installed.loaded(settled))
    shapes = [each.shape for each in clean]
    Progress(progress, shapes[0].name).stage("looking for its kind")(0.0)
    readings = category_residuals(models, shapes, configs)
    if np.isinf(readings).all():
        raise _no_model()
    found = _classified(models, readings, shapes, configs, progress)
    clean = list(clean)
    tried = [known.kind is None or each.far_parts > 0 for known, each in zip(found, clean, strict=True)]
    for number in np.flatnonzero(tried).tolist():
        config = configs[number]
        Progress(progress, shapes[number].name).stage("looking at its parts")(0.0)
        loaders, whole = [model.load for model in models], clean[number].original
        if (alone := find_known_parts(loaders, whole, config, _order(models), progress)) is not None:
            card = models[alone.row].card
            clean[number], readings[:, number] = alone.clean, alone.readings
            found[number] = Classification(card.category, card, alone.fit)
        refuse_far_parts(clean[number])
    shapes = [each.shape for each in clean]
    _refuse_unknown(models, readings, found, shapes, configs)
    names: dict[str, str] = {} if settled is None else {settled.card.category: "the shapes before"}
    for shape, kind in zip(shapes, [each.kind for each in found], strict=True):
        if kind is not None and kind not in names and names:
            ((other, name),) = names.items()
            problem = f"two kinds of shapes: {name}: {other}; {shape.name}: {kind}"
            raise InputError(problem, f"match shapes of one kind; {_NAME_IT}")
        if kind is not None:
            names.setdefault(kind, shape.name)
    common = next(iter(names), models[int(readings.sum(1).argmin())].card.category)
    rows = [row for row, model in enumerate(models) if model.card.category == common]
    chosen = settled or models[min(rows, key=lambda row: readings[row].sum())].load()
    by = "" if chosen.card.name == common else f" (model {chosen.card.name})"
    words = [
        f"{shape.name or 'the shape'}: {each.kind}{by}"
        if each.kind
        else f"{shape.name} {_unsure(shape, each, common + by)}"
        for shape, each in zip(shapes, found, strict=True)
    ]
    usable = [
        each.fit if each.card == chosen.card and config.refine == "nodes" else None
        for each, config in zip(found, configs, strict=True)
    ]
    return Choice(chosen, clean, words, usable, tried)


def _unsure(shape: Shape, found: Classification, taken: str) -> str:
    why = "may be a part, or a rough cloud" if shape.is_cloud else "may be a part, or several objects"
    if not shape.is_cloud and found.fit is not None and _perhaps(found, {found.card.category}):
        why = f"hardly looks like it (trust {found.fit.trust:.2f})"
    hint = _NAME_IT if shape.is_cloud else f"{_NAME_IT}; {_LEAVE_OUT}"
    return f"{why}: treated as {taken}; {hint}"


def classify_shapes(
    models: Sequence[Installed],
    readings: Float[Floats, "M S"],
    shapes: Sequence[Shape],
    configs: Sequence[FitConfig],
    progress: ProgressCallback | None = None,
) -> list[Classification]:
    """What the readings, and fits of those that read strangely, tell of each shape (`meshmatch.fitting.classify`).

    `InputError` for a complete mesh that is not of the kind that reads it best.
    """
    found = _classified(models, readings, shapes, configs, progress)
    _refuse_unknown(models, readings, found, shapes, configs)
    return found


def _classified(
    models: Sequence[Installed],
    readings: Float[Floats, "M S"],
    shapes: Sequence[Shape],
    configs: Sequence[FitConfig],
    progress: ProgressCallback | None,
) -> list[Classification]:
    def tell(shape: Shape, config: FitConfig, column: Float[Floats, " M"]) -> Classification:
        best = models[row := int(column.argmin())]
        kind = best.card.category
        if np.isinf(column[row]):
            return Classification(None, best.card)
        if _is_part(shape, config):  # whose fit would tell nothing that the reading does not
            return Classification(kind if column[row] <= KNOWN else None, best.card)
        known, fit = classify(best.load(), shape, column[row], config, progress)
        return Classification(kind if known else None, best.card, fit)

    return parallel_map(tell, shapes, configs, readings.T)


def _refuse_unknown(
    models: Sequence[Installed],
    readings: Float[Floats, "M S"],
    found: Sequence[Classification],
    shapes: Sequence[Shape],
    configs: Sequence[FitConfig],
) -> None:
    kinds = {each.kind for each in found if each.kind is not None}
    if not kinds and len(found) > 1:
        kinds = {each.card.category for each in found}
    for shape, config, each, nearest in zip(shapes, configs, found, readings.min(0), strict=True):
        unknown = each.kind is None and not shape.is_cloud and not may_show_part(shape, config)
        if unknown and not _perhaps(each, kinds):
            names = ", ".join(sorted({model.card.category for model in models}))
            problem = f"{shape.name} does not look like anything that the installed models know: {names}"
            error = UnknownKindsError if all(other.kind is None for other in found) else InputError
            raise error(problem, _nearest(each) if np.isfinite(nearest) else _LEAVE_OUT)


def _perhaps(found: Classification, kinds: Collection[str]) -> bool:
    """Whether a mesh of no known kind may be of the only kind that the other shapes are of, or may be of."""
    return found.fit is not None and found.fit.trust >= _PERHAPS and set(kinds) == {found.card.category}


def _nearest(found: Classification) -> str:
    """What to do about a shape of no known kind: the kind that comes nearest, and how to insist on it."""
    name, trust = found.card.name, "" if found.fit is None else f", trust {found.fit.trust:.2f}"
    named = f"if it is one, name the model: --model {name} (in Python model={name!r})"
    return f"nearest: {found.card.category}{trust}; {named}; {_LEAVE_OUT}"


def other_kind(model: TrainedModel, shape: Shape, config: FitConfig) -> str | None:
    """The kind that a repaired shape is of by the installed models, if that is another one than the model's."""
    try:
        models = installed_models()
        readings = category_residuals(models, [shape], [config])
        if models[int(readings.argmin())].card.category == model.card.category:
            return None
        return classify_shapes(models, readings, [shape], [config])[0].kind
    except (InputError, ModelError):
        return None


def kinds_of(
    files: Mapping[str, Path], seed: int = 0, progress: ProgressCallback | None = None
) -> dict[str, str | None]:
    """The kind of the shape in each file, by the readings of the included models: None where none is sure of it.

    Of more than `_MOST_READ` files as many, evenly spread. `ModelError` if no model is included.
    """
    models = [model for model in installed_models() if model.built_in]
    if not models:
        raise _no_model()
    config, names = FitConfig(seed=seed), list(files)
    read = [names[k] for k in np.linspace(0, len(names) - 1, min(len(names), _MOST_READ)).round().astype(int)]
    found: dict[str, str | None] = {}
    for number, name in enumerate(read):
        try:
            readings = category_residuals(models, [repair(load_shape(files[name])).shape], [config])[:, 0]
        except InputError:  # of no use to any model
            readings = np.full(len(models), np.inf)
        best = int(readings.argmin())
        found[name] = models[best].card.category if readings[best] <= FAMILIAR else None
        if progress is not None:
            progress("looking for known kinds", "shapes", (number + 1) / len(read))
    return found


def is_person(shape: Shape) -> bool:
    """Whether the model of people is sure of a shape, without asking others; False if it is not installed."""
    people = [model for model in installed_models() if model.built_in and model.card.category == _PEOPLE]
    try:
        return bool(people) and category_residuals(people[:1], [repair(shape).shape], [FitConfig()])[0, 0] <= SURE
    except InputError:  # of no use to any model
        return False


def error_unit(name: UnitName, target: Shape) -> ErrorUnit:
    """What errors on a target are told in; ``"auto"``: centimetres on a person, else the unit of its file.

    `OptionError` if there is no such unit.
    """
    if not isinstance(name, str) or name not in get_args(UnitName):
        raise OptionError(f"invalid unit {name!r}", f"choose one of {', '.join(get_args(UnitName))}")
    if name == "x100":
        return X100
    return CM if name == "cm" or (name == "auto" and is_person(target)) else ErrorUnit.of_file(target)


def kind_notes(kinds: Mapping[str, str | None], folder: Path) -> list[str]:
    """What is to be said of the `kinds_of` a folder, if most are known: which model knows them, or that they are of several
    kinds. One shape of many is more likely misread than strange.
    """
    names: dict[str, list[str]] = {}
    for name, kind in kinds.items():
        if kind is not None:
            names.setdefault(kind, []).append(name)
    if 2 * sum(map(len, names.values())) <= len(kinds):
        return []
    several = {kind: own for kind, own in names.items() if 10 * len(own) >= len(kinds)}
    if len(several) > 1:
        each = (f"{kind} ({', '.join(own[:3])}{', ...' if len(own) > 3 else ''})" for kind, own in several.items())
        return [
            f"these seem to be {len(several)} kinds of shapes: {'; '.join(each)}; a model learns one: split the folder"
        ]
    begin = f"`meshmatch fit {shlex.quote(str(folder))} -o fits` and `meshmatch train --shapes fits -o MODEL`"
    return [f"the model {next(iter(several))} knows these shapes: to begin with it, {begin}"]
