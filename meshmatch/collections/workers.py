"""Who does the work of a collection: this process, several on this machine, or a Dask cluster.

A task is a function at the top of a module, and an item that survives a pickle. It writes its result where all can read
it and returns a few words, so it may be done twice. Results come in any order; nothing depends on it.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from typing import Any, Protocol, TypeVar

from meshmatch.errors import InputError, MeshmatchError, OptionError, needs
from meshmatch.threads import set_threads

Item = TypeVar("Item")
Result = TypeVar("Result")
_PARENT_SEEN = 1.0  # seconds between two looks
_CONNECT = 30.0  # seconds


class Died(MeshmatchError):
    """The process that did a task came to an end, twice."""


class Workers(Protocol):
    """Does one task for many items."""

    def each(self, task: Callable[[Item], Result], items: Sequence[Item]) -> Iterator[tuple[int, Result | Died]]:
        """Number of an item and the task's result for it, as they come in. What a task raises ends the work."""

    def close(self) -> None:
        """Leave the work."""


class Processes:
    """So many processes on this machine; one is this process itself.

    A process that dies takes no other item's result with it. What it worked on is tried once more, alone.
    """

    def __init__(self, count: int = 1) -> None:
        self.count = count
        self._pool: ProcessPoolExecutor | None = None

    def each(self, task: Callable[[Item], Result], items: Sequence[Item]) -> Iterator[tuple[int, Result | Died]]:
        """As `Workers.each`."""
        if min(self.count, len(items)) <= 1:
            yield from ((number, task(item)) for number, item in enumerate(items))
            return
        suspects: list[int] = []
        waiting = list(range(len(items)))[::-1]
        while waiting:
            self._pool = self._pool or _pool(self.count)
            in_flight: dict[Future[Result], int] = {}
            try:
                while waiting or in_flight:
                    while waiting and len(in_flight) < self.count:
                        number = waiting.pop()
                        in_flight[self._pool.submit(task, items[number])] = number
                    for done in wait(in_flight, return_when=FIRST_COMPLETED).done:
                        result = done.result()
                        yield in_flight.pop(done), result
            except BrokenProcessPool:
                suspects += in_flight.values()
                self.close()
        for number in sorted(suspects):
            with _pool(1) as alone:
                try:
                    yield number, alone.submit(task, items[number]).result()
                except BrokenProcessPool:
                    yield number, Died("the process that worked on it died", "is there enough memory?")

    def close(self) -> None:
        """Let the processes finish what they are at, and end."""
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)
            self._pool = None


def _pool(count: int) -> ProcessPoolExecutor:
    # spawned, for a fork would inherit locks and the thread pools of the numerical libraries
    return ProcessPoolExecutor(count, multiprocessing.get_context("spawn"), _begin, (os.getpid(),))


def _begin(parent: int) -> None:
    """A worker leaves Ctrl-C to its parent, uses one thread, warns in a line, and does not outlive its parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    set_threads(1)
    warnings.formatwarning = _in_a_line

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_PARENT_SEEN)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _in_a_line(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> str:
    """A warning as the command line shows it, without the place in the code."""
    return f"warning: {message}\n"


class Cluster:
    """The workers of a Dask scheduler at an address such as ``tcp://127.0.0.1:8786``.

    `OptionError` if there is none; `MeshmatchError` if dask.distributed is not installed.
    """

    def __init__(self, address: str) -> None:
        with needs("distributed", "cluster"):
            from distributed import Client
        try:
            self._client = Client(address, timeout=_CONNECT, set_as_default=False)
        except (OSError, ValueError, TimeoutError) as error:
            hint = "start one: dask scheduler (docs/cluster.md)"
            raise OptionError(f"no Dask scheduler answers at {address}", hint) from error

    def each(self, task: Callable[[Item], Result], items: Sequence[Item]) -> Iterator[tuple[int, Result | Died]]:
        """As `Workers.each`."""
        from distributed import as_completed
        from distributed.scheduler import KilledWorker

        numbers = {self._client.submit(task, item, pure=False): number for number, item in enumerate(items)}
        try:
            for future in as_completed(list(numbers), loop=self._client.loop):
                number = numbers.pop(future)
                try:
                    yield number, future.result()
                except KilledWorker:
                    yield number, Died("the workers that worked on it died", "have they enough memory?")
                except ModuleNotFoundError as error:
                    hint = "install the same meshmatch on all of them"
                    raise InputError(f"a worker of the cluster lacks {error.name}", hint) from error
        finally:
            with suppress(Exception):
                self._client.cancel(list(numbers))

    def close(self) -> None:
        """Leave the scheduler."""
        with suppress(Exception):
            self._client.close()


@contextmanager
def hired(who: int | str | None = None) -> Iterator[Workers]:
    """So many processes on this machine, by default one a core; or the cluster at an address."""
    if isinstance(who, int) and who < 1:
        raise OptionError(f"workers must be 1 or more, not {who}", "leave it out for one a core")
    crew: Workers = Cluster(who) if isinstance(who, str) else Processes(who or _cores())
    try:
        yield crew
    finally:
        crew.close()


def _cores() -> int:
    """How many cores this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on Linux
        return os.cpu_count() or 1
