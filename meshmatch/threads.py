"""How many threads the numerical libraries use: in one call, or in the whole process."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from threadpoolctl import threadpool_limits

_THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMEXPR_NUM_THREADS")

_lock = threading.Lock()
_running: list[tuple[int, int]] = []  # thread and count of every block that is open, oldest first
_before: tuple[threadpool_limits, int | None] | None = None  # what the first of them found: BLAS, torch


@contextmanager
def thread_limit(count: int) -> Iterator[None]:
    """Let the libraries that are loaded use `count` threads inside the block, and give the threads back after it.

    Two fits beside each other, each on one thread, are faster than each on all of them, above all where other work
    runs too. Blocks may be nested, and may overlap in several threads: the last one restores what the first one found.

    Raises
    ------
    ValueError
        `count` is below 1.
    """
    global _before
    _check(count)
    me = threading.get_ident()
    with _lock:
        previous = _limit_blas(count), _torch_threads()
        if not _running:
            _before = previous
        _running.append((me, count))
        _set_torch_threads(count)
    try:
        yield
    finally:
        with _lock:
            _running.reverse()
            _running.remove((me, count))
            _running.reverse()
            mine = [each for thread, each in _running if thread == me]
            assert _before is not None
            blas, torch_count = _before
            if mine:
                _limit_blas(mine[-1])
            elif not _running:
                blas.restore_original_limits()
                _before = None
            # torch keeps a number for each thread: this one must not stay behind with the small one
            _set_torch_threads(mine[-1] if mine else torch_count)


def set_threads(count: int) -> None:
    """Use `count` threads in everything that this process computes.

    Libraries that are not loaded yet read the environment when they are; torch is told directly if it is loaded.

    Raises
    ------
    ValueError
        `count` is below 1.
    """
    _check(count)
    for name in _THREAD_VARIABLES:
        os.environ[name] = str(count)
    _set_torch_threads(count)


def _check(count: int) -> None:
    if count < 1:
        raise ValueError(f"at least one thread is needed, not {count}")


def _limit_blas(count: int) -> threadpool_limits:
    from threadpoolctl import threadpool_limits

    return threadpool_limits(count, user_api="blas")


def _torch_threads() -> int | None:
    torch = sys.modules.get("torch")
    return None if torch is None else torch.get_num_threads()


def _set_torch_threads(count: int | None) -> None:
    torch = sys.modules.get("torch")
    if torch is not None and count is not None:
        torch.set_num_threads(count)
