"""Model cards: strictly validated JSON files with a model's metadata, one class for each type of model.

Uses the standard library only, so that listing models stays cheap: importing this module takes 0.06 s of CPU time, and four
times that with a pydantic model (measured on a shared 2-core machine, 2026-11-22; `models list` would take 0.43 s, not
0.23 s).
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
"""File name of an implicit model's card."""
MAX_BYTES = 1_000_000
"""Larger files are refused."""
ORIENTATIONS = ("searched", "none", "near", "rigid")
"""How a fit finds the orientation: ask the network, keep the file's, refine the file's, or search all rotations."""
SCALES = ("area", "sphere")
MIRRORINGS = ("auto", "no")
"""Whether fits also try the mirror image of a shape, such as a left hand with a model of right hands."""

_NAME = re.compile(r"[a-z0-9][a-z0-9._-]{0,63}")
_OLD_FRAME = {"orientation": "searched", "scale": "area"}
# By schema: entries that cards of older schemas lack, and their implied values.
_OLD_DEFAULTS: dict[int, dict[str, Any]] = {
    1: {"frame": _OLD_FRAME, "stiffness": 1.0, "mirror": "no"},
    2: {"stiffness": 1.0, "mirror": "no"},
    3: {"mirror": "no"},
}
_TYPES: dict[str, tuple[type, str]] = {  # by annotation: type, and its name in messages
    "str": (str, "text"),
    "int": (int, "a whole number"),
    "float": (float, "a number"),
    "bool": (bool, "true or false"),
    "dict[str, Any]": (dict, "an object"),
    "list[str]": (list, "a list"),
    "list[list[float]]": (list, "a list"),
}
_FIELD_KEYS = {"kernel": "str", "radius": "float", "nodes": "int"}
# Conditions on entries: predicate, and its name in messages.
_CONDITIONS: dict[str, tuple[Callable[[Any], object], str]] = {
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
    """Base class of cards: checks types and ranges when built, converts values to plain JSON; `ModelError` if invalid."""

    newest: ClassVar[int]  # current schema
    name: str
    weights_sha256: str
    steps: int
    schema: int

    def __post_init__(self) -> None:
        for item in fields(self):  # type: ignore[arg-type]
            value = _check_type(_json_value(getattr(self, item.name), item.name), item.name, str(item.type))
            object.__setattr__(self, item.name, value)
        _check_schema(self.schema, self.newest)
        check_name(self.name)
        self._check_structure()
        for where, (predicate, words) in _CONDITIONS.items():
            name, _, key = where.partition(".")
            if not hasattr(self, name):
                continue
            value = getattr(self, name)[key] if key else getattr(self, name)
            with suppress(ValueError):
                if predicate(value):
                    continue
            _fail(f"{where} must be {words}, not {_shown(value)}")

    def _check_structure(self) -> None:
        """Check conditions that involve the structure of entries; `ModelError` if they fail."""


@dataclass(frozen=True)
class ModelCard(Card):
    """Metadata of a model."""

    newest = SCHEMA
    name: str  # lowercase letters, digits and . _ -, at most 64; the folder of an installed model has this name
    category: str  # category of shapes, such as "human"
    template: str  # name of the template
    template_hash: str  # hash of the template that the weights belong to
    network: dict[str, Any]  # `NetworkConfig`
    field: dict[str, Any]  # deformation field: kernel (str), radius (the largest, units of sqrt(area)), nodes (K)
    data: str  # training data, in words
    licence: str  # licence of the weights
    recipe: dict[str, Any]  # all settings of the training
    seed: int
    steps: int
    training_minutes: float
    metrics: dict[str, Any]  # for each evaluation set: numbers, or dicts of numbers by refinement ("none", "nodes")
    weights_sha256: str  # hash of the weights file
    created: str  # ISO date
    description: str = ""  # one sentence
    schema: int = SCHEMA  # version of the card's format
    # How a shape is aligned to the template: orientation (one of `ORIENTATIONS`), scale (one of `SCALES`).
    frame: dict[str, Any] = entry(default_factory=lambda: dict(_OLD_FRAME))
    # How strongly fits that agree are held to a common stretch of the template: 1 suits bodies, less suits what varies more.
    stiffness: float = 1.0
    mirror: str = "no"  # whether fits also try a shape's mirror image: one of `MIRRORINGS`
    correspondence: bool = True  # whether it was trained with known correspondence; otherwise fits are at best "fair"

    def __repr__(self) -> str:
        return f"ModelCard({self.name!r}, category {self.category!r}, {self.steps:,} steps, {self.created})"

    def _check_structure(self) -> None:
        for name, keys in (("field", _FIELD_KEYS), ("frame", _OLD_FRAME)):
            if (found := getattr(self, name)).keys() != keys.keys():
                _fail(f"{name} must have {', '.join(keys)}, not {', '.join(found) or 'nothing'}")
        for key, kind in _FIELD_KEYS.items():
            self.field[key] = _check_type(self.field[key], f"field.{key}", kind)
        for name, results in self.metrics.items():
            for key, value in _check_type(results, f"metrics.{name}", "dict[str, Any]").items():
                numbers = value.values() if isinstance(value, dict) else (value,)
                if any(type(number) not in (int, float) for number in numbers):
                    _fail(f"metrics.{name}.{key} must be a number or an object of numbers")


@dataclass(frozen=True)
class ImplicitCard(Card):
    """Metadata of an implicit model; entries that `ModelCard` has as well mean the same."""

    newest = 1
    name: str
    category: str
    network: dict[str, Any]  # `ImplicitConfig`
    shapes: list[str]  # names of the training shapes
    frames: list[list[float]]  # for each shape, in its file: the length that becomes 1, and the center (x, y, z)
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

    def _check_structure(self) -> None:
        names = set(map(str, self.shapes))
        if not len(names) == len(self.shapes) == len(self.frames) > 0 or not all(
            isinstance(n, str) for n in self.shapes
        ):
            _fail("its shapes must be different names, with a frame for each")
        for row in self.frames:
            numbers = isinstance(row, list) and len(row) == 4 and all(type(each) in (int, float) for each in row)
            if not (numbers and row[0] > 0):
                _fail(f"a frame must be a length above 0 and a center, not {_shown(row)}")


AnyCard = TypeVar("AnyCard", bound=Card)


def is_name(name: str) -> bool:
    """Whether a name is valid for a model; valid names are safe as names of folders."""
    return _NAME.fullmatch(name) is not None


def check_name(name: str) -> str:
    """Return the name; `ModelError` unless `is_name`."""
    if not is_name(name):
        hint = "use small letters, digits, '.', '_' and '-', beginning with a letter or digit, at most 64"
        raise ModelError(f"{name[:80]!r} cannot be the name of a model", hint)
    return name


def is_implicit(folder: str | Path) -> bool:
    """Whether a folder contains an implicit model."""
    return os.path.isfile(os.path.join(os.path.expanduser(folder), IMPLICIT))


def read_card(path: str | Path) -> ModelCard:
    """Read the card of a model (one that is not implicit).

    `ModelError` if the file is missing, too large, not a JSON object, of another schema, or has missing, unknown, repeated
    or invalid entries.
    """
    return _read(
        Path(path), ModelCard, "a model is a folder with card.json, weights.safetensors and template.safetensors"
    )


def read_implicit_card(folder: str | Path) -> ImplicitCard:
    """Read the card in an implicit model's folder; `ModelError` as `read_card`."""
    return _read(Path(folder) / IMPLICIT, ImplicitCard, "make one: meshmatch train --implicit")


def _read(path: Path, kind: type[AnyCard], hint: str) -> AnyCard:
    try:
        if path.exists() and not path.is_file():
            raise OSError("not a regular file")  # reading a pipe could block forever
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
    """Parse a card; `ModelError` if the text is not a valid one. Cards of older schemas are converted."""
    try:
        found = json.loads(text, object_pairs_hook=_unique_keys, parse_constant=float)
    except (ValueError, RecursionError) as error:
        reason = "nested too deeply" if isinstance(error, RecursionError) else str(error)
        raise ModelError(f"this is not JSON: {reason}", "is the file damaged?") from error
    if not isinstance(found, dict):
        _fail("a card must be a JSON object")
    schema = found.get("schema")
    if type(schema) is int:
        if schema > kind.newest:
            _check_schema(schema, kind.newest)  # before its keys are checked, which newer versions may change
        old = _OLD_DEFAULTS.get(schema, {}) if kind is ModelCard else {}
        if old and not (old.keys() | {"correspondence"}) & found.keys():
            found = found | old | {"schema": SCHEMA, "correspondence": _had_correspondence(found)}
    known = [item.name for item in fields(kind)]  # type: ignore[arg-type]
    if unknown := sorted(set(found) - set(known)):
        _fail(f"unknown entries: {', '.join(_shown(name) for name in unknown[:5])}")
    if missing := [name for name in known if name not in found]:
        _fail(f"missing entries: {', '.join(missing)}")
    return kind(**found)


def _had_correspondence(card: dict[str, Any]) -> bool:
    """Whether the model of an older card was trained with known correspondence, as far as the card shows.

    The oldest recipes have one loss for both kinds of training, with a weight of landmarks and an entry ``robust``; for
    these the description of the data decides. Later recipes weight landmarks only without correspondence.
    """
    recipe: Any = card.get("recipe")
    for key in ("train", "loss"):
        recipe = recipe.get(key) if isinstance(recipe, dict) else None
    if isinstance(recipe, dict) and "landmarks" in recipe and "robust" not in recipe:
        return False
    return "without correspondence" not in str(card.get("data"))


def card_to_json(card: Card) -> str:
    """Format a card as JSON: keys in the order of its class, the schema first."""
    values = asdict(card)  # type: ignore[call-overload]
    ordered = {"schema": values.pop("schema"), **values}
    return json.dumps(ordered, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def write_card(card: Card, path: str | Path) -> None:
    """Write a card; `OutputError` if that fails. Write it last: a folder without a card is not a model."""
    with replace_on_success(path) as temporary:
        temporary.write_text(card_to_json(card), encoding="utf-8")


def _check_schema(schema: int, newest: int) -> None:
    if schema != newest:
        hint = "it needs a newer meshmatch: update it" if schema > newest else "train or fetch the model again"
        raise ModelError(f"the model card has schema {schema}, not {newest}", hint)


def _check_type(value: Any, where: str, annotation: str) -> Any:
    kind, words = _TYPES[annotation]
    if kind is float and type(value) is int:
        value = float(value)
    if type(value) is not kind:
        _fail(f"{where} must be {words}, not {_shown(value)}")
    return value


def _json_value(value: Any, where: str, depth: int = 0) -> Any:
    """Convert a value to plain JSON: tuples become lists; `ModelError` for what JSON cannot represent."""
    if depth > 20:
        _fail(f"{where} is nested too deeply")
    if isinstance(value, float) and not math.isfinite(value):
        _fail(f"{where} must be finite, not {value}")
    if value is None or isinstance(value, str | bool | int | float):
        return value
    if isinstance(value, list | tuple):
        return [_json_value(inner, where, depth + 1) for inner in value]
    if not isinstance(value, dict):
        _fail(f"{where} cannot hold {_shown(value)}")
    if not all(isinstance(key, str) for key in value):
        _fail(f"{where} has a key that is not text")
    return {key: _json_value(inner, f"{where}.{key}", depth + 1) for key, inner in value.items()}


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        raise ValueError("a key occurs twice")
    return found


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _fail(problem: str) -> NoReturn:
    raise ModelError(f"the model card is wrong: {problem}", "is the file damaged, or from another version?")
