"""Recipes on model cards, and how they are read back.

A file may come from anywhere: it holds plain numbers and words, all of them checked, and names no code that is run.
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
from meshmatch.training.limits import filled
from meshmatch.training.loop import OF_THE_MACHINE, processes
from meshmatch.training.losses import ChamferLoss, CorrespondenceLoss, Objective
from meshmatch.training.recipes import Recipe

_LOSSES: dict[str, type[Objective]] = {
    f"{each.__module__}.{each.__qualname__}": each for each in (CorrespondenceLoss, ChamferLoss)
}
_PARTS = {"network", "field", "recipe"}
_HISTORY = ("start", "earlier", "validation", "processes")
_OWN = ("deform", "storage", "template", "characters", "bodies", "stylised")
_HINT = "give the card.json of a model, or a part of one: network, field.kernel, recipe.train, recipe.scan"


def recipe_record(recipe: Recipe) -> dict[str, Any]:
    """What a card says of a recipe, besides its network and kernel; with the class of the loss by its name.

    `OptionError` if a loss of somebody's own has fields that are no plain numbers and words.
    """
    loss = type(recipe.train.loss)
    record: dict[str, Any] = {"train": asdict(recipe.train), "scan": asdict(recipe.scan)}
    record |= {"loss": f"{loss.__module__}.{loss.__qualname__}"} | {name: getattr(recipe, name) for name in _OWN}
    try:
        json.dumps(record, allow_nan=False)
    except (TypeError, ValueError) as error:
        hint = "fields of a loss are numbers and words, which the model's card holds"
        raise OptionError(f"a card cannot hold this recipe: {error}", hint) from error
    return record


def read_recipe(path: str | Path, usual: Recipe, started: bool = False) -> Recipe:
    """The recipe of a card, or of a file that has parts of one; what it does not say is as in the usual one.

    What belongs to the machine (minutes, threads, device, where batches are drawn, compiling) is not taken from a file.
    Warns where a training by it is another: one that is not ``started`` from the model that it names, one by more or fewer
    processes, or one of several stages.
    `InputError` if it is none, names something unknown, or was learned by a loss that is not meshmatch's own.
    """
    path = Path(path)
    try:
        record = read_json(path)
        if not isinstance(record, dict):
            raise InputError("it is not an object")
        if unknown := sorted(record.keys() - {each.name for each in fields(ModelCard)}):
            raise InputError(f"{unknown[0]} is unknown")
        if not record.keys() & _PARTS:
            raise InputError("it says nothing of a training")
        own = _object(record.get("recipe", {}), "recipe")
        train = _object(own.get("train", {}), "recipe.train")
        loss = _loss(record, own, usual)
        loss = filled(loss, _object(train.get("loss", {}), "recipe.train.loss"), "recipe.train.loss")
        steps = {name: value for name, value in train.items() if name not in ("loss", *OF_THE_MACHINE)}
        more = {name: own[name] for name in _OWN if name in own}
        if unknown := sorted(own.keys() - {"train", "scan", "loss", *_HISTORY, *_OWN}):
            raise InputError(f"recipe.{unknown[0]} is unknown")
        network = _object(record.get("network", {}), "network")
        kernel = _object(record.get("field", {}), "field").get("kernel", usual.kernel)
        found = filled(usual, more, "recipe")
        if kernel not in tuple(KERNELS) or found.storage not in get_args(Storage):
            raise InputError("its kernel or storage is unknown")
        if Path(found.template).name != found.template:
            raise InputError("recipe.template must be the name of an included template")
        _tell_history(path.name, {"processes": 1} | own if "weights_sha256" in record else own, started)
        return replace(
            found,
            network=NetworkConfig.from_dict(usual.network.to_dict() | network),
            train=replace(filled(usual.train, steps, "recipe.train"), loss=loss),
            scan=filled(usual.scan, _object(own.get("scan", {}), "recipe.scan"), "recipe.scan"),
            kernel=kernel,
        )
    except MeshmatchError as error:
        raise InputError(f"{path.name} is no recipe: {error.message}", error.hint or _HINT) from error
    except (OSError, ValueError) as error:
        raise InputError(f"{path.name} is no recipe: {str(error).splitlines()[0]}", _HINT) from error


def _tell_history(name: str, own: Mapping[str, Any], started: bool) -> None:
    """Warn of what a recipe has behind it."""
    if own.get("start") and not started:
        known = own["start"].get("model", "another") if isinstance(own["start"], dict) else "another"
        warn(f"{name} is of a training that started from the model {str(known)[:64]}; this one starts anew (--start)")
    if own.get("processes", now := processes()) != now:
        before = str(own["processes"])[:9]
        warn(
            f"{name}: processes, each with batches of its own, were {before} in that training, and are {now} in this one"
        )
    if own.get("earlier"):
        warn(f"{name} is of a training whose settings changed on the way; this one has the last of them throughout")


def _loss(record: Mapping[str, Any], own: Mapping[str, Any], usual: Recipe) -> Objective:
    """A loss of the class that the file names; older cards say only whether shapes corresponded."""
    if "loss" in own:
        if own["loss"] not in tuple(_LOSSES):
            hint = "its author has the class; put it into a recipe in Python (docs/training.md)"
            raise InputError(f"it was learned by {str(own['loss'])[:80]!r}, a loss of somebody's own", hint)
        kind = _LOSSES[own["loss"]]
    elif "correspondence" in record:
        kind = CorrespondenceLoss if record["correspondence"] is not False else ChamferLoss
    else:
        return usual.train.loss
    return usual.train.loss if type(usual.train.loss) is kind else kind()


def _object(value: Any, where: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise InputError(f"{where} must be an object")
    return value
