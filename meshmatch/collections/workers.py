"""Executors for the tasks of a collection: this process, several local processes, or a Dask cluster.

A task is a module-level function together with an item that can be pickled. It writes its result to shared storage and
returns a short summary, so it may safely run twice. Results arrive in any order, and nothing depends on the order.
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
from meshmatch.scalars import is_integer
from meshmatch.threads import set_threads

Item = TypeVar("Item")
Result = TypeVar("Result")
_PARENT_POLL = 1.0  # seconds between checks that the parent process is alive
_CONNECT_TIMEOUT = 30.0  # seconds
_main_lock = threading.Lock()


class DeadWorkerError(MeshmatchError):
    """The process that ran a task died, on the retry as well."""


class Workers(Protocol):
    """Runs one task for many items."""

    def map_unordered(
        self, task: Callable[[Item], Result], items: Sequence[Item]
    ) -> Iterator[tuple[int, Result | DeadWorkerError]]:
        """Yield (index of the item, result of the task) in order of completion; an exception of a task propagates."""

    def close(self) -> None:
        """Release the workers."""


class CannotStart(Exception):
    """No processes can be started here; the message gives the reason."""


class Processes:
    """``count`` processes on this machine; a count of 1 means this process itself.

    The death of a process loses no other item's result. The items in flight when it died are retried once, each in a
    process of its own. Where no processes can be started, this process does the work, with a warning.
    """

    def __init__(self, count: int = 1) -> None:
        self.count = count
        self._pool: _Pool | None = None

    def map_unordered(
        self, task: Callable[[Item], Result], items: Sequence[Item]
    ) -> Iterator[tuple[int, Result | DeadWorkerError]]:
        """Implement `Workers.map_unordered`."""
        suspects: list[int] = []
        pending = list(range(len(items)))[::-1]
        while pending and min(self.count, len(items)) > 1:
            in_flight: dict[Future[Result], int] = {}
            try:
                self._pool = self._pool or _Pool(self.count, _needs_main(task, items))
                while pending or in_flight:
                    while pending and len(in_flight) < self.count:
                        in_flight[self._pool.submit(task, items[pending[-1]])] = pending[-1]
                        pending.pop()
                    for done in wait(in_flight, return_when=FIRST_COMPLETED).done:
                        result = done.result()
                        yield in_flight.pop(done), result
            except BrokenProcessPool:
                self.close()
                if _can_run_processes(_needs_main(task, items)):
                    suspects += in_flight.values()
                else:
                    pending += in_flight.values()
                    self._work_in_this_process("the started processes ended at once")
            except CannotStart as error:
                pending += in_flight.values()
                self._work_in_this_process(str(error))
                self.close()
        yield from ((number, task(items[number])) for number in reversed(pending))
        for number in sorted(suspects):
            try:
                with closing(_Pool(1, _needs_main(task, items))) as alone:
                    result = alone.submit(task, items[number]).result()
            except (BrokenProcessPool, CannotStart):
                yield number, DeadWorkerError("the process that worked on it died", "is there enough memory?")
            else:
                yield number, result

    def _work_in_this_process(self, why: str) -> None:
        self.count = 1
        warn(f"this process does all the work, one shape after the other: {why}")

    def close(self) -> None:
        """End the processes once they have finished their current tasks."""
        if self._pool is not None:
            self._pool.close()
            self._pool = None


class _Pool:
    """Spawned processes; forked ones would inherit locks and the thread pools of the numerical libraries.

    A spawned process imports the main program again, without the block under ``if __name__ == "__main__"``. A program
    read from standard input cannot be imported again, and one without that guard should not be. The main program is
    therefore hidden from the workers unless they need what it defines. Raises `CannotStart` where no processes can be
    started.
    """

    def __init__(self, count: int, needs_main: bool) -> None:
        if multiprocessing.current_process().daemon:
            raise CannotStart("it is a daemonic process, which cannot start others")
        if getattr(sys, "frozen", False) or not sys.executable:
            raise CannotStart("a frozen program has no Python to start others with")
        if needs_main and not _main_can_be_imported():
            raise CannotStart("other processes cannot import the program, which is not a file")
        self._needs_main = needs_main
        with _raise_cannot_start():
            context = multiprocessing.get_context("spawn")
            self._pool = ProcessPoolExecutor(count, context, _init_worker, (os.getpid(),))

    def submit(self, task: Callable[..., Result], *items: Any) -> Future[Result]:
        """Return a future for the task's result; missing processes are started here."""
        with _raise_cannot_start(), nullcontext() if self._needs_main else _hidden_main():
            return self._pool.submit(task, *items)

    def close(self) -> None:
        self._pool.shutdown(cancel_futures=True)


