"""The only place where an error becomes words and an exit status, and a warning words.

0 done, 1 the user's data or choice (or too little memory for it, or a folder that may not be entered), 2 usage, 130
interrupted, 143 killed by SIGTERM, 129 by SIGHUP. Anything that is not a `MeshmatchError` is a bug and keeps its
traceback; with MESHMATCH_DEBUG=1 so does everything else.
"""

import errno
import os
import signal
import threading
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

from meshmatch.cli.words import Console, stdout_refused
from meshmatch.errors import MeshmatchError, MeshmatchWarning

DEBUG_VARIABLE = "MESHMATCH_DEBUG"
INTERRUPTED = 130
_SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
_USUAL = (signal.SIG_DFL, signal.default_int_handler)
_TWICE = 1.0  # seconds within which a second signal is the same one: `timeout` sends two


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line, by default the words after the process's name, and return its exit status."""
    debug = os.environ.get(DEBUG_VARIABLE, "") not in ("", "0")
    with _kills_as_interrupts() as killed:
        try:
            status = _run(arguments)
            killed.over = True
        except (KeyboardInterrupt, Exception) as error:
            killed.over = True
            if debug:
                raise
            if isinstance(error, KeyboardInterrupt) or killed.number:  # what is killed beside it may be missed first
                status = INTERRUPTED
            elif isinstance(error, MeshmatchError):
                Console().trouble("error", error.message, error.hint)
                return 1
            elif _no_memory(error):
                Console().trouble("error", "there is not enough memory for this", "take smaller shapes, or free some")
                return 1
            elif isinstance(error, PermissionError) and error.filename:
                problem = f"cannot reach {os.fsdecode(error.filename)}: {error.strerror}"
                Console().trouble("error", problem, "may you read and write there?")
                return 1
            else:
                raise
    if killed.number and status:
        status = 128 + killed.number
    if status == INTERRUPTED or (killed.number and status):
        with suppress(OSError):  # of a hang-up: the terminal may be gone
            Console().trouble("interrupted" if status == INTERRUPTED else "killed", "no file is half-written")
    return status


def _no_memory(error: BaseException) -> bool:
    """Whether it says that there is no memory: torch has words for that, but no class."""
    return isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and "can't allocate memory" in str(error))


class _Killed:
    """Which signal came first, 0 if none did; and whether it is too late to stop anything."""

    number, over = 0, False


@contextmanager
def _kills_as_interrupts() -> Iterator["_Killed"]:
    """Inside, SIGTERM and SIGHUP end the program as Ctrl-C does (unless they have another handler), until it is over.

    All three are remembered: where they hit an import, say, another exception may come of it.
    """
    killed = _Killed()
    came: list[float] = []
    owner = os.getpid()

    def stop(number: int, frame: Any) -> None:
        if os.getpid() != owner:  # forked from this one: such a process ends as if nothing had been said
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)
            return
        again = bool(came) and time.monotonic() - came[0] < _TWICE
        came.append(time.monotonic())
        killed.number = killed.number or number
        if not again and not killed.over:
            raise KeyboardInterrupt

    ours = threading.current_thread() is threading.main_thread()
    before = {number: signal.getsignal(number) for number in _SIGNALS if ours}
    borrowed = {number: handler for number, handler in before.items() if handler in _USUAL}
    for number in borrowed:
        signal.signal(number, stop)
    try:
        yield killed
    finally:
        for number, handler in borrowed.items():
            signal.signal(number, handler)


def _run(arguments: Sequence[str] | None) -> int:
    from typer.main import get_command

    from meshmatch.cli.app import app
    from meshmatch.threads import set_threads

    set_threads(1)  # before NumPy reads it: whoever needs more asks for them
    try:
        with _warnings_as_words():
            # not app(...): that would replace sys.excepthook, and a bug keeps Python's own traceback
            get_command(app)(args=arguments, prog_name="meshmatch")
    except OSError as error:
        if error.errno != errno.ENOSPC or error.filename is not None:
            raise
        raise stdout_refused(error) from error  # of --help and --version, which typer writes
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    return 0


@contextmanager
def _warnings_as_words() -> Iterator[None]:
    """Inside, each of our warnings is shown once, in a line, whatever Python was told to do with warnings."""
    shown: set[str] = set()
    others = warnings.showwarning

    def show(message: Any, category: type[Warning], *where: Any, **more: Any) -> None:
        if not issubclass(category, MeshmatchWarning):
            others(message, category, *where, **more)
        elif str(message) not in shown:  # a file may be read twice
            shown.add(str(message))
            Console().warn(str(message))

    with warnings.catch_warnings():
        warnings.simplefilter("always", MeshmatchWarning)
        warnings.showwarning = show
        yield
