"""What a model is, in words and numbers: a strict JSON card beside its weights, one class for each kind of model.

Standard library alone, so that listing models stays cheap: importing this module takes 0.06 s of CPU time, and four times
that with a pydantic model (measured on a shared 2-core machine, 2026-11-22; `models list` would take 0.43 s, not 0.23 s).
"""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, fields
from dataclasses import field as entry
from datetime import datetime
from pathlib import Path
from typing import Any, ClassVar, NoReturn, TypeVar

from meshmatch.errors import ModelError
from meshmatch.outputs import replace_on_success

SCHEMA = 4
IMPLICIT = "implicit.json"
"""The file of an implicit model's card."""
MAX_BYTES = 1_000_000
"""A larger file is not a card."""
ORIENTATIONS = ("searched", "none", "near", "rigid")
"""How a fit finds the orientation: asks the network, takes what the file has, improves that, or tries all turns."""
SCALES = ("area", "sphere")
MIRRORINGS = ("auto", "no")
"""Whether a fit also tries the mirror image of a shape: left hands for a model of right ones."""

_NAME = re.compile(r"[a-z0-9][a-z0-9._-]{0,63}")
_OLD_FRAME = {"orientation": "searched", "scale": "area"}
_SINCE: dict[int, dict[str, Any]] = {  # what cards of older schemas lack, and what they meant
    1: {"frame": _OLD_FRAME, "stiffness": 1.0, "mirror": "no"},
    2: {"stiffness": 1.0, "mirror": "no"},
    3: {"mirror": "no"},
}
_KINDS: dict[str, tuple[type, str]] = {  # by annotation
    "str": (str, "text"),
    "int": (int, "a whole number"),
    "float": (float, "a number"),
    "bool": (bool, "true or false"),
    "dict[str, Any]": (dict, "an object"),
    "list[str]": (list, "a list"),
    "list[list[float]]": (list, "a list"),
}
_FIELD_KEYS = {"kernel": "str", "radius": "float", "nodes": "int"}
_RULES: dict[str, tuple[Callable[[Any], object], str]] = {  # what entries must be besides their kind
    "template_hash": (re.compile("[0-9a-f]{16}").fullmatch, "16 hex digits"),
    "weights_sha256": (re.compile("[0-9a-f]{64}").fullmatch, "64 hex digits"),
    "steps": (lambda count: count >= 0, "0 or more"),
    "training_minutes": (lambda minutes: minutes >= 0, "0 or more"),
    "stiffness": (lambda number: number > 0, "above 0"),
    "created": (datetime.fromisoformat, "an ISO date such as 2026-01-31"),
    "field.radius": (lambda radius: radius > 0, "above 0"),
    "field.nodes": (lambda count: count >= 4, "4 or more"),
    "frame.orientation": (ORIENTATIONS.__contains__, f"one of {', '.join(ORIENTATIONS)}"),
    "mirror": (MIRRORINGS.__contains__, f"one of {', '.join(MIRRORINGS)}"),
    "frame.scale": (SCALES.__contains__, f"one of {', '.join(SCALES)}"),
}


class Card:
    """What all cards share: values of the right kinds and ranges, or `ModelError`. Valid once built; dictionaries are plain
    JSON values.
    """

    newest: ClassVar[int]  # schema
    name: str
    weights_sha256: str
    steps: int
    schema: int

    def __post_init__(self) -> None:
        for item in fields(self):  # type: ignore[arg-type]
            value = _checked(_json_value(getattr(self, item.name), item.name), item.name, str(item.type))
            object.__setattr__(self, item.name, value)
        _check_schema(self.schema, self.newest)
        check_name(self.name)
        self._check_parts()
        for where, (holds, words) in _RULES.items():
            name, _, key = where.partition(".")
            if not hasattr(self, name):
                continue
            value = getattr(self, name)[key] if key else getattr(self, name)
            with suppress(ValueError):
                if holds(value):
                    continue
            _refuse(f"{where} must be {words}, not {_shown(value)}")

    def _check_parts(self) -> None:
        """Refuse parts that do not go together."""


