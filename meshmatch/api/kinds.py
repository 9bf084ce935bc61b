"""Choose among the installed models by the kinds of the given shapes."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from meshmatch.api.inputs import UnknownKindsError, as_model, refuse_far_parts
from meshmatch.api.known_parts import find_known_parts
from meshmatch.arrays import Float, Floats
from meshmatch.errors import InputError, ModelError, OptionError
from meshmatch.fitting.classify import classify
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.fitter import boundary_length, may_be_part
from meshmatch.fitting.judge.category import (
    MAX_CERTAIN_RESIDUAL,
    MAX_KNOWN_RESIDUAL,
    MAX_UNRIVALLED_RESIDUAL,
    CategoryResiduals,
)
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
# Categories that are evaluated after people and before the others; how many models are evaluated at a time.
_SECOND_CATEGORIES, _GROUP_SIZE = ("quadruped",), 2
# Trust above which a shape with an uncertain kind may be of the other shapes' kind; set by hand: a character with a large
# head and short limbs has 0.48; planes, hearts, bones and dinosaurs have 0.13 at most.
_MIN_PLAUSIBLE_TRUST = 0.25
_MAX_CLASSIFIED = 40  # files of a folder that are classified
_HINT_MODEL = "name the model (--model NAME, in Python model=NAME) if that is wrong"
_HINT_DIRECT = "--model none matches two shapes directly"
_HINT_WITHOUT = "exclude what does not belong to it with --without (`meshmatch info` lists parts), or try --try-harder"


@dataclass(frozen=True)
class Installed:
    """A candidate model, loaded when it is first evaluated."""

    card: ModelCard
    load: Callable[[], TrainedModel]
    built_in: bool = False

    @classmethod
    def loaded(cls, model: TrainedModel) -> Installed:
        return cls(model.card, lambda: model)


def installed_models() -> list[Installed]:
    """The explicit models of the registry with readable cards; `ModelError` if there are none."""
    found = [
        Installed(entry.card, partial(as_model, entry.folder), entry.built_in)
        for entry in list_models()
        if isinstance(entry.card, ModelCard)
    ]
    if not found:
        raise _no_model_error()
    return found


def _no_model_error() -> ModelError:
    return ModelError("no model is installed", "see `meshmatch models list`")


def category_residuals(
    models: Sequence[Installed],
    shapes: Sequence[Shape],
    configs: Sequence[FitConfig],
    sure: float = MAX_UNRIVALLED_RESIDUAL,
) -> Float[Floats, "M S"]:
    """Compute `category_residual` of repaired shapes by models, evaluating as few pairs as needed.

    1. One shape comes first: a complete mesh if possible, else the mesh with the shortest boundary.
    2. The model of people and the user's own models are evaluated on it. Unless one of them has a residual of at most
       ``sure``, the other models follow, two at a time and animals first, until one has.
    3. The models of the category found are evaluated on the other shapes.
    4. All other models are evaluated on the shapes that those models do not know, except partial shapes if the category is
       known.

    The residual is infinite for pairs that are not evaluated, and where a model cannot be evaluated on a shape.
    """
    evaluator = CategoryResiduals([model.load for model in models], shapes, configs)
    found = evaluator.found
    parts = [_is_part(shape, config) for shape, config in zip(shapes, configs, strict=True)]
    boundary = [
        np.inf if shape.is_cloud else part * boundary_length(shape) / np.sqrt(shape.area)
        for shape, part in zip(shapes, parts, strict=True)
    ]
    first, *others = np.argsort(boundary, kind="stable").tolist()
    for rows in _order(models):
        evaluator.ask(rows, [first])
        if found[:, first].min() <= sure:
            break
    known = found[:, first].min() <= MAX_KNOWN_RESIDUAL
    kind = models[int(found[:, first].argmin())].card.category
    same = [row for row, model in enumerate(models) if model.card.category == kind and known]
    evaluator.ask(same, others)
    unknown = [
        number for number in others if found[:, number].min() > MAX_KNOWN_RESIDUAL and not (known and parts[number])
    ]
    evaluator.ask([row for row in range(len(models)) if row not in same], unknown)
    return found


def _order(models: Sequence[Installed]) -> list[list[int]]:
    """Group the models (rows) by the order in which they are evaluated."""
    likely = [row for row, model in enumerate(models) if model.card.category == _PEOPLE or not model.built_in]
    rest = sorted(
        set(range(len(models))) - set(likely), key=lambda row: models[row].card.category not in _SECOND_CATEGORIES
    )
    return [likely, *(rest[first : first + _GROUP_SIZE] for first in range(0, len(rest), _GROUP_SIZE))]


def _is_part(shape: Shape, config: FitConfig) -> bool:
    """Whether the user says that a shape is partial, and its surface is consistent with that."""
    return config.partial == "yes" and may_be_part(shape, replace(config, partial="auto"))


@dataclass(frozen=True, eq=False)
class Classification:
    """The kind of one shape.

    Attributes
    ----------
    kind
        The category, None if it is uncertain.
    card
        The card of the model with the lowest residual.
    fit
        The fit by that model, with refined nodes, if one was needed to decide.
    """

    kind: str | None
    card: ModelCard
    fit: Fit | None = None


@dataclass(frozen=True, eq=False)
class Choice:
    """The model for several shapes.

    Attributes
    ----------
    model
        The chosen model.
    clean
        What is fitted of each shape: all of it, or some parts.
    notes
        One note on the kind of each shape.
    fits
        The fit of each shape by the model, if one was needed to find its kind.
    parts_tried
        Whether the parts of each shape were tried on their own.
    """

    model: TrainedModel
    clean: list[Repaired]
    notes: list[str]
    fits: list[Fit | None]
    parts_tried: list[bool]


def choose_model(
    clean: Sequence[Repaired],
    configs: Sequence[FitConfig],
    settled: TrainedModel | None = None,
    progress: ProgressCallback | None = None,
) -> Choice:
    """Choose the installed model that knows the kind of all shapes; ``settled``, if given, is the model chosen before.

    A point cloud, or a shape that may be partial, takes the kind of the other shapes if its own is uncertain. So does a mesh
    that resembles that kind weakly, if it resembles no other kind more; several such meshes take the kind they all resemble.
    If a mesh is of no known kind, or has large parts far apart, parts of it that are of a known kind are selected
    (`meshmatch.api.known_parts`).

    `InputError` if the shapes are of different kinds, or one of no known kind; `ModelError` if no model is installed.
    """
    models = installed_models()
    if settled is not None and settled.card not in [model.card for model in models]:
        models.append(Installed.loaded(settled))
    shapes = [each.shape for each in clean]
    Progress(progress, shapes[0].name).stage("looking for its kind")(0.0)
    residuals = category_residuals(models, shapes, configs)
    if np.isinf(residuals).all():
        raise _no_model_error()
    found = _classify_all(models, residuals, shapes, configs, progress)
    clean = list(clean)
    parts_tried = [known.kind is None or each.far_parts > 0 for known, each in zip(found, clean, strict=True)]
    for number in np.flatnonzero(parts_tried).tolist():
        config = configs[number]
        Progress(progress, shapes[number].name).stage("looking at its parts")(0.0)
        loaders, whole = [model.load for model in models], clean[number].original
        if (alone := find_known_parts(loaders, whole, config, _order(models), progress)) is not None:
            card = models[alone.row].card
            clean[number], residuals[:, number] = alone.clean, alone.residuals
            found[number] = Classification(card.category, card, alone.fit)
        refuse_far_parts(clean[number])
    shapes = [each.shape for each in clean]
    _refuse_unknown(models, residuals, found, shapes, configs)
    names: dict[str, str] = {} if settled is None else {settled.card.category: "the shapes before"}
    for shape, kind in zip(shapes, [each.kind for each in found], strict=True):
        if kind is not None and kind not in names and names:
            ((other, name),) = names.items()
            problem = f"two kinds of shapes: {name}: {other}; {shape.name}: {kind}"
            raise InputError(problem, f"match shapes of one kind; {_HINT_MODEL}; {_HINT_DIRECT}")
        if kind is not None:
            names.setdefault(kind, shape.name)
    common = next(iter(names), models[int(residuals.sum(1).argmin())].card.category)
    rows = [row for row, model in enumerate(models) if model.card.category == common]
    chosen = settled or models[min(rows, key=lambda row: residuals[row].sum())].load()
    suffix = "" if chosen.card.name == common else f" (model {chosen.card.name})"
    notes = [
        f"{shape.name or 'the shape'}: {each.kind}{suffix}"
        if each.kind
        else f"{shape.name} {_uncertain_note(shape, each, common + suffix, len(shapes) == 2)}"
        for shape, each in zip(shapes, found, strict=True)
    ]
    usable = [
        each.fit if each.card == chosen.card and config.refine == "nodes" else None
        for each, config in zip(found, configs, strict=True)
    ]
    return Choice(chosen, clean, notes, usable, parts_tried)


def _uncertain_note(shape: Shape, found: Classification, assumed: str, is_pair: bool) -> str:
    why = "may be a part, or a rough cloud" if shape.is_cloud else "may be a part, or several objects"
    if not shape.is_cloud and found.fit is not None and _may_be_of_kind(found, {found.card.category}):
        why = why if found.fit.partial else f"hardly looks like it (trust {found.fit.trust:.2f})"
    hints = [_HINT_MODEL] + [_HINT_DIRECT] * is_pair + [_HINT_WITHOUT] * (not shape.is_cloud)
    return f"{why}: treated as {assumed}; {'; '.join(hints)}"


def classify_shapes(
    models: Sequence[Installed],
    residuals: Float[Floats, "M S"],
    shapes: Sequence[Shape],
    configs: Sequence[FitConfig],
    progress: ProgressCallback | None = None,
) -> list[Classification]:
    """Classify shapes by their residuals, and by fits where these are inconclusive (`meshmatch.fitting.classify`).

    `InputError` for a complete mesh that is not of the kind whose model has the lowest residual.
    """
    found = _classify_all(models, residuals, shapes, configs, progress)
    _refuse_unknown(models, residuals, found, shapes, configs)
    return found


def _classify_all(
    models: Sequence[Installed],
    residuals: Float[Floats, "M S"],
    shapes: Sequence[Shape],
    configs: Sequence[FitConfig],
    progress: ProgressCallback | None,
) -> list[Classification]:
    def classify_one(shape: Shape, config: FitConfig, column: Float[Floats, " M"]) -> Classification:
        best = models[row := int(column.argmin())]
        kind = best.card.category
        if np.isinf(column[row]):
            return Classification(None, best.card)
        if _is_part(shape, config):  # its fit would say no more than the residual
            return Classification(kind if column[row] <= MAX_KNOWN_RESIDUAL else None, best.card)
        known, fit = classify(best.load(), shape, column[row], config, progress)
        return Classification(kind if known else None, best.card, fit)

    return parallel_map(classify_one, shapes, configs, residuals.T)


def _refuse_unknown(
    models: Sequence[Installed],
    residuals: Float[Floats, "M S"],
    found: Sequence[Classification],
    shapes: Sequence[Shape],
    configs: Sequence[FitConfig],
) -> None:
    kinds = {each.kind for each in found if each.kind is not None}
    if not kinds and len(found) > 1:
        kinds = {each.card.category for each in found}
    for shape, config, each, nearest in zip(shapes, configs, found, residuals.min(0), strict=True):
        unknown = each.kind is None and not shape.is_cloud and not may_be_part(shape, config)
        if unknown and not _may_be_of_kind(each, kinds):
            names = ", ".join(sorted({model.card.category for model in models}))
            problem = f"{shape.name} does not look like anything that the installed models know: {names}"
            error = UnknownKindsError if all(other.kind is None for other in found) else InputError
            hint = _nearest_kind_hint(each) if np.isfinite(nearest) else _HINT_WITHOUT
            raise error(problem, f"{hint}; {_HINT_DIRECT}" if len(found) == 2 else hint)


def _may_be_of_kind(found: Classification, kinds: Collection[str]) -> bool:
    """Whether a mesh of uncertain kind may be of the kind of the other shapes, if these have only one."""
    return found.fit is not None and found.fit.trust >= _MIN_PLAUSIBLE_TRUST and set(kinds) == {found.card.category}


def _nearest_kind_hint(found: Classification) -> str:
    """Hint for a shape of no known kind: the nearest kind, and how to insist on it."""
    name, trust = found.card.name, "" if found.fit is None else f", trust {found.fit.trust:.2f}"
    named = f"if it is one, name the model: --model {name} (in Python model={name!r})"
    return f"nearest: {found.card.category}{trust}; {named}; {_HINT_WITHOUT}"


def differing_kind(model: TrainedModel, shape: Shape, config: FitConfig) -> str | None:
    """The kind of a repaired shape by the installed models, if it differs from the model's; else None."""
    try:
        models = installed_models()
        residuals = category_residuals(models, [shape], [config])
        if models[int(residuals.argmin())].card.category == model.card.category:
            return None
        return classify_shapes(models, residuals, [shape], [config])[0].kind
    except (InputError, ModelError):
        return None


