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
def worker_slot(threads: threading.Semaphore) -> Iterator[None]:
    """Take one of some threads for the block, in which `parallel_map` takes those that are free at the moment."""
    with threads:
        before, _of_thread.shared = getattr(_of_thread, "shared", None), threads
        try:
            yield
        finally:
            _of_thread.shared = before


@contextmanager
def lent_slot() -> Iterator[None]:
    """Give others the thread that the `worker_slot` around this block took, if there is one, and take one again after it."""
    threads: threading.Semaphore | None = getattr(_of_thread, "shared", None)
    if threads is None:
        yield
        return
    threads.release()
    try:
        yield
    finally:
        threads.acquire()


def parallel_map(
    function: Callable[..., Result],
    *arguments: Iterable[Any],
    threads: int | None = None,
    stop: threading.Event | None = None,
) -> list[Result]:
    """Results of a function, as of `map`, by so many threads at once.

    Without a number, by those that are free in the block of `worker_slot` that this thread is in, if any. An error ends
    the work: calls that have not begun are dropped, and ``stop`` is set for the others, which may then raise
    `CancelledError`.
    """
    from concurrent.futures import FIRST_EXCEPTION, CancelledError, ThreadPoolExecutor, wait

    calls = list(zip(*arguments, strict=True))
    free = getattr(_of_thread, "shared", None) or threading.Semaphore(0)
    with ExitStack() as taken:
        count = 1 if threads is None else min(threads, len(calls))
        while threads is None and count < len(calls) and free.acquire(blocking=False):
            taken.callback(free.release)
            count += 1
        if count <= 1:
            return [function(*call) for call in calls]
        ended, pool = stop or threading.Event(), ThreadPoolExecutor(count)

        def run(call: tuple[Any, ...]) -> Result:
            if ended.is_set():
                raise CancelledError
            try:
                return function(*call)
            except BaseException:
                ended.set()
                raise

        futures = [pool.submit(run, call) for call in calls]
        try:
            wait(futures, return_when=FIRST_EXCEPTION)
        finally:
            ended.set()  # also at Ctrl-C
            pool.shutdown(cancel_futures=True)
    errors = [error for future in futures if not future.cancelled() and (error := future.exception()) is not None]
    for error in sorted(errors, key=lambda error: isinstance(error, CancelledError)):
        raise error
    return [future.result() for future in futures]


def parallel_calls(functions: Iterable[Callable[[], Any]]) -> list[Any]:
    """What each function returns, as by `parallel_map`: for work of several sorts beside each other."""
    return parallel_map(lambda function: function(), functions)


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
