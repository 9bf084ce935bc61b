"""Which of the installed models fits what users hand in: the shapes decide."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from meshmatch.api.inputs import as_model
from meshmatch.arrays import Float, Floats
from meshmatch.errors import InputError, MeshmatchError, ModelError, OptionError
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.fitter import may_show_part
from meshmatch.fitting.kind import KNOWN, SURE, is_of_kind, kind_samples, read_kind
from meshmatch.models.card import ModelCard
from meshmatch.models.registry import list_models
from meshmatch.models.trained import TrainedModel
from meshmatch.shapes.repair import Repaired
from meshmatch.shapes.shape import Shape
from meshmatch.threads import beside

_PEOPLE = "human"
_NAME_IT = "name the model with --model (model=...) if that is wrong"


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


def read_kinds(
    models: Sequence[Installed], shapes: Sequence[Shape], configs: Sequence[FitConfig], sure: float = SURE
) -> Float[Floats, "M S"]:
    """`read_kind` of repaired shapes by models; infinite where a model cannot see a shape, or was not asked.

    One shape decides first, if possible a whole one. The model of people, and the user's own, are asked about it, and all
    others only where none of these is ``sure``. Models of its kind are then asked about the other shapes, and the rest
    where they do not know them: but not about a part of something whose kind is known.
    """
    samples = beside(kind_samples, shapes, [config.seed for config in configs])

    def reading(model: Installed, number: int) -> float:
        try:
            return read_kind(model.load(), shapes[number], samples[number], configs[number])
        except OptionError:  # a device that is not there: true of all models
            raise
        except MeshmatchError:  # also of a damaged model: `meshmatch models list` tells what is wrong with it
            return np.inf

    found = np.full((len(models), len(shapes)), np.inf)

    def ask(rows: Iterable[int], numbers: Iterable[int]) -> None:
        at = [(row, number) for row in rows for number in numbers]
        for place, value in zip(at, beside(lambda at: reading(models[at[0]], at[1]), at), strict=True):
            found[place] = value

    parts = [_is_part(shape, config) for shape, config in zip(shapes, configs, strict=True)]
    first, *others = sorted(range(len(shapes)), key=lambda number: shapes[number].is_cloud or parts[number])
    likely = [row for row, model in enumerate(models) if model.card.category == _PEOPLE or not model.built_in]
    ask(likely, [first])
    if found[:, first].min() > sure:
        ask([row for row in range(len(models)) if row not in likely], [first])
    known = found[:, first].min() <= KNOWN
    kind = models[int(found[:, first].argmin())].card.category
    same = [row for row, model in enumerate(models) if model.card.category == kind and known]
    ask(same, others)
    unknown = [number for number in others if found[:, number].min() > KNOWN and not (known and parts[number])]
    ask([row for row in range(len(models)) if row not in same], unknown)
    return found


def _is_part(shape: Shape, config: FitConfig) -> bool:
    """Whether its user says that a shape is a part, and it may be one."""
    return config.partial == "yes" and may_show_part(shape, replace(config, partial="auto"))


def choose_model(
    clean: Sequence[Repaired], configs: Sequence[FitConfig], settled: TrainedModel | None = None
) -> tuple[TrainedModel, list[str]]:
    """The installed model that knows the kind of all the shapes, and a few words on each; or ``settled``, if it does.

    A cloud, or a shape that may be a part of something, is of the other shapes' kind where its own cannot be told.
    `InputError` if two shapes are of different kinds, or one of none; `ModelError` if no model is installed.
    """
    models = installed_models()
    if settled is not None and settled.card not in [model.card for model in models]:
        models.append(Installed.loaded(settled))
    shapes = [each.shape for each in clean]
    readings = read_kinds(models, shapes, configs)
    if np.isinf(readings).all():
        raise _no_model()
    kinds = kinds_of(models, readings, shapes, configs)
    told: dict[str, str] = {} if settled is None else {settled.card.category: "the shapes before"}
    for shape, kind in zip(shapes, kinds, strict=True):
        if kind is not None and kind not in told and told:
            ((other, name),) = told.items()
            problem = f"two kinds of shapes: {name}: {other}; {shape.name}: {kind}"
            raise InputError(problem, f"match shapes of one kind; {_NAME_IT}")
        if kind is not None:
            told.setdefault(kind, shape.name)
    common = next(iter(told), models[int(readings.sum(1).argmin())].card.category)
    rows = [row for row, model in enumerate(models) if model.card.category == common]
    chosen = settled or models[min(rows, key=lambda row: readings[row].sum())].load()
    unsure = f"may be a part, or a rough cloud: taken for {common}; {_NAME_IT}"
    return chosen, [f"{s.name}: {k}" if k else f"{s.name} {unsure}" for s, k in zip(shapes, kinds, strict=True)]


def kinds_of(
    models: Sequence[Installed], readings: Float[Floats, "M S"], shapes: Sequence[Shape], configs: Sequence[FitConfig]
) -> list[str | None]:
    """The category of each shape's best reading, None for a cloud or a part that is not known to be of that kind.

    `InputError` for a complete mesh that is not of that kind (`is_of_kind`).
    """
    found: list[str | None] = []
    for shape, config, column in zip(shapes, configs, readings.T, strict=True):
        best = int(column.argmin())
        kind = models[best].card.category
        whole = not shape.is_cloud and not may_show_part(shape, config)
        known = column[best] <= KNOWN
        if (whole or (shape.is_cloud and config.partial != "yes")) and np.isfinite(column[best]):
            rivals = [reading for model, reading in zip(models, column, strict=True) if model.card.category != kind]
            known = is_of_kind(models[best].load(), shape, column[best], config, min(rivals, default=np.inf))
        found.append(kind if known else None)
        if whole and not known:
            names = ", ".join(sorted({model.card.category for model in models}))
            problem = f"{shape.name} is of no kind that the installed models know: {names}"
            raise InputError(problem, "if it is of one of them, name its model with --model (model=...)")
    return found


def other_kind(model: TrainedModel, shape: Shape, config: FitConfig) -> str | None:
    """The kind that a repaired shape is of by the installed models, if that is another one than the model's."""
    try:
        models = installed_models()
        (kind,) = kinds_of(models, read_kinds(models, [shape], [config]), [shape], [config])
    except (InputError, ModelError):
        return None
    return None if kind == model.card.category else kind
