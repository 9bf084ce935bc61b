"""Thread counts of the numerical libraries, for a block or for the whole process, and functions run in parallel."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, TypeVar

Result = TypeVar("Result")
MAX_THREADS = 4096  # libgomp ends the process for lack of memory if there are many more
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMEXPR_NUM_THREADS")

_lock = threading.Lock()
_thread_state = threading.local()
_open_blocks = 0
_torch_before: int | None = None  # torch's thread count before the first open block


@contextmanager
def thread_limit(count: int) -> Iterator[None]:
    """Limit the loaded libraries to `count` threads inside the block, and restore their thread counts after it.

    Two fits in parallel are faster with one thread each than with all threads each, above all on a busy machine. Blocks
    may be nested. If they overlap in several threads, the BLAS libraries obey the first one. `ValueError` if `count` is
    below 1.
    """
    global _open_blocks, _torch_before
    _check_count(count)
    from threadpoolctl import threadpool_limits

    with threadpool_limits(count, user_api="blas"):
        torch_threads = _torch_threads()
        with _lock:
            if _open_blocks == 0:
                _torch_before = torch_threads
            _open_blocks += 1
        _set_torch_threads(count)
        depth = getattr(_thread_state, "depth", 0)
        _thread_state.depth = depth + 1
        try:
            yield
        finally:
            _thread_state.depth = depth
            with _lock:
                _open_blocks -= 1
                # torch gives a new thread the count that was set last: it must not be that of a block elsewhere
                _set_torch_threads(torch_threads if depth else _torch_before)


@contextmanager
def worker_slot(threads: threading.Semaphore) -> Iterator[None]:
    """Take one of a pool of threads for the block; `parallel_map` inside it uses those that are free at that moment."""
    with threads:
        before, _thread_state.shared = getattr(_thread_state, "shared", None), threads
        try:
            yield
        finally:
            _thread_state.shared = before


@contextmanager
def released_slot() -> Iterator[None]:
    """Release the thread taken by the enclosing `worker_slot`, if any, for the block, and take one again after it."""
    threads: threading.Semaphore | None = getattr(_thread_state, "shared", None)
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
    """Apply a function like `map`, in ``threads`` threads, and return the list of results.

    By default it uses the free threads of the enclosing `worker_slot`, if any. An error stops the work: calls that have
    not begun are dropped, and ``stop`` is set for the others, which may then raise `CancelledError`.
    """
    from concurrent.futures import FIRST_EXCEPTION, CancelledError, ThreadPoolExecutor, wait

    calls = list(zip(*arguments, strict=True))
    free = getattr(_thread_state, "shared", None) or threading.Semaphore(0)
    with ExitStack() as slots:
        count = 1 if threads is None else min(threads, len(calls))
        while threads is None and count < len(calls) and free.acquire(blocking=False):
            slots.callback(free.release)
            count += 1
        if count <= 1:
            return [function(*call) for call in calls]
        stopped, pool = stop or threading.Event(), ThreadPoolExecutor(count)

        def run(call: tuple[Any, ...]) -> Result:
            if stopped.is_set():
                raise CancelledError
            try:
                return function(*call)
            except BaseException:
                stopped.set()
                raise

        futures = [pool.submit(run, call) for call in calls]
        try:
            wait(futures, return_when=FIRST_EXCEPTION)
        finally:
            stopped.set()  # also on Ctrl-C
            pool.shutdown(cancel_futures=True)
    errors = [error for future in futures if not future.cancelled() and (error := future.exception()) is not None]
    for error in sorted(errors, key=lambda error: isinstance(error, CancelledError)):
        raise error
    return [future.result() for future in futures]


def parallel_calls(functions: Iterable[Callable[[], Any]]) -> list[Any]:
    """Results of different functions, called in parallel as by `parallel_map`."""
    return parallel_map(lambda function: function(), functions)


def set_threads(count: int) -> None:
    """Use `count` threads for everything that this process computes.

    Libraries that are not loaded yet will read the environment; a loaded torch is set directly. `ValueError` if `count`
    is below 1.
    """
    _check_count(count)
    for name in _THREAD_VARIABLES:
        os.environ[name] = str(count)
    _set_torch_threads(count)


def _check_count(count: int) -> None:
    if count < 1:
        raise ValueError(f"at least one thread is needed, not {count}")


def _torch_threads() -> int | None:
    torch = sys.modules.get("torch")
    return None if torch is None else torch.get_num_threads()


def _set_torch_threads(count: int | None) -> None:
    torch = sys.modules.get("torch")
    if torch is not None and count is not None:
        torch.set_num_threads(count)
