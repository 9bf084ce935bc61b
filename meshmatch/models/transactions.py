"""Atomic changes to a folder of models, by one process at a time, and recovery from processes that were killed.

An incomplete copy is hidden, as ``.NAME.HEX``; so is a model while it is being replaced, as ``.NAME.replaced``.
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from meshmatch.errors import OutputError
from meshmatch.locks import locked

_REPLACED = ".replaced"
_COPY = re.compile(r"\..+\.[0-9a-f]{8}")
_LOCK_TIMEOUT = 60.0  # seconds to wait for another process; copying a large model takes a few


@contextmanager
def exclusive_changes(folder: Path, hint: str) -> Iterator[None]:
    """Lock the folder for the block, and clean up after killed processes before and after it.

    `OutputError` with this hint if the folder cannot be written, or another process keeps the lock.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot write {folder}: {error.strerror}", hint) from error
    with locked(_lock_path(folder), f"another process is changing the models in {folder}", hint, _LOCK_TIMEOUT):
        for each in folder.iterdir():
            if _COPY.fullmatch(each.name):
                _discard(each)
        _restore(folder)
        try:
            yield
        finally:
            _restore(folder)


def incomplete_path(folder: Path, name: str) -> Path:
    """Hidden path for an incomplete copy of a model."""
    return folder / f".{name}.{os.urandom(4).hex()}"


def put_in_place(copy: Path, target: Path) -> None:
    """Move a copy to its final path, replacing a model there; a kill at any moment leaves either the old or the new one."""
    replaced = target.with_name(f".{target.name}{_REPLACED}")
    if os.path.lexists(target):
        os.rename(target, replaced)
    os.rename(copy, target)


def recover(folder: Path) -> None:
    """Wait for a change in progress, and restore a model that a killed process was replacing."""
    if _lock_path(folder).exists():
        with suppress(OutputError, OSError), locked(_lock_path(folder), "", "", _LOCK_TIMEOUT):
            _restore(folder)


def needs_recovery(folder: Path) -> bool:
    """Whether a model is being replaced, or a process was killed while replacing one."""
    return any(folder.glob(f".*{_REPLACED}"))


def _lock_path(folder: Path) -> Path:
    return folder.with_name(f"{folder.name}.lock")


def _restore(folder: Path) -> None:
    """Restore models whose replacement did not complete; delete replaced ones."""
    for replaced in folder.glob(f".*{_REPLACED}"):
        target = replaced.with_name(replaced.name[1 : -len(_REPLACED)])
        if os.path.lexists(target):
            _discard(replaced)
        else:
            with suppress(OSError):  # the folder is not writable
                os.rename(replaced, target)


def _discard(path: Path) -> None:
    if path.is_symlink():
        path.unlink(missing_ok=True)
    else:
        shutil.rmtree(path, ignore_errors=True)
