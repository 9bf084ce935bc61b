"""Locks between processes that end with their owner, however it ends: nothing has to be removed after a kill."""

import errno
import os
import sys
import time
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from meshmatch.errors import OutputError

_HELD = (errno.EACCES, errno.EAGAIN, errno.EDEADLK)
_PAUSE = 0.05  # seconds between two tries
_open: weakref.WeakSet[IO[bytes]] = weakref.WeakSet()


@contextmanager
def locked(path: Path, busy: str, hint: str, wait: float = 0.0) -> Iterator[None]:
    """Hold the lock of a file, which is made and stays; wait for it up to so many seconds.

    Another holder may be of this process or of any other. `OutputError` with these words if there is one, or if the file
    cannot be made; where the file system knows no locks there are none.
    """
    try:
        file = path.open("a+b")
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}", "choose another folder") from error
    with file:
        _open.add(file)
        until = time.monotonic() + wait
        while not _take(file):
            if time.monotonic() >= until:
                raise OutputError(busy, hint)
            time.sleep(_PAUSE)
        yield  # closing the file gives the lock back


def _take(file: IO[bytes]) -> bool:
    """Whether the lock is ours now."""
    try:
        if sys.platform == "win32":
            import msvcrt

            file.seek(0)
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        return error.errno not in _HELD
    return True


def _let_go() -> None:
    """In a forked process: it shares the lock, and could outlive the one that holds it."""
    for file in tuple(_open):
        file.close()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_let_go)
