"""Locks between processes.

The system releases them when their owner ends, even if it is killed, so that none has to be removed.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from meshmatch.errors import OutputError


@contextmanager
def locked(path: Path, busy: str, hint: str, wait: float = 0.0) -> Iterator[None]:
    """Hold the lock of a file; wait for it for up to ``wait`` seconds.

    The lock excludes this process as well as others. `OutputError` with ``busy`` and ``hint`` if it is held elsewhere,
    or if the file cannot be created.
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
