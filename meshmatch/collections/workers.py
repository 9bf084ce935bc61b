"""Who does the work of a collection: this process, several on this machine, or a Dask cluster.

A task is a function at the top of a module, and an item that survives a pickle. It writes its result where all can read
it and returns a few words, so it may be done twice. Results come in any order; nothing depends on it.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager, nullcontext, suppress
from typing import Any, Protocol, TypeVar

from meshmatch.errors import InputError, MeshmatchError, OptionError, needs, warn
from meshmatch.threads import set_threads

Item = TypeVar("Item")
Result = TypeVar("Result")
_PARENT_SEEN = 1.0  # seconds between two looks
_CONNECT = 30.0  # seconds
_hiding = threading.Lock()


class Died(MeshmatchError):
    """The process that did a task came to an end, twice."""


class Workers(Protocol):
    """Does one task for many items."""

    def each(self, task: Callable[[Item], Result], items: Sequence[Item]) -> Iterator[tuple[int, Result | Died]]:
        """Number of an item and the task's result for it, as they come in. What a task raises ends the work."""

    def close(self) -> None:
        """Leave the work."""


class CannotStart(Exception):
    """No processes can be started here; the reason, in words."""


class Processes:
    """So many processes on this machine; one is this process itself.

    A process that dies takes no other item's result with it. What it worked on is tried once more, alone. Where no
    processes can be started, this one does the work, and warns.
    """

    def __init__(self, count: int = 1) -> None:
        self.count = count
        self._pool: _Pool | None = None

    def each(self, task: Callable[[Item], Result], items: Sequence[Item]) -> Iterator[tuple[int, Result | Died]]:
        """As `Workers.each`."""
        suspects: list[int] = []
        waiting = list(range(len(items)))[::-1]
        while waiting and min(self.count, len(items)) > 1:
            in_flight: dict[Future[Result], int] = {}
            try:
                self._pool = self._pool or _Pool(self.count, _needs_main(task, items))
                while waiting or in_flight:
                    while waiting and len(in_flight) < self.count:
                        in_flight[self._pool.submit(task, items[waiting[-1]])] = waiting[-1]
                        waiting.pop()
                    for done in wait(in_flight, return_when=FIRST_COMPLETED).done:
                        result = done.result()
                        yield in_flight.pop(done), result
            except BrokenProcessPool:
                self.close()
                if _processes_work(_needs_main(task, items)):
                    suspects += in_flight.values()
                else:
                    waiting += in_flight.values()
                    self._work_here("processes that were started ended at once")
            except CannotStart as error:
                waiting += in_flight.values()
                self._work_here(str(error))
                self.close()
        yield from ((number, task(items[number])) for number in reversed(waiting))
        for number in sorted(suspects):
            try:
                with closing(_Pool(1, _needs_main(task, items))) as alone:
                    result = alone.submit(task, items[number]).result()
            except (BrokenProcessPool, CannotStart):
                yield number, Died("the process that worked on it died", "is there enough memory?")
            else:
                yield number, result

    def _work_here(self, why: str) -> None:
        self.count = 1
        warn(f"this process does all the work, one shape after the other: {why}")

    def close(self) -> None:
        """Let the processes finish what they are at, and end."""
        if self._pool is not None:
            self._pool.close()
            self._pool = None


class _Pool:
    """Processes that are spawned, for a fork would inherit locks and the thread pools of the numerical libraries.

    A spawned process runs the program again that started it, up to what stands behind ``if __name__ == "__main__"``. A
    program from standard input cannot be run again, and one without such a line should not be; so it is left alone unless
    the work needs what it defines. Raises `CannotStart` where there can be no processes.
    """

    def __init__(self, count: int, needs_main: bool) -> None:
        if multiprocessing.current_process().daemon:
            raise CannotStart("it is a daemonic process, which cannot start others")
        if getattr(sys, "frozen", False) or not sys.executable:
            raise CannotStart("a frozen program has no Python to start others with")
        if needs_main and not _main_can_be_imported():
            raise CannotStart("other processes cannot import the program, which is no file")
        self._needs_main = needs_main
        with _starting():
            context = multiprocessing.get_context("spawn")
            self._pool = ProcessPoolExecutor(count, context, _begin, (os.getpid(),))

    def submit(self, task: Callable[..., Result], *items: Any) -> Future[Result]:
        """A future of the task's result for an item. The processes are started here, whenever one is missing."""
        with _starting(), nullcontext() if self._needs_main else _hidden_main():
            return self._pool.submit(task, *items)

    def close(self) -> None:
        self._pool.shutdown(cancel_futures=True)


def _processes_work(needs_main: bool) -> bool:
    """Whether a process that is given next to nothing to do can do it."""
    try:
        with closing(_Pool(1, needs_main)) as pool:
            return pool.submit(os.getpid).result() > 0
    except (BrokenProcessPool, CannotStart):
        return False


@contextmanager
def _starting() -> Iterator[None]:
    try:
        yield
    except BrokenProcessPool:
        raise
    except (OSError, ImportError, NotImplementedError, RuntimeError, AssertionError) as error:
        raise CannotStart(f"others cannot be started ({error})") from error


def _needs_main(task: Callable[[Item], Result], items: Sequence[Item]) -> bool:
    """Whether tasks or items are of classes that the running program itself defines."""
    return b"__main__" in pickle.dumps((task, items))


def _main_can_be_imported() -> bool:
    main = sys.modules["__main__"]
    return getattr(main, "__spec__", None) is not None or os.path.isfile(getattr(main, "__file__", ""))


@contextmanager
def _hidden_main() -> Iterator[None]:
    """Inside, a process that is spawned finds no program to run again."""
    main = vars(sys.modules["__main__"])
    with _hiding:
        kept: dict[str, Any] = {name: main[name] for name in ("__spec__", "__file__") if name in main}
        main.pop("__file__", None)
        main["__spec__"] = None
        try:
            yield
        finally:
            main.update(kept)


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
            from distributed.comm.addressing import resolve_address
        try:
            resolve_address(address)  # else the client asks for a minute, and leaves a trace of it at the end
        except ValueError as error:
            hint = "`dask scheduler` tells it, such as tcp://127.0.0.1:8786"
            raise OptionError(f"{address} is no address of a Dask scheduler", hint) from error
        except OSError as error:
            raise OptionError(f"there is no machine at {address}", "is the name right?") from error
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