@dataclass(frozen=True)
class ModelCard(Card):
    """Everything about a model but its weights."""

    newest = SCHEMA
    name: str  # small letters, digits and . _ -, at most 64; the folder of an installed model has this name
    category: str  # what it was trained on, such as "human"
    template: str
    template_hash: str  # of the template that the weights belong to
    network: dict[str, Any]  # its sizes and choices
    field: dict[str, Any]  # of the deformation: kernel (str), radius (the largest, sqrt-area units), nodes (K)
    data: str  # what it was trained on
    licence: str  # under which terms the weights may be used
    recipe: dict[str, Any]  # all settings of the training
    seed: int
    steps: int
    training_minutes: float
    metrics: dict[str, Any]  # of each evaluation set: numbers, or dicts of numbers by refinement ("none", "nodes")
    weights_sha256: str  # of the weights file
    created: str  # ISO date
    description: str = ""  # a sentence for people
    schema: int = SCHEMA  # version of this list
    # How a shape is brought to the template: orientation (one of `ORIENTATIONS`), scale (of `SCALES`).
    frame: dict[str, Any] = entry(default_factory=lambda: dict(_OLD_FRAME))
    # How firmly fits that agree hold a common stretch of the template: 1 suits bodies, less suits what varies more.
    stiffness: float = 1.0
    mirror: str = "no"  # whether fits also try a shape's mirror image: one of `MIRRORINGS`
    correspondence: bool = True  # whether it was learned from known correspondence; else its fits are fair at best

    def __repr__(self) -> str:
        return f"ModelCard({self.name!r}, category {self.category!r}, {self.steps:,} steps, {self.created})"

    def _check_parts(self) -> None:
        for name, keys in (("field", _FIELD_KEYS), ("frame", _OLD_FRAME)):
            if (found := getattr(self, name)).keys() != keys.keys():
                _refuse(f"{name} must have {', '.join(keys)}, not {', '.join(found) or 'nothing'}")
        for key, kind in _FIELD_KEYS.items():
            self.field[key] = _checked(self.field[key], f"field.{key}", kind)
        for name, results in self.metrics.items():
            for key, value in _checked(results, f"metrics.{name}", "dict[str, Any]").items():
                numbers = value.values() if isinstance(value, dict) else (value,)
                if any(type(number) not in (int, float) for number in numbers):
                    _refuse(f"metrics.{name}.{key} must be a number or an object of numbers")


@dataclass(frozen=True)
class ImplicitCard(Card):
    """Everything about an implicit model but its weights."""

    newest = 1
    name: str
    category: str
    network: dict[str, Any]  # its sizes and choices
    shapes: list[str]  # names of those that it learned
    frames: list[list[float]]  # of each: the length that becomes 1, and the center (x, y, z), in its file
    data: str
    licence: str
    recipe: dict[str, Any]
    seed: int
    steps: int
    training_minutes: float
    weights_sha256: str
    created: str
    schema: int = newest

    def __repr__(self) -> str:
        return f"ImplicitCard({self.name!r}, category {self.category!r}, {len(self.shapes)} shapes, {self.created})"

    def _check_parts(self) -> None:
        names = set(map(str, self.shapes))
        if not len(names) == len(self.shapes) == len(self.frames) > 0 or not all(
            isinstance(n, str) for n in self.shapes
        ):
            _refuse("its shapes must be different names, with a frame for each")
        for row in self.frames:
            numbers = isinstance(row, list) and len(row) == 4 and all(type(each) in (int, float) for each in row)
            if not (numbers and row[0] > 0):
                _refuse(f"a frame must be a length above 0 and a center, not {_shown(row)}")


AnyCard = TypeVar("AnyCard", bound=Card)


def is_name(name: str) -> bool:
    """Whether a model can be called so. It can then be used as the name of a folder."""
    return _NAME.fullmatch(name) is not None


def check_name(name: str) -> str:
    """The name, if `is_name`; `ModelError` otherwise."""
    if not is_name(name):
        hint = "use small letters, digits, '.', '_' and '-', beginning with a letter or digit, at most 64"
        raise ModelError(f"{name[:80]!r} cannot be the name of a model", hint)
    return name


def is_implicit(folder: str | Path) -> bool:
    """Whether a folder holds an implicit model."""
    return os.path.isfile(os.path.join(os.path.expanduser(folder), IMPLICIT))


def read_card(path: str | Path) -> ModelCard:
    """Read the card of a model with a template of vertices.

    `ModelError` if the file is missing, too large, not a JSON object, of another schema, or has missing, unknown, repeated
    or wrong entries.
    """
    return _read(
        Path(path), ModelCard, "a model is a folder with card.json, weights.safetensors and template.safetensors"
    )


def read_implicit_card(folder: str | Path) -> ImplicitCard:
    """The card of an implicit model's folder; `ModelError` as `read_card` has it."""
    return _read(Path(folder) / IMPLICIT, ImplicitCard, "make one: meshmatch train --implicit")