def kinds_of(
    files: Mapping[str, Path], seed: int = 0, progress: ProgressCallback | None = None
) -> dict[str, str | None]:
    """Classify the shapes in files by their residuals for the included models; None if the kind is uncertain.

    Of more than `_MAX_CLASSIFIED` files, that many are classified, evenly spaced. `ModelError` if no model is included.
    """
    models = [model for model in installed_models() if model.built_in]
    if not models:
        raise _no_model_error()
    config, names = FitConfig(seed=seed), list(files)
    sampled = [names[k] for k in np.linspace(0, len(names) - 1, min(len(names), _MAX_CLASSIFIED)).round().astype(int)]
    found: dict[str, str | None] = {}
    for number, name in enumerate(sampled):
        try:
            residuals = category_residuals(models, [repair(load_shape(files[name])).shape], [config])[:, 0]
        except InputError:  # of no use to any model
            residuals = np.full(len(models), np.inf)
        best = int(residuals.argmin())
        found[name] = models[best].card.category if residuals[best] <= MAX_CERTAIN_RESIDUAL else None
        if progress is not None:
            progress("looking for known kinds", "shapes", (number + 1) / len(sampled))
    return found


def is_person(shape: Shape) -> bool:
    """Whether the included model of people recognises a shape with certainty; False if it is not installed."""
    people = [model for model in installed_models() if model.built_in and model.card.category == _PEOPLE]
    try:
        return (
            bool(people)
            and category_residuals(people[:1], [repair(shape).shape], [FitConfig()])[0, 0] <= MAX_UNRIVALLED_RESIDUAL
        )
    except InputError:  # of no use to any model
        return False


def error_unit(name: UnitName, target: Shape) -> ErrorUnit:
    """The unit of errors on a target; ``"auto"``: centimetres for a person, else the unit of its file.

    `OptionError` if there is no such unit.
    """
    if not isinstance(name, str) or name not in get_args(UnitName):
        raise OptionError(f"invalid unit {name!r}", f"choose one of {', '.join(get_args(UnitName))}")
    if name == "x100":
        return X100
    return CM if name == "cm" or (name == "auto" and is_person(target)) else ErrorUnit.of_file(target)


def kind_notes(kinds: Mapping[str, str | None], folder: Path) -> list[str]:
    """Notes on the `kinds_of` the shapes of a folder, if most are known: the model that knows them, or a list of kinds.

    Kinds of less than a tenth of the shapes are ignored, as they are probably misclassified.
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
