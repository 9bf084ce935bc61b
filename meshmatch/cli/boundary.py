"""Run the command line: turn errors into messages and exit statuses, and warnings into messages.

Exit status: 0 success, 1 a problem with the user's data or options (also too little memory, or a folder without
permission), 2 a wrong command line, 130 interrupted, 143 killed by SIGTERM, 129 by SIGHUP. An exception that is not a
`MeshmatchError` is a bug and keeps its traceback; with MESHMATCH_DEBUG=1, all errors do.
"""

import errno
import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

from meshmatch.cli.user_messages import Console, stdout_error
from meshmatch.errors import MeshmatchError, MeshmatchWarning, OptionError

DEBUG_VARIABLE = "MESHMATCH_DEBUG"
INTERRUPTED = 130
_SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
_DEFAULT_HANDLERS = (signal.SIG_DFL, signal.default_int_handler)
_MAY_BE_EMPTY = ("--blank", "--title", "--name", "--format")  # texts that are checked by their commands
_SAME_SIGNAL = 1.0  # seconds within which a second signal is ignored: `timeout` sends two


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line, by default with the arguments of the process, and return the exit status."""
    debug = os.environ.get(DEBUG_VARIABLE, "") not in ("", "0")
    with _kills_as_interrupts() as killed:
        try:
            status = _run(arguments)
            killed.over = True
        except (KeyboardInterrupt, Exception) as error:
            killed.over = True
            if debug:
                raise
            if isinstance(error, KeyboardInterrupt) or killed.number:  # a killed child process may raise first
                status = INTERRUPTED
            elif isinstance(error, MeshmatchError):
                Console().problem("error", error.message, error.hint)
                return 1
            elif _no_memory(error):
                Console().problem("error", "there is not enough memory for this", "use smaller shapes, or free memory")
                return 1
            elif isinstance(error, PermissionError) and error.filename:
                problem = f"cannot reach {os.fsdecode(error.filename)}: {error.strerror}"
                Console().problem("error", problem, "may you read and write there?")
                return 1
            else:
                raise
    if killed.number and status:
        status = 128 + killed.number
    if status == INTERRUPTED or (killed.number and status):
        with suppress(OSError):  # after SIGHUP, the terminal may be closed
            Console().problem("interrupted" if status == INTERRUPTED else "killed", "no file is half-written")
    return status


def _no_memory(error: BaseException) -> bool:
    """Whether an error means that memory ran out; torch raises a `RuntimeError` for it."""
    return isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and "can't allocate memory" in str(error))


class _Killed:
    """State of signal handling: the first signal received (0 for none), and whether the program is over."""

    number, over = 0, False


@contextmanager
def _kills_as_interrupts() -> Iterator["_Killed"]:
    """Inside the block, let SIGTERM and SIGHUP raise KeyboardInterrupt as Ctrl-C does, unless they have a handler.

    The first signal is recorded, since it may surface as another exception, for example inside an import.
    """
    killed = _Killed()
    received: list[float] = []
    owner = os.getpid()

    def stop(number: int, frame: Any) -> None:
        if os.getpid() != owner:  # a forked process: restore the default behaviour
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)
            return
        again = bool(received) and time.monotonic() - received[0] < _SAME_SIGNAL
        received.append(time.monotonic())
        killed.number = killed.number or number
        if not again and not killed.over:
            raise KeyboardInterrupt

    is_main_thread = threading.current_thread() is threading.main_thread()
    before = {number: signal.getsignal(number) for number in _SIGNALS if is_main_thread}
    replaced = {number: handler for number, handler in before.items() if handler in _DEFAULT_HANDLERS}
    for number in replaced:
        signal.signal(number, stop)
    try:
        yield killed
    finally:
        for number, handler in replaced.items():
            signal.signal(number, handler)


def _refuse_empty(words: Sequence[str]) -> None:
    """Raise `OptionError` for an empty argument: as a path it would mean the current folder."""
    for before, word in zip(["meshmatch", *words], words, strict=False):
        is_empty = word == "" or (word.startswith("--") and word.find("=") == len(word) - 1)
        if is_empty and (word[:-1] or before) not in _MAY_BE_EMPTY:
            what = f"{word[:-1]} is empty" if word else f"the argument after {before} is empty"
            raise OptionError(what, "is it a variable that is not set?")


def _run(arguments: Sequence[str] | None) -> int:
    from typer.main import get_command

    from meshmatch.cli.app import app
    from meshmatch.threads import set_threads

    _refuse_empty(sys.argv[1:] if arguments is None else arguments)
    set_threads(1)  # before NumPy reads it; commands raise it where they need more
    try:
        with _warnings_as_messages():
            # not app(...), which replaces sys.excepthook: bugs are to keep Python's own traceback
            get_command(app)(args=arguments, prog_name="meshmatch")
    except OSError as error:
        if error.errno != errno.ENOSPC or error.filename is not None:
            raise
        raise stdout_error(error) from error  # from --help or --version, which typer writes
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    return 0


@contextmanager
def _warnings_as_messages() -> Iterator[None]:
    """Inside the block, print each `MeshmatchWarning` once, as one line, regardless of Python's warning filters."""
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
