"""Write recipes to model cards and read them back.

A file may come from an untrusted source: it contains only numbers and strings, all of which are checked, and no code.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any, get_args

from meshmatch.errors import InputError, MeshmatchError, OptionError, warn
from meshmatch.geometry.kernels import KERNELS
from meshmatch.models.card import ModelCard
from meshmatch.models.checkpoint import Storage
from meshmatch.models.network import NetworkConfig
from meshmatch.shapes.input_files import read_json
from meshmatch.training.limits import with_changes
from meshmatch.training.loop import OF_THE_MACHINE, processes
from meshmatch.training.losses import ChamferLoss, CorrespondenceLoss, Objective
from meshmatch.training.recipes import Recipe

_LOSSES: dict[str, type[Objective]] = {
    f"{each.__module__}.{each.__qualname__}": each for each in (CorrespondenceLoss, ChamferLoss)
}
_PARTS = {"network", "field", "recipe"}
_HISTORY = ("start", "earlier", "validation", "processes")
_RECIPE_FIELDS = ("deform", "storage", "template", "characters", "bodies", "stylised")
_HINT = "give the card.json of a model, or a part of one: network, field.kernel, recipe.train, recipe.scan"


def recipe_record(recipe: Recipe) -> dict[str, Any]:
    """The part of a recipe that a card stores under ``recipe``: all but network and kernel, with the loss's class name.

    `OptionError` if a custom loss has fields that are not numbers or strings.
    """
    loss = type(recipe.train.loss)
    record: dict[str, Any] = {"train": asdict(recipe.train), "scan": asdict(recipe.scan)}
    record |= {"loss": f"{loss.__module__}.{loss.__qualname__}"} | {
        name: getattr(recipe, name) for name in _RECIPE_FIELDS
    }
    try:
        json.dumps(record, allow_nan=False)
    except (TypeError, ValueError) as error:
        hint = "fields of a loss are numbers and words, which the model's card holds"
        raise OptionError(f"a card cannot hold this recipe: {error}", hint) from error
    return record


def read_recipe(path: str | Path, usual: Recipe, started: bool = False) -> Recipe:
    """Read the recipe from a card, or from a file with parts of one; missing settings are taken from ``usual``.

    Settings that depend on the machine (minutes, threads, device, where batches are drawn, compiling) are ignored. Warns
    where a training with this recipe cannot repeat the original one: if that began from another model and this is not
    ``started`` from one, used another number of processes, or changed its settings on the way.

    `InputError` if the file is not a recipe, contains unknown names, or names a custom loss.
    """
    path = Path(path)
    try:
        record = read_json(path)
        if not isinstance(record, dict):
            raise InputError("it is not an object")
        if unknown := sorted(record.keys() - {each.name for each in fields(ModelCard)}):
            raise InputError(f"{unknown[0]} is unknown")
        if not record.keys() & _PARTS:
            raise InputError("it has no training settings")
        stored = _object(record.get("recipe", {}), "recipe")
        train = _object(stored.get("train", {}), "recipe.train")
        loss = _loss(record, stored, usual)
        loss = with_changes(loss, _object(train.get("loss", {}), "recipe.train.loss"), "recipe.train.loss")
        steps = {name: value for name, value in train.items() if name not in ("loss", *OF_THE_MACHINE)}
        stored_fields = {name: stored[name] for name in _RECIPE_FIELDS if name in stored}
        if unknown := sorted(stored.keys() - {"train", "scan", "loss", *_HISTORY, *_RECIPE_FIELDS}):
            raise InputError(f"recipe.{unknown[0]} is unknown")
        network = _object(record.get("network", {}), "network")
        kernel = _object(record.get("field", {}), "field").get("kernel", usual.kernel)
        changed = with_changes(usual, stored_fields, "recipe")
        if kernel not in tuple(KERNELS) or changed.storage not in get_args(Storage):
            raise InputError("its kernel or storage is unknown")
        if Path(changed.template).name != changed.template:
            raise InputError("recipe.template must be the name of an included template")
        _warn_of_history(path.name, {"processes": 1} | stored if "weights_sha256" in record else stored, started)
        return replace(
            changed,
            network=NetworkConfig.from_dict(usual.network.to_dict() | network),
            train=replace(with_changes(usual.train, steps, "recipe.train"), loss=loss),
            scan=with_changes(usual.scan, _object(stored.get("scan", {}), "recipe.scan"), "recipe.scan"),
            kernel=kernel,
        )
    except MeshmatchError as error:
        raise InputError(f"{path.name} is not a recipe: {error.message}", error.hint or _HINT) from error
    except (OSError, ValueError) as error:
        raise InputError(f"{path.name} is not a recipe: {str(error).splitlines()[0]}", _HINT) from error


def _warn_of_history(name: str, stored: Mapping[str, Any], started: bool) -> None:
    """Warn if the recorded training cannot be repeated from its recipe alone."""
    if stored.get("start") and not started:
        start_name = stored["start"].get("model", "another") if isinstance(stored["start"], dict) else "another"
        warn(
            f"{name} is from a training that started from the model {str(start_name)[:64]}; this one does not (--start)"
        )
    if stored.get("processes", now := processes()) != now:
        before = str(stored["processes"])[:9]
        warn(f"{name}: processes, each with its own batches, were {before} in that training, and are {now} in this one")
    if stored.get("earlier"):
        warn(f"{name} is from a training whose settings changed on the way; this one uses the last of them throughout")


def _loss(record: Mapping[str, Any], stored: Mapping[str, Any], usual: Recipe) -> Objective:
    """The loss of the class that the file names; older cards state only whether shapes have correspondence."""
    if "loss" in stored:
        if stored["loss"] not in tuple(_LOSSES):
            hint = "its author has the class; put it into a recipe in Python (docs/training.md)"
            raise InputError(f"it was trained with {str(stored['loss'])[:80]!r}, a custom loss", hint)
        kind = _LOSSES[stored["loss"]]
    elif "correspondence" in record:
        kind = CorrespondenceLoss if record["correspondence"] is not False else ChamferLoss
    else:
        return usual.train.loss
    return usual.train.loss if type(usual.train.loss) is kind else kind()


def _object(value: Any, where: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise InputError(f"{where} must be an object")
    return value
