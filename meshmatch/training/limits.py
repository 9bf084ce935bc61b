"""What the settings of a training may be: one check, for the files of recipes and for changes in Python."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any, TypeVar

from meshmatch.errors import OptionError

_MOST: dict[str, float] = {
    "shapes": 4096,
    "scans_per_shape": 256,
    "points": 100_000,
    "workers": 256,
    "bodies": 20_000,
    "correct_points": 100_000,
}
_MOST |= dict.fromkeys(("holes", "outliers", "partial", "outside", "strays", "characters", "stylised", "average"), 1)
_MOST |= {"momentum": 0.9999999}
_LEAST = {"points": 64}
T = TypeVar("T")


def filled(values: T, changes: Mapping[str, Any], where: str = "") -> T:
    """A dataclass with some of its numbers and words changed; ``where`` names it in messages.

    `OptionError` for a field that there is not, or a value that is not of its kind or out of range.
    """
    known = {each.name: str(getattr(each.type, "__name__", each.type)) for each in fields(values)}  # type: ignore[arg-type]
    for name, value in changes.items():
        label = f"{where}.{name}" if where else name
        if name not in known:
            raise OptionError(f"{label} is unknown", f"choose from {', '.join(known)}")
        kind = known[name]
        number = type(value) is int or (type(value) is float and math.isfinite(value))
        right = {
            "bool": type(value) is bool,
            "int": type(value) is int,
            "float": number,
            "float | None": number or value is None,
        }.get(kind, isinstance(value, str))
        if not right:
            raise OptionError(f"{label} must be {kind}, not {str(value)[:40]!r}")
        least, most = _LEAST.get(name, 0), _MOST.get(name, 2**53)
        if type(value) is not bool and number and not least <= value <= most:
            raise OptionError(f"{label} must lie in {least}..{most:,}, not {value}")
    changed: Any = replace(values, **changes)  # type: ignore[type-var]
    return changed  # type: ignore[no-any-return]
