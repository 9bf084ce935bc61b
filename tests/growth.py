"""How time grows with the size of what is worked on: seconds depend on the machine and what else it does, ratios little."""

import gc
import time
from collections.abc import Callable
from typing import TypeVar

Found = TypeVar("Found")
_LESS = 8
_MOST = 2 * _LESS  # with the square: 64
_TRIES = 4


def grows_with_size(prepared: Callable[[int], Callable[[], Found]], size: int) -> Found:
    """What work on so many things gives, if it takes no more than twice as long per thing as on an eighth of them.

    ``prepared`` makes what is worked on, outside the clock. Other work on the machine may disturb a measurement: the
    best of several counts.
    """
    ratios: list[float] = []
    while len(ratios) < _TRIES:
        few, found = _timed(prepared(size // _LESS))[0], _timed(prepared(size))
        ratios.append(found[0] / few)
        if ratios[-1] < _MOST:
            return found[1]
    raise AssertionError(f"{_LESS} times as many take {min(ratios):.0f} times as long")


def _timed(work: Callable[[], Found]) -> tuple[float, Found]:
    gc.disable()  # what it goes through is all that other tests left
    try:
        began = time.process_time()
        found = work()
        return time.process_time() - began, found
    finally:
        gc.enable()