def _can_run_processes(needs_main: bool) -> bool:
    """Whether a process can be started and can run a trivial task."""
    try:
        with closing(_Pool(1, needs_main)) as pool:
            return pool.submit(os.getpid).result() > 0
    except (BrokenProcessPool, CannotStart):
        return False


@contextmanager
def _raise_cannot_start() -> Iterator[None]:
    try:
        yield
    except BrokenProcessPool:
        raise
    except (OSError, ImportError, NotImplementedError, RuntimeError, AssertionError) as error:
        raise CannotStart(f"others cannot be started ({error})") from error


def _needs_main(task: Callable[[Item], Result], items: Sequence[Item]) -> bool:
    """Whether the task or an item is defined in the main program, so that unpickling it needs that program."""
    return b"__main__" in pickle.dumps((task, items))


def _main_can_be_imported() -> bool:
    main = sys.modules["__main__"]
    return getattr(main, "__spec__", None) is not None or os.path.isfile(getattr(main, "__file__", ""))


@contextmanager
def _hidden_main() -> Iterator[None]:
    """Context in which spawned processes find no main program to import."""
    main = vars(sys.modules["__main__"])
    with _main_lock:
        saved: dict[str, Any] = {name: main[name] for name in ("__spec__", "__file__") if name in main}
        main.pop("__file__", None)
        main["__spec__"] = None
        try:
            yield
        finally:
            main.update(saved)


def _init_worker(parent: int) -> None:
    """Set up a worker: ignore Ctrl-C (the parent handles it), use one thread, warn in one line, exit with the parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    set_threads(1)
    warnings.formatwarning = _format_warning

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_PARENT_POLL)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _format_warning(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> str:
    """Format a warning as the command line does, without its location in the code."""
    return f"warning: {message}\n"


class Cluster:
    """The workers of the Dask scheduler at an address such as ``tcp://127.0.0.1:8786``.

    Raises `OptionError` if no scheduler answers there, and `MeshmatchError` if dask.distributed is not installed.
    """

    def __init__(self, address: str) -> None:
        with needs("distributed", "cluster"):
            from distributed import Client
            from distributed.comm.addressing import resolve_address
        try:
            resolve_address(address)  # without this check, the client retries for a minute and then logs a traceback
        except ValueError as error:
            hint = "`dask scheduler` prints it, such as tcp://127.0.0.1:8786"
            raise OptionError(f"{address} is no address of a Dask scheduler", hint) from error
        except OSError as error:
            raise OptionError(f"there is no machine at {address}", "check the name") from error
        try:
            self._client = Client(address, timeout=_CONNECT_TIMEOUT, set_as_default=False)
        except (OSError, ValueError, TimeoutError) as error:
            hint = "start one: dask scheduler (docs/cluster.md)"
            raise OptionError(f"no Dask scheduler answers at {address}", hint) from error

    def map_unordered(
        self, task: Callable[[Item], Result], items: Sequence[Item]
    ) -> Iterator[tuple[int, Result | DeadWorkerError]]:
        """Implement `Workers.map_unordered`."""
        from distributed import as_completed
        from distributed.scheduler import KilledWorker

        numbers = {self._client.submit(task, item, pure=False): number for number, item in enumerate(items)}
        try:
            for future in as_completed(list(numbers), loop=self._client.loop):
                number = numbers.pop(future)
                try:
                    yield number, future.result()
                except KilledWorker:
                    yield number, DeadWorkerError("the workers that worked on it died", "do they have enough memory?")
                except ModuleNotFoundError as error:
                    hint = "install the same meshmatch on all of them"
                    raise InputError(f"a worker of the cluster lacks {error.name}", hint) from error
        finally:
            with suppress(Exception):
                self._client.cancel(list(numbers))

    def close(self) -> None:
        """Disconnect from the scheduler."""
        with suppress(Exception):
            self._client.close()


@contextmanager
def open_workers(spec: int | str | None = None) -> Iterator[Workers]:
    """Open a number of processes on this machine, by default one per core, or the Dask cluster at an address."""
    if spec is not None and not isinstance(spec, str) and not is_integer(spec, 1):
        raise OptionError(f"workers must be 1 or more, not {spec!r}", "leave it out for one per core")
    workers: Workers = Cluster(spec) if isinstance(spec, str) else Processes(spec or _cores())
    try:
        yield workers
    finally:
        workers.close()


def _cores() -> int:
    """Number of cores that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on Linux
        return os.cpu_count() or 1
