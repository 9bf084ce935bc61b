"""The card of an implicit model: a strict JSON file beside its weights. Loads neither NumPy nor torch."""

from __future__ import annotations

import json
import math
import os
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from meshmatch.errors import ModelError
from meshmatch.models.card import MAX_BYTES, check_name
from meshmatch.outputs import replace_on_success

IMPLICIT = "implicit.json"
SCHEMA = 1
_KINDS: dict[str, tuple[type, ...]] = {
    **{"str": (str,), "int": (int,), "float": (float, int), "dict[str, Any]": (dict,)},
    **{"list[str]": (list,), "list[list[float]]": (list,)},
}


@dataclass(frozen=True)
class ImplicitCard:
    """Everything about an implicit model but its weights. `ModelError` if a value cannot be."""

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
    schema: int = SCHEMA

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if type(value) not in _KINDS[str(item.type)]:
                raise ModelError(f"the card is wrong: {item.name} is {value!r:.60}", "is the file damaged?")
        check_name(self.name)
        if self.schema != SCHEMA:
            raise ModelError(f"the card has schema {self.schema}, not {SCHEMA}", "it may need another meshmatch")
        rows = all(
            type(row) is list
            and len(row) == 4
            and all(type(each) in (int, float) and math.isfinite(each) for each in row)
            and row[0] > 0
            for row in self.frames
        )
        names = all(type(name) is str for name in self.shapes) and len(set(self.shapes)) == len(self.shapes)
        if not (rows and names and len(self.shapes) == len(self.frames) > 0):
            raise ModelError("the card is wrong: its shapes and frames do not go together", "is the file damaged?")


def is_implicit(folder: str | Path) -> bool:
    """Whether a folder holds an implicit model."""
    return os.path.isfile(os.path.join(os.path.expanduser(folder), IMPLICIT))


def write_implicit_card(card: ImplicitCard, folder: Path) -> None:
    """Write a card, or raise `OutputError`. Write it last: a folder without one is not a model."""
    with replace_on_success(folder / IMPLICIT) as temporary:
        temporary.write_text(implicit_card_to_json(card), encoding="utf-8")


def implicit_card_to_json(card: ImplicitCard) -> str:
    """The text of a card."""
    return json.dumps(asdict(card), indent=1, allow_nan=False) + "\n"


def read_implicit_card(folder: str | Path) -> ImplicitCard:
    """The card of a folder; `ModelError` if it holds none, or one with missing, unknown or wrong entries."""
    path = Path(folder) / IMPLICIT
    try:
        with path.open("rb") as file:
            text = file.read(MAX_BYTES + 1)
    except OSError as error:
        hint = "make one: meshmatch train --implicit"
        raise ModelError(f"{folder} holds no implicit model: cannot read {IMPLICIT}", hint) from error
    try:
        if len(text) > MAX_BYTES:
            raise ValueError(f"it is larger than {MAX_BYTES // 1000} kB")
        found = json.loads(text)
        known = {item.name for item in fields(ImplicitCard)}
        if not isinstance(found, dict) or found.keys() != known:
            odd = sorted(known ^ found.keys()) if isinstance(found, dict) else ["no object"]
            raise ValueError(f"missing or unknown entries: {', '.join(odd)[:200]}")
        return ImplicitCard(**found)
    except (ValueError, RecursionError) as error:
        raise ModelError(f"{path} is not the card of an implicit model: {error}", "is a file damaged?") from error
    except ModelError as error:
        raise ModelError(f"{path}: {error.message}", error.hint) from error
