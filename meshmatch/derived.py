"""Values computed from one object: once, whichever threads request them, and kept as long as the object lives.

For functions that take time. Use `functools.cached_property` for cheap properties of an object, and
`functools.lru_cache` for lookups by value, such as a file's name.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from threading import RLock
from typing import Any, Concatenate, ParamSpec, TypeVar

from meshmatch.batching import unbatched

Owner = TypeVar("Owner")
P = ParamSpec("P")
Value = TypeVar("Value")
_ATTRIBUTE = "_derived"


class _Store:
    """Values derived from one object."""

    def __init__(self) -> None:
        self.values: dict[Any, Any] = {}
        self.lock = RLock()  # reentrant: one derivation may need another


def derived(derive: Callable[Concatenate[Owner, P], Value]) -> Callable[Concatenate[Owner, P], Value]:
    """Decorate a function of an object, and of hashable arguments, so that it computes once per object and arguments."""

    @wraps(derive)
    def wrapper(owner: Owner, /, *args: P.args, **kwargs: P.kwargs) -> Value:
        store, key = _store_of(owner), (derive, args, tuple(sorted(kwargs.items())))
        with store.lock:
            if key not in store.values:
                with unbatched():  # a batch could deadlock: its other callers may wait for this lock
                    store.values[key] = derive(owner, *args, **kwargs)
            value: Value = store.values[key]
            return value

    return wrapper


def store_derived(function: Callable[[Owner], Value], owner: Owner, value: Value) -> None:
    """Store the value that a `derived` function would compute for an object."""
    _store_of(owner).values[function.__wrapped__, (), ()] = value  # type: ignore[attr-defined]


def _store_of(owner: Any) -> _Store:
    store: _Store = vars(owner).setdefault(_ATTRIBUTE, _Store())
    return store
