"""Locks between processes that end with their owner, however it ends: nothing has to be removed after a kill."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from meshmatch.errors import OutputError


@contextmanager
def locked(path: Path, busy: str, hint: str, wait: float = 0.0) -> Iterator[None]:
    """Hold the lock of a file; wait for it up to so many seconds.

    Another holder may be of this process or of any other. `OutputError` with these words if there is one, or if the file
    cannot be made.
    """
    from filelock import FileLock, Timeout

    lock = FileLock(path, timeout=wait, thread_local=False)
    try:
        lock.acquire()
    except Timeout as error:
        raise OutputError(busy, hint) from error
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}", "choose another folder") from error
    try:
        yield
    finally:
        lock.release()
