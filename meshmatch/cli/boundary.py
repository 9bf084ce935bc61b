"""The only place where an error becomes words and an exit status.

0 done, 1 the user's data or choice, 2 usage, 130 interrupted, 143 killed by SIGTERM. Anything that is not a
`MeshmatchError` is a bug and keeps its traceback; with MESHMATCH_DEBUG=1 so does everything else.
"""

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from meshmatch.cli.words import Console
from meshmatch.errors import MeshmatchError

DEBUG_VARIABLE = "MESHMATCH_DEBUG"
INTERRUPTED, KILLED = 130, 143
_TWICE = 1.0  # seconds within which a second signal is the same one: `timeout` sends two


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line, by default the words after the process's name, and return its exit status."""
    debug = os.environ.get(DEBUG_VARIABLE, "") not in ("", "0")
    with _kill_as_interrupt() as killed:
        try:
            status = _run(arguments)
        except (KeyboardInterrupt, Exception) as error:
            if debug:
                raise
            if isinstance(error, KeyboardInterrupt) or killed():  # a process killed with this one may be missed first
                status = INTERRUPTED
            elif isinstance(error, MeshmatchError):
                Console().trouble("error", error.message, error.hint)
                return 1
            else:
                raise
    if killed() and status:
        status = KILLED
    if status in (INTERRUPTED, KILLED):
        Console().trouble("interrupted" if status == INTERRUPTED else "killed", "no file is half-written")
    return status


@contextmanager
def _kill_as_interrupt() -> Iterator[Callable[[], bool]]:
    """Inside, SIGTERM ends the program as Ctrl-C does (unless it has another handler); gives whether it came."""
    came: list[float] = []
    owner = os.getpid()

    def stop(number: int, frame: Any) -> None:
        if os.getpid() != owner:  # forked from this one: such a process ends as if nothing had been said
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)
            return
        again = bool(came) and time.monotonic() - came[0] < _TWICE
        came.append(time.monotonic())
        if not again:
            raise KeyboardInterrupt

    ours = threading.current_thread() is threading.main_thread()
    if not ours or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
        yield lambda: False
        return
    signal.signal(signal.SIGTERM, stop)
    try:
        yield lambda: bool(came)
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _run(arguments: Sequence[str] | None) -> int:
    from typer.main import get_command

    from meshmatch.cli.app import app
    from meshmatch.threads import set_threads

    set_threads(1)  # before NumPy reads it: whoever needs more asks for them
    try:
        # not app(...): that would replace sys.excepthook, and a bug keeps Python's own traceback
        get_command(app)(args=arguments, prog_name="meshmatch")
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    return 0