def _read(path: Path, kind: type[AnyCard], hint: str) -> AnyCard:
    try:
        if path.exists() and not path.is_file():
            raise OSError("not a regular file")  # a pipe would wait for ever
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except OSError as error:
        what = "implicit model" if kind is ImplicitCard else "model"
        raise ModelError(f"{path.parent} holds no {what}: cannot read {path.name}", hint) from error
    if len(data) > MAX_BYTES:
        raise ModelError(
            f"{path} is not a model card: it is larger than {MAX_BYTES // 1000} kB", "is the file damaged?"
        )
    try:
        return card_from_json(data.decode("utf-8"), kind)
    except UnicodeDecodeError as error:
        raise ModelError(f"{path} is not a model card: it is not text", "is the file damaged?") from error
    except ModelError as error:
        raise ModelError(f"{path}: {error.message}", error.hint) from error


def card_from_json(text: str, kind: type[AnyCard] = ModelCard) -> AnyCard:  # type: ignore[assignment]
    """The card that a text holds; `ModelError` if it holds none."""
    try:
        found = json.loads(text, object_pairs_hook=_unique_keys, parse_constant=float)
    except (ValueError, RecursionError) as error:
        reason = "nested too deeply" if isinstance(error, RecursionError) else str(error)
        raise ModelError(f"this is not JSON: {reason}", "is the file damaged?") from error
    if not isinstance(found, dict):
        _refuse("a card must be a JSON object")
    schema = found.get("schema")
    if type(schema) is int:
        if schema > kind.newest:
            _check_schema(schema, kind.newest)  # before its keys are judged, which a newer version is free to change
        old = _SINCE.get(schema, {}) if kind is ModelCard else {}
        if old and not (old.keys() | {"correspondence"}) & found.keys():
            found = found | old | {"schema": SCHEMA, "correspondence": _corresponded(found)}
    known = [item.name for item in fields(kind)]  # type: ignore[arg-type]
    if unknown := sorted(set(found) - set(known)):
        _refuse(f"unknown entries: {', '.join(_shown(name) for name in unknown[:5])}")
    if missing := [name for name in known if name not in found]:
        _refuse(f"missing entries: {', '.join(missing)}")
    return kind(**found)


def _corresponded(card: dict[str, Any]) -> bool:
    """Whether an older card is of a model that learned from known correspondence, as far as it says so.

    The oldest recipes have one loss for both ways of learning, which always weighs landmarks and says ``robust``; of these
    the words about the data tell. Later ones weigh landmarks only without correspondence.
    """
    recipe: Any = card.get("recipe")
    for key in ("train", "loss"):
        recipe = recipe.get(key) if isinstance(recipe, dict) else None
    if isinstance(recipe, dict) and "landmarks" in recipe and "robust" not in recipe:
        return False
    return "without correspondence" not in str(card.get("data"))


def card_to_json(card: Card) -> str:
    """The text of a card: keys in the order of its class, the schema first."""
    values = asdict(card)  # type: ignore[call-overload]
    ordered = {"schema": values.pop("schema"), **values}
    return json.dumps(ordered, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def write_card(card: Card, path: str | Path) -> None:
    """Write a card, or raise `OutputError`. Write it last: a folder without one is not a model."""
    with replace_on_success(path) as temporary:
        temporary.write_text(card_to_json(card), encoding="utf-8")


def _check_schema(schema: int, newest: int) -> None:
    if schema != newest:
        hint = "it needs a newer meshmatch: update it" if schema > newest else "train or fetch the model again"
        raise ModelError(f"the model card has schema {schema}, not {newest}", hint)


def _checked(value: Any, where: str, annotation: str) -> Any:
    kind, words = _KINDS[annotation]
    if kind is float and type(value) is int:
        value = float(value)
    if type(value) is not kind:
        _refuse(f"{where} must be {words}, not {_shown(value)}")
    return value


def _json_value(value: Any, where: str, depth: int = 0) -> Any:
    """The value as JSON has it: tuples become lists; what JSON does not have is refused."""
    if depth > 20:
        _refuse(f"{where} is nested too deeply")
    if isinstance(value, float) and not math.isfinite(value):
        _refuse(f"{where} must be finite, not {value}")
    if value is None or isinstance(value, str | bool | int | float):
        return value
    if isinstance(value, list | tuple):
        return [_json_value(inner, where, depth + 1) for inner in value]
    if not isinstance(value, dict):
        _refuse(f"{where} cannot hold {_shown(value)}")
    if not all(isinstance(key, str) for key in value):
        _refuse(f"{where} has a key that is not text")
    return {key: _json_value(inner, f"{where}.{key}", depth + 1) for key, inner in value.items()}


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        raise ValueError("a key occurs twice")
    return found


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _refuse(problem: str) -> NoReturn:
    raise ModelError(f"the model card is wrong: {problem}", "is the file damaged, or from another version?")
