"""How many threads the numerical libraries use: in one call, or in the whole process."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, TypeVar

Result = TypeVar("Result")
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMEXPR_NUM_THREADS")

_lock = threading.Lock()
_of_thread = threading.local()
_open_blocks = 0
_torch_before: int | None = None  # what the first of the open blocks found


@contextmanager
def thread_limit(count: int) -> Iterator[None]:
    """Let the libraries that are loaded use `count` threads inside the block, and give the threads back after it.

    Two fits beside each other, each on one thread, are faster than each on all of them, above all where other work
    runs too. Blocks may be nested. Where they overlap in several threads, the BLAS libraries obey the first one.
    `ValueError` if `count` is below 1.
    """
    global _open_blocks, _torch_before
    _check(count)
    from threadpoolctl import threadpool_limits

    with threadpool_limits(count, user_api="blas"):
        here = _torch_threads()
        with _lock:
            if _open_blocks == 0:
                _torch_before = here
            _open_blocks += 1
        _set_torch_threads(count)
        nested = getattr(_of_thread, "depth", 0)
        _of_thread.depth = nested + 1
        try:
            yield
        finally:
            _of_thread.depth = nested
            with _lock:
                _open_blocks -= 1
                # torch gives a new thread the count that was set last: not that of a block elsewhere
                _set_torch_threads(here if nested else _torch_before)


@contextmanager
def one_of(threads: threading.Semaphore) -> Iterator[None]:
    """Take one of some threads for the block, in which `beside` takes those that are free at the moment."""
    with threads:
        _of_thread.shared = threads
        try:
            yield
        finally:
            _of_thread.shared = None


def beside(function: Callable[..., Result], *arguments: Iterable[Any]) -> list[Result]:
    """Results of a function, as of `map`, on free threads of the block of `one_of` that this thread is in, if any."""
    from concurrent.futures import ThreadPoolExecutor

    calls = list(zip(*arguments, strict=True))
    threads = getattr(_of_thread, "shared", None) or threading.Semaphore(0)
    with ExitStack() as taken:
        count = 1
        while count < len(calls) and threads.acquire(blocking=False):
            taken.callback(threads.release)
            count += 1
        if count == 1:
            return [function(*call) for call in calls]
        return list(taken.enter_context(ThreadPoolExecutor(count)).map(lambda call: function(*call), calls))


def set_threads(count: int) -> None:
    """Use `count` threads in everything that this process computes.

    Libraries that are not loaded yet read the environment when they are; torch is told directly if it is loaded.
    `ValueError` if `count` is below 1.
    """
    _check(count)
    for name in _THREAD_VARIABLES:
        os.environ[name] = str(count)
    _set_torch_threads(count)


def _check(count: int) -> None:
    if count < 1:
        raise ValueError(f"at least one thread is needed, not {count}")


def _torch_threads() -> int | None:
    torch = sys.modules.get("torch")
    return None if torch is None else torch.get_num_threads()


def _set_torch_threads(count: int | None) -> None:
    torch = sys.modules.get("torch")
    if torch is not None and count is not None:
        torch.set_num_threads(count)
