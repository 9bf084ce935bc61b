"""What is computed from one object alone: once, whatever threads ask for it, and kept as long as the object lives.

This is for functions that take time. What an object knows of itself at little cost is a `functools.cached_property`; what
is looked up by a value, such as a file's name, has a `functools.lru_cache`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from threading import RLock
from typing import Any, Concatenate, ParamSpec, TypeVar

from meshmatch.gathering import asking_alone

Owner = TypeVar("Owner")
P = ParamSpec("P")
Value = TypeVar("Value")
_ATTRIBUTE = "_derived"


class _Store:
    """What was derived of one object."""

    def __init__(self) -> None:
        self.values: dict[Any, Any] = {}
        self.lock = RLock()  # one derivation may need another


def derived(derive: Callable[Concatenate[Owner, P], Value]) -> Callable[Concatenate[Owner, P], Value]:
    """Let a function of an object, and of hashable arguments, compute once for each object."""

    @wraps(derive)
    def once(owner: Owner, /, *args: P.args, **kwargs: P.kwargs) -> Value:
        store, key = _store_of(owner), (derive, args, tuple(sorted(kwargs.items())))
        with store.lock:
            if key not in store.values:
                with asking_alone():  # others may wait for the lock
                    store.values[key] = derive(owner, *args, **kwargs)
            value: Value = store.values[key]
            return value

    return once


def remember(once: Callable[[Owner], Value], owner: Owner, value: Value) -> None:
    """Say what a function that is `derived` would compute of an object."""
    _store_of(owner).values[once.__wrapped__, (), ()] = value  # type: ignore[attr-defined]


def _store_of(owner: Any) -> _Store:
    store: _Store = vars(owner).setdefault(_ATTRIBUTE, _Store())
    return store
