"""Which of the installed models fits what users hand in: the shapes decide."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from meshmatch.api.inputs import as_model
from meshmatch.arrays import Float, Floats
from meshmatch.errors import InputError, MeshmatchError, ModelError
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.fitter import may_show_part
from meshmatch.fitting.kind import KNOWN, kind_samples, read_kind
from meshmatch.models.registry import list_models
from meshmatch.models.trained import TrainedModel
from meshmatch.shapes.repair import Repaired
from meshmatch.shapes.shape import Shape
from meshmatch.threads import beside

_NAME_IT = "name the model with --model (model=...) if that is wrong"


def installed_models() -> list[TrainedModel]:
    """The models of the registry that can be loaded; `ModelError` if there are none."""
    found = []
    for entry in list_models():
        try:
            found.append(as_model(entry.folder))
        except MeshmatchError:  # `meshmatch models list` tells what is wrong with it
            continue
    if not found:
        raise ModelError("no model is installed", "see `meshmatch models list`")
    return found


def read_kinds(
    models: Sequence[TrainedModel], shapes: Sequence[Shape], configs: Sequence[FitConfig]
) -> Float[Floats, "M S"]:
    """`read_kind` of repaired shapes by models; infinite where a model cannot see a shape, or was not asked.

    Every model is asked about the first shape. Those of its kind are asked about the others first, and the rest only where
    they do not know them.
    """
    samples = beside(kind_samples, shapes, [config.seed for config in configs])

    def reading(model: TrainedModel, number: int) -> float:
        try:
            return read_kind(model, shapes[number], samples[number], configs[number])
        except MeshmatchError:
            return np.inf

    found = np.full((len(models), len(shapes)), np.inf)

    def ask(rows: Iterable[int], numbers: Iterable[int]) -> None:
        at = [(row, number) for row in rows for number in numbers]
        for place, value in zip(at, beside(lambda at: reading(models[at[0]], at[1]), at), strict=True):
            found[place] = value

    every, others = range(len(models)), range(1, len(shapes))
    ask(every, [0])
    kind = models[int(found[:, 0].argmin())].card.category
    same = [row for row in every if models[row].card.category == kind and found[:, 0].min() <= KNOWN]
    ask(same, others)
    ask([row for row in every if row not in same], [number for number in others if found[:, number].min() > KNOWN])
    return found


def choose_model(
    clean: Sequence[Repaired], configs: Sequence[FitConfig], settled: TrainedModel | None = None
) -> tuple[TrainedModel, list[str]]:
    """The installed model that knows the kind of all the shapes, and a few words on each; or ``settled``, if it does.

    A cloud, or a shape that may be a part of something, is of the other shapes' kind where its own cannot be told.
    `InputError` if two shapes are of different kinds, or one of none; `ModelError` if no model is installed.
    """
    models = installed_models()
    if settled is not None and settled not in models:
        models.append(settled)
    shapes = [each.shape for each in clean]
    readings = read_kinds(models, shapes, configs)
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
    chosen = settled or models[min(rows, key=lambda row: readings[row].sum())]
    unsure = f"may be a part, or a rough cloud: taken for {common}; {_NAME_IT}"
    return chosen, [f"{s.name}: {k}" if k else f"{s.name} {unsure}" for s, k in zip(shapes, kinds, strict=True)]


def kinds_of(
    models: Sequence[TrainedModel],
    readings: Float[Floats, "M S"],
    shapes: Sequence[Shape],
    configs: Sequence[FitConfig],
) -> list[str | None]:
    """The category of each shape's best reading, None where it is too high for a shape that may hide some of itself.

    `InputError` where it is too high for a complete shape.
    """
    found: list[str | None] = []
    for shape, config, column in zip(shapes, configs, readings.T, strict=True):
        best = int(column.argmin())
        found.append(models[best].card.category if column[best] <= KNOWN else None)
        if found[-1] is None and not shape.is_cloud and not may_show_part(shape, config):
            known = ", ".join(sorted({model.card.category for model in models}))
            problem = f"{shape.name} is of no kind that the installed models know: {known}"
            raise InputError(problem, "if it is of one of them, name its model with --model (model=...)")
    return found
