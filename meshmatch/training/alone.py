"""One training at a time writes to a folder."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import wraps
from pathlib import Path
from typing import Concatenate, ParamSpec, TypeVar

from meshmatch.locks import locked
from meshmatch.outputs import as_path, make_folder

CHECKPOINT = Path("checkpoint", "last.safetensors")  # in the model folder
P = ParamSpec("P")
Made = TypeVar("Made")


def alone(train: Callable[Concatenate[str | Path, P], Made]) -> Callable[Concatenate[str | Path, P], Made]:
    """Let a training make its output folder, and refuse a second one in it (`OutputError`) until the first ends or is
    killed. One that fails before it has written anything leaves no folder.
    """

    @wraps(train)
    def only(output: str | Path, *args: P.args, **kwargs: P.kwargs) -> Made:
        folder = (as_path(output) / CHECKPOINT).parent
        make_folder(folder)
        if os.environ.get("RANK", "0") != "0":  # of several processes the first holds the lock for all
            return train(output, *args, **kwargs)
        busy, hint = f"another training writes to {output}", "let it end, or choose another folder"
        with locked(folder / "lock", busy, hint), _removed_if_bare(folder):
            return train(output, *args, **kwargs)

    return only


@contextmanager
def _removed_if_bare(folder: Path) -> Iterator[None]:
    """Remove a checkpoint's folder, and the model's, after an error that left nothing in them but the lock."""
    try:
        yield
    except BaseException:
        with suppress(OSError):
            if [each.name for each in folder.iterdir()] == ["lock"]:
                (folder / "lock").unlink()
                folder.rmdir()
                folder.parent.rmdir()
        raise
