"""Check training settings, both from recipe files and from Python."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any, TypeVar

from meshmatch.errors import OptionError
from meshmatch.threads import MAX_THREADS

_MAX_VALUES: dict[str, float] = {
    "shapes": 4096,
    "scans_per_shape": 256,
    "points": 100_000,
    "workers": 256,
    "threads": MAX_THREADS,
    "bodies": 20_000,
    "correct_points": 100_000,
}
_MAX_VALUES |= dict.fromkeys(
    ("holes", "outliers", "partial", "outside", "strays", "characters", "stylised", "average"), 1
)
_MAX_VALUES |= {"momentum": 0.9999999}
_MIN_VALUES = {"points": 64, "steps": 1, "shapes": 1, "scans_per_shape": 1, "threads": 1}
T = TypeVar("T")


def check_range(name: str, value: float, label: str = "") -> None:
    """Raise `OptionError` unless a setting lies in its range; ``label`` is its name in the message."""
    low, high = _MIN_VALUES.get(name, 0), _MAX_VALUES.get(name, 2**53)
    if value < low and name not in _MAX_VALUES:
        raise OptionError(f"{label or name} must be at least {low}, not {value}")
    if not low <= value <= high:
        raise OptionError(f"{label or name} must lie in {low}..{high:,}, not {value}")


def with_changes(values: T, changes: Mapping[str, Any], where: str = "") -> T:
    """Copy of a dataclass with some numbers and strings changed; ``where`` is its name in messages.

    `OptionError` for an unknown field, or a value of the wrong type or out of range.
    """
    field_types = {each.name: str(getattr(each.type, "__name__", each.type)) for each in fields(values)}  # type: ignore[arg-type]
    for name, value in changes.items():
        label = f"{where}.{name}" if where else name
        if name not in field_types:
            raise OptionError(f"{label} is unknown", f"choose from {', '.join(field_types)}")
        kind = field_types[name]
        is_number = type(value) is int or (type(value) is float and math.isfinite(value))
        is_valid = {
            "bool": type(value) is bool,
            "int": type(value) is int,
            "float": is_number,
            "float | None": is_number or value is None,
        }.get(kind, isinstance(value, str))
        if not is_valid:
            raise OptionError(f"{label} must be {kind}, not {str(value)[:40]!r}")
        if is_number:
            check_range(name, value, label)
    changed: Any = replace(values, **changes)  # type: ignore[type-var]
    return changed  # type: ignore[no-any-return]
