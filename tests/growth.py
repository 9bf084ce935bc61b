"""Checks of time complexity by ratios of times, which depend on the machine and its load less than seconds do."""

import gc
import time
from collections.abc import Callable
from typing import TypeVar

Found = TypeVar("Found")
_FACTOR = 8
_MAX_RATIO = 2 * _FACTOR  # quadratic growth would give 64
_TRIES = 4


def grows_with_size(prepared: Callable[[int], Callable[[], Found]], size: int) -> Found:
    """Assert that time grows about linearly, and return the result for ``size``.

    ``prepared`` makes the work for a size; it is not timed. The work for ``size`` may take at most twice as long per item
    as for an eighth of it. Other processes may disturb a measurement, so the best of several tries counts.
    """
    ratios: list[float] = []
    while len(ratios) < _TRIES:
        baseline, found = _timed(prepared(size // _FACTOR))[0], _timed(prepared(size))
        ratios.append(found[0] / baseline)
        if ratios[-1] < _MAX_RATIO:
            return found[1]
    raise AssertionError(f"{_FACTOR} times as many take {min(ratios):.0f} times as long")


def _timed(work: Callable[[], Found]) -> tuple[float, Found]:
    gc.disable()  # collection would traverse the objects of all earlier tests
    try:
        began = time.process_time()
        found = work()
        return time.process_time() - began, found
    finally:
        gc.enable()
