"""Tell integers and numbers from what only behaves like them; numbers in messages."""

from numbers import Integral, Real
from typing import Any, TypeGuard

from meshmatch.errors import OptionError


def is_integer(value: Any, least: float = float("-inf")) -> TypeGuard[int]:
    """Whether a value is an integer, NumPy's included, of at least ``least``; a bool is none."""
    return isinstance(value, Integral) and not isinstance(value, bool) and bool(value >= least)  # type: ignore[operator]


def is_number(value: Any) -> TypeGuard[float]:
    """Whether a value is a real number, NumPy's included; a bool is none."""
    return isinstance(value, Real) and not isinstance(value, bool)


def counted(count: int, noun: str) -> str:
    """A number with its noun, such as "1 shape" or "1,200 shapes"."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def check_seed(seed: object) -> None:
    """Raise `OptionError` unless a seed is a non-negative integer."""
    if not is_integer(seed, 0):
        raise OptionError(f"a seed is a whole number of 0 or more, not {seed!r}")
