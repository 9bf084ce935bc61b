"""A folder of models that one process at a time changes, and what killed ones left behind in it.

A copy in the making is hidden, ``.NAME.HEX``; so is a model while it is being replaced, ``.NAME.replaced``.
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
_PATIENCE = 60.0  # seconds: a large model takes a few


@contextmanager
def changing(folder: Path, hint: str) -> Iterator[None]:
    """Let nobody else change the folder inside the block; what was left behind is cleared up before and after it.

    `OutputError` with this hint if the folder cannot be written, or another process does not come to its end.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot write {folder}: {error.strerror}", hint) from error
    with locked(_lock(folder), f"another process is changing the models in {folder}", hint, _PATIENCE):
        for each in folder.iterdir():
            if _COPY.fullmatch(each.name):
                _discard(each)
        _give_back(folder)
        try:
            yield
        finally:
            _give_back(folder)


def copy_for(folder: Path, name: str) -> Path:
    """Where a copy is made that has no name yet."""
    return folder / f".{name}.{os.urandom(4).hex()}"


def put(copy: Path, target: Path) -> None:
    """Give a copy its name, also where another model has it: killed at any moment, this leaves the old or the new one."""
    replaced = target.with_name(f".{target.name}{_REPLACED}")
    if os.path.lexists(target):
        os.rename(target, replaced)
    os.rename(copy, target)


def settle(folder: Path) -> None:
    """Wait for a change that is going on, and give a model that a kill left without its name that name back."""
    if _lock(folder).exists():
        with suppress(OutputError, OSError), locked(_lock(folder), "", "", _PATIENCE):
            _give_back(folder)


def needs_settling(folder: Path) -> bool:
    """Whether a model has lost its name, for the moment or by a kill."""
    return any(folder.glob(f".*{_REPLACED}"))


def _lock(folder: Path) -> Path:
    return folder.with_name(f"{folder.name}.lock")


def _give_back(folder: Path) -> None:
    """A model that was being replaced gets its name back if nothing took its place; else it goes."""
    for replaced in folder.glob(f".*{_REPLACED}"):
        target = replaced.with_name(replaced.name[1 : -len(_REPLACED)])
        if os.path.lexists(target):
            _discard(replaced)
        else:
            with suppress(OSError):  # the folder is not ours to write
                os.rename(replaced, target)


def _discard(path: Path) -> None:
    if path.is_symlink():
        path.unlink(missing_ok=True)
    else:
        shutil.rmtree(path, ignore_errors=True)
