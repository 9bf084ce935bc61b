"""The only place where an error becomes words and an exit status.

0 done, 1 the user's data or choice, 2 usage, 130 interrupted. Anything that is not a `MeshmatchError` is a bug and
keeps its traceback; with MESHMATCH_DEBUG=1 so does everything else.
"""

import os
from collections.abc import Sequence

from meshmatch.errors import MeshmatchError

DEBUG_VARIABLE = "MESHMATCH_DEBUG"
INTERRUPTED = 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status.

    Parameters
    ----------
    arguments : sequence of str, optional
        Words after the program's name; those of the process if not given.
    """
    debug = os.environ.get(DEBUG_VARIABLE, "") not in ("", "0")
    try:
        status = _run(arguments)
    except MeshmatchError as error:
        if debug:
            raise
        _tell("error", error.message, error.hint)
        return 1
    except KeyboardInterrupt:
        if debug:
            raise
        status = INTERRUPTED
    if status == INTERRUPTED:
        _tell("interrupted", "no file is half-written")
    return status


def _run(arguments: Sequence[str] | None) -> int:
    from typer.main import get_command

    from meshmatch.cli.app import app

    try:
        # not app(...): that would replace sys.excepthook, and a bug keeps Python's own traceback
        get_command(app)(args=arguments, prog_name="meshmatch")
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    return 0


def _tell(what: str, message: str, hint: str = "") -> None:
    from meshmatch.cli.voice import Voice

    Voice().trouble(what, message, hint)
